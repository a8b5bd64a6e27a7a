"""The best parameters of a run: which are kept, when, and that they are the ones that are played.

Mutants that must die here: the last kept in place of the best · of equals the later kept · the newest parameters handed
out as the best · a resumed run that forgets what its best was · more than one kept on the disk · statistics of
observations left out.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neuralq.apps.cli import main
from neuralq.learners import RolloutSettings
from neuralq.q import MLP
from neuralq.runs import RunConfig, evaluate_run, load, resume, train
from neuralq.runs import loop as training
from neuralq.runs.evaluation import Evaluation
from neuralq.runs.folder.best import Best, keep_best, load_best
from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.session import Session

CONFIG = RunConfig(
    total_steps=64, evaluate_every=16, evaluation_episodes=2, log_every=64, checkpoint_every=16, body=MLP((4,)),
    rollout=RolloutSettings(num_envs=2, num_steps=4),
)  # fmt: skip


def scripted(monkeypatch: pytest.MonkeyPatch, scores: list[float]) -> list[torch.Tensor]:
    """Evaluations score these numbers, one after another; the parameters at each are collected."""
    seen: list[torch.Tensor] = []

    def play(session: Session, seed: int) -> Evaluation:
        seen.append(session.learner.engine.flat.values.clone())
        return Evaluation((scores[len(seen) - 1],), (1,), 0)

    monkeypatch.setattr(Session, "play_greedily", play)
    return seen


def test_the_first_of_the_highest_evaluations_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = scripted(monkeypatch, [5.0, 9.0, 9.0, 7.0])
    train(CONFIG, tmp_path / "run")
    best = load_best(tmp_path / "run")
    assert len(seen) >= 4 and len({str(values) for values in seen[:4]}) == 4
    assert best.greedy_return == 9.0 and 32 <= best.env_steps < 48
    torch.testing.assert_close(best.parameters, seen[1], rtol=0, atol=0)
    assert len(list((tmp_path / "run" / "best").iterdir())) == 1

    def parameters(wanted: bool) -> list[float]:
        q = load(tmp_path / "run", best=wanted).q
        return sorted(x for p in q.parameters() for x in p.detach().reshape(-1).tolist())  # type: ignore[attr-defined]

    assert parameters(True) == sorted(seen[1].tolist())
    assert parameters(False) == sorted(seen[3].tolist()) != parameters(True)


def test_a_resumed_run_knows_its_best(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = scripted(monkeypatch, [5.0, 9.0, 3.0, 2.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.0])
    train(CONFIG, tmp_path / "run")
    resume(tmp_path / "run", total_steps=128)
    assert len(seen) >= 7
    torch.testing.assert_close(load_best(tmp_path / "run").parameters, seen[1], rtol=0, atol=0)


def test_keeping_changes_nothing_in_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = train(CONFIG, tmp_path / "kept")
    monkeypatch.setattr(training, "keep_best", lambda *_: None)
    assert train(CONFIG, tmp_path / "not").parameters_sha256 == kept.parameters_sha256
    with pytest.raises(CheckpointError, match="has kept no best parameters: it was not evaluated yet"):
        evaluate_run(tmp_path / "not", 1, best=True)


def test_statistics_of_observations_are_kept_along(tmp_path: Path) -> None:
    statistics = {"observation_mean": np.array([1.0, 2.0]), "observation_count": np.array([3.0])}
    keep_best(tmp_path, Best(10, 1.5, torch.arange(3.0), statistics))
    best = load_best(tmp_path)
    assert (best.env_steps, best.greedy_return) == (10, 1.5) and best.parameters.tolist() == [0.0, 1.0, 2.0]
    assert best.normalisation is not None
    assert {name: value.tolist() for name, value in best.normalisation.items()} == {
        "observation_mean": [1.0, 2.0], "observation_count": [3.0],
    }  # fmt: skip


def test_a_folder_with_something_else_is_refused(tmp_path: Path) -> None:
    from neuralq.runs.folder import checkpoint

    checkpoint.save(tmp_path / "best", 3, {"other": 1})
    with pytest.raises(CheckpointError, match="holds no parameters"):
        load_best(tmp_path)


def test_the_command_says_which_parameters_played(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train(CONFIG, tmp_path / "run")
    for words, named in ([], "newest"), (["--best"], "best"):
        assert main(["evaluate", str(tmp_path / "run"), "--episodes", "2", "--json", *words]) == 0
        assert json.loads(capsys.readouterr().out)["parameters"] == named


@pytest.mark.slow
def test_the_end_of_a_run_names_a_best_that_was_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--preset", "false", "--total-steps", "32", "--evaluate-every", "16", "--hidden", "4"]
    words += ["--rollout.num-envs", "2", "--rollout.num-steps", "4"]
    for name, scores in (("lost", [9.0, 2.0, 2.0]), ("kept", [2.0, 9.0, 9.0])):
        scripted(monkeypatch, scores)
        assert main(["train", "CartPole-v1", *words, "--run-dir", str(tmp_path / name)]) == 0
        said = f"the best evaluation scored 9.0: neuralq evaluate {tmp_path / name} --best"
        assert (said in capsys.readouterr().out) is (name == "lost")

"""The best parameters of a run: which are kept, when, and that they are the ones that are played.

Mutants that must die here: the last kept in place of the best · of equals the later kept · the newest parameters handed
out as the best · a resumed run that forgets what its best was · more than one kept on the disk · statistics of
observations left out · the best kept for one lucky evaluation · both played on other episodes, or not at all · what was
learned, or the statistics, changed by playing · a run that goes on from its best in place of its last.
"""

from __future__ import annotations

import copy
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
from neuralq.runs.folder.checkpoint import CheckpointError, load_newest
from neuralq.runs.play_off import play_off
from neuralq.runs.recipe.build import build_session
from neuralq.runs.report.comparison import read_groups
from neuralq.runs.session import Session
from neuralq.runs.stop_request import StopRequest

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


def by_parameters(monkeypatch: pytest.MonkeyPatch, score: Callable[[torch.Tensor], float]) -> list[tuple[int, int]]:
    """Play-offs score what ``score`` says of the parameters; how many episodes were played from which seed."""
    played: list[tuple[int, int]] = []

    def play(session: Session, num_episodes: int, seed: int) -> Evaluation:
        played.append((num_episodes, seed))
        returns = [score(session.learner.engine.flat.values) + 0.1 * (i % 2) for i in range(num_episodes)]
        return Evaluation(tuple(returns), (1,) * num_episodes, 0)

    monkeypatch.setattr(Session, "_play", play)
    return played


def flat_parameters(agent: Any) -> list[float]:
    return sorted(x for p in agent.q.parameters() for x in p.detach().reshape(-1).tolist())


def test_a_run_that_ends_below_its_best_keeps_the_better(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = scripted(monkeypatch, [5.0, 9.0, 9.0, 7.0, 9.5])
    played = by_parameters(monkeypatch, lambda values: 9.0 if torch.equal(values, seen[1]) else 7.0)
    run = train(CONFIG, tmp_path / "run")
    assert run.agent == "best" and run.greedy_return == 7.0 and run.play_off is not None
    assert run.play_off["difference"] == pytest.approx(2.0) and run.play_off["best_return"] == pytest.approx(9.05)
    assert played[::2] == played[1::2] and len(set(played[::2])) == len(played) // 2  # both met the same, each anew
    episodes = 2 * -(-(run.env_steps // 2) // 4)  # of one step each, two of each agent a round: half of training
    assert run.play_off["num_episodes"] == sum(n for n, _ in played[::2]) == episodes
    error = 0.05 / (episodes - 1) ** 0.5  # of 9 and 9.1 in turn
    assert run.agent_return == pytest.approx(9.05) and run.agent_standard_error == pytest.approx(error)
    assert f"greedy return 9.1 ± {error:.2g} of the best parameters" in run.lines()[0]
    assert "(last evaluation 7.0)" in run.lines()[0]
    group = read_groups([tmp_path / "run"])[0][0].plain()
    assert group["agent_returns"] == [pytest.approx(9.05)] == [group["iqm"]] and group["greedy_returns"] == [7.0]
    assert run.parameters_sha256 == resume_sha(tmp_path / "run")
    for best, kept in (None, seen[1]), (True, seen[1]), (False, seen[3]):
        assert flat_parameters(load(tmp_path / "run", best)) == sorted(kept.tolist())
    again = resume(tmp_path / "run", total_steps=80)  # from where it ended, and decides anew
    assert again.agent == "final" and again.play_off is None and again.agent_return == again.greedy_return == 9.5
    assert flat_parameters(load(tmp_path / "run")) == sorted(seen[4].tolist())


def resume_sha(path: Path) -> str:
    """Of the parameters in the newest checkpoint."""
    state = load_newest(path / "checkpoints").state["learner"]
    values = state["parameters"] if "parameters" in state else state["descent"]["parameters"]
    return hashlib.sha256(np.asarray(values).tobytes()).hexdigest()


def test_a_lucky_evaluation_is_no_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = scripted(monkeypatch, [5.0, 9.0, 9.0, 7.0])
    by_parameters(monkeypatch, lambda values: 7.0)
    run = train(CONFIG, tmp_path / "run")
    assert run.agent == "final" and run.play_off is not None and "not better beyond chance" in " ".join(run.lines())
    assert flat_parameters(load(tmp_path / "run")) == sorted(seen[3].tolist())
    shutil.rmtree(tmp_path / "run" / "best")
    assert load(tmp_path / "run") is not None


def test_the_rule_needs_more_than_the_standard_error() -> None:
    """Differences 0 and 2 in turn: mean 1, standard error √(n/(n−1))/√n = 1/√(n−1), which is 1 for n = 2."""

    def agent(shift: float, most_steps: int) -> str:
        def best(num: int, seed: int) -> Evaluation:
            return Evaluation(tuple(2.0 * (i % 2) + shift for i in range(num)), (1,) * num, 0)

        def final(num: int, seed: int) -> Evaluation:
            return Evaluation((0.0,) * num, (1,) * num, 0)

        return str(play_off(final, best, 2, most_steps, 0)["agent"])

    ups = play_off(
        lambda n, at: Evaluation((4.0,) * n, (1,) * n, 0), lambda n, at: Evaluation((3.0, 5.0), (1, 1), 0), 2, 1, 0
    )
    assert (ups["final_standard_error"], ups["best_standard_error"]) == (0.0, pytest.approx(1.0))
    assert (agent(0.0, 1), agent(0.001, 1), agent(0.0, 5)) == ("final", "best", "best")


def test_playing_with_others_leaves_everything_as_it_was(tmp_path: Path) -> None:
    config = RunConfig(learner="streaming", total_steps=32, body=MLP((4,), layer_norm=True), epsilon_end=0.0)
    session = build_session(config)
    session.advance(32, StopRequest())
    seen = session.stream.normalisation
    assert seen is not None
    parameters, statistics = session.learner.engine.flat.values.clone(), copy.deepcopy(seen.state_dict())
    other = {name: value + 1.0 for name, value in statistics.items()}
    with session.playing_with(Best(1, 0.0, parameters + 1.0, other)):
        assert torch.equal(session.learner.engine.flat.values, parameters + 1.0)
        assert np.array_equal(seen.state_dict()["observation_mean"], other["observation_mean"])
    assert torch.equal(session.learner.engine.flat.values, parameters)
    assert all(np.array_equal(value, statistics[name]) for name, value in seen.state_dict().items())
    session.close()


def test_an_agent_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = scripted(monkeypatch, [5.0, 9.0, 9.0, 7.0])
    by_parameters(monkeypatch, lambda values: 9.0 if torch.equal(values, seen[1]) else 7.0)
    train(CONFIG, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "best")
    with pytest.raises(CheckpointError, match="these are the run's agent, --final takes the last"):
        load(tmp_path / "run")
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "1", "--final"]) == 0


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
    for words, named in ([], "final"), (["--best"], "best"), (["--final"], "final"):
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
        assert ("it ended below its best evaluation, at 16 steps" in capsys.readouterr().out) is (name == "lost")

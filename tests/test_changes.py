"""Runs that go on otherwise than they began: what may change, that it does, and that it is kept and said.

Mutants that must die here: a step size that is stored and not used · one that is used and not stored · a checkpoint or
the best parameters that can no longer be read after a change · a period that changes only at its next turn · a change
that is not kept, or kept without its old value · a change that makes another run of it and is taken.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from neuralq.apps.cli import main
from neuralq.learners import OnlineSettings, ReplaySettings, RolloutSettings
from neuralq.q import MLP
from neuralq.runs import RunConfig, evaluate_run, load, resume, train
from neuralq.runs.folder.checkpoint import CheckpointError, load_newest
from neuralq.runs.folder.run_folder import read_changes, read_config, read_metrics, read_summary

Capture = pytest.CaptureFixture[str]
LEARNERS = {
    "rollout": {"rollout": RolloutSettings(num_envs=2, num_steps=8, optimiser="sgd")},
    "replay": {"learner": "replay", "replay": ReplaySettings(learning_starts=20, batch_size=8, optimiser="sgd")},
    "online": {"learner": "online", "online": OnlineSettings()},
}
NAMES = {"rollout": "learning_rate", "replay": "replay.learning_rate", "online": "step_size"}


def configuration(**given: Any) -> RunConfig:
    periods = {
        "total_steps": 64,
        "evaluate_every": 32,
        "evaluation_episodes": 1,
        "checkpoint_every": 32,
        "log_every": 32,
    }
    more = {"env": "MountainCar-v0", "evaluation_max_steps": 5, "body": MLP((4,)), "epsilon_decay_steps": 32}
    return RunConfig(**{**periods, **more, **given})


def parameters(path: Path) -> torch.Tensor:
    learner = load_newest(path / "checkpoints").state["learner"]
    return learner["descent"]["parameters"] if "descent" in learner else learner["parameters"]


@pytest.mark.parametrize("learner", sorted(LEARNERS))
def test_a_step_size_is_used_from_where_it_was_changed_and_kept(tmp_path: Path, learner: str) -> None:
    path, field = tmp_path / "run", NAMES[learner].rpartition(".")[2]
    config = configuration(**LEARNERS[learner])
    train(config, path)
    before, old = parameters(path), getattr(config.settings, field)
    resume(path, 128, **{NAMES[learner]: 1e-30})  # too small for float32 to move anything by
    assert torch.equal(parameters(path), before)
    assert read_config(path)[learner][field] == 1e-30
    (row,) = read_changes(path)
    assert row["env_steps"] == 64 and row["changes"] == {f"{learner}.{field}": [old, 1e-30], "total_steps": [64, 128]}
    assert read_summary(path)["changes"] == [row]
    config_file = path / "config.json"
    kept = config_file.read_text()
    config_file.write_text(kept.replace("1e-30", "2e-30"))
    with pytest.raises(CheckpointError, match="is of another configuration"):  # nobody asked for that one
        resume(path, 192)
    config_file.write_text(kept)
    resume(path, 192, **{NAMES[learner]: old})
    assert not torch.equal(parameters(path), before)
    assert evaluate_run(path, 1, best=True).returns and load(path).predict([-0.5, 0.0]) in (0, 1, 2)


def test_the_same_values_are_no_change_and_new_periods_begin_at_once(tmp_path: Path) -> None:
    config = configuration(**LEARNERS["rollout"])
    whole = train(configuration(**LEARNERS["rollout"], evaluate_every=500, total_steps=128), tmp_path / "whole")
    train(config, tmp_path / "run")
    with pytest.warns(UserWarning, match="nothing is left to do"):
        resume(tmp_path / "run", 64, learning_rate=config.settings.learning_rate)
    assert not (tmp_path / "run" / "changes.jsonl").exists()
    resume(tmp_path / "run", 128, evaluate_every=16)
    rows = [row["env_steps"] for row in read_metrics(tmp_path / "run") if row["kind"] == "evaluation"]
    assert rows == [32, 64, 80, 96, 112, 128]
    assert load_newest(tmp_path / "run/checkpoints").step == 128  # evaluations change nothing
    assert torch.equal(parameters(tmp_path / "run"), parameters(tmp_path / "whole")) and whole.env_steps == 128


def test_changes_from_the_shell_are_kept_said_and_refused_where_they_make_another_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    train(configuration(**LEARNERS["replay"]), "run")
    words = ["--set", "total-steps=96", "--set", "learning_rate=0.01", "--set", "stop_at_return=none"]
    assert main(["resume", "run", *words, "--set", "evaluation_episodes=2"]) == 0
    captured = capsys.readouterr()
    told = "changed at 64 environment steps: evaluation_episodes 1 → 2, replay.learning_rate 0.0005 → 0.01, total_steps"
    assert f"{told} 64 → 96; what is learned from there on is not what a run that was never" in captured.out
    assert main(["resume", "run", "--set", "total_steps=100", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["env_steps"] == 100
    for wrong, said in (
        (
            "gamma=0.5",
            "gamma cannot be changed where a run on an environment goes on: it would be another run; what can is",
        ),
        ("rollout.learning_rate=1", "rollout.learning_rate cannot be changed"),
        ("learning_rate=fast", "--set replay.learning_rate: must be a number, got fast"),
        ("learning_rate", "--set takes key=value, got 'learning_rate'; e.g. --set total_steps=100000"),
        ("replay.dqrc_learning_rate=1", "dqrc_learning_rate"),
        ("total_steps=5", "total_steps=5 is less than what run has spent, 100"),
    ):
        assert main(["resume", "run", "--set", wrong]) != 0
        error = capsys.readouterr().err
        assert said in error and "Traceback" not in error, error
        if wrong.startswith("gamma"):
            assert "replay.learning_rate" in error and "rollout." not in error
    assert main(["resume", "run", "--set", "total_steps=1", "--total-steps", "1"]) == 2
    assert "given twice" in capsys.readouterr().err

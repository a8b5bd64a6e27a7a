"""Weights & Biases, told by a module that only notes what it is asked, and by the package itself where there is one.

Mutants that must die here: the record's id not kept for the resumed run · texts and lists logged as numbers · steps
left out · the record not ended · the command that does not log.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neuralq.apps.cli import main
from neuralq.checks import MissingExtra
from neuralq.runs.hooks import WeightsAndBiases


class Record:
    def __init__(self, **asked: Any) -> None:
        self.asked = asked
        self.logged: list[dict[str, Any]] = []
        self.metrics: list[tuple[str, str]] = []
        self.is_finished = False

    def define_metric(self, name: str, step_metric: str) -> None:
        self.metrics.append((name, step_metric))

    def log(self, row: dict[str, Any]) -> None:
        assert not self.is_finished
        self.logged.append(row)

    def finish(self) -> None:
        self.is_finished = True


@pytest.fixture
def records(monkeypatch: pytest.MonkeyPatch) -> list[Record]:
    made: list[Record] = []

    def init(**asked: Any) -> Record:
        made.append(Record(**asked))
        return made[-1]

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    return made


def test_every_number_is_logged_at_its_step(tmp_path: Path, records: list[Record]) -> None:
    tracker = WeightsAndBiases(tmp_path / "run", {"seed": 3}, "mine")
    tracker({"kind": "train", "env_steps": 64, "loss": 0.5, "episode_return": None})
    tracker({"kind": "evaluation", "env_steps": 64, "greedy_return": 30.0, "returns": [30.0]})
    tracker.close()
    (record,) = records
    assert record.logged == [{"train/loss": 0.5, "env_steps": 64}, {"evaluation/greedy_return": 30.0, "env_steps": 64}]
    assert record.metrics == [("*", "env_steps")] and record.is_finished
    asked = record.asked
    assert (asked["project"], asked["name"], asked["config"], asked["resume"]) == ("mine", "run", {"seed": 3}, "allow")
    assert asked["dir"] == str(tmp_path / "run") and len(asked["id"]) == 16


@pytest.mark.slow
def test_a_run_and_its_continuation_are_one_record(tmp_path: Path, records: list[Record]) -> None:
    small = ["--preset", "false", "--rollout.num-envs", "2", "--rollout.num-steps", "16", "--hidden", "4"]
    small += ["--evaluation-episodes", "1", "--evaluate-every", "64", "--log-every", "32"]
    path = str(tmp_path / "run")
    assert main(["train", "CartPole-v1", *small, "--total-steps", "64", "--wandb", "--run-dir", path]) == 0
    assert main(["resume", path, "--total-steps", "128"]) == 0
    assert main(["train", "CartPole-v1", *small, "--total-steps", "64", "--run-dir", str(tmp_path / "other")]) == 0
    first, second = records
    assert first.asked["id"] == second.asked["id"] and first.asked["config"]["env"] == "CartPole-v1"
    assert first.is_finished and second.is_finished
    assert max(row["env_steps"] for row in first.logged) < min(row["env_steps"] for row in second.logged)
    assert any("evaluation/greedy_return" in row for row in second.logged)


def test_what_the_package_refuses_is_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class UsageError(Exception):
        """As the package raises without a login: no error of Python's own."""

    def init(**asked: Any) -> Record:
        raise UsageError("No API key configured. Use `wandb login` to log in.")

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    assert main(["train", "CartPole-v1", "--wandb", "--run-dir", str(tmp_path / "run")]) == 1
    said = capsys.readouterr().err
    assert "No API key configured" in said and "WANDB_MODE=offline" in said and "Traceback" not in said


@pytest.mark.slow
def test_the_package_itself_keeps_a_record_on_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb", reason="needs the extra wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    for _ in range(2):  # begun, and gone on with
        tracker = WeightsAndBiases(tmp_path, {"seed": 3})
        tracker({"kind": "train", "env_steps": 64, "loss": 0.5, "episode_return": None})
        tracker.close()
    name = (tmp_path / "wandb" / "neuralq-run-id").read_text()
    kept = list((tmp_path / "wandb").glob(f"offline-run-*/run-{name}.wandb"))
    assert kept and all(b"train/loss" in file.read_bytes() for file in kept)


def test_a_missing_package_is_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingExtra, match=r'pip install "neuralq\[wandb\]"'):
        WeightsAndBiases(tmp_path / "run", {})
    assert not (tmp_path / "run").exists()
    assert main(["train", "CartPole-v1", "--wandb", "--run-dir", str(tmp_path / "run")]) == 1
    assert 'pip install "neuralq[wandb]"' in capsys.readouterr().err

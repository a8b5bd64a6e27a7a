"""Kinds of runs: a system that trains is one folder and one line of the table, told by one that only counts.

Mutants that must die here: a kind that the loop, loading, resuming or a command does not ask the table for · a row
forgotten at the end of a budget that is no whole period, or one written twice · a new budget taken by the wrong field ·
an option of the outer settings that wins over the inner one's.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

import neuralq
from neuralq.apps.cli import main
from neuralq.runs import kinds
from neuralq.runs.folder.best import Best
from neuralq.runs.folder.checkpoint import load_newest
from neuralq.runs.folder.run_folder import RunFolder, RunFolderError, read_config, read_metrics, read_summary
from neuralq.runs.kinds import CommandLine, Kind, kind_in, kind_named
from neuralq.runs.loop import Plan, Progress
from neuralq.runs.stop_request import StopRequest

Capture = pytest.CaptureFixture[str]


@dataclass(frozen=True)
class Steps:
    """How to count.

    Args:
        num_games: as long as the schedule goes.
        at_once: games that are counted at once.
    """

    num_games: int = 40
    at_once: int = 1


@dataclass(frozen=True)
class Counting:
    """What to count.

    Args:
        steps: how.
        seed: of nothing.
        num_games: budget; None for the games of the schedule.
        names: of the games.
    """

    steps: Steps = field(default_factory=Steps)
    seed: int = 0
    num_games: int | None = None
    names: tuple[str, ...] = ("one",)

    def __post_init__(self) -> None:
        if self.steps.at_once < 1:
            raise ValueError(f"at_once must be at least 1, got {self.steps.at_once}")


class Counter:
    observed = None

    def __init__(self, config: Counting) -> None:
        self.config, self.count, self.closed = config, 0, False

    @property
    def amount(self) -> int:
        return self.count

    @property
    def env_steps(self) -> int:
        return 10 * self.count

    def advance(self, until: int, request: StopRequest) -> None:
        self.count += self.config.steps.at_once

    def training_row(self) -> dict[str, Any]:
        return {"half": self.count / 2}

    def evaluate(self, seed: int) -> tuple[dict[str, Any], Best | None]:
        return {"seed": seed}, None

    def require_finite(self) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return {"progress": {"of_its_own": [self.count]}, "count": self.count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        assert state["progress"]["of_its_own"] == [state["count"]]
        self.count = state["count"]

    def close(self) -> None:
        self.closed = True


@dataclass(frozen=True)
class Counted:
    run_dir: Path
    env_steps: int
    interrupted_by: str | None

    def plain(self) -> dict[str, Any]:
        return dataclasses.asdict(self) | {"run_dir": str(self.run_dir), "kind": "counting"}

    def lines(self) -> list[str]:
        return [f"counted {self.env_steps}"]


def from_plain(plain: Mapping[str, Any]) -> Counting:
    values = {name: value for name, value in plain.items() if name not in ("kind", "steps")}
    return Counting(Steps(**plain.get("steps", {})), **{**values, "names": tuple(values.get("names", ("one",)))})


def plan(config: Counting) -> Plan:
    return Plan("games", config.num_games or config.steps.num_games, 25, 20, 10, config.seed, log_whole_periods=True)


def result(config: Counting, counter: Counter, progress: Progress, folder: RunFolder) -> Counted:
    return Counted(folder.path, counter.env_steps, progress.interrupted_by)


def measure(argv: list[str]) -> int:
    print("measured", *argv)
    return 0


COUNTING = Kind(
    name="counting",
    title="a counting run",
    config=Counting,
    budget="num_games",
    to_plain=lambda config: {"kind": "counting", **dataclasses.asdict(config), "names": list(config.names)},
    from_plain=from_plain,
    default_path=lambda config: Path("runs/counting"),
    num_threads=lambda config: 1,
    build=Counter,
    plan=plan,
    result=result,
    load=lambda path, best: load_newest(path / "checkpoints").state["count"],
    notes=lambda config, latest: [],
    command=CommandLine(
        "Count.", ("neuralq train counting --games 3",), {"num_games": "games"}, f"{__name__}:measure", ("--counts",),
        "left alone: {run}",
    ),
)  # fmt: skip


@pytest.fixture(autouse=True)
def in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(kinds.KINDS, "counting", f"{__name__}:COUNTING")
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])


def rows(path: Path, kind: str) -> list[int]:
    return [row["games"] for row in read_metrics(path) if row["kind"] == kind]


def test_a_kind_of_ones_own_is_trained_resumed_and_loaded(tmp_path: Path) -> None:
    run = COUNTING.train(Counting(num_games=32), tmp_path / "run")
    assert kind_in(tmp_path / "run") == "counting" and kind_named("counting") is COUNTING
    assert run.env_steps == 320 and neuralq.load(tmp_path / "run") == 32
    assert rows(tmp_path / "run", "train") == [10, 20, 30, 32]  # at whole periods and at the end
    assert rows(tmp_path / "run", "evaluation") == [25, 32]
    first = read_metrics(tmp_path / "run")[0]
    assert list(first) == [
        "kind", "env_steps", "games", "cpu_seconds", "wall_seconds", "games_per_second", "half",
    ]  # fmt: skip
    with pytest.warns(UserWarning, match="nothing is left to do: .* has spent its budget of 32 games"):
        assert neuralq.resume(tmp_path / "run") == run  # finished, and stays as it is
    assert COUNTING.resume(tmp_path / "run", 45).env_steps == 450
    assert rows(tmp_path / "run", "train") == [10, 20, 30, 32, 40, 45]
    assert read_config(tmp_path / "run")["num_games"] == 45 and read_summary(tmp_path / "run")["env_steps"] == 450


def test_units_that_come_several_at_a_time_keep_the_periods(tmp_path: Path) -> None:
    COUNTING.train(Counting(Steps(33, at_once=4)), tmp_path / "run")
    assert rows(tmp_path / "run", "train") == [12, 20, 32, 36]
    assert rows(tmp_path / "run", "evaluation") == [28, 36]


def test_the_best_of_a_run_without_scores_is_not_kept_and_its_checkpoint_has_no_score(tmp_path: Path) -> None:
    COUNTING.train(Counting(num_games=5), tmp_path / "run")
    saved = load_newest(tmp_path / "run" / "checkpoints").state["progress"]
    assert not (tmp_path / "run" / "best").exists()
    assert saved["of_its_own"] == [5] and saved["finished"] is True
    assert not {"greedy_return", "best_return"} & set(saved)


def test_an_unknown_kind_is_refused(tmp_path: Path) -> None:
    RunFolder.create(tmp_path / "run", config={"kind": "singing"}, seed=0).close()
    for ask in (neuralq.load, neuralq.resume):
        with pytest.raises(RunFolderError, match="of the kinds control, td-gammon, counting, got 'singing'"):
            ask(tmp_path / "run")


def test_its_commands(tmp_path: Path, capsys: Capture) -> None:
    path = str(tmp_path / "run")
    assert main(["train", "counting", "--games", "12", "--at-once", "2", "--names", "a", "b", "--run-dir", path]) == 0
    assert capsys.readouterr().out.splitlines() == ["counted 120", f"run folder {path}"]
    assert read_config(path) == {
        "kind": "counting", "steps": {"num_games": 12, "at_once": 2}, "seed": 0, "num_games": None, "names": ["a", "b"],
    }  # fmt: skip
    assert main(["resume", path, "--games", "14", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["env_steps"] == 140
    again = str(tmp_path / "again")
    assert main(["train", "counting", "--config", f"{path}/config.json", "--games", "3", "--run-dir", again]) == 0
    assert capsys.readouterr().out.startswith("counted 40")  # not the 14 of the run
    for words in (["evaluate", path], ["evaluate", "--counts", "--help"]):
        assert main(words) == 0
        assert capsys.readouterr().out.startswith("measured")
    assert main(["train", "counting", "--help"]) == 0
    shown = capsys.readouterr().out
    assert "games that are counted at once (default: 1)" in shown and "neuralq train counting --games 3" in shown


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("report RUN", "RUN is a counting run, which is left alone: RUN"),
        ("compare RUN", "RUN is a counting run, which is left alone: RUN"),
        ("resume RUN --total-steps 9", "--total-steps is not for a counting run like RUN; leave it out"),
        ("resume RUN --hook a:b", "--hook is not for a counting run like RUN; leave it out"),
        ("train counting --at-once 0", "--at-once must be at least 1, got 0"),
        ("train counting --at-once many", "--at-once must be a whole number, got many"),
    ],
)
def test_what_is_not_for_it_is_refused_in_one_line(words: str, said: str, tmp_path: Path, capsys: Capture) -> None:
    path = str(tmp_path / "run")
    COUNTING.train(Counting(num_games=2), path)
    assert main(words.replace("RUN", path).split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said.replace("RUN", path) in line

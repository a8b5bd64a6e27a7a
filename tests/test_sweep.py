"""Sweeps: many seeds in processes of their own, told by children that only pretend to train.

Mutants that must die here: a failed seed that stops the others, or is not named · a missed target taken for a failure ·
a finished seed run again · a failed or stopped one not tried again · more processes than asked for · a child that goes
on when its parent is killed · a signal that is not passed on · more threads than the configuration says · a seed that
uses another seed's number · an interval over seeds that have not finished.
"""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from neuralq import train, with_preset
from neuralq.apps.cli import main, sweeps
from neuralq.apps.cli.sweeps import sweep_bar
from neuralq.runs.folder.files import FolderLock, read_json
from neuralq.runs.folder.run_folder import RunFolderBusy, RunFolderError, read_metrics, read_summary
from neuralq.runs.recipe.config import config_to_dict
from neuralq.runs.sweep import (
    Asked,
    Ended,
    LocalProcesses,
    Status,
    Sweep,
    Task,
    ask,
    create_sweep,
    is_sweep_folder,
    open_sweep,
    read_asked,
    run_sweep,
    share_of,
    state_of,
)
from neuralq.runs.sweep import engine as engine_module
from neuralq.runs.sweep import folder as folder_module
from neuralq.runs.sweep.scripts import REQUEUE
from neuralq.runs.sweep.states import forget_failure, note_failure

CONFIG = {"env": "CartPole-v1", "total_steps": 1000, "threads": 1}
ASKED = Asked({"env": "CartPole-v1", "total_steps": 1000}, {"gamma": [0.9, 0.99]}, (0, 1))


class Pretender:
    """An engine whose runs end at once, each as it is told to: by the number of its seed, or of the others.

    "finish", "fail", "die", "miss" the target, "reach" it early, "vanish" without a word, "advance" once and vanish,
    "wait" until the end is asked for.
    """

    title = "pretended"

    def __init__(self, num_workers: int = 2, **behaviours: str) -> None:
        self.num_workers, self.behaviours = num_workers, behaviours
        self.asked: list[int] = []
        self.waiting: list[Task] = []
        self.ended: list[Ended] = []
        self.most = 0

    def has_room(self) -> bool:
        return len(self.waiting) + len(self.ended) < self.num_workers

    def start(self, task: Task) -> None:
        seed, path, total = int(task.config["seed"]), task.path, int(task.config["total_steps"])
        self.asked.append(seed)
        behaviour = self.behaviours.get(f"s{seed}", self.behaviours.get("others", "finish"))
        if behaviour == "refuse":
            raise OSError("no room for a process")
        path.mkdir(parents=True, exist_ok=True)
        forget_failure(path)
        (path / "run.json").write_text(json.dumps({"format": "neuralq-run", "version": 1, "seed": seed}))
        reason = ""
        if behaviour == "wait":
            line = json.dumps({"kind": "train", "env_steps": total // 4}) + "\n{half"
            (path / "metrics.jsonl").write_text(line)
            self.waiting.append(task)
            return
        if behaviour == "fail":
            note_failure(path, "the world ended")
        elif behaviour == "die":
            reason = "killed by SIGKILL"
        elif behaviour == "advance":
            step = 1000 * self.asked.count(seed)
            (path / "checkpoints" / f"step-{step:012d}").mkdir(parents=True)
            if step == 5000:
                self.end(path, seed, total)
        elif behaviour in ("miss", "reach"):
            self.end(path, seed, total if behaviour == "miss" else total // 5, reached=behaviour == "reach")
        elif behaviour != "vanish":
            self.end(path, seed, total)
        self.ended.append(Ended(task, reason))

    def end(self, path: Path, seed: int, steps: int, **more: Any) -> None:
        (path / "metrics.jsonl").write_text(json.dumps({"kind": "train", "env_steps": steps}) + "\n")
        summary = {"env_steps": steps, "greedy_return": 10.0 * seed, "cpu_seconds": 1.0, "reached": None}
        summary |= {"interrupted_by": None, "parameters_sha256": "0" * 64, **more}
        (path / "summary.json").write_text(json.dumps(summary))

    def collect(self, seconds: float) -> list[Ended]:
        self.most = max(self.most, len(self.running()))
        ended, self.ended = self.ended, []
        return ended

    def running(self) -> list[Task]:
        return [*self.waiting, *(one.task for one in self.ended)]

    def stop(self) -> None:
        for task in self.waiting:
            seed, total = int(task.config["seed"]), int(task.config["total_steps"])
            self.end(task.path, seed, total // 2, interrupted_by="SIGTERM")
            self.ended.append(Ended(task))
        self.waiting = []

    def close(self) -> None:
        self.waiting = []


def a_sweep(tmp_path: Path, num_seeds: int = 4, **config: Any) -> Sweep:
    return create_sweep(tmp_path / "sweep", {**CONFIG, **config}, range(num_seeds))


def test_every_seed_runs_once_and_the_result_is_their_interquartile_mean(tmp_path: Path) -> None:
    sweep, engine, seen = a_sweep(tmp_path, 5), Pretender(), list[Status]()
    result = run_sweep(sweep, engine, seen.append)
    assert engine.asked == [0, 1, 2, 3, 4] and engine.most == 2
    assert [run.state for run in result.runs] == ["finished"] * 5
    assert result.returns == [0.0, 10.0, 20.0, 30.0, 40.0]
    plain = result.plain()
    assert plain["iqm"] == 20.0  # (10 + 20 + 30) / 3
    assert plain["low"] < 20.0 < plain["high"] and plain["num_finished"] == 5
    assert plain["runs"][3]["seed"] == 3 and plain["runs"][3]["env_steps"] == 1000
    assert read_json(sweep.path / "summary.json") == plain
    assert (seen[-1].env_steps, seen[-1].total_steps, seen[-1].num_finished) == (5000, 5000, 5)
    assert seen[-1].returns == {f"seed-{seed}": 10.0 * seed for seed in range(5)}


def test_a_seed_that_fails_is_named_with_its_reason_and_the_others_go_on(tmp_path: Path) -> None:
    sweep, engine = a_sweep(tmp_path, 5), Pretender(s1="fail", s2="die", s3="vanish", s4="refuse")
    result = run_sweep(sweep, engine)
    assert [run.state for run in result.runs] == ["finished", "failed", "failed", "failed", "failed"]
    assert [run.reason for run in result.runs] == [
        "", "the world ended", "killed by SIGKILL, 3 times over", "it ended before its end, 3 times over",
        "no room for a process",
    ]  # fmt: skip
    assert [engine.asked.count(seed) for seed in range(5)] == [1, 1, 3, 3, 1]
    assert [state_of(sweep.run_path(seed)).reason for seed in range(5)] == [run.reason for run in result.runs]
    assert result.returns == [0.0] and result.plain()["num_failed"] == 4


def test_a_run_that_dies_and_has_come_further_each_time_is_begun_again(tmp_path: Path) -> None:
    engine = Pretender(others="advance")
    assert [run.state for run in run_sweep(a_sweep(tmp_path, 1), engine).runs] == ["finished"]
    assert engine.asked == [0] * 5


def test_a_missed_target_is_no_failure_and_a_reached_one_ends_a_seed_early(tmp_path: Path) -> None:
    seen = list[Status]()
    result = run_sweep(a_sweep(tmp_path, 2, stop_at_return=475), Pretender(s0="miss", s1="reach"), seen.append)
    assert [run.state for run in result.runs] == ["finished", "finished"]
    assert [run.summary["env_steps"] for run in result.runs] == [1000, 200]
    assert seen[-1].env_steps == 2000, "a seed that ended early counts whole"
    assert not any(status.failed for status in seen)


def test_a_sweep_goes_on_where_it_stands(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path)
    run_sweep(sweep, Pretender(s1="fail", s2="die"))
    left = Pretender()
    assert run_sweep(open_sweep(sweep.path), left, retry_failed=False).plain()["num_failed"] == 2 and left.asked == []
    again = Pretender()
    assert [run.state for run in run_sweep(open_sweep(sweep.path), again).runs] == ["finished"] * 4
    assert again.asked == [1, 2], "finished seeds are left alone"
    none = Pretender()
    assert len(run_sweep(open_sweep(sweep.path), none).returns) == 4 and none.asked == []
    more = Pretender()
    result = run_sweep(open_sweep(sweep.path, 2000), more)
    assert more.asked == [0, 1, 2, 3] and {run.summary["env_steps"] for run in result.runs} == {2000}
    assert open_sweep(sweep.path).config["total_steps"] == 2000


def test_a_signal_is_passed_on_and_the_sweep_resumes(tmp_path: Path) -> None:
    sweep, steps = a_sweep(tmp_path, 3), []

    def watch(status: Status) -> None:
        steps.append(status.env_steps)
        os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    result = run_sweep(sweep, Pretender(others="wait"), lambda status: watch(status) if not steps else None)
    assert signal.getsignal(signal.SIGTERM) is before
    assert result.interrupted_by == "SIGTERM"
    assert [run.state for run in result.runs] == ["stopped"] * 3 and result.returns == []
    assert steps == [500], "two seeds at a quarter of 1000 steps; the half-written line is passed over"
    assert read_summary(sweep.run_path(0))["interrupted_by"] == "SIGTERM"
    assert not sweep.run_path(2).exists(), "nothing new is begun"
    engine = Pretender()
    assert len(run_sweep(sweep, engine).returns) == 3 and engine.asked == [0, 1, 2]


def test_asked_twice_it_ends_at_once(tmp_path: Path) -> None:
    def watch(status: Status) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_sweep(a_sweep(tmp_path, 1), Pretender(others="wait"), watch)


def test_one_process_runs_a_sweep(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path, 1)

    def watch(status: Status) -> None:
        with pytest.raises(RunFolderBusy, match=f"the sweep in {sweep.path} is being run by process {os.getpid()}"):
            run_sweep(sweep, Pretender())

    assert len(run_sweep(sweep, Pretender(), watch).returns) == 1


def test_a_run_that_another_process_is_at_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module, "_ELSEWHERE_SECONDS", 0.0)
    sweep, engine, looks = a_sweep(tmp_path, 2), Pretender(), list[Status]()
    sweep.run_path(0).mkdir(parents=True)
    lock = FolderLock(sweep.run_path(0) / "run.lock", "busy")
    assert sweep.state(next(sweep.members())).state == "running"

    def watch(status: Status) -> None:
        looks.append(status)
        assert engine.asked == [1] or len(looks) > 1
        lock.close()

    assert [run.state for run in run_sweep(sweep, engine, watch).runs] == ["finished"] * 2
    assert engine.asked == [1, 0] and sweep.state(next(sweep.members())).state == "finished"


def test_the_table_below_the_bar_has_the_best_combination_first() -> None:
    returns = {"gamma=0.9-0123abcd/seed-0": 1.0, "gamma=0.5-0123abce/seed-0": 3.0, "gamma=0.9-0123abcd/seed-1": 4.0}
    table = sweeps._cells(Status(0, 0, (), 3, (), returns))
    columns = [list(column.cells) for column in table.columns]
    assert columns == [["3.0", "2.5"], ["1", "2"], ["gamma=0.5", "gamma=0.9"]]


def test_shares_divide_a_sweep(tmp_path: Path) -> None:
    sweep = ask(tmp_path / "sweep", ASKED)
    shares = [[member.name for member in share_of(sweep, index, 3)] for index in range(3)]
    assert (
        sorted(name for share in shares for name in share) == sorted(member.name for member in sweep.members())
        and len(shares[0]) == 2
    )
    engine = Pretender()
    result = run_sweep(sweep, engine, members=share_of(sweep, 1, 3))
    assert len(result.runs) == 1 and not (sweep.path / "summary.json").exists(), "that is of the whole"
    for index, of in ((3, 3), (-1, 3), (0, 0)):
        with pytest.raises(ValueError, match="shares 0 to"):
            share_of(sweep, index, of)


def test_values_and_seeds_are_added_and_nothing_is_made_again(tmp_path: Path) -> None:
    sweep, engine = ask(tmp_path / "sweep", ASKED), Pretender()
    run_sweep(sweep, engine)
    assert engine.asked == [0, 0, 1, 1] and len(sweep) == 4
    more = ask(sweep.path, Asked(ASKED.base, {"gamma": [0.99, 0.95]}, (2, 0)))
    assert more.axes == {"gamma": [0.9, 0.99, 0.95]} and more.seeds == (0, 1, 2)
    again = Pretender()
    assert len(run_sweep(more, again).runs) == 9 and again.asked == [0, 1, 2, 2, 2]
    assert open_sweep(sweep.path).asked == more.asked
    assert ask(sweep.path, Asked(ASKED.base, ASKED.axes, (3,))).seeds == open_sweep(sweep.path).seeds == (0, 1, 2, 3)
    for base, axes, named in (
        ({**ASKED.base, "total_steps": 7}, ASKED.axes, "total_steps: 1000 there, 7 here"),
        (ASKED.base, {}, r"gamma: \[0.9, 0.99, 0.95\] there, 'nothing' here"),
        (ASKED.base, {**ASKED.axes, "seed": [1]}, "seed"),
    ):
        with pytest.raises(RunFolderError, match=named):
            ask(sweep.path, Asked(base, axes, (0,)))


def test_what_another_command_asks_for_at_the_same_moment_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep, check = ask(tmp_path / "sweep", ASKED), folder_module._check_cells

    def meanwhile(new: Sweep) -> None:
        monkeypatch.setattr(folder_module, "_check_cells", check)
        ask(sweep.path, Asked(ASKED.base, ASKED.axes, (7,)))

    monkeypatch.setattr(folder_module, "_check_cells", meanwhile)
    assert ask(sweep.path, Asked(ASKED.base, ASKED.axes, (8,))).seeds == (0, 1, 7, 8)
    lock = FolderLock(sweep.path / "sweep.lock", "busy")
    assert ask(sweep.path, ASKED).seeds == (0, 1, 7, 8), "nothing is to be written"
    with pytest.raises(RunFolderBusy, match="is being run by process"):
        ask(sweep.path, Asked(ASKED.base, ASKED.axes, (9,)))
    lock.close()


def test_each_run_gets_its_options_over_the_preset_of_its_environment(tmp_path: Path) -> None:
    base = {"env": "CartPole-v1", "total_steps": 1000, "hidden": "8", "learning_rate": 0.5}
    sweep = ask(tmp_path / "sweep", Asked({**base, "hidden": [8]}, {"lambda_": [0.1, 0.2]}, (3,)))
    tasks = [sweep.task(member) for member in sweep.members()]
    assert [task.config["rollout"]["lambda_"] for task in tasks] == [0.1, 0.2]
    assert {task.config["seed"] for task in tasks} == {3}
    assert {task.config["rollout"]["learning_rate"] for task in tasks} == {0.5}
    given = {"total_steps": 1000, "hidden": [8], "seed": 3, "learning_rate": 0.5, "lambda_": 0.1}
    assert tasks[0].config == json.loads(json.dumps(config_to_dict(with_preset("CartPole-v1", **given))))
    assert tasks[0].path == sweep.path / tasks[0].name and tasks[0].log_path.name == "seed-3.log"
    with pytest.raises(ValueError, match=r"gamma.*\(with gamma 2\)"):
        ask(tmp_path / "other", Asked({"env": "CartPole-v1"}, {"gamma": [0.5, 2]}, (0,)))
    assert not (tmp_path / "other").exists()


def test_of_very_many_combinations_each_value_is_tried_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neuralq.runs.sweep.folder._MOST_CHECKED", 3)
    base, axes = {"env": "CartPole-v1"}, {"gamma": [0.5, 0.9], "lambda_": [0.1, 0.2]}
    assert len(ask(tmp_path / "sweep", Asked(base, axes, (0,)))) == 4
    for name in axes:
        with pytest.raises(ValueError, match=f"with .*{name} 2"):
            ask(tmp_path / "other", Asked(base, {**axes, name: [*axes[name], 2]}, (0,)))


@pytest.mark.parametrize(
    ("value", "values"),
    [
        ({"from": 4, "to": 16, "step": 4}, [4, 8, 12, 16]),
        ({"from": 1, "to": 3}, [1, 2, 3]),
        ({"from": 3, "to": 1, "step": -1}, [3, 2, 1]),
        ({"from": 0.5, "to": 0.9, "count": 3}, [0.5, 0.7, 0.9]),
        ({"from": 1e-4, "to": 1e-2, "count": 3, "scale": "log"}, [1e-4, 1e-3, 1e-2]),
        ({"from": 0.1, "to": 0.3, "step": 0.1}, [0.1, 0.2, 0.3]),
        ([[64, 64], [32]], [[64, 64], [32]]),
        ([True, False], [True, False]),
    ],
)
def test_lists_and_ranges_are_axes(value: Any, values: list[Any]) -> None:
    asked = read_asked({"env": "X-v0", "rollout": {"some": value}, "gamma": 0.9, "seeds": {"from": 3, "to": 5}})
    assert asked.axes == {"some": values} and asked.base == {"env": "X-v0", "gamma": 0.9}
    assert asked.seeds == (3, 4, 5) and asked.num_cells == len(values)


def test_a_list_is_one_value_of_an_option_whose_values_are_lists() -> None:
    asked = read_asked({"env": "X-v0", "hidden": [64, 64], "wrappers": [["a:B"], []], "rules": [{"action": 1}]})
    assert asked.base == {"env": "X-v0", "hidden": [64, 64], "rules": [{"action": 1}]}
    assert asked.axes == {"wrappers": [["a:B"], []]}


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ({"gamma": []}, "gamma needs one value or more"),
        ({"gamma": [0.9, 0.9]}, "each named once"),
        ({"gamma": {"from": 1, "to": 2, "scale": "log", "count": 0}}, "count of gamma"),
        ({"gamma": {"from": 0, "to": 2, "scale": "log", "count": 3}}, "lies above 0"),
        ({"gamma": {"from": 0.1, "to": 0.2}}, "must be a range like"),
        ({"gamma": {"from": 1, "to": 2, "step": -1}}, "must be a range like"),
        ({"gamma": {"from": 1, "to": 2, "step": 0}}, "must be a range like"),
        ({"gamma": {"from": "a", "to": 2}}, "must be a range like"),
        ({"gamma": 1, "seeds": 0}, "seeds"),
        ({"gamma": 1, "seeds": 10**12}, "at most 10,000,000 runs, got 1,000,000,000,000 seeds"),
        ({"gamma": 1, "seeds": [1, 1]}, "each named once"),
        ({"gamma": 1, "seed": 1, "seeds": 2}, "seed and seeds"),
        ({"lambda": 1, "lambda_": 1}, "lambda_ is given twice"),
        ({"lambda": [1], "lambda_": [2]}, "lambda_ is given twice"),
        ({"a": {"from": 1, "to": 10_000}, "b": {"from": 1, "to": 10_000}}, "at most 10,000,000 runs"),
    ],
)
def test_what_no_sweep_can_be_is_refused_by_its_name(content: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        read_asked({"env": "X-v0", **content})


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + 30
    while not path.exists():
        assert time.monotonic() < deadline, path
        time.sleep(0.02)


def test_what_is_no_new_sweep_is_refused(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path, 1)
    assert is_sweep_folder(sweep.path) and not is_sweep_folder(tmp_path)
    with pytest.raises(RunFolderError, match=f"already holds a sweep; continue it with `neuralq resume {sweep.path}`"):
        create_sweep(sweep.path, CONFIG, [0])
    run_sweep(sweep, Pretender())
    with pytest.raises(RunFolderError, match="already holds a run"):
        create_sweep(sweep.run_path(0), CONFIG, [0])
    for seeds in ([], [1, 1]):
        with pytest.raises(ValueError, match="each named once"):
            create_sweep(tmp_path / "other", CONFIG, seeds)
    with pytest.raises(ValueError, match="seed must be a whole number"):
        create_sweep(tmp_path / "other", CONFIG, [-1])
    with pytest.raises(ValueError, match="num_workers"):
        LocalProcesses(0)
    with pytest.raises(RunFolderError, match="no sweep in"):
        open_sweep(tmp_path)
    for damage in ("{", "{}", '{"format": "other", "version": 1, "seeds": [], "options": []}'):
        (sweep.path / "sweep.json").write_text(damage)
        with pytest.raises(RunFolderError, match="cannot be read"):
            open_sweep(sweep.path)


def test_a_seed_stopped_at_its_last_step_has_not_finished(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path, 1)
    run_sweep(sweep, Pretender())
    summary = read_summary(sweep.run_path(0))
    (sweep.run_path(0) / "summary.json").write_text(json.dumps({**summary, "interrupted_by": "SIGTERM"}))
    engine = Pretender()
    assert len(run_sweep(sweep, engine).returns) == 1 and engine.asked == [0], "its last evaluation was missing"


def test_a_damaged_summary_is_a_seed_that_has_not_finished(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path, 1)
    run_sweep(sweep, Pretender())
    (sweep.run_path(0) / "summary.json").write_text("{")
    assert run_sweep(sweep, Pretender()).returns == [0.0]


# The command line.


def test_lines_for_people_and_their_pace(tmp_path: Path) -> None:
    out, now = io.StringIO(), [0.0]
    with sweep_bar(a_sweep(tmp_path, 3), out, lambda: now[0]) as bar:
        for second, status in (
            (0, Status(0, 3000, ("seed-0", "seed-1"), 0, (), {})),
            (5, Status(500, 3000, ("seed-0", "seed-1"), 0, (), {})),
            (11, Status(1100, 3000, ("seed-0", "seed-1"), 0, (), {})),
            (12, Status(2000, 3000, ("seed-2",), 1, ("seed-1",), {"seed-0": 50.0})),
        ):
            now[0] = float(second)
            bar(status)
    assert out.getvalue().splitlines() == [
        "19 s left · 0 of 3 seeds · 1,100 of 3,000 steps · 100 steps/s",
        "6 s left · 1 of 3 seeds · failed: 1 · 2,000 of 3,000 steps · 167 steps/s · IQM 50.0",
    ]


TRAIN = ["train", "CartPole-v1", "--preset", "false", "--total-steps", "1000", "--seed", "2", "--seeds", "3"]


def test_the_command_names_what_failed_and_resumes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sweep"
    monkeypatch.setattr(sweeps, "LocalProcesses", lambda *_: Pretender(s3="fail"))
    assert main([*TRAIN, "--run-dir", str(path)]) == 1
    captured = capsys.readouterr()
    assert f"seed 3: failed: the world ended (see {path}/seed-3.log)" in captured.out
    assert "interquartile mean over 2 seeds: 30.00, 95 % interval 20.00 to 40.00" in captured.out
    assert f"seed 3 failed, try again with: neuralq resume {path}" in captured.err.splitlines()[-1]
    assert main([*TRAIN, "--run-dir", str(path)]) == 1
    assert "already holds a sweep" in capsys.readouterr().err
    monkeypatch.setattr(sweeps, "LocalProcesses", lambda *_: Pretender())
    assert main(["resume", str(path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["iqm"] == 30.0 and [run["seed"] for run in result["runs"]] == [2, 3, 4]
    assert result["sweep_dir"] == str(path)


def test_the_command_says_which_seeds_missed_the_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sweeps, "LocalProcesses", lambda *_: Pretender(s2="miss", others="reach"))
    assert main([*TRAIN, "--stop-at-return", "475", "--run-dir", str(tmp_path / "sweep")]) == 1
    assert "the target of 475 was not reached by 1 seeds: 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["train", "CartPole-v1", "--seeds", "0"], "--seeds must be a whole number of at least 1, got 0"),
        (["train", "CartPole-v1", "--workers", "2"], "add --seeds or leave it out"),
        (["train", "CartPole-v1", "--seeds", "many"], "--seeds must be a whole number, got many"),
        (["resume", "/nowhere", "--workers", "2"], "--workers is for a sweep"),
    ],
)
def test_wrong_usage_is_refused(argv: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 2
    assert said in capsys.readouterr().err


@pytest.mark.whole
def test_processes_of_this_machine_make_the_runs_that_one_process_makes(asked: Path) -> None:
    """Whatever a run was forked of, and whoever ran beside it: the bits of a process of its own."""
    asked.write_text("env: CartPole-v1\ntotal_steps: 600\nlambda: [0.5, 0.9]\nhidden: [[8]]\nseeds: 2\n")
    assert main(["sweep", "s.yaml", "d", "--workers", "2"]) == 0
    sweep = open_sweep("d")
    for member in sweep.members():
        run = train(sweep.configuration(member), "alone/" + member.name, preset=False)
        assert sweep.state(member).summary["parameters_sha256"] == run.parameters_sha256
    assert not any(child.name.startswith("lambda") for child in multiprocessing.active_children())


@pytest.mark.whole
def test_what_fails_in_a_process_is_told_in_a_line_and_a_missing_environment_hurts_no_other(
    asked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked.write_text("env: [CartPole-v1, no_such_package:Env-v0]\ntotal_steps: 600\nhidden: [[8]]\n")
    assert main(["sweep", "s.yaml", "d", "--workers", "1"]) == 1
    capsys.readouterr()
    assert main(["sweep", "d", "--status", "--json"]) == 0
    first, second = result_of(capsys)["runs"]
    assert first["state"] == "finished" and second["state"] == "failed" and "no_such_package" in second["reason"]
    assert second["reason"] in Path(second["run_dir"] + ".log").read_text()


@pytest.mark.slow
def test_a_killed_sweep_ends_with_the_bits_of_runs_that_were_never_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["CartPole-v1", "--preset", "false", "--total-steps", "12000", "--hidden", "8", "--evaluate-every", "4000"]
    given += ["--evaluation-episodes", "2", "--checkpoint-every", "2000", "--log-every", "200"]
    path = tmp_path / "sweep"
    argv = [sys.executable, "-m", "neuralq", "train", *given, "--seeds", "2", "--run-dir", str(path)]
    process = subprocess.Popen(argv, stderr=subprocess.DEVNULL)
    try:
        wait_for(path / "seed-1" / "metrics.jsonl")
    finally:
        process.kill()
        process.wait()
    time.sleep(1.0)
    assert main(["resume", str(path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    for run in result["runs"]:
        single = tmp_path / f"single-{run['seed']}"
        assert main(["train", *given, "--seed", str(run["seed"]), "--run-dir", str(single), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["parameters_sha256"] == run["parameters_sha256"]
        rows = [row["greedy_return"] for row in read_metrics(run["run_dir"]) if row["kind"] == "evaluation"]
        assert rows == [row["greedy_return"] for row in read_metrics(single) if row["kind"] == "evaluation"]


FILE = "env: CartPole-v1\ntotal_steps: 1k\nlambda: [0.5, 0.9]\nhidden: ['8']\nseeds: 2\n"


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that asks for a sweep, in the present folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text(FILE)
    return tmp_path / "s.yaml"


def made_by(monkeypatch: pytest.MonkeyPatch, **behaviours: str) -> Pretender:
    engine = Pretender(**behaviours)  # type: ignore[arg-type]  # none is the number of processes
    monkeypatch.setattr("neuralq.apps.cli.sweeps.LocalProcesses", lambda *_: engine)
    return engine


def result_of(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return found


@pytest.mark.usefixtures("asked")
def test_the_command_makes_what_a_file_asks_for_and_tells_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made_by(monkeypatch, s1="fail")
    assert main(["sweep", "s.yaml", "d", "--json"]) == 1
    assert [run["state"] for run in result_of(capsys)["runs"]] == ["finished", "finished", "failed", "failed"]
    assert main(["sweep", "d", "--status", "--json"]) == 0
    runs = result_of(capsys)["runs"]
    assert [(run["seed"], run["options"], run["state"], run["parameters_sha256"]) for run in runs] == [
        (0, {"lambda_": 0.5, "hidden": [8]}, "finished", "0" * 64),
        (0, {"lambda_": 0.9, "hidden": [8]}, "finished", "0" * 64),
        (1, {"lambda_": 0.5, "hidden": [8]}, "failed", None),
        (1, {"lambda_": 0.9, "hidden": [8]}, "failed", None),
    ]
    assert main(["sweep", "s.yaml", "d", "--status"]) == 0
    out = capsys.readouterr().out
    assert "4 runs: 2 finished, 0 running, 0 stopped, 2 failed, 0 not begun" in out and "the world ended" in out
    assert made_by(monkeypatch).asked == [] and main(["sweep", "d"]) == 1, "what has failed is left alone"
    assert "2 of 4 runs failed, try again with: neuralq sweep d --retry-failed" in capsys.readouterr().err
    again = made_by(monkeypatch)
    assert main(["sweep", "d", "--retry-failed"]) == 0 and again.asked == [1, 1]
    assert "side by side: neuralq compare d --by lambda\n" in capsys.readouterr().out


@pytest.mark.usefixtures("asked")
def test_a_share_that_is_asked_to_end_says_that_it_is_to_be_begun_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made_by(monkeypatch)
    assert main(["sweep", "s.yaml", "d", "--index", "1", "--of", "2", "--json"]) == 0
    assert [run["seed"] for run in result_of(capsys)["runs"]] == [0, 1]
    engine = made_by(monkeypatch, others="wait")
    start = engine.start
    monkeypatch.setattr(engine, "start", lambda task: start(task) or os.kill(os.getpid(), signal.SIGUSR1))
    assert main(["sweep", "d", "--index", "0"]) == REQUEUE == 75
    assert engine.asked == [0]
    assert main(["sweep", "d", "--index", "4"]) == 1 and "shares 0 to 3 of 4, got 4" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "words", "said"),
    [
        ("gamma: [0.9]", ["s.yaml", "d"], "s.yaml: a sweep needs an environment"),
        ("env: CartPole-v1\nlamda: [0.9]", ["s.yaml", "d"], "did you mean"),
        ("env: CartPole-v1\ngamma: [0.9, 2]", ["s.yaml", "d"], r"(with gamma 2)"),
        ("env: CartPole-v1\nreplay.learning_rate: 1", ["s.yaml", "d"], "replay.learning_rate"),
        ("env: td-gammon", ["s.yaml", "d"], "one by one: neuralq train td-gammon --seed 0"),
        ("- a", ["s.yaml", "d"], "must hold a mapping of options, got list"),
        ("env: [", ["s.yaml", "d"], "cannot read s.yaml"),
        (FILE, ["s.yaml"], "neuralq sweep s.yaml DIR"),
        (FILE, ["none.yaml", "d"], "cannot read none.yaml"),
        (FILE, ["d"], "there is no sweep in d; start one with: neuralq sweep FILE.yaml d"),
        (FILE, ["s.yaml", "d", "--hook", "nothing"], "cannot import the hook"),
        (FILE, ["s.yaml", "d", "e"], "two words at most"),
        (FILE, ["s.yaml", "d", "--of", "3"], "--of says how many shares there are; add --index"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_in_a_line(
    asked: Path, content: str, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    asked.write_text(content)
    assert main(["sweep", *words]) in (1, 2)
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not Path("d").exists()


@pytest.mark.usefixtures("asked")
def test_a_sweep_that_was_asked_for_otherwise_is_left_alone(
    asked: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made_by(monkeypatch)
    assert main(["sweep", "s.yaml", "d"]) == 0
    before = Path("d/sweep.json").read_bytes()
    asked.write_text(FILE.replace("1k", "2k"))
    assert main(["sweep", "s.yaml", "d"]) == 1
    assert "total_steps: 1000 there, 2000 here" in capsys.readouterr().err
    assert Path("d/sweep.json").read_bytes() == before
    more = made_by(monkeypatch)
    monkeypatch.setattr(sweeps, "LocalProcesses", lambda *_: more)
    assert main(["resume", "d", "--total-steps", "2k", "--set", "learning_rate=0.25"]) == 0
    configs = [open_sweep("d").configuration(member) for member in open_sweep("d").members()]
    assert {(c["total_steps"], c["rollout"]["learning_rate"]) for c in configs} == {(2000, 0.25)}
    assert main(["resume", "d", "--set", "lambda=0.25"]) == 1
    assert "lambda cannot be changed" in capsys.readouterr().err

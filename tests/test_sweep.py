"""Sweeps: many seeds in processes of their own, told by children that only pretend to train.

Mutants that must die here: a failed seed that stops the others, or is not named · a missed target taken for a failure ·
a finished seed run again · a failed or stopped one not tried again · more processes than asked for · a child that goes
on when its parent is killed · a signal that is not passed on · more threads than the configuration says · a seed that
uses another seed's number · an interval over seeds that have not finished.
"""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from neuralq.apps.cli import main, sweeps
from neuralq.apps.cli.sweeps import sweep_bar
from neuralq.runs.folder.files import read_json
from neuralq.runs.folder.run_folder import RunFolderBusy, RunFolderError, read_metrics, read_summary
from neuralq.runs.sweep import Status, Sweep, create_sweep, is_sweep_folder, open_sweep, run_sweep
from neuralq.runs.sweep import processes as processes_module

CHILD = """
import json, os, pathlib, signal, sys, time
folder, seed, total, behaviour = pathlib.Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
folder.mkdir(parents=True, exist_ok=True)
(folder / "run.json").write_text(json.dumps({"format": "neuralq-run", "version": 1, "seed": seed}))
with open(folder / "started", "a") as file:
    file.write(os.environ["OMP_NUM_THREADS"] + chr(10))
def end(steps, status=0, **more):
    (folder / "metrics.jsonl").write_text(json.dumps({"kind": "train", "env_steps": steps}) + chr(10))
    summary = {"env_steps": steps, "greedy_return": 10.0 * seed, "cpu_seconds": 1.0, "reached": None,
               "interrupted_by": None, "parameters_sha256": "0" * 64, **more}
    (folder / "summary.json").write_text(json.dumps(summary))
    sys.exit(status)
if behaviour == "fail":
    sys.stderr.write("a first line\\nneuralq: error: the world ended\\n")
    sys.exit(1)
if behaviour == "die":
    os.kill(os.getpid(), signal.SIGKILL)
if behaviour == "wait":
    signal.signal(signal.SIGTERM, lambda *_: end(total // 2, 143, interrupted_by="SIGTERM"))
    (folder / "metrics.jsonl").write_text(json.dumps({"kind": "train", "env_steps": total // 4}) + chr(10) + "{half")
    time.sleep(60)
if behaviour == "slow":
    time.sleep(0.15)
if behaviour == "miss":
    end(total, 1, reached=False)
if behaviour == "reach":
    end(total // 5, reached=True)
end(total)
"""

CONFIG = {"env": "CartPole-v1", "total_steps": 1000, "threads": 1}


class Children:
    """The command of each seed, as `run_sweep` wants it."""

    def __init__(self, **behaviours: str) -> None:
        self.behaviours = behaviours
        self.asked: list[int] = []

    def __call__(self, sweep: Sweep, seed: int) -> list[str]:
        self.asked.append(seed)
        total = str(sweep.total_steps)
        behaviour = self.behaviours.get(f"s{seed}", self.behaviours.get("others", "finish"))
        return [sys.executable, "-S", "-c", CHILD, str(sweep.run_path(seed)), str(seed), total, behaviour]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes_module, "_POLL_SECONDS", 0.01)


def a_sweep(tmp_path: Path, num_seeds: int = 4, **config: Any) -> Sweep:
    return create_sweep(tmp_path / "sweep", {**CONFIG, **config}, range(num_seeds))


def test_every_seed_runs_once_and_the_result_is_their_interquartile_mean(tmp_path: Path) -> None:
    sweep, children, seen = a_sweep(tmp_path, 5), Children(others="slow"), list[Status]()
    result = run_sweep(sweep, children, 2, seen.append)
    assert children.asked == [0, 1, 2, 3, 4]
    assert [run.state for run in result.runs] == ["finished"] * 5
    assert result.returns == [0.0, 10.0, 20.0, 30.0, 40.0]
    plain = result.plain()
    assert plain["iqm"] == 20.0  # (10 + 20 + 30) / 3
    assert plain["low"] < 20.0 < plain["high"] and plain["num_finished"] == 5
    assert plain["runs"][3]["seed"] == 3 and plain["runs"][3]["env_steps"] == 1000
    assert read_json(sweep.path / "summary.json") == plain
    assert max(len(status.running) for status in seen) == 2
    assert (seen[-1].env_steps, seen[-1].total_steps, seen[-1].num_finished) == (5000, 5000, 5)
    assert seen[-1].returns == (0.0, 10.0, 20.0, 30.0, 40.0)


def test_a_seed_that_fails_is_named_with_its_reason_and_the_others_go_on(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path)
    result = run_sweep(sweep, Children(s1="fail", s2="die"), 2)
    assert [run.state for run in result.runs] == ["finished", "failed", "failed", "finished"]
    assert [run.reason for run in result.runs] == ["", "the world ended", "killed by SIGKILL", ""]
    assert result.returns == [0.0, 30.0] and result.plain()["num_failed"] == 2


def test_a_program_that_cannot_be_started_is_a_failed_seed(tmp_path: Path) -> None:
    result = run_sweep(a_sweep(tmp_path, 2), lambda sweep, seed: [str(tmp_path / "nothing")], 1)
    assert all(run.state == "failed" and "nothing" in run.reason for run in result.runs)
    assert result.plain()["iqm"] is None


def test_a_missed_target_is_no_failure_and_a_reached_one_ends_a_seed_early(tmp_path: Path) -> None:
    seen = list[Status]()
    result = run_sweep(a_sweep(tmp_path, 2, stop_at_return=475), Children(s0="miss", s1="reach"), 2, seen.append)
    assert [run.state for run in result.runs] == ["finished", "finished"]
    assert [run.summary["env_steps"] for run in result.runs] == [1000, 200]
    assert seen[-1].env_steps == 2000, "a seed that ended early counts whole"
    assert not any(status.failed for status in seen)


def test_a_sweep_goes_on_where_it_stands(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path)
    run_sweep(sweep, Children(s1="fail", s2="die"), 2)
    children = Children()
    assert [run.state for run in run_sweep(open_sweep(sweep.path), children, 2).runs] == ["finished"] * 4
    assert children.asked == [1, 2], "finished seeds are left alone"
    none = Children()
    assert len(run_sweep(open_sweep(sweep.path), none, 2).returns) == 4 and none.asked == []
    more = Children()
    result = run_sweep(open_sweep(sweep.path, 2000), more, 2)
    assert more.asked == [0, 1, 2, 3] and {run.summary["env_steps"] for run in result.runs} == {2000}
    assert open_sweep(sweep.path).total_steps == 2000


def test_a_signal_is_passed_on_and_the_sweep_resumes(tmp_path: Path) -> None:
    sweep, steps = a_sweep(tmp_path, 3), []

    def watch(status: Status) -> None:
        begun = [sweep.run_path(seed) / "metrics.jsonl" for seed in (0, 1)]
        if len(status.running) == 2 and all(file.exists() and file.stat().st_size for file in begun):
            steps.append(status.env_steps)
            if len(steps) == 2:
                os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    result = run_sweep(sweep, Children(others="wait"), 2, watch)
    assert signal.getsignal(signal.SIGTERM) is before
    assert result.interrupted_by == "SIGTERM"
    assert [run.state for run in result.runs] == ["stopped"] * 3 and result.returns == []
    assert 500 in steps, "two seeds at a quarter of 1000 steps; the half-written line is passed over"
    assert read_summary(sweep.run_path(0))["interrupted_by"] == "SIGTERM"
    assert not sweep.run_path(2).exists(), "nothing new is begun"
    children = Children()
    assert len(run_sweep(sweep, children, 2).returns) == 3 and children.asked == [0, 1, 2]


def test_asked_twice_it_ends_at_once(tmp_path: Path) -> None:
    def watch(status: Status) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_sweep(
            a_sweep(tmp_path, 1), lambda *_: [sys.executable, "-S", "-c", "import time; time.sleep(60)"], 1, watch
        )


def test_children_get_the_threads_of_the_configuration(tmp_path: Path) -> None:
    for threads in (1, 3):
        sweep = a_sweep(tmp_path / str(threads), 1, threads=threads)
        run_sweep(sweep, Children())
        assert (sweep.run_path(0) / "started").read_text() == f"{threads}\n"


def test_one_process_runs_a_sweep(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path, 1)

    def watch(status: Status) -> None:
        with pytest.raises(RunFolderBusy, match=f"the sweep in {sweep.path} is being run by process {os.getpid()}"):
            run_sweep(sweep, Children())

    assert len(run_sweep(sweep, Children(), 1, watch).returns) == 1


def test_children_stop_when_their_parent_is_killed(tmp_path: Path) -> None:
    child = (
        "import pathlib, signal, sys, time; from neuralq.runs.sweep import stop_with_parent; stop_with_parent();"
        "place = pathlib.Path(sys.argv[1]);"
        "signal.signal(signal.SIGTERM, lambda *_: (place.with_suffix('.stopped').touch(), sys.exit(0)));"
        "place.with_suffix('.begun').touch(); time.sleep(60)"
    )
    parent = (
        "import sys; from neuralq.runs.sweep import *\n"
        f"sweep = create_sweep(sys.argv[1], {CONFIG!r}, range(1))\n"
        f"run_sweep(sweep, lambda sweep, seed: [sys.executable, '-c', {child!r}, sys.argv[2]], 1)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", parent, str(tmp_path / "sweep"), str(tmp_path / "child")])
    try:
        wait_for(tmp_path / "child.begun")
    finally:
        process.kill()
        process.wait()
    wait_for(tmp_path / "child.stopped")
    assert run_sweep(open_sweep(tmp_path / "sweep"), Children()).returns == [0.0], "and the lock is free"


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
    run_sweep(sweep, Children())
    with pytest.raises(RunFolderError, match="already holds a run"):
        create_sweep(sweep.run_path(0), CONFIG, [0])
    for seeds in ([], [1, 1]):
        with pytest.raises(ValueError, match="each named once"):
            create_sweep(tmp_path / "other", CONFIG, seeds)
    with pytest.raises(ValueError, match="seed must be a whole number"):
        create_sweep(tmp_path / "other", CONFIG, [-1])
    with pytest.raises(ValueError, match="num_workers"):
        run_sweep(sweep, Children(), 0)
    with pytest.raises(RunFolderError, match="no sweep in"):
        open_sweep(tmp_path)
    for damage in ("{", "{}", '{"format": "other", "version": 1, "seeds": [], "options": []}'):
        (sweep.path / "sweep.json").write_text(damage)
        with pytest.raises(RunFolderError, match="cannot be read"):
            open_sweep(sweep.path)


def test_a_seed_stopped_at_its_last_step_has_not_finished(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path, 1)
    run_sweep(sweep, Children())
    summary = read_summary(sweep.run_path(0))
    (sweep.run_path(0) / "summary.json").write_text(json.dumps({**summary, "interrupted_by": "SIGTERM"}))
    children = Children()
    assert len(run_sweep(sweep, children).returns) == 1 and children.asked == [0], "its last evaluation was missing"


def test_a_damaged_summary_is_a_seed_that_has_not_finished(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path, 1)
    run_sweep(sweep, Children())
    (sweep.run_path(0) / "summary.json").write_text("{")
    assert run_sweep(sweep, Children()).returns == [0.0]


# The command line.


def test_lines_for_people_and_their_pace(tmp_path: Path) -> None:
    out, now = io.StringIO(), [0.0]
    with sweep_bar(a_sweep(tmp_path, 3), out, lambda: now[0]) as bar:
        for second, status in (
            (0, Status(0, 3000, (0, 1), 0, (), ())),
            (5, Status(500, 3000, (0, 1), 0, (), ())),
            (11, Status(1100, 3000, (0, 1), 0, (), ())),
            (12, Status(2000, 3000, (2,), 1, (1,), (50.0,))),
        ):
            now[0] = float(second)
            bar(status)
    assert out.getvalue().splitlines() == [
        "0 of 3 seeds · 1,100 of 3,000 steps · 100 steps/s",
        "1 of 3 seeds · failed: 1 · 2,000 of 3,000 steps · 167 steps/s · IQM 50.0",
    ]


TRAIN = ["train", "CartPole-v1", "--preset", "false", "--total-steps", "1000", "--seed", "2", "--seeds", "3"]


def test_the_command_names_what_failed_and_resumes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sweep"
    monkeypatch.setattr(sweeps, "_command", Children(s3="fail"))
    assert main([*TRAIN, "--run-dir", str(path)]) == 1
    captured = capsys.readouterr()
    assert f"seed 3: failed: the world ended (see {path}/seed-3.log)" in captured.out
    assert "interquartile mean over 2 seeds: 30.00, 95 % interval 20.00 to 40.00" in captured.out
    assert f"seed 3 failed, try again with: neuralq resume {path}" in captured.err.splitlines()[-1]
    assert main([*TRAIN, "--run-dir", str(path)]) == 1
    assert "already holds a sweep" in capsys.readouterr().err
    monkeypatch.setattr(sweeps, "_command", Children())
    assert main(["resume", str(path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["iqm"] == 30.0 and [run["seed"] for run in result["runs"]] == [2, 3, 4]
    assert result["sweep_dir"] == str(path)


def test_the_command_says_which_seeds_missed_the_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sweeps, "_command", Children(s2="miss", others="reach"))
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


def test_the_words_of_the_command_line_reach_each_seed(tmp_path: Path) -> None:
    sweep = create_sweep(tmp_path / "sweep", CONFIG, [7], ["--tensorboard"])
    words = sweeps._command(open_sweep(sweep.path), 7)
    assert words[4:7] == ["train", "--config", str(sweep.path / "config.json")]
    assert words[words.index("--seed") + 1] == "7" and words[-1] == "--tensorboard"
    assert words[words.index("--run-dir") + 1] == str(sweep.path / "seed-7")
    run_sweep(sweep, Children())
    words = sweeps._command(sweep, 7)
    assert words[4:] == ["resume", str(sweep.path / "seed-7"), "--total-steps", "1000"]


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

"""``neuralq tune`` as a process: killed, interrupted, gone on with; ``neuralq train`` takes what it leaves."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from neuralq.apps.cli import main
from neuralq.runs.evaluation import shown
from neuralq.runs.folder.run_folder import read_summary
from neuralq.runs.tune.confirming import confirmed, winner
from neuralq.runs.tune.study import Study, open_study

pytest.importorskip("optuna")
pytest.importorskip("matplotlib")

ASKED = ["FrozenLake-v1", "--learner", "tabular", "--total-steps", "2000", "--seeds-most", "3", "--trials", "5"]


def begun(folder: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "neuralq", "tune", *ASKED, "--workers", "2", "--dir", str(folder), *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended_runs(folder: Path) -> int:
    return sum(len(json.loads(file.read_text())["runs"]) for file in folder.glob("trials/*.json"))


def when(folder: Path, process: subprocess.Popen[str], count: int) -> None:
    """Returns as soon as so many runs have ended."""
    until = time.monotonic() + 300
    while ended_runs(folder) < count:
        assert process.poll() is None and time.monotonic() < until, process.communicate()
        time.sleep(0.05)


def processes_of(folder: Path) -> list[str]:
    """Processes that have something of the folder open or in their command line."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            words = (entry / "cmdline").read_bytes().decode(errors="replace")
            files = {os.readlink(file) for file in (entry / "fd").iterdir()}
        except OSError:
            continue
        if str(folder) in words or any(name.startswith(str(folder)) for name in files):
            found.append(words.replace("\0", " "))
    return found


def result(study: Study) -> list[Any]:
    return [(trial.chosen, {seed: run.score for seed, run in sorted(trial.runs.items())}) for trial in study.trials]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="looks for orphans in /proc")
def test_killed_and_interrupted_it_comes_to_what_it_would_have_come_to(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    out, err = begun(whole, "--json").communicate(timeout=900)
    plain = json.loads(out.splitlines()[-1])
    for count in (2, 5, 20):
        process = begun(killed)
        when(killed, process, count)
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=120)  # its runs have the other end of these pipes: they end, too
    process = begun(killed)
    when(killed, process, 23)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    again = re.search(r"go on with: neuralq (tune .*)", err)
    assert process.returncode == 130 and again is not None, err
    said = subprocess.run([sys.executable, "-m", "neuralq", *shlex.split(again[1])], capture_output=True, text=True)
    assert said.returncode == 0 and "report" in said.stdout, said.stderr
    assert result(open_study(killed)) == result(open_study(whole))
    assert not processes_of(tmp_path)
    assert plain["num_trials"] == 5 and plain["confirmed"][0]["trial"] == 0 and plain["result"] is not None


@pytest.mark.slow
def test_what_is_recommended_is_what_was_confirmed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "study"
    out, err = begun(folder).communicate(timeout=900)
    command = re.search(r"train with it: neuralq (train .*)", out)
    assert command is not None, err
    study = open_study(folder)
    best, first = winner(confirmed(study)), max(confirmed(study), key=lambda one: one.searched.iqm)
    assert best is not None and f"flattered by {shown(first.flattery)}" in out
    seed = study.fresh_seeds[3]
    assert main([*shlex.split(command[1]), "--seed", str(seed), "--run-dir", str(tmp_path / "run")]) == 0
    confirmed_run = read_summary(study.task(best.trial, seed).path)
    assert read_summary(tmp_path / "run")["parameters_sha256"] == confirmed_run["parameters_sha256"]
    assert confirmed_run["greedy_return"] is not None
    page = (folder / "report.html").read_text()
    for words in ("Confirmed on fresh seeds", "flattered by the race", "Slices", "the preset"):
        assert words in page
    assert page.count("<svg") >= 2 and "http://" not in re.sub(r'xmlns="[^"]+"', "", page)

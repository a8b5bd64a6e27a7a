"""Kills the processes of a sweep again and again, and says whether anything was lost, done twice or different.

    python scripts/kill_rounds.py [--rounds 20] [--victim worker|coordinator] [--folder DIR] [--seed 0]

A round is a kill (SIGKILL, at a random time) of one of the runs that go on, each once at most, or of the command
itself, which is then given again. Sweeps are begun until there have been so many. Of each sweep every run must have
finished with the parameters (SHA-256) and with the rows of metrics of a sweep that nobody disturbed, so that no step
was lost or taken twice; what had finished at a kill must not be touched after it, and no process may be left. A line
for each sweep; the exit status is 1 if any of it did not hold. Needs /proc, so Linux.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from neuralq.runs.sweep import open_sweep

ASKED = "{env: CartPole-v1, total_steps: 12000, checkpoint_every: 2000, learning_rate: [1e-3, 3e-3], seeds: 4}"
TIMES = ("cpu_seconds", "wall_seconds", "steps_per_second", "crc32", "time")


def command(folder: Path) -> list[str]:
    return [sys.executable, "-m", "neuralq", "sweep", str(folder.parent / "asked.yaml"), str(folder), "--workers", "2"]


def descendants(process: int) -> list[int]:
    """Every process that this one has begun, and those have, in that order."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            words = stat.read_text().rpartition(")")[2].split()
            if words[0] != "Z":
                children.setdefault(int(words[1]), []).append(int(stat.parent.name))
    found = [process]
    for each in found:
        found += children.get(each, [])
    return found[1:]


def runs_at_work(process: int, folder: Path) -> dict[int, str]:
    """Those of them that make a run, with its log, which each writes in the folder."""
    found = {}
    for each in descendants(process):
        with contextlib.suppress(OSError):
            log = os.readlink(f"/proc/{each}/fd/1")
            if log.startswith(str(folder.resolve())):
                found[each] = log
    return found


def until(holds: Callable[[], bool], seconds: float, what: str) -> None:
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            raise TimeoutError(f"{what}: not within {seconds:g} seconds")
        time.sleep(0.02)


def result(folder: Path) -> dict[str, tuple[str, str]]:
    """By name of the run: SHA-256 of its parameters, and its rows of metrics without times."""
    sweep, found = open_sweep(folder), {}
    for member in sweep.members():
        state, lines = sweep.state(member), (folder / member.name / "metrics.jsonl").read_text().splitlines()
        rows = [{n: value for n, value in json.loads(line).items() if n not in TIMES} for line in lines]
        found[member.name] = (str(state.summary.get("parameters_sha256", state.state)), json.dumps(rows))
    return found


def finished(folder: Path) -> dict[Path, tuple[int, int]]:
    """The summaries of runs that say so, as files: whoever writes one anew makes another file."""
    found = {}
    for path in folder.glob("*/*/summary.json"):
        if json.loads(path.read_text()).get("interrupted_by") is None:
            stat = path.stat()
            found[path] = (stat.st_ino, stat.st_mtime_ns)
    return found


class Killed:
    """A sweep whose processes are killed.

    Args:
        folder: of the sweep, empty.
        victim: "worker" or "coordinator".
        rng: of the times.
    """

    def __init__(self, folder: Path, victim: str, rng: random.Random) -> None:
        self.folder, self.victim, self.rng = folder, victim, rng
        self.kills = 0
        self.victims: set[str] = set()
        self.kept: dict[Path, tuple[int, int]] = {}
        self.begun: set[int] = set()

    def kill(self, most: int) -> None:
        """Kill until the sweep is through, so many times at most.

        Raises:
            RuntimeError: if the command fails.
            TimeoutError: if a process is left behind.
        """
        status = -signal.SIGKILL
        while status == -signal.SIGKILL:
            asked = subprocess.Popen(command(self.folder), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            try:
                while asked.poll() is None and self.kills < most:
                    self._wait_and_kill(asked)
                _, said = asked.communicate(timeout=600)
            finally:
                asked.kill()
            self.kept |= finished(self.folder)
            until(lambda: not any(map(is_there, self.begun)), 150, "a process is left")
            status = asked.returncode
        if status != 0:
            raise RuntimeError(f"the command ended with {status}: {' '.join(said.splitlines()[-1:])}")

    def _wait_and_kill(self, asked: subprocess.Popen[str]) -> None:
        until(lambda: asked.poll() is not None or bool(runs_at_work(asked.pid, self.folder)), 300, "no run has begun")
        time.sleep(self.rng.uniform(0, 2))
        runs = runs_at_work(asked.pid, self.folder)
        left = [process for process, log in runs.items() if log not in self.victims]
        self.begun.update(descendants(asked.pid))
        if not runs or (self.victim == "worker" and not left):
            return
        self.kept |= finished(self.folder)
        victim = self.rng.choice(left) if self.victim == "worker" else asked.pid
        self.victims.add(runs.get(victim, ""))
        with contextlib.suppress(ProcessLookupError):
            os.kill(victim, signal.SIGKILL)
            self.kills += 1
        if self.victim == "coordinator":
            asked.wait()


def is_there(process: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="kills that hit something (default: 20)")
    parser.add_argument("--victim", choices=("worker", "coordinator"), default="worker", help="who is killed")
    parser.add_argument("--folder", type=Path, help="an empty folder for the sweeps (default: a temporary one)")
    parser.add_argument("--seed", type=int, default=0, help="of the times at which is killed")
    options = parser.parse_args(arguments)
    rng, kills, faults, number = random.Random(options.seed), 0, 0, 0
    with contextlib.ExitStack() as stack:
        place = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        place.mkdir(parents=True, exist_ok=True)
        (place / "asked.yaml").write_text(ASKED)
        subprocess.run(command(place / "undisturbed"), check=True, capture_output=True)
        wanted = result(place / "undisturbed")
        while kills < options.rounds and number < 5 * options.rounds:
            number += 1
            killed = Killed(place / f"sweep-{number}", options.victim, rng)
            killed.kill(options.rounds - kills)
            wrong = [name for name, found in result(killed.folder).items() if found != wanted.get(name)]
            files = finished(killed.folder)
            touched = [str(path) for path, file in killed.kept.items() if files.get(path) != file]
            holds = not wrong and not touched and len(files) == len(wanted)
            kills, faults = kills + killed.kills, faults + (not holds)
            told = f"differing {wrong}, touched after their end {touched}, {len(files)} of {len(wanted)} finished"
            print(f"{options.victim}: {killed.kills} kills, {'as undisturbed' if holds else told}", flush=True)
    print(f"{kills} kills of a {options.victim}, {faults} sweeps with a fault")
    return 0 if kills >= options.rounds and not faults else 1


if __name__ == "__main__":
    sys.exit(main())

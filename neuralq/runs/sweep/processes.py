"""The processes of a sweep: begun, watched, asked to stop, and the result of each."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuralq.checks import check_whole
from neuralq.runs.folder.files import (
    FolderLock,
    RunFolderError,
    open_regular,
    refuse_links,
    to_json,
    write_durably,
)
from neuralq.runs.folder.run_folder import read_summary
from neuralq.runs.play_off import score_of
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.sweep.folder import Sweep, has_finished, steps_so_far
from neuralq.runs.sweep.statistics import Estimate, estimate

__all__ = ["SeedResult", "Status", "SweepResult", "num_cores", "run_sweep", "stop_with_parent"]

_POLL_SECONDS = 0.2
_TAIL_BYTES = 1 << 16


@dataclass(frozen=True)
class SeedResult:
    """The result of one seed.

    Args:
        seed: which.
        run_dir: its run folder.
        state: "finished", "failed", or "stopped" before its end.
        reason: why it failed, "" otherwise.
        summary: of its run folder; empty where it has not finished.
    """

    seed: int
    run_dir: Path
    state: str
    reason: str
    summary: dict[str, Any]


@dataclass(frozen=True)
class SweepResult:
    """The result of a sweep: one per seed, and the name of the signal that ended it early, if one did."""

    runs: tuple[SeedResult, ...]
    interrupted_by: str | None = None

    @property
    def returns(self) -> list[float]:
        """What the agents of the finished seeds score."""
        found = (score_of(run.summary) for run in self.runs if run.state == "finished")
        return [score.mean for score in found if score is not None]

    @property
    def estimate(self) -> Estimate | None:
        """Their interquartile mean and its interval; None where no seed has finished."""
        return estimate(self.returns) if self.returns else None

    def plain(self) -> dict[str, Any]:
        """The same as plain values."""
        found = self.estimate
        numbers = ("agent_return", "greedy_return", "env_steps", "cpu_seconds", "reached", "parameters_sha256")
        return {
            "iqm": None if found is None else found.iqm,
            "low": None if found is None else found.low,
            "high": None if found is None else found.high,
            "num_finished": sum(run.state == "finished" for run in self.runs),
            "num_failed": sum(run.state == "failed" for run in self.runs),
            "interrupted_by": self.interrupted_by,
            "runs": [
                {"seed": run.seed, "state": run.state, "reason": run.reason or None, "run_dir": str(run.run_dir)}
                | {name: run.summary.get(name) for name in numbers}
                for run in self.runs
            ],
        }


@dataclass(frozen=True)
class Status:
    """How far a sweep has come.

    Args:
        env_steps: of all seeds together; a seed that ended early counts whole.
        total_steps: of all seeds together.
        running: seeds at work.
        num_finished: seeds that have finished.
        failed: seeds that have failed.
        returns: what the agents of those that have finished score.
    """

    env_steps: int
    total_steps: int
    running: tuple[int, ...]
    num_finished: int
    failed: tuple[int, ...]
    returns: tuple[float, ...]


def num_cores() -> int:
    """Cores that this process may use.

    Example:
        >>> num_cores() >= 1
        True
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_sweep(
    sweep: Sweep,
    command: Callable[[Sweep, int], Sequence[str]],
    num_workers: int | None = None,
    watch: Callable[[Status], None] | None = None,
) -> SweepResult:
    """Run every seed that has not finished, some at a time; a seed that fails is named and the others go on.

    SIGINT and SIGTERM are passed on to the children, which save and stop; a second one ends them at once.

    Args:
        sweep: which.
        command: the command line that trains a seed, or goes on with it where its run folder exists.
        num_workers: processes at a time; as many as there are cores by default.
        watch: told how far it has come, a few times a second.

    Raises:
        RunFolderBusy: if another process is running this sweep.
    """
    check_whole("num_workers", num_workers := num_cores() if num_workers is None else num_workers)
    request, lock = StopRequest(), FolderLock(sweep.path / "sweep.lock", f"the sweep in {sweep.path} is being run")
    with contextlib.closing(lock), request.listening():
        processes = _Processes(sweep, command)
        try:
            while processes.waiting or processes.running:
                if request.name is not None:
                    processes.stop()
                while processes.waiting and len(processes.running) < num_workers:
                    processes.start(processes.waiting.pop(0))
                time.sleep(_POLL_SECONDS)
                processes.collect()
                if watch is not None:
                    watch(processes.status())
        finally:
            processes.kill()
        result = SweepResult(tuple(processes.result(seed) for seed in sweep.seeds), request.name)
        write_durably(sweep.path / "summary.json", to_json(result.plain(), "summary", sealed=True))
    return result


class _Processes:
    """The processes of a sweep: which seeds wait, which run and why those that failed did."""

    def __init__(self, sweep: Sweep, command: Callable[[Sweep, int], Sequence[str]]) -> None:
        self.sweep, self.command = sweep, command
        self.waiting = [seed for seed in sweep.seeds if not has_finished(sweep, seed)]
        self.running: dict[int, subprocess.Popen[bytes]] = {}
        self.reasons: dict[int, str] = {}
        self.stopping = False

    def start(self, seed: int) -> None:
        try:
            refuse_links(self.sweep.path, [self.sweep.run_path(seed).name])
            with open(open_regular(self.sweep.log_path(seed), os.O_WRONLY | os.O_CREAT), "wb") as log:
                log.truncate()
                # A session of its own: the terminal's Ctrl-C reaches the parent alone, which passes it on in order.
                self.running[seed] = subprocess.Popen(
                    list(self.command(self.sweep, seed)),
                    stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT,
                    env=_environment(int(self.sweep.config.get("threads", 1))), start_new_session=True,
                )  # fmt: skip
        except (OSError, RunFolderError) as error:  # no memory for a process, no room for a log: this seed's alone
            self.reasons[seed] = str(error)

    def collect(self) -> None:
        for seed, process in list(self.running.items()):
            status = process.poll()
            if status is not None:
                self._release(seed)
                # A status of 1 may only mean that the target was not reached; the run folder knows better.
                if not has_finished(self.sweep, seed) and not self.stopping:
                    self.reasons[seed] = _reason(self.sweep.log_path(seed), status)

    def stop(self) -> None:
        """Ask every child to save and end, once; nothing new is begun."""
        self.waiting.clear()
        if not self.stopping:
            for process in self.running.values():
                process.terminate()
        self.stopping = True

    def kill(self) -> None:
        for seed, process in list(self.running.items()):
            process.kill()
            process.wait()
            self._release(seed)

    def _release(self, seed: int) -> None:
        pipe = self.running.pop(seed).stdin
        if pipe is not None:
            pipe.close()

    def result(self, seed: int) -> SeedResult:
        path = self.sweep.run_path(seed)
        if has_finished(self.sweep, seed):
            return SeedResult(seed, path, "finished", "", read_summary(path))
        reason = self.reasons.get(seed, "")
        return SeedResult(seed, path, "failed" if reason else "stopped", reason, {})

    def status(self) -> Status:
        total = self.sweep.total_steps
        finished = [seed for seed in self.sweep.seeds if seed not in self.running and has_finished(self.sweep, seed)]
        scores = (score_of(read_summary(self.sweep.run_path(seed))) for seed in finished)
        others = (steps_so_far(self.sweep.run_path(seed)) for seed in self.sweep.seeds if seed not in finished)
        steps = len(finished) * total + sum(min(total, steps) for steps in others)
        kept = tuple(score.mean for score in scores if score is not None)
        return Status(
            steps, total * len(self.sweep.seeds), tuple(self.running), len(finished), tuple(self.reasons), kept
        )


def stop_with_parent() -> None:
    """In a child: ask this process to stop, as SIGTERM does, as soon as the parent's end of standard input closes.

    The system closes it when the parent dies, however it dies, so no seed goes on unseen.
    """

    def wait() -> None:
        with contextlib.suppress(OSError):
            while os.read(0, 1024):  # not sys.stdin: its lock would be held when the interpreter ends
                pass
            os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


def _environment(num_threads: int) -> dict[str, str]:
    """The parent's, with a bound on threads, which libraries read when they are loaded."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    limits = dict.fromkeys(names, str(num_threads))
    return {**os.environ, **limits}


def _reason(log: Path, status: int) -> str:
    """Why a process failed, in one line: the last that it printed, or the signal that killed it."""
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    with open(open_regular(log, os.O_RDONLY), "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL_BYTES))
        lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    said = lines[-1].strip().removeprefix("neuralq: ").removeprefix("error: ") if lines else ""
    return said or f"ended with status {status}"

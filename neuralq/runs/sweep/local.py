"""Runs in processes of this machine: forked in a hundredth of a second from one that has everything in memory.

A Python that imports PyTorch and loads kernels takes seconds, as long as many a run. So one process is made ready, and
each run is a fork of it, with a session, a log and an end of its own. A run ends with the process that asked for it,
however that ends: it saves and stops.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Mapping
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from neuralq.checks import check_whole
from neuralq.runs.children import safe_path, with_environment, without_main
from neuralq.runs.folder.files import open_regular, refuse_links
from neuralq.runs.sweep.engine import Ended
from neuralq.runs.sweep.task import Task
from neuralq.runs.sweep.work import perform

__all__ = ["LocalProcesses", "free_memory", "num_cores", "run_forked"]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_GRACE_SECONDS = 120
"""That a run has to save once the process that asked for it is gone."""
_SPARE_BYTES = 1 << 28
_TAIL_BYTES = 1 << 16


def num_cores() -> int:
    """Cores that this process may use.

    Example:
        >>> num_cores() >= 1
        True
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class LocalProcesses:
    """Some runs at a time, as many as there are cores and memory for.

    Args:
        num_workers: processes at a time; as many as there are cores for by default.
        config: of a run: how many threads each has, and what kernels are made ready.

    Raises:
        ValueError: for a number of processes below one.
    """

    def __init__(self, num_workers: int | None = None, config: Mapping[str, Any] | None = None) -> None:
        self._config = dict(config or {})
        self._threads = int(self._config.get("threads", 1))
        self.num_workers = max(1, num_cores() // self._threads) if num_workers is None else num_workers
        check_whole("num_workers", self.num_workers)
        self._running: dict[int, tuple[Task, BaseProcess]] = {}

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.num_workers} at a time"

    def has_room(self) -> bool:
        """Whether there is a core for another run, and memory for one as large as the largest that goes on."""
        if len(self._running) >= self.num_workers:
            return False
        free = free_memory() if self._running else None
        largest = max((_memory_of(process.pid) for _, process in self._running.values()), default=0)
        return free is None or free > largest + _SPARE_BYTES

    def start(self, task: Task) -> None:
        """Begin a task in a process of its own."""
        folder = task.path.parent
        refuse_links(folder, [task.path.name])
        if "/" in task.name:
            refuse_links(folder.parent, [folder.name])
        folder.mkdir(parents=True, exist_ok=True)
        os.close(open_regular(task.log_path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC))
        process = run_forked(task, self._threads, self._config)
        self._running[process.sentinel] = (task, process)

    def collect(self, seconds: float) -> list[Ended]:
        """What has ended, as soon as something has."""
        ended = []
        for sentinel in wait(list(self._running), seconds):
            task, process = self._running.pop(int(str(sentinel)))
            process.join()
            ended.append(Ended(task, reason_of(process.exitcode or 0, task.log_path)))
            process.close()
        return ended

    def running(self) -> list[Task]:
        """What goes on."""
        return [task for task, _ in self._running.values()]

    def stop(self) -> None:
        """Ask every run to save and end."""
        for _, process in self._running.values():
            process.terminate()

    def close(self) -> None:
        """Kill what is left."""
        for _, process in self._running.values():
            process.kill()
            process.join()
        self._running.clear()


def run_forked(task: Task, num_threads: int = 1, config: Mapping[str, Any] | None = None) -> BaseProcess:
    """A process that performs a task, started.

    Args:
        task: what it does.
        num_threads: that libraries of its have.
        config: of a run like those that will be made; its kernels are made ready in the process that all are forked of.
    """
    context: Any = multiprocessing.get_context("spawn" if sys.platform == "darwin" else "forkserver")
    if sys.platform != "darwin":  # where a process that has loaded frameworks of the system may not be forked
        context.set_forkserver_preload(["neuralq.runs.sweep.warm"])
    ready = {"NEURALQ_WARM": json.dumps(dict(config))} if config and num_threads == 1 else {}
    process: BaseProcess = context.Process(target=_child, args=(task,), name=task.name)
    with safe_path(), without_main(), with_environment({**dict.fromkeys(_THREADS, str(num_threads)), **ready}):
        process.start()
    return process


def _child(task: Task) -> None:
    os.setsid()  # the terminal's Ctrl-C reaches the parent alone, which passes it on in order
    log = open_regular(task.log_path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for descriptor in (1, 2):
        os.dup2(log, descriptor)
    sys.stdout = open(1, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)
    sys.stderr = open(2, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)
    _stop_with_parent()
    perform(task)


def _stop_with_parent() -> None:
    """Ask this process to stop, as SIGTERM does, as soon as the one that asked for it is gone, however it went."""

    def watch() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(_GRACE_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def reason_of(status: int, log: Path) -> str:
    """What happened to a process: the signal that killed it, or the last that it printed; "" if it ended well."""
    if status <= 0:
        return f"killed by {signal.Signals(-status).name}" if status else ""
    lines: list[str] = []
    with contextlib.suppress(OSError), open(open_regular(log, os.O_RDONLY), "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL_BYTES))
        lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    said = lines[-1].strip().removeprefix("neuralq: ").removeprefix("error: ") if lines else ""
    return said or f"ended with status {status}"


def free_memory() -> int | None:
    """Bytes that may still be taken, by the system and the group of processes that this one is in; None if unknown."""
    found = []
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found.append(1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")))
    with contextlib.suppress(OSError, ValueError):  # "max" where there is no bound
        group = Path("/sys/fs/cgroup")
        found.append(int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    return min(found, default=None)


def _memory_of(process: int | None) -> int:
    """The most bytes that a process has held so far; 0 where that cannot be seen."""
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    return 0

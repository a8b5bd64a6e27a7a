"""Runs in processes of this machine: forked in a hundredth of a second from one that has everything in memory.

A Python that imports PyTorch and loads kernels takes seconds, as long as many a run. So one process is made ready, and
each run is a fork of it, with a session, a log and an end of its own. A run ends with the process that asked for it,
however that ends: it saves and stops.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from neuralq.checks import check_whole
from neuralq.runs.folder.files import open_regular, refuse_links
from neuralq.runs.sweep.engine import Ended
from neuralq.runs.sweep.forked import reason_of, run_forked
from neuralq.runs.sweep.task import Task

__all__ = ["LocalProcesses", "free_memory", "num_cores"]

_SPARE_BYTES = 1 << 28


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

"""Where the time of a run goes: CPU time of training, and wall time of everything."""

from __future__ import annotations

import time
from typing import Protocol

__all__ = ["Booked", "Stopwatch"]


class Booked(Protocol):
    """What a `Stopwatch` books time to."""

    cpu_seconds: float
    wall_seconds: float


class Stopwatch:
    """Books the time since it was last read to a progress; what is no training counts as wall time only.

    Example:
        >>> from types import SimpleNamespace
        >>> progress = SimpleNamespace(cpu_seconds=0.0, wall_seconds=0.0)
        >>> Stopwatch(progress).read(training=False)
        >>> progress.cpu_seconds, progress.wall_seconds > 0
        (0.0, True)
    """

    def __init__(self, progress: Booked) -> None:
        self._progress = progress
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def read(self, training: bool = True) -> None:
        """Book, and begin anew."""
        cpu, wall = time.process_time(), time.perf_counter()
        if training:
            self._progress.cpu_seconds += cpu - self._cpu
        self._progress.wall_seconds += wall - self._wall
        self._cpu, self._wall = cpu, wall

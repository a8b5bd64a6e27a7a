"""SIGTERM and SIGINT as a request, so that whatever goes on can save before it ends."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType

__all__ = ["StopRequest"]


class StopRequest:
    """Remembers SIGTERM or SIGINT by ``name``; asked twice, it raises KeyboardInterrupt at once.

    Example:
        >>> import os
        >>> request = StopRequest()
        >>> with request.listening():
        ...     os.kill(os.getpid(), signal.SIGTERM)
        >>> request.name
        'SIGTERM'
    """

    def __init__(self) -> None:
        self.name: str | None = None

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.name is not None:
            raise KeyboardInterrupt
        self.name = signal.Signals(number).name

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Listen while the block runs; outside the main thread, where Python allows no handlers, do nothing."""
        try:
            before = {n: signal.signal(n, self._note) for n in (signal.SIGTERM, signal.SIGINT)}
        except ValueError:
            yield
            return
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

"""SIGTERM, SIGINT, SIGHUP and SIGUSR1 as a request, so that whatever goes on can save before it ends.

Schedulers send SIGUSR1 before the time that they allow is over.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator, Sequence
from types import FrameType

__all__ = ["StopAsked", "StopRequest", "pass_on", "raise_if_asked"]

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGHUP", "SIGUSR1") if hasattr(signal, name))
_FROM_A_HOOK = "a hook"
_listening: list[StopRequest] = []
_abandonable: list[StopRequest] = []


class StopAsked(Exception):
    """Work that may be abandoned, an evaluation, ends here: a signal has asked for the end."""


class StopRequest:
    """Remembers a signal by ``name``; asked twice, it raises KeyboardInterrupt at once, but never while saving.

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
        self._impatient = False
        self._saving = False

    @property
    def by_hook(self) -> bool:
        """Whether it was a hook that asked, and no signal since."""
        return self.name == _FROM_A_HOOK

    def ask(self) -> None:
        """Ask as a hook does: what goes on comes back where it can be saved."""
        self.name = self.name or _FROM_A_HOOK

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.name is None or self.by_hook:
            self.name = signal.Signals(number).name
        elif self._saving:
            self._impatient = True
        else:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def listening(self, signals: Sequence[signal.Signals] = _SIGNALS) -> Iterator[None]:
        """Listen while the block runs; outside the main thread, where Python allows no handlers, do nothing.

        What was asked of a request that listens around this one is asked of this one. SIGHUP stays ignored where it is
        (nohup).
        """
        if _listening:
            self.name = self.name or _listening[-1].name
        wanted = [n for n in signals if n != _HANGUP or signal.getsignal(n) is not signal.SIG_IGN]
        try:
            before = {n: signal.signal(n, self._note) for n in wanted}
        except ValueError:
            yield
            return
        _listening.append(self)
        try:
            yield
        finally:
            _listening.remove(self)
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextlib.contextmanager
    def saving(self) -> Iterator[None]:
        """A second signal waits until the block has ended: it would lose what the first one asked to be saved."""
        self._saving = True
        try:
            yield
        finally:
            self._saving = False
        if self._impatient:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def abandoning(self) -> Iterator[None]:
        """What the block does may be left half done: `raise_if_asked` in it raises once a signal came."""
        _abandonable.append(self)
        try:
            yield
        finally:
            _abandonable.remove(self)


_HANGUP = getattr(signal, "SIGHUP", None)


def raise_if_asked() -> None:
    """Raises `StopAsked` if what goes on may be abandoned and a signal has asked for the end.

    Example:
        >>> raise_if_asked()  # nobody has
    """
    if _abandonable and _abandonable[-1].name is not None and not _abandonable[-1].by_hook:
        raise StopAsked


def pass_on(name: str | None, told: str) -> None:
    """The signal of this name, whose handler stood aside, has the effect that it would have had; None has none.

    Raises:
        KeyboardInterrupt: for SIGINT, with ``told`` as its message.
    """
    if name == "SIGINT":
        raise KeyboardInterrupt(told)
    if name is not None:
        signal.raise_signal(signal.Signals[name])

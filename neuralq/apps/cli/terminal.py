"""What a command has from whoever started it: streams that may be closed or know no Greek, and Ctrl-C."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, TextIO

__all__ = ["GRACE", "descriptor_of_its_own", "end_without_waiting", "listening", "make_standard_streams_safe"]

GRACE = 5.0
"""Seconds that threads which somebody's code has left have to end."""

_IN_ASCII = dict(λ="lambda", ε="epsilon", γ="gamma", α="alpha", δ="delta", τ="tau", π="pi", θ="theta")
_IN_ASCII |= {"±": "+-", "−": "-", "–": "-", "—": "-", "·": "-", "×": "x", "…": "...", "≤": "<=", "≥": ">=", "∞": "inf"}
_IN_ASCII |= {"→": "->", "←": "<-", "↑": "^", "↓": "v", "½": "1/2", "²": "^2", "√": "sqrt ", "“": '"', "”": '"'}
_IN_ASCII |= dict.fromkeys("─━╸╺", "-") | dict.fromkeys("│┃", "|") | dict.fromkeys("┌┐└┘├┤┬┴┼╭╮╰╯", "+")


def _spelled_out(error: UnicodeError) -> tuple[str, int]:
    """What stands for characters that the terminal's encoding lacks."""
    assert isinstance(error, UnicodeEncodeError)
    return "".join(_IN_ASCII.get(one, "?") for one in error.object[error.start : error.end]), error.end


def make_standard_streams_safe() -> None:
    """Nothing that is said can fail: neither where a stream is closed, nor for what its encoding lacks.

    What is written to a closed stream is lost, and does not end up in a file that happens to be opened in its place.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            taken = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: the one that was closed
            mode = "r" if number == 0 else "w"
            setattr(sys, name, open(taken, mode, encoding="utf-8"))
    codecs.register_error("neuralq", _spelled_out)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.encoding.lower().replace("-", "") != "utf8":
            stream.reconfigure(errors="neuralq")


@contextlib.contextmanager
def descriptor_of_its_own() -> Iterator[TextIO]:
    """Standard output by a descriptor of its own; what others write to descriptor 1 goes to standard error meanwhile.

    Libraries in C, and processes that are started, print there, whatever `sys.stdout` is.
    """
    try:
        ours = sys.stdout.fileno() == 1
    except (OSError, ValueError):  # it is no file
        ours = False
    if not ours:
        yield sys.stdout
        return
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with open(os.dup(kept), "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors) as own:
            yield own
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def end_without_waiting(status: int) -> None:
    """If a thread was left that no daemon is, the process ends with this status after `GRACE` seconds all the same.

    Python waits at its end for every such thread, and an environment's may run for ever.
    """
    left = [t.name for t in threading.enumerate() if t is not threading.main_thread() and not t.daemon]
    if not left:
        return

    def end() -> None:
        time.sleep(GRACE)
        print(f"neuralq: ended without waiting any longer for the thread {left[0]!r}", file=sys.stderr, flush=True)
        os._exit(status)

    threading.Thread(target=end, daemon=True).start()


@contextlib.contextmanager
def listening() -> Iterator[list[int]]:
    """Ctrl-C raises KeyboardInterrupt, as ever, and is remembered: raised while kernels load, it may be swallowed."""
    heard: list[int] = []

    def note(number: int, frame: Any) -> None:
        heard.append(number)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not (
        signal.default_int_handler
    ):
        yield heard
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield heard
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)

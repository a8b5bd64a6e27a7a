"""What a command has from whoever started it: streams that may be closed or know no Greek, and Ctrl-C."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

__all__ = ["listening", "make_standard_streams_safe"]

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

"""Numbers as people write them on a command line: 1e5, 100k, 2.5M, 1_000_000."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable
from decimal import Decimal

__all__ = ["any_number", "joined", "number", "whole_number"]

_WRITTEN = re.compile(r"([-+]?(?:\d+(?:_\d+)*(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d{1,4})?)([kKMG]?)", re.ASCII)
_THOUSANDS = {"": 0, "k": 3, "K": 3, "M": 6, "G": 9}
_MOST_DIGITS = 400
"""Of a whole number; what is larger is a float, and soon infinite."""


def any_number(text: str) -> int | float:
    """The number, whole where it has no fraction: 2.3M is 2,300,000 and not a little less.

    Raises:
        ValueError: it is no number.

    Example:
        >>> any_number("100k"), any_number("2.3M"), any_number("1_000"), any_number("5e-4")
        (100000, 2300000, 1000, 0.0005)
    """
    match = _WRITTEN.fullmatch(text.strip())
    if match is None:
        return float(text)  # inf and nan, which whoever wants a number refuses where it must be finite
    exact = Decimal(match[1]).scaleb(_THOUSANDS[match[2]])
    is_whole = exact.adjusted() < _MOST_DIGITS and exact == exact.to_integral_value()
    return int(exact) if is_whole else float(exact)


def number(text: str) -> float:
    """A number, for an option that takes any.

    Raises:
        argparse.ArgumentTypeError: it is no number.
    """
    try:
        return float(any_number(text))
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"must be a number, got {text!r}") from None


def whole_number(text: str) -> int:
    """A whole number, for an option that counts.

    Raises:
        argparse.ArgumentTypeError: it is none.

    Example:
        >>> whole_number("1e5")
        100000
    """
    try:
        value = any_number(text)
    except ValueError:
        value = 0.5
    if isinstance(value, float):
        raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}")
    return value


def joined(argv: Iterable[str]) -> list[str]:
    """An option and the negative number behind it as one word: argparse takes -1 for a number but -1e2 for an option.

    Example:
        >>> joined(["--stop-at-return", "-1.1e2", "--seed", "3"])
        ['--stop-at-return=-1.1e2', '--seed', '3']
    """
    out: list[str] = []
    for token in argv:
        if out and re.fullmatch(r"--[^=]+", out[-1]) and re.match(r"-\.?\d", token):
            out[-1] = f"{out[-1]}={token}"
        else:
            out.append(token)
    return out

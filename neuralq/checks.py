"""Checks of what callers hand in: each says what was wrong, what was got and the way out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

__all__ = ["check_choice", "check_discount", "check_fraction", "check_positive", "check_whole"]


def check_fraction(name: str, value: float, hint: str = "") -> None:
    """``value`` lies in [0, 1].

    Raises:
        ValueError: otherwise (also for NaN), with ``hint`` as the way out.
    """
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name} must lie in [0, 1], got {value!r}" + (f"; {hint}" if hint else ""))


def check_discount(name: str, value: float) -> None:
    """``value`` is a discount factor in [0, 1].

    Raises:
        ValueError: otherwise.
    """
    check_fraction(name, value, "a discount above 1 makes returns grow without bound")


def check_positive(name: str, value: float) -> None:
    """``value`` is finite and greater than zero.

    Raises:
        ValueError: otherwise.
    """
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be a finite number above 0, got {value!r}")


def check_whole(name: str, value: int, minimum: int = 1) -> None:
    """``value`` is a whole number of at least ``minimum`` (a bool is not).

    Raises:
        ValueError: otherwise.
    """
    if isinstance(value, bool) or not math.isfinite(value) or int(value) != value or value < minimum:
        raise ValueError(f"{name} must be a whole number of at least {minimum}, got {value!r}")


def check_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """``value`` is one of ``choices``.

    Raises:
        ValueError: otherwise, listing them.
    """
    options = list(choices)
    if value not in options:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, options))}, got {value!r}")

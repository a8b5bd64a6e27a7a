"""Schedules: numbers that depend on a counter and on nothing else.

A schedule has no memory: ``value(step)`` is a pure function of the counter its owner keeps, so a resumed run needs no
schedule state and any point of the future can be asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from neuralq.checks import check_positive, check_whole

__all__ = ["Constant", "Exponential", "Linear", "Power", "Schedule"]


class Schedule(Protocol):
    """Anything with ``value(step)``: a number for every counter from 0."""

    def value(self, step: int) -> float:
        """The number at ``step`` (0, 1, 2, …)."""
        ...


@dataclass(frozen=True, slots=True)
class Constant:
    """The same number always: ``level``.

    Raises:
        ValueError: if ``level`` is not finite.

    Example:
        >>> Constant(0.1).value(1_000_000)
        0.1
    """

    level: float

    def __post_init__(self) -> None:
        """Refuses what is not a number."""
        _check_finite("level", self.level)

    def value(self, step: int) -> float:
        """The level, whatever the step."""
        check_whole("step", step, 0)
        return self.level


@dataclass(frozen=True, slots=True)
class Linear:
    """A straight line from ``start`` at step 0 to ``end`` at ``num_steps``, and ``end`` from there on.

    Raises:
        ValueError: if an end is not finite or ``num_steps`` is not a whole number of at least 1.

    Example:
        >>> epsilon = Linear(1.0, 0.1, 9)
        >>> [round(epsilon.value(step), 3) for step in (0, 1, 9, 1000)]
        [1.0, 0.9, 0.1, 0.1]
    """

    start: float
    end: float
    num_steps: int

    def __post_init__(self) -> None:
        """Refuses ends that are not numbers and lengths below 1."""
        _check_finite("start", self.start)
        _check_finite("end", self.end)
        check_whole("num_steps", self.num_steps)

    def value(self, step: int) -> float:
        """``start + (end - start) · step / num_steps``, not beyond ``end``."""
        check_whole("step", step, 0)
        if step >= self.num_steps:  # exactly the end, not the end up to rounding
            return self.end
        return self.start + (self.end - self.start) * (step / self.num_steps)


@dataclass(frozen=True, slots=True)
class Exponential:
    """The same factor every step, from ``start`` at step 0 to ``end`` at ``num_steps``, and ``end`` from there on.

    Raises:
        ValueError: if an end is not a finite number above 0, or ``num_steps`` is not a whole number of at least 1.

    Example:
        >>> rate = Exponential(1.0, 0.01, 2)
        >>> [round(rate.value(step), 3) for step in (0, 1, 2, 1000)]
        [1.0, 0.1, 0.01, 0.01]
    """

    start: float
    end: float
    num_steps: int

    def __post_init__(self) -> None:
        """Refuses ends that no factor connects, and lengths below 1."""
        check_positive("start", self.start)
        check_positive("end", self.end)
        check_whole("num_steps", self.num_steps)

    def value(self, step: int) -> float:
        """``start · (end / start)^(step / num_steps)``, not beyond ``end``."""
        check_whole("step", step, 0)
        if step >= self.num_steps:
            return self.end
        # A product of powers: end / start may overflow or underflow where the answer does not.
        fraction = step / self.num_steps
        return float(self.start ** (1.0 - fraction) * self.end**fraction)


@dataclass(frozen=True, slots=True)
class Power:
    """A polynomially falling step size: ``scale / (step + offset)^exponent``.

    Stochastic approximation converges where the sum of the step sizes is infinite and the sum of their squares finite:
    exponents in (1/2, 1]. With exponent 1 and offset 1, ``value(visits)`` is Mitchell's 1 / (1 + visits), the visits
    counted up to and including the present one.

    Raises:
        ValueError: if a number is not finite and above 0.

    Source: Robbins & Monro 1951; Mitchell 1997, eq. 13.11.

    Example:
        >>> alpha = Power(exponent=1.0)
        >>> [alpha.value(visits) for visits in (1, 3)]
        [0.5, 0.25]
    """

    exponent: float
    scale: float = 1.0
    offset: float = 1.0

    def __post_init__(self) -> None:
        """Refuses exponents, scales and offsets that are not above 0."""
        check_positive("exponent", self.exponent)
        check_positive("scale", self.scale)
        check_positive("offset", self.offset)

    def value(self, step: int) -> float:
        """``scale / (step + offset)^exponent``."""
        check_whole("step", step, 0)
        return float(self.scale / (step + self.offset) ** self.exponent)


def _check_finite(name: str, value: float) -> None:
    """``value`` is a finite number."""
    if not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}")

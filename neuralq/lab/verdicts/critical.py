"""Where stability begins and ends, in any one parameter of a problem or of a method.

The margin of an expected update is positive where it converges:

* without a step size, for a flow θ' = g − G θ: the least real part of an eigenvalue of G that moves anything, the limit
  of small steps;
* with one: 1 − ρ, ρ the spectral radius of θ ← M θ + c on what it moves.

Stable sets need not be intervals: a short target period can be worse than none, a penalty can be too large for the step
size, a window can open in the middle. So the whole range is scanned first, dips between the points are followed
to their bottom, and only then is each change of sign refined by bracketing.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from neuralq.checks import check_choice, check_positive
from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.spectrum import flow_spectrum, moving_spectrum, visible_process
from neuralq.lab.methods import Method
from neuralq.lab.methods import method as method_named
from neuralq.lab.methods.record import Options
from neuralq.lab.plain import fields_of
from neuralq.types import Floats
from neuralq_envs.counterexamples import Problem

__all__ = ["CRITICAL_PARAMETERS", "NoBoundary", "StabilityScan", "critical", "scan", "stability_margin"]


@dataclass(frozen=True)
class _Range:
    """Where a parameter is looked at.

    Args:
        low: smallest value.
        high: largest value.
        spacing: ``"linear"``, ``"log"`` or ``"whole"`` (every whole number).
        method: the method that has this parameter and is TD without it.
    """

    low: float
    high: float
    spacing: str
    method: str


CRITICAL_PARAMETERS = {
    "gamma": _Range(0.0, 1.0, "linear", "td"),
    "lambda_": _Range(0.0, 1.0, "linear", "td"),
    "eta": _Range(1e-6, 1e3, "log", "td"),
    "phi": _Range(0.0, 1.0, "linear", "residual"),
    "period": _Range(1, 1024, "whole", "hard-target"),
    "tau": _Range(1e-6, 1.0, "log", "polyak-target"),
    "beta": _Range(0.0, 1.0, "linear", "etd"),
    "beta_over_alpha": _Range(1e-4, 1e4, "log", "tdc"),
    "num_steps": _Range(1, 256, "whole", "n-step"),
}
"""Every parameter that has a critical value, and where it is looked for."""

_POINTS = 241
_LARGEST = float(np.finfo(np.float64).max)  # the margin where nothing moves, and minus that where float64 overflows
_LARGEST_RATIO = 1.0 - 1e-9  # γ and λ below 1 by this: continuing problems have no values at γ = 1


class NoBoundary(ValueError):
    """The update is stable, or unstable, over the whole range."""


@dataclass(frozen=True, eq=False)
class StabilityScan:
    """The margin of stability over a range of one parameter.

    Args:
        problem: its name.
        method: its name.
        parameter: which one.
        step_size: α, or None for the limit of small steps.
        values: where it was looked at, rising, ``[m]``.
        margins: positive where the update converges, ``[m]``.
        boundaries: values at which stability changes, rising; for whole numbers the first value after the change.
    """

    problem: str
    method: str
    parameter: str
    step_size: float | None
    values: Floats
    margins: Floats
    boundaries: tuple[float, ...]

    @property
    def intervals(self) -> tuple[tuple[float, float, bool], ...]:
        """The whole range as ``(from, to, whether it is stable)``."""
        edges = [float(self.values[0]), *self.boundaries, float(self.values[-1])]
        first = bool(self.margins[0] > 0)
        return tuple((low, high, first == (k % 2 == 0)) for k, (low, high) in enumerate(itertools.pairwise(edges)))

    @property
    def stable(self) -> tuple[tuple[float, float], ...]:
        """The stable set as intervals ``(from, to)``."""
        return tuple((low, high) for low, high, inside in self.intervals if inside)

    def first(self) -> float:
        """The first boundary from below.

        Raises:
            NoBoundary: nothing changes over the whole range; the message says what holds.
        """
        if self.boundaries:
            return self.boundaries[0]
        raise NoBoundary(
            f"{self.method} on {self.problem} is {'stable' if self.margins[0] > 0 else 'unstable'} for every "
            f"{self.parameter} from {self.values[0]:g} to {self.values[-1]:g}: there is no critical value"
        )

    def plain(self) -> dict[str, Any]:
        """Everything as text and numbers, as JSON takes it."""
        return {
            **fields_of(self, "problem", "method", "parameter", "step_size", "boundaries", "stable"),
            "critical": self.boundaries[0] if self.boundaries else None,
            "range": [float(self.values[0]), float(self.values[-1])],
        }


def critical(
    problem: Problem, parameter: str, method: str = "td", step_size: float | None = None, **options: float
) -> float:
    """The value of a parameter at which stability first changes, scanning upwards.

    Args:
        problem: what is learned.
        parameter: one of `CRITICAL_PARAMETERS`.
        method: which method; for a parameter that TD does not have, ``"td"`` stands for the method that adds it.
        step_size: α; None for the limit of small steps where the method has one, else for the problem's own.
        options: other options of the method.

    Returns:
        The boundary; for whole numbers (``period``, ``num_steps``) the first value on its other side. `scan` gives all
        boundaries and the margin in between.

    Raises:
        ValueError: an unknown parameter, method or option.
        NoBoundary: nothing changes over the whole range; the message says what holds.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> round(critical(star(), "gamma"), 10) == round(15 / 17, 10)
        True
    """
    return scan(problem, parameter, method, step_size, None, **options).first()


def scan(
    problem: Problem,
    parameter: str,
    method: str = "td",
    step_size: float | None = None,
    bounds: tuple[float, float] | None = None,
    **options: float,
) -> StabilityScan:
    """The margin of stability over the range of a parameter, with every boundary.

    Arguments as for `critical`; ``bounds`` replaces the range.

    Raises:
        ValueError: what `critical` refuses, or bounds that are no range.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> [(round(low, 6), round(high, 6)) for low, high in scan(star(), "gamma").stable]
        [(0.0, 0.882353)]
    """
    check_choice("parameter", parameter, CRITICAL_PARAMETERS)
    if step_size is not None:
        check_positive("step_size", step_size)
    usual = CRITICAL_PARAMETERS[parameter]
    chosen = method_named(method)
    if parameter != "gamma" and parameter not in chosen.options and method == "td":
        chosen = method_named(usual.method)
    if parameter != "gamma":
        chosen.checked({parameter: usual.high})
    values = _values_of(parameter, usual, bounds)
    seen = None if parameter == "gamma" else visible_process(linear_process(problem))[0]

    def margin(value: float) -> float:
        if seen is None:
            return stability_margin(replace(problem, gamma=value), chosen, step_size, **options)
        return _margin(seen, chosen, problem.step_size, step_size, {**options, parameter: value})

    margins = np.array([_or_nan(margin, value) for value in values])
    known = np.isfinite(margins)
    if not known.any():
        margin(float(values[0]))  # says what is wrong
    values, margins = values[known], margins[known]
    if usual.spacing == "whole":
        changes = np.flatnonzero((margins[1:] > 0) != (margins[:-1] > 0))
        boundaries = tuple(float(value) for value in values[changes + 1])
    else:
        boundaries = _crossings(margin, values, margins)
    return StabilityScan(problem.name, chosen.name, parameter, step_size, values, margins, boundaries)


def stability_margin(problem: Problem, chosen: Method, step_size: float | None = None, **options: float) -> float:
    """How far the expected update is from the edge of stability; positive where it converges.

    Args:
        problem: what is learned.
        chosen: the method.
        step_size: α; None for the limit of small steps (a method that is no flow is looked at with the problem's own).
        options: of the method.

    Raises:
        ValueError: the method has no expected update, or one that changes with the weights.

    Example:
        >>> from neuralq.lab.methods.td import TD
        >>> from neuralq_envs.counterexamples import star
        >>> round(stability_margin(star(), TD), 9)  # the eigenvalue behind the divergence of the star
        -0.239250464
    """
    process, _ = visible_process(linear_process(problem))
    return _margin(process, chosen, problem.step_size, step_size, options)


def _margin(process: Process, chosen: Method, usual: float, step_size: float | None, options: Options) -> float:
    if chosen.expected is None:
        raise ValueError(f"{chosen.title} has no expected update to look at")
    expected = chosen.expected(process, chosen.checked(options))
    if not expected.linear:
        raise ValueError(f"the expected update of {chosen.title} changes with the weights: use diagnose instead")
    if step_size is None and expected.generator is not None:
        return float(flow_spectrum(expected.generator[0]).real.min(initial=_LARGEST))
    alpha = usual if step_size is None else step_size
    start = expected.initial(np.zeros(process.num_weights))
    with np.errstate(over="ignore", invalid="ignore"):
        M = expected.at(start, alpha)[0]
    if not np.isfinite(M).all():  # the power of an update that explodes
        return -_LARGEST
    factors = moving_spectrum(M)
    return 1.0 - float(np.abs(factors).max(initial=0.0))


def _values_of(parameter: str, usual: _Range, bounds: tuple[float, float] | None) -> Floats:
    """Where a scan looks."""
    low, high = (usual.low, usual.high) if bounds is None else bounds
    if not (np.isfinite([low, high]).all() and low < high) or (usual.spacing != "linear" and low <= 0):
        least = "" if usual.spacing == "linear" else " with from > 0"
        raise ValueError(
            f"bounds of {parameter} must be finite numbers (from, to) in rising order{least}, got {bounds!r}"
        )
    return _points(usual.spacing, low, high)


def _points(spacing: str, low: float, high: float) -> Floats:
    if spacing == "whole":
        return np.arange(int(low), int(high) + 1, dtype=np.float64)
    if spacing == "log":
        return np.geomspace(low, high, _POINTS)
    return np.linspace(low, min(high, _LARGEST_RATIO) if high == 1.0 else high, _POINTS)


def _or_nan(margin: Callable[[float], float], value: float) -> float:
    """A parameter value for which the update is not defined (γ = 1 in a world without end) is passed over."""
    try:
        return margin(float(value))
    except (np.linalg.LinAlgError, ValueError, RuntimeError):
        return float("nan")


def _crossings(margin: Callable[[float], float], values: Floats, margins: Floats) -> tuple[float, ...]:
    """Every zero of a continuous margin, also pairs of them between two points of the scan."""
    knots = list(zip(values.tolist(), (margins > 0).tolist(), strict=True))  # and whether it is stable there
    size = np.abs(margins)
    for i in range(1, len(values) - 1):
        # A dip towards zero that does not reach it at the points may do so in between.
        same = np.sign(margins[i - 1]) == np.sign(margins[i]) == np.sign(margins[i + 1])
        if same and size[i] <= size[i - 1] and size[i] <= size[i + 1]:
            sign = np.sign(margins[i])
            least = minimize_scalar(
                lambda x, sign=sign: sign * margin(x), bounds=(values[i - 1], values[i + 1]), method="bounded"
            )
            if least.fun < 0:
                knots.append((float(least.x), bool(sign < 0)))
    knots.sort()
    found = []
    for (low, stable_low), (high, stable_high) in itertools.pairwise(knots):
        if stable_low != stable_high:
            found.append(float(brentq(margin, low, high, xtol=1e-15, rtol=4e-15)))
    return tuple(found)

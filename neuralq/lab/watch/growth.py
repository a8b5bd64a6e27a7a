"""Exponential growth in a series of measurements: its rate, how well it fits, and whether it goes on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["GrowthFit", "fit_growth"]


@dataclass(frozen=True)
class GrowthFit:
    """A geometric curve through a series.

    Args:
        rate: slope of log y; per unit of x.
        rise: factor of the fitted curve from the first x to the last.
        fit: R² of log y on x: 1 for a pure exponential, near 0 for noise.
        sustained: whether the second half grows at least half as fast as the first: learning slows down, divergence
            does not.
        doubling: units of x in which y doubles; None where it does not grow.
    """

    rate: float
    rise: float
    fit: float
    sustained: bool
    doubling: float | None

    @property
    def explosive(self) -> bool:
        """Whether it rose at least tenfold, along an exponential, without slowing down."""
        return self.rise >= 10 and self.fit >= 0.9 and self.sustained


def fit_growth(x: ArrayLike, y: ArrayLike) -> GrowthFit | None:
    """The geometric curve through ``y`` by least squares on its logarithm; None where there is nothing to fit.

    Args:
        x: updates or steps, increasing, ``[k]``.
        y: what is measured, ``[k]``. Entries that are not finite and above 0 are left out.

    Example:
        >>> found = fit_growth([0, 10, 20, 30], [1.0, 4.0, 16.0, 64.0])
        >>> round(found.doubling, 9), round(found.rise, 9), found.explosive
        (5.0, 64.0, True)
    """
    at, height = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    usable = np.isfinite(height) & (height > 0)
    at, height = at[usable], height[usable]
    if len(at) < 4 or at[-1] <= at[0]:
        return None
    logs = np.log(height)
    rate, fit = _slope(at, logs)
    middle = len(at) // 2
    early, late = _slope(at[: middle + 1], logs[: middle + 1])[0], _slope(at[middle:], logs[middle:])[0]
    rise = math.exp(min(rate * (at[-1] - at[0]), 700.0))
    return GrowthFit(rate, rise, fit, late > 0 and late >= 0.5 * early, math.log(2) / rate if rate > 0 else None)


def _slope(
    x: np.ndarray[tuple[int], np.dtype[np.float64]], y: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> tuple[float, float]:
    """Slope and R² of the least-squares line."""
    dx, dy = x - x.mean(), y - y.mean()
    spread = float(dx @ dx)
    if spread == 0:
        return 0.0, 0.0
    slope = float(dx @ dy) / spread
    total = float(dy @ dy)
    return slope, 1 - float(((dy - slope * dx) ** 2).sum()) / total if total > 0 else 0.0

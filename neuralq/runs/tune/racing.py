"""Racing: a trial is given further seeds only while it may still be as good as the best.

Every trial begins with a few seeds, the same for all. As long as the bootstrap interval of its interquartile mean
overlaps with that of the best, it is given the next seed, up to a most; where it lies below, the trial is dropped. So
most of the runs go to configurations between which it is hard to tell.

Source: Birattari, Stützle, Paquete & Varrentrapp 2002, "A racing algorithm for configuring metaheuristics", with the
interval of Agarwal et al. 2021 in place of the test of ranks.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from neuralq.checks import check_fraction
from neuralq.runs.sweep.statistics import Estimate, estimate, interquartile_mean

__all__ = ["Difference", "Standing", "difference", "raced"]

_RESAMPLES = 10_000


@dataclass(frozen=True)
class Standing:
    """How a trial stands in the race.

    Args:
        state: "racing", "dropped" or "through", with every seed that there is.
        estimate: by the seeds that count; None before the first few are there.
        num_seeds: that count. Others may have run ahead, and say nothing.
    """

    state: str
    estimate: Estimate | None
    num_seeds: int

    @property
    def is_settled(self) -> bool:
        """Whether no further seed will change it."""
        return self.state != "racing"


def raced(scores: Sequence[float], best: Estimate | None, few: int, most: int) -> Standing:
    """How a trial stands whose seeds are looked at in their order, as if each had been waited for.

    Args:
        scores: of its seeds in their order, as far as they are known.
        best: of the trial that is to be beaten; None where there is nothing to be dropped for.
        few: seeds of every trial, at least 2.
        most: seeds of a trial that is not dropped.

    Example:
        >>> best = raced([9.0, 10.0, 11.0], None, 3, 3).estimate
        >>> raced([1.0, 2.0, 3.0, 50.0], best, 3, 10).state, raced([9.0, 9.5, 10.0, 10.0], best, 3, 10).state
        ('dropped', 'racing')
    """
    found, num_seeds = None, 0
    for num_seeds in range(few, min(len(scores), most) + 1):
        found = _estimate(tuple(scores[:num_seeds]))
        if best is not None and _is_below(found, best):
            return Standing("dropped", found, num_seeds)
    state = "through" if found is not None and num_seeds == most else "racing"
    return Standing(state, found, num_seeds if found is not None else 0)


@functools.lru_cache(maxsize=1024)
def _estimate(scores: tuple[float, ...]) -> Estimate:
    """The same for the same scores, which are asked for again whenever a seed has ended."""
    return estimate(scores)


def _is_below(one: Estimate, best: Estimate) -> bool:
    return one.high is not None and best.low is not None and one.high < best.low


@dataclass(frozen=True)
class Difference:
    """By how much the interquartile mean of some runs exceeds that of others.

    Args:
        value: the one less the other.
        low: lower end of its interval.
        high: upper end.
    """

    value: float
    low: float
    high: float


def difference(ours: ArrayLike, theirs: ArrayLike, confidence: float = 0.95, seed: int = 0) -> Difference:
    """The difference between two interquartile means and its percentile bootstrap interval, each resampled by itself.

    Args:
        ours: ``[n]`` scores.
        theirs: ``[m]`` scores.
        confidence: share of the resamples within the interval.
        seed: of the resamples.

    Raises:
        ValueError: there are no scores, or the confidence is none.

    Example:
        >>> difference([5.0, 6.0, 7.0], [1.0, 2.0, 3.0]).low > 0
        True
    """
    check_fraction("confidence", confidence)
    rng = np.random.default_rng(seed)
    one, other = (np.asarray(scores, np.float64).reshape(-1) for scores in (ours, theirs))
    value = float(interquartile_mean(one) - interquartile_mean(other))
    means = [
        interquartile_mean(scores[rng.integers(len(scores), size=(_RESAMPLES, len(scores)))]) for scores in (one, other)
    ]
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(means[0] - means[1], [tail, 100.0 - tail])
    return Difference(value, float(low), float(high))

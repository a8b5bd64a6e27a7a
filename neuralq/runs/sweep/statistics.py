"""One number for many runs, and how sure it is: the interquartile mean with a stratified bootstrap interval.

A mean over a few runs is moved by one lucky run, and a median wastes most of them. The interquartile mean drops the
lowest and the highest quarter of the scores and averages the rest: nearly as robust as the median, nearly as efficient
as the mean. Its interval comes from the bootstrap: draw as many runs again, with replacement, and ask between which
bounds the number falls in 95 % of the draws. With several tasks the runs of each task are drawn by themselves, so that
every resample has as many runs of every task as there were: the stratified bootstrap.

Source: Agarwal, Schwarzer, Castro, Courville, Bellemare (2021), "Deep reinforcement learning at the edge of the
statistical precipice", §4.1 and §4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike

from neuralq.checks import check_fraction, check_whole
from neuralq.types import Floats

__all__ = ["Estimate", "bootstrap_interval", "estimate", "interquartile_mean", "median_interval"]

_MOST_DRAWN = 4_000_000  # scores held at once while resampling: 32 MB


@dataclass(frozen=True, slots=True)
class Estimate:
    """The interquartile mean of some runs and the interval it is known to.

    Args:
        iqm: interquartile mean.
        low: lower bound of the interval; None with fewer than two runs, which say nothing about the spread.
        high: upper bound, likewise.
        num_runs: how many runs.
    """

    iqm: float
    low: float | None
    high: float | None
    num_runs: int


def interquartile_mean(scores: ArrayLike, axis: int = -1) -> Floats:
    """The mean of the middle half: ⌊n/4⌋ scores are dropped at each end and the others averaged.

    Args:
        scores: ``[..., n]`` along ``axis``, n ≥ 1.
        axis: along which the runs lie.

    Returns:
        ``[...]``, one number per remaining place.

    Raises:
        ValueError: if there are no scores.

    Source: Agarwal et al. (2021), §4.3; for n not divisible by 4 the trimmed mean of `scipy.stats.trim_mean`.

    Example:
        >>> float(interquartile_mean([0.0, 1.0, 3.0, 100.0]))  # (1 + 3) / 2
        2.0
    """
    ordered = np.sort(np.moveaxis(np.asarray(scores, np.float64), axis, -1), axis=-1)
    num_scores = ordered.shape[-1]
    if num_scores == 0:
        raise ValueError("an interquartile mean needs at least one score, got none")
    cut = num_scores // 4
    mean: Floats = np.mean(ordered[..., cut : num_scores - cut], axis=-1)
    return mean


def bootstrap_interval(
    scores: ArrayLike, rng: np.random.Generator, confidence: float = 0.95, num_resamples: int = 10_000
) -> tuple[Floats, Floats]:
    """Percentile interval of the interquartile mean over all runs and tasks, the runs of each task drawn by themselves.

    Args:
        scores: ``[num_runs, num_tasks]``, or ``[num_runs]`` for one task; further leading axes ``[*n, num_runs,
            num_tasks]`` (points of a curve, say) are resampled alike, whole runs at a time.
        rng: draws the resamples.
        confidence: share of the resamples within the interval, in [0, 1].
        num_resamples: how many.

    Returns:
        Lower and upper bounds ``[*n]``.

    Raises:
        ValueError: if there are no scores, or for a confidence outside [0, 1].

    Source: Agarwal et al. (2021), §4.1; percentile bootstrap of Efron (1979).

    Example:
        >>> low, high = bootstrap_interval([1.0, 2.0, 3.0, 4.0], np.random.default_rng(0))
        >>> 1.0 <= low < 2.5 < high <= 4.0
        np.True_
    """
    check_fraction("confidence", confidence)
    check_whole("num_resamples", num_resamples)
    table = np.asarray(scores, np.float64)
    table = table[:, None] if table.ndim == 1 else table
    *leading, num_runs, num_tasks = table.shape
    if table.size == 0:
        raise ValueError("an interval needs at least one score, got none")
    at_once = max(1, _MOST_DRAWN // table.size)
    found = []
    for begin in range(0, num_resamples, at_once):
        size = min(at_once, num_resamples - begin)
        drawn = rng.integers(num_runs, size=(size, num_runs, num_tasks))
        resampled = table[..., drawn, np.arange(num_tasks)]  # [*n, size, num_runs, num_tasks]
        found.append(interquartile_mean(resampled.reshape(*leading, size, num_runs * num_tasks)))
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(np.concatenate(found, axis=-1), [tail, 100.0 - tail], axis=-1)
    return low, high


def estimate(scores: ArrayLike, seed: int = 0) -> Estimate:
    """Interquartile mean and 95 % interval; the same scores give the same interval every time.

    Args:
        scores: ``[num_runs]`` of one task, or ``[num_runs, num_tasks]``.
        seed: of the resamples.

    Raises:
        ValueError: if there are no scores.

    Example:
        >>> estimate([500.0, 500.0, 480.0]).iqm, estimate([500.0]).low
        (493.3333333333333, None)
    """
    values = np.asarray(scores, np.float64)
    iqm = float(interquartile_mean(values.reshape(-1)))
    if len(values) < 2:
        return Estimate(iqm, None, None, values.size)
    low, high = bootstrap_interval(values, np.random.default_rng(seed))
    return Estimate(iqm, float(low), float(high), values.size)


def median_interval(scores: ArrayLike, confidence: float = 0.95) -> tuple[float, float] | None:
    """The two scores between which the true median lies with at least this confidence, whatever the distribution.

    Of n scores the number below the median is binomial, so the k-th from either end will do where k − 1 or fewer
    successes of n fair throws have a probability of at most (1 − confidence) / 2. Scores that are only known to be
    large ("not within 1,000") may stand as the bound.

    Args:
        scores: ``[n]``.
        confidence: in [0, 1].

    Returns:
        Lower and upper bound; None where n is too small for any (below six for 95 %).

    Raises:
        ValueError: if there are no scores, or for a confidence outside [0, 1].

    Source: David & Nagaraja 2003, "Order statistics", section 7.1.

    Example:
        >>> median_interval([9.0, 1.0, 2.0, 3.0, 4.0, 5.0]), median_interval([1.0, 2.0])
        ((1.0, 9.0), None)
    """
    check_fraction("confidence", confidence)
    ordered = np.sort(np.asarray(scores, np.float64).reshape(-1))
    if not ordered.size:
        raise ValueError("an interval needs at least one score, got none")
    at_most = scipy.stats.binom.cdf(np.arange(ordered.size // 2), ordered.size, 0.5)
    k = int(np.count_nonzero(at_most <= (1.0 - confidence) / 2))
    return (float(ordered[k - 1]), float(ordered[-k])) if k else None

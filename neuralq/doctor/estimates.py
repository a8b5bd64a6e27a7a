"""Statistics of episodes: intervals that resample whole episodes, and regressions held out by episode.

Steps of an episode hang together, so that as many steps as there are do not make as many independent observations.
Everything here therefore resamples, and holds out, whole episodes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from neuralq.types import Array, Floats

__all__ = [
    "area_under_curve",
    "bounds_of",
    "held_out_r2",
    "held_out_scores",
    "rank_correlation",
    "td_against_monte_carlo",
]

_RESAMPLES = 1000
_NUM_FEATURES = 300


def bounds_of(
    sums: Array, statistic: Callable[[Floats], Floats], rng: np.random.Generator, confidence: float = 0.95
) -> tuple[float, float]:
    """Percentile interval of a statistic of sums over episodes (Efron 1979), whole episodes resampled.

    Args:
        sums: what each episode adds, ``[episodes, k]``.
        statistic: of the sums over a resample, ``[resamples, k] -> [resamples]``.
        rng: draws the resamples.
        confidence: share of the resamples within.

    Example:
        >>> low, high = bounds_of(np.array([[1.0, 1], [2, 1], [3, 1]]), lambda s: s[:, 0] / s[:, 1],
        ...                       np.random.default_rng(0))
        >>> 1 <= low < 2 < high <= 3
        True
    """
    counts = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), size=_RESAMPLES)
    with np.errstate(all="ignore"):
        drawn = statistic(counts.astype(np.float64) @ np.asarray(sums, np.float64))
    kept = drawn[np.isfinite(drawn)]
    if not kept.size:
        return float("nan"), float("nan")
    tail = 50.0 * (1 - confidence)
    low, high = np.percentile(kept, [tail, 100 - tail])
    return float(low), float(high)


def rank_correlation(x: Array, y: Array) -> float:
    """Spearman's ρ, ties averaged; 0 where one of them does not vary.

    Example:
        >>> rank_correlation(np.array([1.0, 2, 3]), np.array([1.0, 4, 9]))
        1.0
    """
    from scipy.stats import rankdata

    a, b = (rankdata(v) for v in (x, y))
    spread = float(a.std() * b.std())
    return 0.0 if spread == 0 else round(float(((a - a.mean()) * (b - b.mean())).mean() / spread), 12)


def area_under_curve(scores: Array, positive: Array) -> float:
    """The chance that a positive scores above a negative, ties counted half.

    Example:
        >>> area_under_curve(np.array([0.1, 0.9]), np.array([False, True]))
        1.0
    """
    from scipy.stats import rankdata

    num = int(positive.sum())
    others = len(positive) - num
    ranks = rankdata(scores)
    return float((ranks[positive].sum() - num * (num + 1) / 2) / (num * others))


def held_out_scores(x: Array, y: Array, episode: Array, rng: np.random.Generator) -> Floats:
    """Predictions of y from x for episodes that were not fitted: ridge on x and random Fourier features of it.

    Args:
        x: ``[N, d]``.
        y: ``[N, k]``.
        episode: to which each row belongs, ``[N]``; by halves one is fitted and the other predicted.
        rng: draws the features (Rahimi & Recht 2007) and the halves.

    Returns:
        ``[N, k]``.
    """
    features = _features(x, rng)
    names = rng.permutation(np.unique(episode))
    first = np.isin(episode, names[: len(names) // 2])
    predicted = np.empty_like(y, dtype=np.float64)
    for fit in (first, ~first):
        mean = y[fit].mean(0)
        gram = features[fit].T @ features[fit]
        penalty = 1e-3 * len(features[fit]) * np.eye(len(gram)) * _PENALTY
        weights = np.linalg.solve(gram + penalty, features[fit].T @ (y[fit] - mean))
        predicted[~fit] = features[~fit] @ weights + mean
    return predicted


_PENALTY = 0.1


def _features(x: Array, rng: np.random.Generator) -> Floats:
    x = np.asarray(x, np.float64)
    spread = x.std(0)
    scaled = np.clip((x - x.mean(0)) / np.where(spread > 1e-12, spread, 1.0), -5, 5)
    width = np.sqrt(max(scaled.shape[1], 1)) * 1.5
    angles = scaled @ (rng.standard_normal((scaled.shape[1], _NUM_FEATURES)) / width) + rng.uniform(
        0, 2 * np.pi, _NUM_FEATURES
    )
    made: Floats = np.concatenate([np.ones((len(x), 1)), scaled, np.cos(angles)], axis=1)
    return made


def td_against_monte_carlo(
    x: Array, rewards: Array, x_t: Array, ended: Array, returns: Array, gamma: float, rng: np.random.Generator
) -> float:
    """The λ-discrepancy of a policy's values (Allen et al. 2024): TD(0) against Monte Carlo, over returns' spread.

    Both are linear in the same features, at the fixed point of TD(0) (Bradtke & Barto 1996) and by least squares. Where
    observations are states both are its values; where states look alike they differ.

    Args:
        x: what is seen, ``[N, d]``.
        rewards: ``[N]``.
        x_t: what is seen next, ``[N, d]``.
        ended: whether the world ended there, ``[N]``.
        returns: discounted returns from x on, ``[N]``.
        gamma: γ of the returns.
        rng: draws the features.
    """
    both = _features(np.concatenate([x, x_t]), rng)
    now, ahead = both[: len(x)], both[len(x) :] * ~ended[:, None]
    penalty = 1e-6 * len(x) * np.eye(now.shape[1])
    by_td = np.linalg.solve(now.T @ (now - gamma * ahead) + penalty, now.T @ rewards)
    by_returns = np.linalg.solve(now.T @ now + penalty, now.T @ returns)
    apart = float(np.sqrt(((now @ (by_td - by_returns)) ** 2).mean()))
    return apart / max(float(returns.std()), 1e-12)


def held_out_r2(x: Array, y: Array, episode: Array, rng: np.random.Generator) -> Floats:
    """R² of `held_out_scores`, column by column of y, ``[k]``; 0 of a column that does not vary."""
    errors = ((y - held_out_scores(x, y, episode, rng)) ** 2).mean(0)
    variance = y.var(0)
    r2: Floats = np.where(variance > 1e-12, 1 - errors / np.maximum(variance, 1e-12), 0.0)
    return r2

"""One seed of one contender: the same few episodes, fitted with slopes from somewhere or without."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq.learners import SlopeNet, fit_slopes, new_slope_net
from neuralq.rules import lob_star
from neuralq.systems.ebnn.theory import Theory, explain, learn_theory, observe, predict
from neuralq_envs.linear_quadratic import PUSH, action_value_slopes, action_values

__all__ = [
    "BAD",
    "BELIEVED",
    "EXACT",
    "EXPLAINED",
    "GOOD",
    "LARGEST",
    "NONE",
    "NUM_POINTS",
    "SOURCES",
    "WEIGHED",
    "Fit",
    "fit",
]

Array = NDArray[np.float64]

NUM_POINTS = (5, 10, 20, 40)
"""Episodes that are learned from, one value each."""
GOOD, BAD = 200, 3
"""Transitions of each kind that a theory was learned from."""
LARGEST = 0.3
"""Error of the theory from which LOB* believes nothing of it, in units of the return."""
_NUM_HIDDEN, _NUM_TESTS = 10, 1000

NONE, EXACT, EXPLAINED, WEIGHED, BELIEVED = "none", "exact", "good theory", "bad theory", "bad theory, believed"
SOURCES = (NONE, EXACT, EXPLAINED, WEIGHED, BELIEVED)
"""Where slopes come from; theories are weighed by LOB*, one is believed whatever it predicts."""


@dataclass(frozen=True, eq=False)
class Fit:
    """What one seed of one contender came to.

    Args:
        points: first states of the episodes, ``[most, 2]``; of n points, the first n.
        slopes: what their values' slopes were said to be, ``[most, 2]``.
        weights: how much each was believed, ``[most]``.
        nets: by number of points, what was learned.
        errors: by number of points, the mean squared error of the value on states that were not seen.
    """

    points: Array
    slopes: Array
    weights: Array
    nets: Mapping[int, SlopeNet]
    errors: Mapping[int, float]


def fit(
    seed: np.random.SeedSequence, source: str, num_points: tuple[int, ...] = NUM_POINTS, points: Array | None = None
) -> Fit:
    """The value of pushing once, learned from the first few of the same episodes with slopes from ``source``.

    Args:
        seed: of the points, the theory and the network that learning starts from.
        source: one of `SOURCES`.
        num_points: how many episodes, one training each.
        points: where they begin, ``[most, 2]``; None to draw them.

    Raises:
        ValueError: another source.

    Example:
        >>> seed = np.random.SeedSequence(0)
        >>> fit(seed, "none", (5,)).errors[5] > 3 * fit(seed, "exact", (5,)).errors[5]
        True
    """
    check_choice("source", source, SOURCES)
    rng = np.random.default_rng(seed)
    tests, drawn = rng.uniform(-1.0, 1.0, (_NUM_TESTS, 2)), rng.uniform(-1.0, 1.0, (max(NUM_POINTS), 2))
    points = drawn if points is None else points
    start = new_slope_net(2, _NUM_HIDDEN, rng)
    theory = None if source in (NONE, EXACT) else learn_theory(GOOD if source == EXPLAINED else BAD, rng)
    y, slopes, weights = _told(points, theory, source)
    nets = {n: fit_slopes(start, points[:n], y[:n], slopes[:n], weights[:n]) for n in num_points}
    truth = action_values(tests, PUSH)
    errors = {n: float(np.mean((net.values(tests) - truth) ** 2)) for n, net in nets.items()}
    return Fit(points, slopes, weights, nets, errors)


def _told(points: Array, theory: Theory | None, source: str) -> tuple[Array, Array, Array]:
    """Observed values, slopes, and how far each of those is believed."""
    left, y = observe(points)
    if theory is None:
        return y, action_value_slopes(points, PUSH), np.full(len(points), float(source == EXACT))
    slopes = explain(theory, left)
    if source == BELIEVED:
        return y, slopes, np.ones(len(points))
    weights = lob_star(torch.from_numpy(predict(theory, points)), torch.from_numpy(y), LARGEST)
    return y, slopes, weights.numpy()

"""The first returns of a run, for what nothing else tells: that a learner cannot represent them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from neuralq.runs.stream.stream import Step

__all__ = ["EarlyReturns"]

_EARLY_STEPS = 1_000


class EarlyReturns:
    """Watches the first steps for returns outside of the range that a distribution was given.

    The discounted return of an episode is a value that the first state of it should have.

    Args:
        value_min: the smallest return that the distribution holds.
        value_max: the largest.
        discount: γ.
        num_envs: parallel environments.
        say: takes the warning, once.
    """

    def __init__(
        self, value_min: float, value_max: float, discount: float, num_envs: int, say: Callable[[str], None]
    ) -> None:
        self._range, self._discount, self._say = (value_min, value_max), discount, say
        self._sums, self._weights = np.zeros(num_envs), np.ones(num_envs)
        self._seen = 0

    def add(self, step: Step) -> EarlyReturns | None:
        """Take in a step; returns itself, or None where there is nothing more to watch for."""
        rows = step.env_indices
        self._sums[rows] += self._weights[rows] * step.rows[3]
        self._weights[rows] *= self._discount
        self._seen += len(rows)
        for episode in step.episodes:
            found, (low, high) = float(self._sums[episode.env_index]), self._range
            self._sums[episode.env_index], self._weights[episode.env_index] = 0.0, 1.0
            if not low <= found <= high:
                self._say(
                    f"a discounted return of {found:.4g} lies outside of {low:g}..{high:g}, which is all that the "
                    "categorical distribution holds: widen --replay.value-min and --replay.value-max, or take "
                    "--replay.distribution quantile, which needs neither"
                )
                return None
        return self if self._seen < _EARLY_STEPS else None

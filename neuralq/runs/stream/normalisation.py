"""Observations and rewards brought to a common scale while they stream by (Elsayed, Vasan & Mahmood 2024).

Observations are centred and divided by their standard deviation so far, (s − mean)/√(var + 1e-8), each when it arrives:
what was learned from is not rewritten later. Rewards are divided by √(var(u) + 1e-8), where u ← γ(1 − end)u + r is the
discounted sum up to now. The statistics are Welford's (1962), with the sample variance, which is 1 until there are two,
and while all that was seen is the same: nothing is divided by a spread that nobody saw. Nothing is seen further than
`CLIP` standard deviations from the mean.

The statistics are part of the stream, and of what a checkpoint holds: an agent without them would see another world.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from neuralq.checks import check_discount, check_whole
from neuralq.jit import kernel
from neuralq.types import Array

__all__ = ["CLIP", "Normalisation"]

CLIP = 100.0
"""Standard deviations beyond which nothing is seen: what was as good as constant is not worth more when it moves. In
the first 10,000 steps of training no observation is further away than that."""
_EPSILON = 1e-8


@kernel
def _take_in(x: float, n: float, j: int, mean: Array, squares: Array) -> None:
    """Welford's update of entry j with the n-th number."""
    before = x - (x if n == 1 else mean[j])
    mean[j] = x - before * (1.0 - 1.0 / n)
    squares[j] += before * (x - mean[j])


@kernel
def _spread(squares: float, n: float) -> Any:
    return np.sqrt((squares / (n - 1) if n > 1 and squares > 0 else 1.0) + _EPSILON)


@kernel
def _learn(x: Array, env_indices: Array, count: Array, mean: Array, squares: Array) -> None:
    """Welford's update with the rows ``env_indices`` of ``x [N, d]``, one after another."""
    for env_index in env_indices:
        count[0] += 1
        for j in range(mean.size):
            _take_in(x[env_index, j], count[0], j, mean, squares)


@kernel
def _scaled(x: Array, count: Array, mean: Array, squares: Array, out: Array) -> None:
    for j in range(mean.size):
        inv = 1.0 / _spread(squares[j], count[0])
        for i in range(x.shape[0]):
            out[i, j] = min(max((x[i, j] - mean[j]) * inv, -CLIP), CLIP)


@kernel
def _accumulate(
    r_t: Array, last_t: Array, moved: Array, discount: float, u: Array, count: Array, mean: Array,
    squares: Array, out: Array,
) -> None:  # fmt: skip
    for env_index in range(r_t.size):
        if moved[env_index]:
            u[env_index] = (0.0 if last_t[env_index] else discount * u[env_index]) + r_t[env_index]
            count[0] += 1
            _take_in(u[env_index], count[0], 0, mean, squares)
        out[env_index] = r_t[env_index] / _spread(squares[0], count[0])


class Normalisation:
    """Running statistics of a stream, and what it looks like seen through them.

    Args:
        shape: of one encoded observation, without the action mask.
        discount: γ, of the sums by whose spread rewards are divided.
        num_envs: parallel environments N.
        observations: whether observations are normalised.
        rewards: whether rewards are scaled.

    Example:
        >>> seen = Normalisation((1,), discount=0.99, num_envs=1)
        >>> [round(float(seen.observe(np.array([[x]], np.float32))[0, 0]), 3) for x in (1.0, 3.0, 5.0)]
        [0.0, 0.707, 1.0]
    """

    def __init__(
        self, shape: tuple[int, ...], discount: float, num_envs: int, observations: bool = True, rewards: bool = True
    ) -> None:
        check_discount("discount", discount)
        check_whole("num_envs", num_envs)
        size = int(np.prod(shape))
        self.discount = float(discount)
        self.observations, self.rewards = observations, rewards
        self._everyone = np.arange(num_envs)
        self._learning = True
        self._size = size
        self._state = {
            "observation_count": np.zeros(1),
            "observation_mean": np.zeros(size),
            "observation_squares": np.zeros(size),
            "return_count": np.zeros(1),
            "return_mean": np.zeros(1),
            "return_squares": np.zeros(1),
            "returns": np.zeros(num_envs),
        }

    def frozen(self) -> Normalisation:
        """A view that follows these statistics and adds nothing to them, for evaluations."""
        view = Normalisation((0,), self.discount, 1, self.observations, self.rewards)
        view._state, view._size, view._learning = self._state, self._size, False
        return view

    def observe(self, x: Array, env_indices: Array | None = None) -> Array:
        """Learn from the rows ``env_indices`` (all if None); returns every row normalised, ``[N, *shape]`` float32.

        Rows come as float64 where they have that: a mean of 1e9 is subtracted before float32 rounds.
        """
        if not self.observations:
            return x
        state = self._state
        stats = state["observation_count"], state["observation_mean"], state["observation_squares"]
        rows = np.ascontiguousarray(x, np.float64).reshape(len(x), self._size)
        if self._learning:
            _learn(rows, self._everyone[: len(x)] if env_indices is None else env_indices, *stats)
        out = np.empty(rows.shape, np.float32)
        _scaled(rows, *stats, out)
        return out.reshape(x.shape)

    def scaling(self) -> tuple[Array, Array] | None:
        """Mean and inverse spread of the observations so far, each ``[d]``: they are seen as (s − mean) · inverse.

        That is clipped to ±`CLIP`. None where observations are not normalised.
        """
        if not self.observations:
            return None
        (count,), squares = self._state["observation_count"], self._state["observation_squares"]
        return self._state["observation_mean"].copy(), np.array([1.0 / _spread(x, count) for x in squares])

    def reward(self, r_t: Array, last_t: Array, moved: Array) -> Array:
        """Rewards ``[N]`` over the spread of discounted sums; environments that did not move teach nothing."""
        if not self.rewards or not self._learning:
            return r_t
        state, out = self._state, np.empty(len(r_t))
        stats = state["return_count"], state["return_mean"], state["return_squares"]
        _accumulate(r_t, last_t, moved, self.discount, state["returns"], *stats, out)
        return out

    @property
    def reward_scale(self) -> float:
        """By what rewards are multiplied now."""
        count, squares = self._state["return_count"][0], self._state["return_squares"][0]
        return float(1.0 / _spread(squares, count)) if self.rewards and count > 1 else 1.0

    def state_dict(self) -> dict[str, Any]:
        """The statistics."""
        return dict(self._state)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit; views made by `frozen` follow."""
        for name, mine in self._state.items():
            mine[:] = np.asarray(state[name])

"""Environments of which only a part is seen, so that whoever acts has to remember."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

__all__ = ["Shown"]


class Shown(gym.ObservationWrapper[Any, Any, Any]):
    """Some entries of a vector of observations, and not the others.

    Args:
        env: an environment that observes a vector.
        entries: which of them are seen, in this order.

    Raises:
        ValueError: if the observations are no vector, or there is no such entry.

    Example:
        >>> env = Shown(gym.make("CartPole-v1"), entries=[0, 2])  # where cart and pole are, and not how fast
        >>> env.observation_space.shape, env.reset(seed=0)[0].shape
        ((2,), (2,))
    """

    def __init__(self, env: gym.Env[Any, Any], entries: tuple[int, ...] | list[int]) -> None:
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise ValueError(f"entries are hidden of vectors of numbers, and {env} observes {space}")
        size = space.shape[0]
        if not entries or any(i not in range(size) for i in entries):
            raise ValueError(f"entries must be whole numbers from 0 to {size - 1}, at least one, got {entries!r}")
        self._entries = np.array(entries)
        self.observation_space = Box(space.low[self._entries], space.high[self._entries], dtype=space.dtype)

    def observation(self, observation: NDArray[Any]) -> NDArray[Any]:
        """The entries that are seen."""
        seen: NDArray[Any] = observation[self._entries]
        return seen

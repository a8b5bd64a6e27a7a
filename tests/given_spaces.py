"""An environment whose observations are drawn from a space that is given, for tests of what leaves a run."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class GivenSpace(gym.Env[Any, Any]):
    """Observations of a space that is given, with a mask or without one; actions are numbered from −1."""

    action_space = spaces.Discrete(3, start=-1)

    def __init__(self, space: gym.Space[Any], masked: bool = False) -> None:
        self.observation_space, self.masked = space, masked

    def look(self) -> tuple[Any, dict[str, Any]]:
        mask = self.np_random.integers(0, 2, 3, np.int8)
        mask[1] = 1
        return self.observation_space.sample(), {"action_mask": mask} if self.masked else {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.look()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, info = self.look()
        return observation, float(action), bool(self.np_random.random() < 0.2), False, info

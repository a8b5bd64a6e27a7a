"""A domain theory of small networks: where the target is after a move and what that earns, learned beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.learners import SlopeNet, fit_slopes, new_slope_net
from neuralq_envs.thrun_robot import FAR, NEAR, NUM_MOVES, outcomes, successors

__all__ = ["Theory", "learn_theory"]

Array = NDArray[np.float64]
Moves = NDArray[np.int64]

_NUM_HIDDEN, _NUM_STEPS, _STEP_SIZE = 10, 1000, 0.05


@dataclass(frozen=True, eq=False)
class Theory:
    """What was learned of the moves before.

    Args:
        rewards: for each move, a network for what it earns.
        changes: for each move, a network for each number of the target: how much that changes.
    """

    rewards: Sequence[SlopeNet]
    changes: Sequence[Sequence[SlopeNet]]

    def step(self, s: Array, a: Moves) -> tuple[Array, Array]:
        """The reward ``[*n]`` and the next state ``[*n, 2]`` that are expected of moves ``[*n]`` in ``[*n, 2]``."""
        reward, after = np.empty(s.shape[:-1]), np.empty(s.shape)
        for move in range(NUM_MOVES):
            here = s[a == move]
            reward[a == move] = self.rewards[move].values(here)
            after[a == move] = here + np.stack([net.values(here) for net in self.changes[move]], axis=-1)
        return reward, after

    def slopes(self, s: Array, a: Moves) -> tuple[Array, Array]:
        """How both depend on the state, ``[*n, 2]`` and ``[*n, 2, 2]``: numbers of the next down, of s across."""
        reward, jacobian = np.empty(s.shape), np.empty((*s.shape, 2))
        for move in range(NUM_MOVES):
            here = s[a == move]
            reward[a == move] = self.rewards[move].slopes(here)
            jacobian[a == move] = np.eye(2) + np.stack([net.slopes(here) for net in self.changes[move]], axis=-2)
        return reward, jacobian


def learn_theory(num_steps: int, rng: np.random.Generator) -> Theory:
    """Fitted to that many single steps of each move, with the target anywhere in view.

    Raises:
        ValueError: fewer than one step.

    Example:
        >>> theory = learn_theory(50, np.random.default_rng(0))
        >>> _, after = theory.step(np.array([[2.0, 0.0]]), np.array([0]))
        >>> bool(np.abs(after - [[1.65, 0.0]]).max() < 0.05)
        True
    """
    check_whole("num_steps", num_steps)
    distance, bearing = rng.uniform((NEAR, -np.pi / 2), (FAR, np.pi / 2), (num_steps, 2)).T
    s = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)

    def learned(y: Array) -> SlopeNet:
        return fit_slopes(new_slope_net(2, _NUM_HIDDEN, rng), s, y, num_steps=_NUM_STEPS, step_size=_STEP_SIZE)

    after = [successors(s, move) for move in range(NUM_MOVES)]
    rewards = tuple(learned(outcomes(one)) for one in after)
    return Theory(rewards, tuple(tuple(map(learned, (one - s).T)) for one in after))

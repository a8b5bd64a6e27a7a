"""Trial after trial in the M, by whoever remembers, and the control that cannot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.tabular import EpsilonGreedy, NearestSequenceMemory, RunOptions, UtileSuffixMemory, q_learning
from neuralq_envs.aliased import make, mccallum, walked

__all__ = ["LEARNERS", "LIMIT", "NUM_LAST", "Training", "forgetful", "train"]

LIMIT = 200
"""Steps after which a trial is cut off."""
NUM_LAST = 50
"""Trials at the end that do not explore; these are measured."""

_GAMMA, _EPSILON = 0.9, 0.1

Memory = NearestSequenceMemory | UtileSuffixMemory
LEARNERS: dict[str, Callable[[], Memory]] = {
    "NSM": lambda: NearestSequenceMemory(4, gamma=_GAMMA),
    "USM": lambda: UtileSuffixMemory(4, gamma=_GAMMA),
    "NSM, match 1": lambda: NearestSequenceMemory(4, gamma=_GAMMA, max_match=1),
}


@dataclass(frozen=True, eq=False)
class Training:
    """What came of one training.

    Args:
        lengths: steps of each trial, ``[T]``; of the control those of its last policy from each start.
        num_leaves: of the tree after each trial, ``[T]``; empty without one.
        leaves: values of each of its leaves in the end, by suffix.
    """

    lengths: NDArray[np.int64]
    num_leaves: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    leaves: dict[tuple[int, ...], NDArray[np.float64]] = field(default_factory=dict)

    @property
    def steps(self) -> float:
        """Mean of the last trials."""
        return float(self.lengths[-NUM_LAST:].mean())

    def learned_after(self, steps: float) -> int:
        """Steps of all trials until ten in a row first took so few in the mean; all of them if they never did."""
        sums = np.cumsum(np.append(0, self.lengths))
        good = np.flatnonzero((sums[10:] - sums[:-10]) <= 10 * steps)
        return int(sums[good[0] + 10] if good.size else sums[-1])


def train(seed: int | np.random.SeedSequence, learner: str, num_trials: int = 200) -> Training:
    """So many trials from cells drawn at random; the last fifty without exploring, but learning all the same.

    Args:
        seed: of starts and actions.
        learner: one of `LEARNERS`.
        num_trials: in all.

    Raises:
        ValueError: another learner, or fewer trials than are measured.

    Example:
        >>> train(0, "USM", num_trials=60).lengths.shape
        (60,)
    """
    check_choice("learner", learner, LEARNERS)
    check_whole("num_trials", num_trials, NUM_LAST)
    memory, env, rng = LEARNERS[learner](), make(maze="mccallum"), np.random.default_rng(seed)
    lengths, leaves = np.zeros(num_trials, np.int64), np.zeros(num_trials, np.int64)
    env.reset(seed=int(rng.integers(2**31)))
    for trial in range(num_trials):
        epsilon = _EPSILON if trial < num_trials - NUM_LAST else 0.0
        o, _ = env.reset()
        memory.begin(o)
        terminated = False
        while not terminated and lengths[trial] < LIMIT:
            values = memory.values()
            best = np.flatnonzero(values == values.max())
            a = int(rng.integers(4)) if rng.random() < epsilon else int(rng.choice(best))
            o, reward, terminated, _, _ = env.step(a)
            memory.learn(a, reward, o, terminated)
            lengths[trial] += 1
        leaves[trial] = memory.num_leaves if isinstance(memory, UtileSuffixMemory) else 0
    if isinstance(memory, UtileSuffixMemory):
        return Training(lengths, leaves, memory.leaf_values())
    return Training(lengths)


def forgetful(seed: int | np.random.SeedSequence, num_steps: int = 40_000) -> Training:
    """Q-learning on percepts for as many steps as 200 trials can have, and the walk of its policy from every start.

    Example:
        >>> forgetful(0, num_steps=500).lengths.shape
        (10,)
    """
    maze = mccallum()
    learned = q_learning(
        maze, num_steps, _GAMMA, policy=EpsilonGreedy(_EPSILON), step_size=0.1, seed=seed,
        options=RunOptions(max_episode_steps=LIMIT),
    )  # fmt: skip
    return Training(walked(maze, learned.q.argmax(axis=1), LIMIT))

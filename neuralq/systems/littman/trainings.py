"""One training on what the cells look like, and how far its policy has to walk from everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.mdp import AliasedMDP
from neuralq.tabular import EpsilonGreedy, Model, RunOptions, compile_model, q_lambda, sarsa_lambda
from neuralq_envs.aliased import littman, walked

__all__ = ["LOST", "METHODS", "Training", "train"]

LOST = 1000
"""Steps that are charged for a start from which the goal is never reached."""

METHODS = {"Sarsa(λ)": ("sarsa", 0.9), "Sarsa(0)": ("sarsa", 0.0), "Q(0)": ("q", 0.0)}
"""Rule and λ by name."""

_GAMMA, _STEP_SIZE, _EPSILON, _LIMIT = 0.95, 0.05, 0.2, 500


@dataclass(frozen=True, eq=False)
class Training:
    """What came of one training.

    Args:
        policy: what is done at each percept, ``[O]``.
        steps: that it needs from each of the 46 starts, `LOST` where it never arrives.
        num_episodes: that it was trained for.
    """

    policy: NDArray[np.int64]
    steps: NDArray[np.int64]
    num_episodes: int

    @property
    def total(self) -> int:
        """Steps from all starts together."""
        return int(self.steps.sum())

    @property
    def num_lost(self) -> int:
        """Starts from which it never arrives."""
        return int(np.count_nonzero(self.steps == LOST))


@cache
def _maze() -> tuple[AliasedMDP, Model]:
    maze = littman()
    return maze, compile_model(maze)


def train(seed: int | np.random.SeedSequence, method: str = "Sarsa(λ)", num_steps: int = 1_000_000) -> Training:
    """So many steps in the maze from nothing, exploring less and less, and the greedy policy of what was learned.

    Args:
        seed: of the stream that draws starts and actions.
        method: one of `METHODS`.
        num_steps: of the training.

    Raises:
        ValueError: another method, or no step.

    Example:
        >>> train(0, num_steps=2000).steps.shape
        (46,)
    """
    check_choice("method", method, METHODS)
    check_whole("num_steps", num_steps)
    maze, model = _maze()
    rule, lambda_ = METHODS[method]
    learn = sarsa_lambda if rule == "sarsa" else q_lambda
    learned = learn(
        model, num_steps, _GAMMA, lambda_=lambda_, trace="replacing", step_size=_STEP_SIZE, seed=seed,
        policy=EpsilonGreedy(_EPSILON, 0.0, num_steps), options=RunOptions(max_episode_steps=_LIMIT),
    )  # fmt: skip
    policy = np.where(np.isnan(learned.q), -np.inf, learned.q).argmax(axis=1)
    return Training(policy, walked(maze, policy, LOST), learned.num_episodes)

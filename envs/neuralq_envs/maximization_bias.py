"""Maximization bias (Sutton & Barto 2018, example 6.7): a tempting way that is worse than none.

From A, ``right`` ends the episode with reward 0; ``left`` leads to B with reward 0, and each of B's many actions ends
it with a normal reward of mean −.1 and standard deviation 1. So V*(A) = 0, V*(B) = −.1 and ``left`` is worth −.1
(γ = 1); the largest of several noisy estimates in B looks better than 0 for long, and Q-learning goes left.

The environment pays the sampled reward, the model holds its mean. States: A = 0, B = 1, the end = 2.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.graphs import GraphScene
from neuralq_envs.rendering import NoisyRewards, RenderedEnv

__all__ = ["GAMMA", "LEFT", "RIGHT", "make", "make_vector", "mdp"]

GAMMA = 1.0
LEFT, RIGHT = 0, 1
_A, _B, _END = range(3)


def mdp(num_actions: int = 10, mean: float = -0.1) -> FiniteMDP:
    """The exact model: two actions in A, ``num_actions`` in B.

    Raises:
        ValueError: fewer than two actions, or a mean that is not finite.

    Example:
        >>> mdp(num_actions=3).reward.tolist()
        [0.0, 0.0, -0.1, -0.1, -0.1]
    """
    check_whole("num_actions", num_actions, minimum=2)
    if not math.isfinite(mean):
        raise ValueError(f"mean must be finite, got {mean}")

    def actions(s: int) -> range:
        return range((2, num_actions, 0)[s])

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        if s == _A:
            return [(1.0, _B, 0.0, False) if a == LEFT else (1.0, _END, 0.0, True)]
        return [(1.0, _END, mean, True)]

    return FiniteMDP.from_functions(
        3, num_actions, actions, transitions, start=[1.0, 0.0, 0.0], state_names=("A", "B", "end")
    )


def make(
    num_actions: int = 10, mean: float = -0.1, standard_deviation: float = 1.0, render_mode: str | None = None
) -> RenderedEnv:
    """What ``gymnasium.make("neuralq/MaximizationBias-v0")`` calls.

    Example:
        >>> env = make()
        >>> env.reset(seed=0)[1]["action_mask"].tolist()
        [1, 1, 0, 0, 0, 0, 0, 0, 0, 0]
    """
    scene = GraphScene(("A", "B", "END"), ((0, 1), (0, 0), (0, 2)), ((0, 1), (0, 2), (1, 2)), (2,))
    model = mdp(num_actions, mean)
    return RenderedEnv(model, scene, render_mode, _noise(model, standard_deviation))


def make_vector(
    num_envs: int = 1,
    num_actions: int = 10,
    mean: float = -0.1,
    standard_deviation: float = 1.0,
    max_episode_steps: int | None = None,
) -> VectorEnv[Any, Any, Any]:
    """What ``gymnasium.make_vec`` calls in mode ``"vector_entry_point"``.

    Example:
        >>> make_vector(num_envs=2).reset(seed=0)[0].tolist()
        [0, 0]
    """
    model = mdp(num_actions, mean)
    copies = model.as_vector_env(num_envs, max_episode_steps=max_episode_steps)
    return NoisyRewards(copies, model, _noise(model, standard_deviation))


def _noise(model: FiniteMDP, standard_deviation: float) -> NDArray[np.float64]:
    table = np.zeros((model.num_states, model.num_actions))
    table[_B] = standard_deviation
    return table

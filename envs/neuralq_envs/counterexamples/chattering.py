"""Chattering of Sarsa (after Gordon 1996): a policy that no weight is consistent with.

One state, two actions that end the episode: a pays 1 and has the feature 1, b pays −1 and has the feature 2, so
Q = (w, 2w) and b is greedy iff w > 0. With ε-greedy actions, p = 1 − ε/2 for the greedy one and q = ε/2,

    while a is greedy, w → w_a = (p − 2q)/(p + 4q);      while b is greedy, w → w_b = (q − 2p)/(q + 4p) < 0.

If p > 2q, that is ε < 2/3, then w_a > 0 lies where b is greedy and w_b < 0 where a is: w slides along 0 for ever. The
drifts there are p − 2q and q − 2p, so a is greedy for the share (2p − q)/(3p − 3q) of the time, 37/54 = .685 at ε = .1.
The weights stay bounded, as they always do for Sarsa(0) (Gordon 2001).
"""

from __future__ import annotations

import numpy as np

from neuralq.checks import check_fraction
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["chattering", "greedy_share", "policy_fixed_points"]


def chattering(exploration: float = 0.1) -> Problem:
    """One state, two actions to the end, one weight: Sarsa's policy switches for ever.

    Raises:
        ValueError: ε outside [0, 1].

    Example:
        >>> problem = chattering()
        >>> problem.features.tolist(), problem.control, problem.exploration
        ([[[1.0], [2.0]]], True, 0.1)
    """
    w_a, w_b = policy_fixed_points(exploration)
    known = (
        f"Greedy a pulls w to {w_a:.4f}, where b is greedy; greedy b pulls it to {w_b:.4f}, where a is. Sarsa chatters "
        f"at w = 0 and a is greedy for {greedy_share(exploration):.4f} of the time."
        if w_a > 0
        else f"With so much exploration w converges to {w_a:.4f}, where a is greedy."
    )
    model = FiniteMDP.from_arrays(np.zeros((2, 1, 1)), [[1.0, -1.0]], substochastic=True, action_names=("a", "b"))
    uniform = np.full((1, 2), 0.5)
    return Problem(
        name="chattering",
        mdp=model,
        features=np.array([[[1.0], [2.0]]]),
        target_policy=uniform,
        behaviour_policy=uniform,
        state_distribution=np.ones(1),
        initial_weights=np.ones(1),
        gamma=0.9,  # every action ends the episode: any γ gives the same
        step_size=0.01,
        title="Chattering",
        source="after Gordon 1996",
        known=known,
        control=True,
        exploration=exploration,
    )


def policy_fixed_points(exploration: float = 0.1) -> tuple[float, float]:
    """Where the weight goes while a is greedy, and while b is: (p − 2q)/(p + 4q) and (q − 2p)/(q + 4p).

    Raises:
        ValueError: ε outside [0, 1].

    Example:
        >>> [round(weight, 6) for weight in policy_fixed_points(0.1)]
        [0.73913, -0.480519]
    """
    check_fraction("exploration", exploration)
    p, q = 1 - exploration / 2, exploration / 2
    return (p - 2 * q) / (p + 4 * q), (q - 2 * p) / (q + 4 * p)


def greedy_share(exploration: float = 0.1) -> float:
    """The share of time for which a is greedy, (2p − q)/(3p − 3q) while that is below 1 (ε < 2/3), else 1.

    Raises:
        ValueError: ε outside [0, 1].

    Example:
        >>> round(greedy_share(0.1), 6)
        0.685185
    """
    check_fraction("exploration", exploration)
    p, q = 1 - exploration / 2, exploration / 2
    return (2 * p - q) / (3 * p - 3 * q) if p > 2 * q else 1.0

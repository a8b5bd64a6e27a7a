"""Kolter's two states (Kolter 2011): the off-policy TD fixed point can be arbitrarily bad.

Action a leads to state a. The target policy chooses evenly, the behaviour policy takes action 0 with probability p, so
it visits the states with d = (p, 1 − p). Rewards are such that the values are (1, 1.05), and the one feature is
(1, 1.05 + ε): nearly the values themselves. With x̄ = (x₁ + x₂)/2 and A_s = x_s (x_s − γ x̄)

    A(p) = p A₁ + (1 − p) A₂ = 0   at   p* = A₂ / (A₂ − A₁).

For γ = .99 that is (2961 + 45240ε + 40400ε²)/(4141 + 84840ε + 40400ε²). Beyond p* TD(0) diverges at every step
size. Close to it, on either side, the fixed point b/A exceeds every bound and changes its sign, unless ε = 0, when the
values are representable and w = 1 solves everything, though not stably.
"""

from __future__ import annotations

import math

import numpy as np

from neuralq.checks import check_discount
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["critical_probability", "kolter"]

VALUES = (1.0, 1.05)


def kolter(probability: float = 0.75, epsilon: float = 0.01, gamma: float = 0.99) -> Problem:
    """Two states whose TD fixed point depends on how often each is visited; p = .75 lies beyond p*.

    Args:
        probability: p in (0, 1), how often the behaviour policy goes to state 0.
        epsilon: ε > −.05, how far the feature is from the values.
        gamma: γ.

    Raises:
        ValueError: one of them out of its range.

    Example:
        >>> problem = kolter(0.5)
        >>> problem.features.reshape(-1).tolist(), problem.mdp.reward.round(5).tolist()
        ([1.0, 1.06], [-0.01475, -0.01475, 0.03525, 0.03525])
    """
    if not 0 < probability < 1:
        raise ValueError(f"probability must lie strictly between 0 and 1, got {probability}; else one state is unseen")
    check_discount("gamma", gamma)
    critical = critical_probability(epsilon, gamma)
    values = np.array(VALUES)
    reward = values - gamma * values.mean()
    transition = np.zeros((2, 2, 2))
    transition[0, :, 0] = transition[1, :, 1] = 1.0
    model = FiniteMDP.from_arrays(transition, np.column_stack([reward, reward]))
    d = [probability, 1 - probability]
    return Problem(
        name="kolter",
        mdp=model,
        features=np.array([[1.0], [1.05 + epsilon]]),
        target_policy=np.full((2, 2), 0.5),
        behaviour_policy=np.tile(d, (2, 1)),
        state_distribution=np.array(d),
        initial_weights=np.zeros(1),
        gamma=gamma,
        step_size=0.1,
        title="Kolter's two states",
        source="Kolter 2011",
        known=f"A changes its sign at p* = {critical:.4f}: TD(0) diverges for p > p*, and near p*, unless ε = 0, its "
        "fixed point is arbitrarily far from the values, though the feature is within ε of them.",
    )


def critical_probability(epsilon: float, gamma: float = 0.99) -> float:
    """TD(0) diverges at every step size iff p > p* = A₂/(A₂ − A₁); 1 or more means never.

    Raises:
        ValueError: ε of −.05 or less, where the features no longer grow, or γ outside [0, 1].

    Example:
        >>> round(critical_probability(0.0), 10)
        0.7150446752
    """
    check_discount("gamma", gamma)
    if not (math.isfinite(epsilon) and epsilon > -0.05):
        raise ValueError(f"epsilon must be a finite number above -0.05, got {epsilon}")
    first, second = 1.0, 1.05 + epsilon
    mean = (first + second) / 2
    a_1, a_2 = first * (first - gamma * mean), second * (second - gamma * mean)
    return a_2 / (a_2 - a_1)

"""From w to 2w (Tsitsiklis & Van Roy 1996; Sutton & Barto 2018, example 11.1): two states, one weight.

State 1 has the feature 1 and leads to state 2, which has the feature 2, stays with probability 1 − ε and else ends the
episode. Every reward and every value is 0. With both states updated equally often

    A = ½ [1·(1 − 2γ) + 2·(2 − 2γ(1 − ε))] = ½ [5 − γ(6 − 4ε)],        C = 5/2,

so expected TD(0) diverges at every step size iff γ > 5/(6 − 4ε); refitting by least squares multiplies w by
1 − A/C = γ(6 − 4ε)/5 and diverges at exactly the same γ. Updated only in state 1, w is multiplied by 1 + α(2γ − 1):
γ > 1/2 is enough. Visited as episodes visit it, d ∝ (ε, 1), A ∝ ε(1 + 2γ) + 4(1 − γ) > 0.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuralq.checks import check_fraction
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["critical_gamma", "w2w", "w2w_on_policy", "w2w_single"]


def w2w(gamma: float = 0.99, epsilon: float = 0.1) -> Problem:
    """Two states with the values w and 2w, updated equally often.

    Raises:
        ValueError: γ or ε outside [0, 1].

    Example:
        >>> problem = w2w(epsilon=0.25)
        >>> problem.features.reshape(-1).tolist(), problem.mdp.termination.tolist()
        ([1.0, 2.0], [0.0, 0.25])
    """
    check_fraction("epsilon", epsilon)
    model = FiniteMDP.from_arrays(
        [[[0.0, 1.0], [0.0, 1.0 - epsilon]]],
        np.zeros((2, 1)),
        substochastic=True,
        start=[1.0, 0.0],
        state_names=("w", "2w"),
    )
    return Problem.from_mdp(
        model,
        [[1.0], [2.0]],
        gamma=gamma,
        state_distribution=[0.5, 0.5],
        initial_weights=[1.0],
        step_size=0.1,
        name="w2w",
        title="From w to 2w",
        source="Tsitsiklis & Van Roy 1996; Sutton & Barto 2018, example 11.1",
        known=f"Expected TD(0) and refitting by least squares both diverge iff γ > 5/(6 − 4ε) = "
        f"{critical_gamma(epsilon):.4f}.",
    )


def w2w_single(gamma: float = 0.99) -> Problem:
    """Only the transition from w to 2w is ever updated.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> w2w_single().state_distribution.tolist()
        [1.0, 0.0]
    """
    return replace(
        w2w(gamma),
        name="w2w-single",
        state_distribution=np.array([1.0, 0.0]),
        title="From w to 2w, one transition",
        source="Sutton & Barto 2018, section 11.2",
        known="Each update multiplies w by 1 + α(2γ − 1): divergence iff γ > 1/2.",
    )


def w2w_on_policy(gamma: float = 0.99, epsilon: float = 0.1) -> Problem:
    """The two states updated as often as episodes visit them, d = (ε, 1)/(1 + ε).

    Raises:
        ValueError: γ or ε outside [0, 1].

    Example:
        >>> w2w_on_policy(epsilon=0.25).state_distribution.round(12).tolist()
        [0.2, 0.8]
    """
    return replace(
        w2w(gamma, epsilon),
        name="w2w-on-policy",
        state_distribution=np.array([epsilon, 1.0]) / (1.0 + epsilon),
        title="From w to 2w, on-policy",
        known="A = (ε(1 + 2γ) + 4(1 − γ))/(1 + ε) > 0: converges to 0 for every γ below 1, and for γ = 1 if ε > 0.",
    )


def critical_gamma(epsilon: float) -> float:
    """Expected TD(0) diverges at every step size iff γ > 5/(6 − 4ε); 1 or more means never.

    Raises:
        ValueError: ε outside [0, 1].

    Example:
        >>> critical_gamma(0.0) == 5 / 6, critical_gamma(0.25)
        (True, 1.0)
    """
    check_fraction("epsilon", epsilon)
    return 5.0 / (6.0 - 4.0 * epsilon)

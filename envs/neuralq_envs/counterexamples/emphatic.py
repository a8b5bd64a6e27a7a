"""The two states of emphatic TD (Sutton, Mahmood & White 2016): the smallest off-policy problem with two actions.

``left`` leads to state 1, ``right`` to state 2, whose features are 1 and 2. The target policy goes right, the behaviour
policy tosses a coin, so each state is updated equally often; every reward is 0. In closed form

    TD(λ):     A_λ = ½ [5 − 6γ + γλ] / (1 − γλ)                stable iff λ > 6 − 5/γ
    ETD(0, β): f = (½, ½ (1 + β)/(1 − β)),  A = f₁(1 − 2γ) + 4f₂(1 − γ)     stable iff β > (6γ − 5)/(3 − 2γ)

and the follow-on trace F has a finite variance iff 2β² < 1, because ρ is 2 with probability ½. At γ = .9 the thresholds
are λ = 4/9 and 1/3 < β < √½: ETD itself, β = γ, is stable in the mean and has infinite variance.
"""

from __future__ import annotations

import numpy as np

from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["LEFT", "RIGHT", "emphatic"]

LEFT, RIGHT = 0, 1


def emphatic(gamma: float = 0.9) -> Problem:
    """Two states, features 1 and 2; always right is learned from coin tosses.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> emphatic().importance_ratio.tolist()
        [[0.0, 2.0], [0.0, 2.0]]
    """
    transition = np.zeros((2, 2, 2))
    transition[LEFT, :, 0] = transition[RIGHT, :, 1] = 1.0
    model = FiniteMDP.from_arrays(transition, np.zeros((2, 2)), action_names=("left", "right"))
    return Problem(
        name="emphatic",
        mdp=model,
        features=np.array([[1.0], [2.0]]),
        target_policy=np.tile([0.0, 1.0], (2, 1)),
        behaviour_policy=np.full((2, 2), 0.5),
        state_distribution=np.full(2, 0.5),
        initial_weights=np.ones(1),
        gamma=gamma,
        step_size=0.01,
        title="Two states, off-policy",
        source="Sutton, Mahmood & White 2016",
        known="TD(0) diverges iff γ > 5/6, TD(λ) is stable iff λ > 6 − 5/γ. Emphatic TD is stable in the mean for "
        "every γ below 1, but its follow-on trace has infinite variance from γ = √½ on.",
    )

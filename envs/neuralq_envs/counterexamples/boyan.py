"""The chain of Boyan 1999 as a problem: values that are linear in the features, learned on-policy without discount.

What can go wrong is the end. State 0 is terminal, so its value is 0 by definition and its features must be 0 too. With
the row (0, 0, 0, 1) that interpolation would give it, TD bootstraps from a weight that nothing ever updates there: A
loses a rank, and the values are right only up to that constant.
"""

from __future__ import annotations

import numpy as np

from neuralq_envs import boyan as chain
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["boyan"]


def boyan() -> Problem:
    """Boyan's chain with its four features, on-policy; TD(λ) finds the weights (−24, −16, −8, 0).

    Example:
        >>> problem = boyan()
        >>> problem.features[[12, 1, 0]].tolist()
        [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.25, 0.75], [0.0, 0.0, 0.0, 0.0]]
    """
    return Problem.from_mdp(
        chain.mdp(),
        chain.features(),
        gamma=chain.GAMMA,
        initial_weights=np.zeros(4),
        step_size=0.1,
        name="boyan",
        title="Boyan's chain",
        source="Boyan 1999",
        known="On-policy, V(s) = −2s is linear in the features: TD(λ) converges to (−24, −16, −8, 0) for every λ.",
    )

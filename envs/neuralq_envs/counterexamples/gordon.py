"""Gordon's averagers and his counterexample (Gordon 1995): why least squares is not safe in fitted value iteration.

Fitted value iteration alternates a backup, a γ-contraction in the maximum norm, and a fit ŷ = H y. If the fit never
expands the maximum norm the whole is a contraction. It does not if no entry of H is negative and no row sums to more
than 1: every fitted value is then an average of the targets (and 0). Nearest neighbours, bilinear interpolation, kernel
smoothing and aggregation are averagers. Least squares has H = X (XᵀDX)⁺ XᵀD, which extrapolates: with features 1
and 2, H = [[1, 2], [2, 4]]/5, whose second row sums to 6/5, and on the two states of `w2w` the iteration diverges at
ε = 0 iff γ · 6/5 > 1. Aggregating both states, x = (1, 1), makes each row an average, and it converges.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuralq_envs.counterexamples.problem import Problem
from neuralq_envs.counterexamples.w2w import w2w

__all__ = ["gordon", "gordon_averager"]


def gordon(gamma: float = 0.9) -> Problem:
    """Fitted by least squares the two states w and 2w diverge iff γ > 5/6: the fit is no averager.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> gordon().features.tolist(), gordon().gamma
        ([[1.0], [2.0]], 0.9)
    """
    return replace(
        w2w(gamma, epsilon=0.0),
        name="gordon",
        title="Gordon's regression",
        source="Gordon 1995",
        known="The hat matrix has rows that sum to 3/5 and 6/5, so the fit is no averager; the iteration multiplies w "
        "by 6γ/5 and diverges iff γ > 5/6.",
    )


def gordon_averager(gamma: float = 0.9) -> Problem:
    """The same two states as one aggregate: the fit averages, so the iteration is a γ-contraction.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> gordon_averager().features.tolist()
        [[1.0], [1.0]]
    """
    return replace(
        gordon(gamma),
        name="gordon-averager",
        features=np.ones((2, 1)),
        title="Gordon's averager",
        known="The hat matrix averages, so the iteration contracts by γ in the maximum norm.",
    )

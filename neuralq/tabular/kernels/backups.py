"""Backed-up scores as targets: linear weights learn from what a look-ahead says one turn later (Samuel 1959).

The value of a position is w·φ. A search from the position that the same side meets at its next turn gives v_t, and

    w_i ← w_i + α (clip(v_t, ±largest) − w·φ_tm1) φ_tm1,i

for every weight but the first ``num_fixed``, which give the others their unit. That is semi-gradient TD(0) without
rewards, with the look-ahead's value in place of the next state's. A score beyond ``decided`` is a win or a loss that
the search has seen; the terms cannot say such a number, so it teaches nothing.

Source: Samuel 1959 ("learning procedure involving generalizations"), who corrected signs and correlations of terms
rather than their gradient; the gradient form is Sutton's (1988, section 2).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel

__all__ = ["BackupRule", "backup_update"]


class BackupRule(NamedTuple):
    """What bounds a correction.

    Args:
        num_fixed: how many of the first weights stay as they are.
        largest: a backed-up score is cut at − and + this.
        decided: one beyond − or + this is left out.
    """

    num_fixed: int = 1
    largest: float = 12.0
    decided: float = 50.0


@lean_kernel
def backup_update(
    weights: NDArray[np.float64],
    rule: BackupRule,
    terms_tm1: NDArray[np.float64],
    backed_up_t: float,
    step_size: float,
) -> Any:
    """Changes ``weights`` by one backed-up score and returns the error, or 0 where the score is a decided one.

    Args:
        weights: w, ``[K]``; changed in place.
        rule: what bounds the correction.
        terms_tm1: φ of the earlier position, ``[K]``, for the side that was to move.
        backed_up_t: what a search says at that side's next turn, for the same side.
        step_size: α.

    Example:
        The error is 2 − (1·1 + .5·2) = 0, then 3 − 2 = 1, and w(1) grows by .1 · 1 · 2; w(0) is fixed.

        >>> weights = np.array([1.0, 0.5])
        >>> [backup_update(weights, BackupRule(), np.array([1.0, 2.0]), v, 0.1) for v in (2.0, 3.0, 99.0)]
        [0.0, 1.0, 0.0]
        >>> weights.tolist()
        [1.0, 0.7]
    """
    if abs(backed_up_t) > rule.decided:
        return 0.0
    value = 0.0
    for i in range(len(weights)):
        value += weights[i] * terms_tm1[i]
    error = min(max(backed_up_t, -rule.largest), rule.largest) - value
    for i in range(rule.num_fixed, len(weights)):
        weights[i] += step_size * error * terms_tm1[i]
    return error

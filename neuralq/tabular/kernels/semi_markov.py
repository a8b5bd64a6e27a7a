"""SMDP Q-learning on a table: one decision that lasted."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel

__all__ = ["smdp_q_update"]


@lean_kernel
def smdp_q_update(
    q: NDArray[np.float64],
    s_tm1: int,
    a_tm1: int,
    r_t: float,
    duration_t: float,
    rate: float,
    s_t: int,
    terminated_t: bool,
    step_size: float,
) -> Any:
    """Moves Q(s_tm1, a_tm1) towards ``r_t + e^(−β τ) max_a Q(s_t, a)`` and returns the TD error.

    Args:
        q: the table, ``[S, A]``, changed in place.
        s_tm1: state in which the decision was made.
        a_tm1: what was decided.
        r_t: ∫ e^(−βt) (rate of reward) dt until the next decision.
        duration_t: τ, how long that took.
        rate: β, per unit of time.
        s_t: state of the next decision; not looked at where the world terminated.
        terminated_t: whether it did.
        step_size: α.

    Source: Bradtke & Duff 1995, eq. 6.

    Example:
        >>> q = np.array([[0.0, 0.0], [3.0, 5.0]])
        >>> error = smdp_q_update(q, 0, 1, 1.0, 2.0, 0.5, 1, False, 0.1)  # 1 + 5 e⁻¹ = 2.8394
        >>> round(error, 4), q[0].round(5).tolist()
        (2.8394, [0.0, 0.28394])
    """
    target = r_t
    if not terminated_t:
        best = q[s_t, 0]
        for a in range(1, q.shape[1]):
            best = max(best, q[s_t, a])
        target += math.exp(-rate * duration_t) * best
    error = target - q[s_tm1, a_tm1]
    q[s_tm1, a_tm1] += step_size * error
    return error

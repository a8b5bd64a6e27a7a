"""R-learning: relative values and the average reward per step, without a discount (Schwartz 1993; Mahadevan 1996).

    R(s, a) ← R(s, a) + α [r − ρ + max_a' R(s', a') − R(s, a)]
    ρ ← ρ + β [r + max_a' R(s', a') − max_a R(s, a) − ρ]      where the action taken was a best one

ρ estimates the gain, reward per step in the long run, and R the bias of each pair up to a constant. The world must go
on for ever: an end has no successor whose relative value could be compared.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import Log, Table, Walk, best_value, next_step, step_length
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["run_r_learning"]

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


@lean_kernel
def run_r_learning(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    gain: NDArray[np.float64],
    beta: float,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions, each followed by its update.

    Args:
        gain: ρ, and whether the world ended, ``[2]``.
        beta: step size of ρ. (γ is 1.)
    """
    q, visits = table.q, table.visits
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, _a_t, _last = next_step(model, policy, table, walk, log, i, gamma, False)
        if discount_t == 0.0:
            gain[_ONE] = 1.0
        visits[s, a] += 1
        alpha = step_length(step_size, visits[s, a])
        before, after = best_value(q, s), best_value(q, s_t)
        greedy = q[s, a] == before
        rho = gain[_ZERO]
        if greedy:
            gain[_ZERO] = rho + beta * (r_t + after - before - rho)
        q[s, a] += alpha * (r_t - rho + after - q[s, a])

"""One-step control: Q-learning, Sarsa, expected Sarsa and double Q-learning, in one kernel.

Every rule moves the value of the pair just left towards a target,

    Q(s_tm1, a_tm1) ← (1 − α) Q(s_tm1, a_tm1) + α [r_t + discount_t · bootstrap]                   (Mitchell 13.10)

with bootstrap max_a Q(s_t, a) (Q-learning), Q(s_t, a_t) (Sarsa), Σ_a π(a|s_t) Q(s_t, a) (expected Sarsa), or the value
that one table gives to the best action of the other (double Q-learning). With α = 1 the value *is* the target, which is
Mitchell's rule 13.7. Q-learning chooses its action after the update of the step before, as Table 13.1 says.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import (
    BOOTSTRAPS,
    MAXIMUM,
    SARSA,
    Log,
    Table,
    Walk,
    best_value,
    expected_value,
    moved,
    next_step,
    step_length,
)
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["RULES", "run_one_step"]

RULES = (*BOOTSTRAPS, "double-q")
DOUBLE = len(BOOTSTRAPS)

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


@lean_kernel
def run_one_step(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    rule: int,
    halves: NDArray[np.float64],
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions, each followed by its update.

    Args:
        rule: index in ``RULES``.
        halves: the two tables of double Q-learning, ``[2, S, A]``, whose mean ``table`` holds; empty for other rules.
    """
    q, visits = table.q, table.visits
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, a_t, _last = next_step(model, policy, table, walk, log, i, gamma, rule == SARSA)
        n = visits[s, a] + 1
        visits[s, a] = n
        alpha = step_length(step_size, n)
        target = r_t
        if rule == DOUBLE:
            mine = _ZERO if uniform(walk.rng) < 0.5 else _ONE
            if discount_t != 0.0:
                best = _ZERO
                for b in range(_ONE, np.uint64(q.shape[1])):
                    if halves[mine, s_t, b] > halves[mine, s_t, best]:
                        best = b
                target = r_t + discount_t * halves[_ONE - mine, s_t, best]
            halves[mine, s, a] = moved(halves[mine, s, a], target, alpha)
            q[s, a] = 0.5 * (halves[_ZERO, s, a] + halves[_ONE, s, a])
            continue
        if discount_t != 0.0:
            if rule == MAXIMUM:
                target = r_t + discount_t * best_value(q, s_t)
            elif rule == SARSA:
                target = r_t + discount_t * q[s_t, np.uint64(a_t)]
            else:
                target = r_t + discount_t * expected_value(table, s_t, walk.counters[0], policy)
        q[s, a] = moved(q[s, a], target, alpha)

"""Prediction: TD(λ) for state values, on-line, once per episode, or over a whole batch; and true online TD(λ).

    δ_t = r_t + discount_t V(s_t) − V(s_tm1),    V(x) ← V(x) + α δ_t z(x)                       (Sutton 1988, eq. 4)

The trace z decays by λ · (discount into s_tm1) and grows by 1 at s_tm1 (accumulating) or is set to 1 (replacing). True
online TD(λ) has a dutch trace and one more term, and equals the on-line λ-return step for step. A batch is presented
again and again, its increments added at the end of each presentation, until nothing moves: TD(0) then gives the values
of the most likely Markov process (certainty equivalence), TD(1) the least squares fit to the returns seen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import Log, Table, Walk, next_step, step_length
from neuralq.tabular.kernels.traces import Traces, drop
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["KINDS", "UPDATES", "run_td"]

KINDS = ("accumulating", "replacing", "true-online")
UPDATES = ("step", "episode", "batch")
REPLACING, TRUE_ONLINE = 1, 2
EVERY_STEP, EVERY_EPISODE = 0, 1

_SMALLEST = 1e-14
_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


@lean_kernel
def run_td(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    traces: Traces,
    pending: NDArray[np.float64],
    v_old: NDArray[np.float64],
    kind: int,
    update: int,
    lambda_: float,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions, each followed by its increments.

    Args:
        pending: increments not yet added, ``[S]``.
        v_old: V(s_tm1) before the last update, ``[1]``.
        kind: index in ``KINDS``.
        update: index in ``UPDATES``.
        lambda_: λ.
    """
    v, visits, z = table.q, table.visits, traces.z
    for i in range(num_steps):
        s, _a, r_t, discount_t, s_t, _a_t, last_t = next_step(model, policy, table, walk, log, i, gamma, False)
        n = visits[s, _ZERO] + 1
        visits[s, _ZERO] = n
        alpha = step_length(step_size, n)
        traces.alpha[s] = alpha
        v_tm1 = v[s, _ZERO]
        v_t = v[s_t, _ZERO] if discount_t != 0.0 else 0.0
        delta = r_t + discount_t * v_t - v_tm1
        change = v_tm1 - v_old[_ZERO] if kind == TRUE_ONLINE else 0.0
        decay = traces.decay[_ZERO]
        kept, own = _ZERO, 0.0
        for k in range(traces.num_active[_ZERO]):
            x = traces.active[k]
            z[x] *= decay
            if x == s:
                own = z[x]
            elif z[x] > _SMALLEST:
                traces.active[kept] = x
                kept += _ONE
            else:
                z[x] = 0.0
        if kind == TRUE_ONLINE:
            z[s] = own + (1.0 - alpha * own)
        else:
            z[s] = 1.0 if kind == REPLACING else own + 1.0
        traces.active[kept] = s
        kept += _ONE
        for k in range(kept):
            x = traces.active[k]
            step = traces.alpha[x] * (delta + change) * z[x]
            if x == s:
                step -= alpha * change
            if update == EVERY_STEP:
                v[x, _ZERO] += step
            else:
                pending[x] += step
        traces.num_active[_ZERO] = kept
        traces.decay[_ZERO] = discount_t * lambda_
        v_old[_ZERO] = v_t
        if last_t or discount_t * lambda_ == 0.0:
            drop(traces)
        if last_t:
            v_old[_ZERO] = 0.0
            if update == EVERY_EPISODE:
                for x in range(_ZERO, np.uint64(pending.size)):
                    v[x, _ZERO] += pending[x]
                    pending[x] = 0.0

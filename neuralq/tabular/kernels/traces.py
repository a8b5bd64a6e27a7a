"""Control with eligibility traces: Watkins', Peng's and naive Q(λ), Sarsa(λ) and expected Sarsa(λ), in one kernel.

A trace z(x) says how much of the present error a pair x visited before deserves. One step, in this order, with
V(s) = max_a Q(s, a):

* Watkins: z ← 0 if the action explored; then decay by λ · (discount into s_tm1) and add 1 at the pair;
  Q(x) ← Q(x) + α δ z(x) with δ = r_t + discount_t V(s_t) − Q(s_tm1, a_tm1).
* naive: the same without the cut.
* Sarsa, expected Sarsa: the same without the cut; Q(s_t, a_t) or Σ_a π(a|s_t) Q(s_t, a) in place of V(s_t). (For
  expected Sarsa, as for naive Q(λ), the sum over an episode is that of the errors ahead, not a mixture of returns.)
* Peng: the pairs before move by δ' = r_t + discount_t V(s_t) − V(s_tm1), the present pair by δ. Values held fixed, the
  sum over an episode is exactly the book's Q^λ: Q^λ_t = r_t + discount_t [(1 − λ) V(s_t) + λ Q^λ_{t+1}].

The last line has s_t where the book prints the state before, which would not equal the book's own sum.

Every pair moves with the α of its own last visit. Only pairs with a trace are touched, in the order of their first
visit; a trace below 10⁻¹⁴ is dropped. With λ = 0 each rule is its one-step rule, bit for bit. Transitions after
``last_t`` begin with no trace.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import Log, Table, Walk, best_value, expected_value, moved, next_step, step_length
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["RULES", "Traces", "drop", "new_traces", "run_traces"]

RULES = ("watkins", "peng", "naive", "sarsa", "expected-sarsa")
WATKINS, PENG, NAIVE, SARSA, EXPECTED = range(5)

_SMALLEST = 1e-14
_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


class Traces(NamedTuple):
    """Traces and step sizes of pairs ``[S·A]``, the pairs that have a trace, their number, and the decay due next."""

    z: NDArray[np.float64]
    alpha: NDArray[np.float64]
    active: NDArray[np.uint64]
    num_active: NDArray[np.uint64]
    decay: NDArray[np.float64]


def new_traces(size: int) -> Traces:
    """No trace anywhere.

    Example:
        >>> new_traces(2).z.tolist()
        [0.0, 0.0]
    """
    return Traces(np.zeros(size), np.zeros(size), np.zeros(size, np.uint64), np.zeros(1, np.uint64), np.zeros(1))


@lean_kernel
def drop(traces: Traces) -> None:
    """No trace any more.

    Example:
        >>> traces = new_traces(2)
        >>> drop(traces)
        >>> traces.num_active.tolist()
        [0]
    """
    for k in range(traces.num_active[_ZERO]):
        traces.z[traces.active[k]] = 0.0
    traces.num_active[_ZERO] = _ZERO
    traces.decay[_ZERO] = 0.0


@lean_kernel
def run_traces(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    traces: Traces,
    rule: int,
    replacing: bool,
    lambda_: float,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions, each followed by its update along the traces.

    Args:
        rule: index in ``RULES``.
        replacing: a visit sets the trace to 1 instead of adding 1.
        lambda_: λ.
    """
    q, visits, z = table.q, table.visits, traces.z
    num_actions = np.uint64(q.shape[1])
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, a_t, last_t = next_step(model, policy, table, walk, log, i, gamma, rule == SARSA)
        n = visits[s, a] + 1
        visits[s, a] = n
        pair = s * num_actions + a
        alpha = step_length(step_size, n)
        traces.alpha[pair] = alpha
        v_tm1 = best_value(q, s)
        if rule == WATKINS and q[s, a] < v_tm1:
            drop(traces)
        target = r_t
        if discount_t != 0.0:
            if rule == SARSA:
                target = r_t + discount_t * q[s_t, np.uint64(a_t)]
            elif rule == EXPECTED:
                target = r_t + discount_t * expected_value(table, s_t, walk.counters[0], policy)
            else:
                target = r_t + discount_t * best_value(q, s_t)
        delta = target - q[s, a]
        earlier = target - v_tm1 if rule == PENG else delta
        decay = traces.decay[_ZERO]
        kept = _ZERO
        own = 0.0
        for k in range(traces.num_active[_ZERO]):
            x = traces.active[k]
            z[x] *= decay
            if x == pair:
                own = z[x]
                z[x] = 0.0
            elif z[x] > _SMALLEST:
                q[x // num_actions, x % num_actions] += traces.alpha[x] * earlier * z[x]
                traces.active[kept] = x
                kept += _ONE
            else:
                z[x] = 0.0
        if replacing or own == 0.0:
            z[pair] = 1.0
            q[s, a] = moved(q[s, a], target, alpha)
        else:
            z[pair] = own + 1.0
            q[s, a] += alpha * (delta + earlier * own)
        traces.active[kept] = pair
        traces.num_active[_ZERO] = kept + _ONE
        traces.decay[_ZERO] = discount_t * lambda_
        if last_t or discount_t * lambda_ == 0.0:
            drop(traces)

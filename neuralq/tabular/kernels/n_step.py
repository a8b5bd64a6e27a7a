"""n-step control: Q^(n) of Mitchell's section 13.5, n-step Sarsa and n-step expected Sarsa.

    target = r_1 + γ r_2 + … + γ^{n−1} r_n + γ^n · bootstrap(s_n)

A pair is updated when the n-th reward after it has come, or at the end of its stream with the steps there are. The
bootstrap is max_a Q(s_n, a) (the book's Q^(n), uncorrected for exploring actions on the way), Q(s_n, a_n) or the
policy's expectation. n = 1 is the one-step rule, bit for bit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import (
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
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["Window", "new_window", "run_n_step"]

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


class Window(NamedTuple):
    """The last n pairs, rewards and discounts in a ring, and ``[position of the oldest, how many]``."""

    s: NDArray[np.uint64]
    a: NDArray[np.uint64]
    reward: NDArray[np.float64]
    discount: NDArray[np.float64]
    counters: NDArray[np.uint64]


def new_window(n: int) -> Window:
    """An empty window of n steps.

    Example:
        >>> new_window(2).counters.tolist()
        [0, 0]
    """
    index = np.uint64
    return Window(np.zeros(n, index), np.zeros(n, index), np.zeros(n), np.zeros(n), np.zeros(2, index))


@lean_kernel
def run_n_step(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    window: Window,
    rule: int,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions; each updates the pair n steps back, the last of a stream all that are left.

    Args:
        window: the steps that wait for their target. Visits are counted when it has come.
        rule: index in `BOOTSTRAPS`.
    """
    q, visits = table.q, table.visits
    n = np.uint64(window.s.size)
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, a_t, last_t = next_step(model, policy, table, walk, log, i, gamma, rule == SARSA)
        at = (window.counters[_ZERO] + window.counters[_ONE]) % n
        window.s[at], window.a[at], window.reward[at], window.discount[at] = s, a, r_t, discount_t
        window.counters[_ONE] += _ONE
        while window.counters[_ONE] == n or (last_t and window.counters[_ONE] > _ZERO):
            target = 0.0
            if discount_t != 0.0:
                if rule == MAXIMUM:
                    target = best_value(q, s_t)
                elif rule == SARSA:
                    target = q[s_t, np.uint64(a_t)]
                else:
                    target = expected_value(table, s_t, walk.counters[0], policy)
            first, size = window.counters[_ZERO], window.counters[_ONE]
            for back in range(_ZERO, size):
                k = (first + size - _ONE - back) % n
                target = window.reward[k] + (window.discount[k] * target if window.discount[k] != 0.0 else 0.0)
            x, b = window.s[first], window.a[first]
            visits[x, b] += 1
            q[x, b] = moved(q[x, b], target, step_length(step_size, visits[x, b]))
            window.counters[_ZERO] = (first + _ONE) % n
            window.counters[_ONE] = size - _ONE

"""The kernel of Dyna-Q and Dyna-Q+: after each real step, n imagined ones from remembered outcomes.

Planning draws a state among those seen, then one of its actions: of those taken there (Dyna-Q), or of all legal ones
(Dyna-Q+), where an action never taken is believed to stay with reward 0. Dyna-Q+ adds κ √τ to an imagined reward, τ
steps after the pair was last taken, so that old knowledge is doubted more and more. (Sutton 1990, 1991.)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import Log, Table, Walk, best_value, moved, next_step, step_length
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["Recall", "new_recall", "run_dyna"]

NUM_SEEN, BACKUPS = range(2)

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


class Recall(NamedTuple):
    """The last outcome of each pair, when it was taken (−1: never), updates of it, the states seen, and counters."""

    s_t: NDArray[np.uint64]
    reward: NDArray[np.float64]
    discount: NDArray[np.float64]
    taken_at: NDArray[np.int64]
    updates: NDArray[np.int64]
    seen: NDArray[np.uint64]
    counters: NDArray[np.int64]


def new_recall(num_states: int, num_actions: int) -> Recall:
    """A memory of nothing.

    Example:
        >>> new_recall(2, 3).taken_at.tolist()
        [[-1, -1, -1], [-1, -1, -1]]
    """
    shape, whole = (num_states, num_actions), np.int64
    return Recall(
        np.zeros(shape, np.uint64), np.zeros(shape), np.zeros(shape), np.full(shape, -1, whole),
        np.zeros(shape, whole), np.zeros(num_states, np.uint64), np.zeros(2, whole),
    )  # fmt: skip


@lean_kernel
def _draw_action(table: Table, recall: Recall, s: Any, untried: bool, rng: NDArray[np.uint64]) -> Any:
    """One of the actions taken in ``s``, or of all legal ones."""
    count, chosen = 0.0, _ZERO
    u = uniform(rng)
    for a in range(_ZERO, np.uint64(table.q.shape[1])):
        if recall.taken_at[s, a] >= 0 or (untried and table.q[s, a] > -np.inf):
            count += 1.0
    left = np.int64(u * count)
    for a in range(_ZERO, np.uint64(table.q.shape[1])):
        if recall.taken_at[s, a] >= 0 or (untried and table.q[s, a] > -np.inf):
            chosen = a
            if left == 0:
                break
            left -= 1
    return chosen


@lean_kernel
def run_dyna(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    recall: Recall,
    num_planning: int,
    kappa: float,
    untried: bool,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` real transitions, each followed by its update and ``num_planning`` imagined ones.

    Args:
        recall: what is remembered. (Updates are counted real or imagined.)
        num_planning: n.
        kappa: κ.
        untried: whether actions never taken are planned with.
    """
    q, counters = table.q, recall.counters
    num_actions = np.uint64(q.shape[1])
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, _a_t, _last = next_step(model, policy, table, walk, log, i, gamma, False)
        now = walk.counters[0]
        fresh = True
        for b in range(num_actions):
            if recall.taken_at[s, b] >= 0:
                fresh = False
        if fresh:
            recall.seen[np.uint64(counters[NUM_SEEN])] = s
            counters[NUM_SEEN] += 1
            for b in range(num_actions):
                recall.s_t[s, b], recall.discount[s, b] = s, gamma
        table.visits[s, a] += 1
        recall.s_t[s, a], recall.reward[s, a], recall.discount[s, a] = s_t, r_t, discount_t
        recall.taken_at[s, a] = now
        for k in range(num_planning + 1):
            x, b, bonus = s, a, 0.0
            if k > 0:
                x = recall.seen[np.uint64(uniform(walk.rng) * np.float64(counters[NUM_SEEN]))]
                b = _draw_action(table, recall, x, untried, walk.rng)
                if kappa != 0.0:
                    bonus = kappa * math.sqrt(np.float64(now - max(recall.taken_at[x, b], 0)))
            recall.updates[x, b] += 1
            alpha = step_length(step_size, recall.updates[x, b])
            target = recall.reward[x, b] + bonus
            if recall.discount[x, b] != 0.0:
                target += recall.discount[x, b] * best_value(q, recall.s_t[x, b])
            q[x, b] = moved(q[x, b], target, alpha)
            counters[BACKUPS] += 1

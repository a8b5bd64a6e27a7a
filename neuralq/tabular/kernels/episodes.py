"""Q-learning on stored transitions: episodes updated backwards, and old transitions replayed (Mitchell 1997, 13.3.6).

Nothing is learned during an episode. When it ends, its transitions are updated once, in reverse or in their own order,
and then ``num_replayed`` transitions drawn from all that are stored. In reverse order the reward of the goal reaches
every transition of the path at once; in forward order it moves back one transition per episode.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import Log, Table, Walk, best_value, moved, next_step, step_length
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["BACKUPS", "Store", "new_store", "run_episodes"]

COUNT, EPISODE, BACKUPS = range(3)


class Store(NamedTuple):
    """A ring of transitions, updates of each pair, and counters: ever stored, in this episode, updates."""

    s_tm1: NDArray[np.uint64]
    a_tm1: NDArray[np.uint64]
    r_t: NDArray[np.float64]
    discount_t: NDArray[np.float64]
    s_t: NDArray[np.uint64]
    updates: NDArray[np.int64]
    counters: NDArray[np.int64]


def new_store(capacity: int, shape: tuple[int, ...]) -> Store:
    """A store of nothing.

    Example:
        >>> new_store(3, (2, 2)).r_t.tolist()
        [0.0, 0.0, 0.0]
    """
    index = np.uint64
    return Store(
        np.zeros(capacity, index), np.zeros(capacity, index), np.zeros(capacity), np.zeros(capacity),
        np.zeros(capacity, index), np.zeros(shape, np.int64), np.zeros(3, np.int64),
    )  # fmt: skip


@lean_kernel
def _update(table: Table, store: Store, step_size: StepCode, k: Any) -> None:
    """Q-learning from stored transition ``k``."""
    q, s, a = table.q, store.s_tm1[k], store.a_tm1[k]
    store.updates[s, a] += 1
    alpha = step_length(step_size, store.updates[s, a])
    target = store.r_t[k]
    if store.discount_t[k] != 0.0:
        target += store.discount_t[k] * best_value(q, store.s_t[k])
    q[s, a] = moved(q[s, a], target, alpha)
    store.counters[BACKUPS] += 1


@lean_kernel
def run_episodes(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    store: Store,
    reverse: bool,
    num_replayed: int,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions; updates happen where an episode ends.

    Args:
        store: every transition; an episode longer than it keeps its newest.
        reverse: whether an episode is updated from its end.
        num_replayed: transitions drawn from the store after each episode.
    """
    counters = store.counters
    capacity = store.r_t.size
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, _a_t, last_t = next_step(model, policy, table, walk, log, i, gamma, False)
        table.visits[s, a] += 1
        at = np.uint64(counters[COUNT] % capacity)
        store.s_tm1[at], store.a_tm1[at], store.r_t[at] = s, a, r_t
        store.discount_t[at], store.s_t[at] = discount_t, s_t
        counters[COUNT] += 1
        counters[EPISODE] += 1
        if not last_t:
            continue
        length = min(counters[EPISODE], capacity)
        for k in range(length):
            back = k + 1 if reverse else length - k
            _update(table, store, step_size, np.uint64((counters[COUNT] - back) % capacity))
        held = min(counters[COUNT], capacity)
        for _ in range(num_replayed):
            _update(table, store, step_size, np.uint64(uniform(walk.rng) * held))
        counters[EPISODE] = 0

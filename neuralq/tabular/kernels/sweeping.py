"""Kernels of planning by priority: a learned model, the pairs that lead to each state, and a queue of Bellman errors.

After a real step its pair enters the queue; then up to n pairs are backed up, the worst first, and whoever leads to a
state whose value changed is measured again. Every change of a value re-measures all predecessors, so whenever the queue
is empty no pair of the learned model has a Bellman error above θ.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import Log, Table, Walk, best_value, moved, next_step, step_length
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["Memory", "new_memory", "run_sweeping"]

HEAP_SIZE, BACKUPS, OVERFLOW = range(3)
FULL, SAMPLE = range(2)

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)
_TWO: Any = np.uint64(2)


class Memory(NamedTuple):
    """The learned model and the queue; P pairs, B outcomes at most of each, node p·B + b.

    Outcome b of a pair: how often it came (``times``), its state, its discount. ``reward`` is the sum of a pair's
    rewards, ``last`` its last reward and ``newest`` its last outcome. ``head`` and ``after`` chain the nodes that lead
    to each state. The queue is a binary heap of pairs, ``place`` says where a pair is (−1: nowhere).
    """

    times: NDArray[np.int64]
    s_t: NDArray[np.uint64]
    discount: NDArray[np.float64]
    reward: NDArray[np.float64]
    last: NDArray[np.float64]
    newest: NDArray[np.int64]
    head: NDArray[np.int64]
    after: NDArray[np.int64]
    heap: NDArray[np.uint64]
    place: NDArray[np.int64]
    priority: NDArray[np.float64]
    updates: NDArray[np.int64]
    counters: NDArray[np.int64]


def new_memory(shape: tuple[int, ...], max_outcomes: int) -> Memory:
    """A memory of nothing.

    Raises:
        ValueError: room for no outcome.

    Example:
        >>> new_memory((2, 2), 3).s_t.shape
        (4, 3)
    """
    check_whole("max_outcomes", max_outcomes)
    num_states, num_actions = shape
    p, b, whole = num_states * num_actions, max_outcomes, np.int64
    return Memory(
        np.zeros((p, b), whole), np.zeros((p, b), np.uint64), np.zeros((p, b)), np.zeros(p), np.zeros(p),
        np.zeros(p, whole), np.full(num_states, -1, whole), np.full(p * b, -1, whole), np.zeros(p, np.uint64),
        np.full(p, -1, whole), np.zeros(p), np.zeros(p, whole), np.zeros(3, whole),
    )  # fmt: skip


@lean_kernel
def _remember(memory: Memory, pair: Any, r_t: float, discount_t: float, s_t: Any) -> None:
    """Count the outcome; a new one is chained to its state."""
    num_outcomes = memory.times.shape[1]
    memory.reward[pair] += r_t
    memory.last[pair] = r_t
    for b in range(num_outcomes):
        node = np.uint64(b)
        if memory.times[pair, node] == 0:
            memory.s_t[pair, node], memory.discount[pair, node] = s_t, discount_t
            chain = np.int64(pair) * num_outcomes + b
            memory.after[np.uint64(chain)] = memory.head[s_t]
            memory.head[s_t] = chain
        same_end = (memory.discount[pair, node] == 0.0) == (discount_t == 0.0)
        if memory.s_t[pair, node] == s_t and same_end:
            memory.times[pair, node] += 1
            memory.discount[pair, node] = discount_t
            memory.newest[pair] = b
            return
    memory.counters[OVERFLOW] = 1


@lean_kernel
def _target(memory: Memory, table: Table, pair: Any, kind: int, bored: int, optimistic: float) -> Any:
    """What the learned model says a pair is worth: expected, or by its last outcome; optimistic while rarely tried."""
    if kind == SAMPLE:
        newest = np.uint64(memory.newest[pair])
        value = memory.last[pair]
        if memory.discount[pair, newest] != 0.0:
            value += memory.discount[pair, newest] * best_value(table.q, memory.s_t[pair, newest])
        return value
    total, n = 0.0, 0
    for node in range(_ZERO, np.uint64(memory.times.shape[1])):
        times = memory.times[pair, node]
        if times == 0:
            break
        n += times
        if memory.discount[pair, node] != 0.0:
            total += times * memory.discount[pair, node] * best_value(table.q, memory.s_t[pair, node])
    if n < bored:
        return optimistic
    return (memory.reward[pair] + total) / n


@lean_kernel
def _sift(memory: Memory, start: Any) -> None:
    """Moves the entry at ``start`` up or down to where it belongs."""
    heap, place, priority = memory.heap, memory.place, memory.priority
    size = np.uint64(memory.counters[HEAP_SIZE])
    i = start
    pair = heap[i]
    while i > _ZERO:
        parent = (i - _ONE) // _TWO
        if priority[heap[parent]] >= priority[pair]:
            break
        heap[i] = heap[parent]
        place[heap[i]] = np.int64(i)
        i = parent
    while True:
        child = _TWO * i + _ONE
        if child >= size:
            break
        if child + _ONE < size and priority[heap[child + _ONE]] > priority[heap[child]]:
            child += _ONE
        if priority[heap[child]] <= priority[pair]:
            break
        heap[i] = heap[child]
        place[heap[i]] = np.int64(i)
        i = child
    heap[i] = pair
    place[pair] = np.int64(i)


@lean_kernel
def _offer(memory: Memory, pair: Any, priority: float, threshold: float) -> None:
    """Puts a pair into the queue, or moves it, if its error is above the threshold; takes no pair out."""
    if memory.place[pair] < 0:
        if priority <= threshold:
            return
        at = np.uint64(memory.counters[HEAP_SIZE])
        memory.counters[HEAP_SIZE] += 1
        memory.heap[at] = pair
        memory.place[pair] = np.int64(at)
    memory.priority[pair] = priority
    _sift(memory, np.uint64(memory.place[pair]))


@lean_kernel
def _pop(memory: Memory) -> Any:
    """The pair with the largest error; the queue must not be empty."""
    top = memory.heap[_ZERO]
    memory.counters[HEAP_SIZE] -= 1
    size = np.uint64(memory.counters[HEAP_SIZE])
    memory.place[top] = -1
    if size > _ZERO:
        moved = memory.heap[size]
        memory.heap[_ZERO] = moved
        memory.place[moved] = 0
        _sift(memory, _ZERO)
    return top


@lean_kernel
def run_sweeping(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    memory: Memory,
    kind: int,
    num_planning: int,
    threshold: float,
    bored: int,
    optimistic: float,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` real transitions, each followed by up to ``num_planning`` backups of the worst pairs.

    Args:
        memory: the learned model and the queue.
        kind: FULL (expected backups of counted outcomes) or SAMPLE (the last outcome stands for all).
        num_planning: n.
        threshold: θ.
        bored: pairs tried fewer times are worth ``optimistic``.
        optimistic: that value.
    """
    q = table.q
    num_actions = np.uint64(q.shape[1])
    num_outcomes = np.uint64(memory.times.shape[1])
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, _a_t, _last = next_step(model, policy, table, walk, log, i, gamma, False)
        pair = s * num_actions + a
        table.visits[s, a] += 1
        _remember(memory, pair, r_t, discount_t, s_t)
        error = abs(_target(memory, table, pair, kind, bored, optimistic) - q[s, a])
        _offer(memory, pair, error, threshold)
        for _ in range(num_planning):
            if memory.counters[HEAP_SIZE] == 0 or memory.priority[memory.heap[_ZERO]] <= threshold:
                break
            x = _pop(memory)
            sx, ax = x // num_actions, x % num_actions
            before = best_value(q, sx)
            memory.updates[x] += 1
            alpha = step_length(step_size, memory.updates[x])
            target = _target(memory, table, x, kind, bored, optimistic)
            q[sx, ax] = moved(q[sx, ax], target, alpha)
            memory.counters[BACKUPS] += 1
            if alpha != 1.0:
                _offer(memory, x, abs(target - q[sx, ax]), threshold)
            if best_value(q, sx) == before:
                continue
            chain = memory.head[sx]
            while chain >= 0:
                node = np.uint64(chain)
                y = node // num_outcomes
                error = abs(_target(memory, table, y, kind, bored, optimistic) - q[y // num_actions, y % num_actions])
                _offer(memory, y, error, threshold)
                chain = memory.after[node]

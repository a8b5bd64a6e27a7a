"""Compiled loops of the asynchronous methods: a priority queue over states, and trials along greedy paths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.exact.kernels import Floats, Index, Rows
from neuralq.jit import kernel

__all__ = ["back_up", "greedy_trials", "predecessors", "process_queue", "settle"]

Whole = NDArray[np.int64]


@kernel
def back_up(rows: Rows, v: Floats, s: int) -> tuple[float, int]:
    """(T V)(s) of a state that acts, and the lowest row that attains it."""
    best, best_k = -np.inf, np.int64(rows.starts[s])
    for k in range(np.int64(rows.starts[s]), np.int64(rows.starts[s + 1])):
        total = 0.0
        for j in range(rows.indptr[k], rows.indptr[k + 1]):
            total += rows.probability[j] * v[rows.column[j]]
        value = rows.reward[k] + rows.decay[k] * total
        if value > best:
            best, best_k = value, k  # type: ignore[assignment]
    return best, best_k  # type: ignore[return-value]


@kernel
def predecessors(rows: Rows, cursor: Whole, state: Index, weight: Floats) -> None:
    """Fills, for every state, the states one step before it and the discounted probabilities of those steps.

    ``cursor[s]`` is the place where the entries of s begin; it moves to where they end.
    """
    for s in range(rows.starts.size - 1):
        for k in range(np.int64(rows.starts[s]), np.int64(rows.starts[s + 1])):
            for j in range(rows.indptr[k], rows.indptr[k + 1]):
                following = rows.column[j]
                state[cursor[following]] = s
                weight[cursor[following]] = rows.decay[k] * rows.probability[j]
                cursor[following] += 1


@kernel
def _sift_up(heap: Whole, place: Whole, priority: Floats, i: int) -> None:
    s = heap[i]
    while i > 0:
        parent = (i - 1) // 2
        if priority[heap[parent]] >= priority[s]:
            break
        heap[i] = heap[parent]
        place[heap[i]] = i
        i = parent
    heap[i] = s
    place[s] = i


@kernel
def _sift_down(heap: Whole, place: Whole, priority: Floats, size: int) -> None:
    i, s = 0, heap[0]
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size and priority[heap[child + 1]] > priority[heap[child]]:
            child += 1
        if priority[heap[child]] <= priority[s]:
            break
        heap[i] = heap[child]
        place[heap[i]] = i
        i = child
    heap[i] = s
    place[s] = i


@kernel
def process_queue(
    rows: Rows,
    begins: Whole,
    state: Index,
    weight: Floats,
    v: Floats,
    priority: Floats,
    heap: Whole,
    place: Whole,
    size: int,
    threshold: float,
    most_states: int,
) -> tuple[int, int, int]:
    """Backs up the state of largest priority until none exceeds the threshold, or ``most_states`` were backed up.

    The queue is a binary heap of states; ``place`` is -1 outside it. Returns its size, the states and the rows used.
    """
    states, used = 0, 0
    while size > 0 and states < most_states:
        s = heap[0]
        size -= 1
        place[s] = -1
        if size > 0:
            heap[0] = heap[size]
            _sift_down(heap, place, priority, size)
        priority[s] = 0.0
        best, _ = back_up(rows, v, s)
        change = abs(best - v[s])
        v[s] = best
        states += 1
        used += np.int64(rows.starts[s + 1]) - np.int64(rows.starts[s])  # type: ignore[assignment]
        if change == 0.0:
            continue
        for i in range(begins[s], begins[s + 1]):
            before = np.int64(state[i])
            priority[before] += weight[i] * change
            if priority[before] > threshold:
                if place[before] < 0:
                    heap[size] = before
                    place[before] = size
                    size += 1
                _sift_up(heap, place, priority, place[before])
    return size, states, used


@kernel
def greedy_trials(
    rows: Rows,
    v: Floats,
    starts: Whole,
    settled: NDArray[np.bool_],
    most_steps: int,
    path: Whole,
    rng: np.random.Generator,
) -> tuple[int, int, int]:
    """One trial from each state of ``starts``: back up, take the greedy action, draw the successor, until it ends.

    A trial also ends on entering a settled state. Returns the length of the last one, which is left in ``path``, and
    the states and rows backed up by all.
    """
    states, used, steps = 0, 0, 0
    for start in starts:
        s, steps = start, 0
        while steps < most_steps and not settled[s]:
            best, k = back_up(rows, v, s)
            v[s] = best
            path[steps] = s
            steps += 1
            states += 1
            used += np.int64(rows.starts[s + 1]) - np.int64(rows.starts[s])  # type: ignore[assignment]
            left, following = rng.random(), -1
            for j in range(rows.indptr[k], rows.indptr[k + 1]):
                left -= rows.decay[k] * rows.probability[j]
                if left < 0.0:
                    following = np.int64(rows.column[j])  # type: ignore[assignment]
                    break
            if following < 0:
                break
            s = following
    return steps, states, used


@kernel
def settle(
    rows: Rows, v: Floats, root: int, threshold: float, settled: NDArray[np.bool_], seen: NDArray[np.bool_], path: Whole
) -> tuple[bool, int]:
    """Labels the greedy envelope of ``root`` as settled if no residual in it exceeds the threshold, else backs it up.

    ``seen`` is False everywhere before and after; returns the verdict and the rows used (CheckSolved, Bonet & Geffner).
    """
    size, reached, used, solved = 1, 0, 0, True
    path[0] = root
    seen[root] = True
    while reached < size:
        s = path[reached]
        reached += 1
        best, k = back_up(rows, v, s)
        used += np.int64(rows.starts[s + 1]) - np.int64(rows.starts[s])  # type: ignore[assignment]
        if abs(best - v[s]) > threshold:
            solved = False
            continue
        for j in range(rows.indptr[k], rows.indptr[k + 1]):
            following = np.int64(rows.column[j])
            if rows.decay[k] * rows.probability[j] > 0.0 and not settled[following] and not seen[following]:
                seen[following] = True
                path[size] = following
                size += 1
    for i in range(size - 1, -1, -1):
        s = path[i]
        seen[s] = False
        if solved:
            settled[s] = True
        else:
            v[s] = back_up(rows, v, s)[0]
            used += np.int64(rows.starts[s + 1]) - np.int64(rows.starts[s])  # type: ignore[assignment]
    return solved, used

"""Action values of states that are strings of bits, remembered in one of three ways: how far does a lesson reach?

* a **table**: what is learned in a state is learned of that state;
* **weighted Hamming distance**: it is learned of every state seen so far that differs in bits of small weight only, and
  a state that is new starts with the values of the nearest one;
* **clusters**: each action keeps groups of states, each with one value and with how often every bit was on. A lesson
  joins the group that makes its state likeliest among those whose value agrees with it, if that is likely enough, and
  else begins one. A state is worth what the groups say that make it likely enough, each counted by its size times how
  likely it makes the state: the mean of a mixture of Bernoulli distributions.

With a radius of 0 the second is the first.

Source: Mahadevan & Connell 1992, sections 4.2 and 4.3; that all likely groups have a say, by their size, is ours.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_fraction, check_positive, check_whole
from neuralq.jit import lean_kernel

__all__ = ["BitMemory", "bit_clusters", "bit_hamming", "bit_table", "bit_update", "bit_values", "bits_remembered"]

_TABLE, _HAMMING, _CLUSTERS = range(3)
_MOST_BITS = 22
_MOST_CLUSTERS = 1024  # of each action; where all are taken, the likeliest is joined whatever its value


class BitMemory(NamedTuple):
    """What was learned; made by `bit_table`, `bit_hamming` or `bit_clusters`, and changed in place.

    Args:
        kind: which of them.
        num_bits: n; states are whole numbers below 2ⁿ.
        q: values, ``[rows, A]``.
        used: rows in use, ``[A]`` (clusters: by action; else all alike).
        row_of: 1 + the row of each state, 0 for one that is new, ``[2ⁿ]`` (Hamming).
        states: the state of each row, ``[rows]`` (Hamming).
        distance: by which bits differ, the sum of their weights, ``[2ⁿ]`` (Hamming).
        radius: up to which states share a lesson (Hamming).
        size: lessons in each cluster, ``[rows, A]``.
        on: how many of them had each bit on, ``[rows, A, n]``.
        likely: log-probability of a bit that is off, and of one that is on, ``[rows, A, n, 2]``.
        least_likely: log-likelihood from which a cluster has a say about a state.
        tolerance: by how much a lesson and the cluster that it joins differ at most.
    """

    kind: int
    num_bits: int
    q: NDArray[np.float64]
    used: NDArray[np.int64]
    row_of: NDArray[np.int64]
    states: NDArray[np.int64]
    distance: NDArray[np.float64]
    radius: float
    size: NDArray[np.int64]
    on: NDArray[np.int64]
    likely: NDArray[np.float64]
    least_likely: float
    tolerance: float


def bit_table(num_bits: int, num_actions: int) -> BitMemory:
    """A value for each state and action, 0 at first.

    Raises:
        ValueError: no bits or more than 22, or no actions.

    Example:
        >>> memory = bit_table(3, 2)
        >>> bit_update(memory, 5, 1, 10.0, 0.5)
        >>> values = np.zeros(2)
        >>> bit_values(memory, 5, values), values.tolist()
        (5.0, [0.0, 5.0])
    """
    return _memory(_TABLE, num_bits, num_actions)


def bit_hamming(weights: ArrayLike, num_actions: int, radius: float) -> BitMemory:
    """Lessons are shared by the states seen so far within a weighted Hamming distance.

    Args:
        weights: of each bit, from the lowest, ``[n]``, at least 0.
        num_actions: A.
        radius: up to which distance; 0 makes it a table.

    Raises:
        ValueError: no bits or more than 22, no actions, a negative weight or radius.

    Example:
        >>> memory, values = bit_hamming([1.0, 5.0], 1, radius=2.0), np.zeros(1)
        >>> for s in (0, 1, 2):
        ...     bit_update(memory, s, 0, 10.0 * (s == 1), 0.5)
        >>> [bit_values(memory, s, values) for s in (0, 1, 2)]
        [5.0, 5.0, 0.0]
    """
    given = np.asarray(weights, np.float64)
    if given.ndim != 1 or not np.isfinite(given).all() or (given < 0).any():
        raise ValueError(f"weights must be one finite number of at least 0 for each bit, got {weights!r}")
    if not 0.0 <= radius < math.inf:
        raise ValueError(f"radius must be a finite number of at least 0, got {radius!r}")
    return _memory(_HAMMING, len(given), num_actions, weights=given, radius=float(radius))


def bit_clusters(num_bits: int, num_actions: int, likelihood: float = 1e-4, tolerance: float = 1.5) -> BitMemory:
    """Each action groups the states by their bits and by the values that it has in them.

    Args:
        num_bits: n.
        num_actions: A.
        likelihood: a cluster has a say about a state to which it gives at least this probability, in (0, 1].
        tolerance: a lesson joins a cluster whose value is closer to it than this, above 0.

    Raises:
        ValueError: no bits or more than 22, no actions, or a number out of range.

    Example:
        A cluster of one lesson expects each bit with 2/3: a state that differs in one is half as likely, enough here.

        >>> memory, values = bit_clusters(2, 1, likelihood=0.2), np.zeros(1)
        >>> bit_update(memory, 0, 0, 3.0, 1.0)
        >>> [bit_values(memory, s, values) for s in range(4)]
        [3.0, 3.0, 3.0, 0.0]
    """
    check_fraction("likelihood", likelihood)
    check_positive("likelihood", likelihood)
    check_positive("tolerance", tolerance)
    return _memory(_CLUSTERS, num_bits, num_actions, least_likely=math.log(likelihood), tolerance=float(tolerance))


def bits_remembered(memory: BitMemory) -> int:
    """How many values are kept apart for the best known action: states that were seen, or clusters of all actions.

    Raises:
        ValueError: a table, which keeps all of them apart from the start.

    Example:
        >>> memory = bit_clusters(3, 2)
        >>> bit_update(memory, 5, 1, 10.0, 0.5)
        >>> bits_remembered(memory)
        1
    """
    if memory.kind == _TABLE:
        raise ValueError("a table keeps every state apart; count the rows of q that are not 0")
    return int(memory.used.sum()) if memory.kind == _CLUSTERS else int(memory.used[0])


def _memory(
    kind: int,
    num_bits: int,
    num_actions: int,
    weights: NDArray[np.float64] | None = None,
    radius: float = 0.0,
    least_likely: float = 0.0,
    tolerance: float = 0.0,
) -> BitMemory:
    """Arrays of zeros, which take memory only where something is written."""
    check_whole("num_bits", num_bits)
    check_whole("num_actions", num_actions)
    if num_bits > _MOST_BITS:
        raise ValueError(f"num_bits must be at most {_MOST_BITS}, got {num_bits}; leave out bits that say little")
    states = 2**num_bits
    rows = _MOST_CLUSTERS if kind == _CLUSTERS else states
    grouped, near = rows * (kind == _CLUSTERS), states * (kind == _HAMMING)
    distance = np.zeros(near)
    if weights is not None:
        for bit, weight in enumerate(weights):
            distance += weight * (np.arange(states) >> bit & 1)
    return BitMemory(
        kind,
        num_bits,
        np.zeros((rows, num_actions)),
        np.zeros(num_actions, np.int64),
        np.zeros(near, np.int64),
        np.zeros(near, np.int64),
        distance,
        radius,
        np.zeros((grouped, num_actions), np.int64),
        np.zeros((grouped, num_actions, num_bits), np.int64),
        np.zeros((grouped, num_actions, num_bits, 2)),
        least_likely,
        tolerance,
    )


@lean_kernel
def bit_values(memory: BitMemory, s: int, values: NDArray[np.float64]) -> float:
    """Writes the value of every action in state ``s``, 0 where nothing is known, and returns the largest.

    Args:
        memory: what was learned.
        s: state, a whole number below 2ⁿ.
        values: ``[A]``; written.

    Example:
        >>> values = np.ones(2)
        >>> bit_values(bit_clusters(4, 2), 7, values), values.tolist()
        (0.0, [0.0, 0.0])
    """
    row = s if memory.kind == _TABLE else -1 if memory.kind == _CLUSTERS else _nearest(memory, s)
    largest = -np.inf
    for a in range(len(values)):
        if memory.kind == _CLUSTERS:
            values[a] = _expected(memory, s, a)
        else:
            values[a] = memory.q[row, a] if row >= 0 else 0.0
        largest = max(largest, values[a])
    return largest


@lean_kernel
def bit_update(memory: BitMemory, s: int, a: int, target: float, step_size: float) -> None:
    """Moves the value of ``a`` in ``s``, and of what shares the lesson, towards a target.

    Args:
        memory: changed in place.
        s: state, a whole number below 2ⁿ.
        a: action.
        target: such as r + γ max Q.
        step_size: α in (0, 1].

    Example:
        Two lessons agree within the tolerance of 1.5; the third begins a cluster. The first expects each bit with 3/4,
        the second with 2/3: the state is worth (2 · 9/16 · 1.25 + 1 · 4/9 · 9) / (2 · 9/16 + 4/9).

        >>> memory, values = bit_clusters(2, 1), np.zeros(1)
        >>> for target in (1.0, 1.5, 9.0):
        ...     bit_update(memory, 3, 0, target, 0.5)
        >>> memory.q[:2, 0].tolist(), memory.size[:2, 0].tolist(), round(bit_values(memory, 3, values), 4)
        ([1.25, 9.0], [2, 1], 3.4447)
    """
    if memory.kind == _TABLE:
        memory.q[s, a] += step_size * (target - memory.q[s, a])
    elif memory.kind == _HAMMING:
        if memory.row_of[s] == 0:
            nearest, row = _nearest(memory, s), memory.used[0]
            if nearest >= 0:
                for b in range(memory.q.shape[1]):
                    memory.q[row, b] = memory.q[nearest, b]
            memory.states[row], memory.row_of[s] = s, row + 1
            for b in range(len(memory.used)):
                memory.used[b] += 1
        for row in range(memory.used[0]):
            if memory.distance[memory.states[row] ^ s] <= memory.radius:
                memory.q[row, a] += step_size * (target - memory.q[row, a])
    else:
        _join(memory, s, a, target, step_size)


@lean_kernel
def _nearest(memory: BitMemory, s: int) -> Any:
    """The row of the nearest state that was seen, the first of those that tie, or -1 for none within the radius."""
    if memory.row_of[s] > 0:
        return memory.row_of[s] - 1
    nearest, least = -1, np.inf
    for row in range(memory.used[0]):
        apart = memory.distance[memory.states[row] ^ s]
        if apart <= memory.radius and apart < least:
            nearest, least = row, apart
    return nearest


@lean_kernel
def _expected(memory: BitMemory, s: int, a: int) -> float:
    """The mean value of ``a`` over the clusters that make ``s`` likely enough, 0 for none."""
    worth, weights = 0.0, 0.0
    for c in range(memory.used[a]):
        likely = _log_likelihood(memory, c, a, s, memory.least_likely)
        if likely >= memory.least_likely:
            weight = memory.size[c, a] * math.exp(likely)
            weights += weight
            worth += weight / weights * (memory.q[c, a] - worth)
    return worth


@lean_kernel
def _likeliest(memory: BitMemory, s: int, a: int, least: float, target: float, tolerance: float) -> int:
    """The cluster that makes ``s`` likeliest of those whose value is near ``target``, or -1 for none."""
    best, most = -1, least
    for c in range(memory.used[a]):
        if abs(memory.q[c, a] - target) < tolerance:
            likely = _log_likelihood(memory, c, a, s, most)
            if likely > most or (best < 0 and likely >= most):
                best, most = c, likely
    return best


@lean_kernel
def _log_likelihood(memory: BitMemory, c: int, a: int, s: int, least: float) -> float:
    """Of ``s`` in a cluster, or something below ``least`` where it is below."""
    likely = 0.0
    for i in range(memory.num_bits):
        likely += memory.likely[c, a, i, s >> i & 1]
        if likely < least:
            break
    return likely


@lean_kernel
def _join(memory: BitMemory, s: int, a: int, target: float, step_size: float) -> None:
    """The lesson joins the likeliest cluster that it agrees with, or begins one."""
    c = _likeliest(memory, s, a, memory.least_likely, target, memory.tolerance)
    if c < 0 and memory.used[a] < memory.size.shape[0]:
        c = memory.used[a]
        memory.used[a], memory.q[c, a] = c + 1, target
    elif c < 0:
        c = _likeliest(memory, s, a, -np.inf, 0.0, np.inf)
    memory.q[c, a] += step_size * (target - memory.q[c, a])
    memory.size[c, a] += 1
    for i in range(memory.num_bits):
        memory.on[c, a, i] += s >> i & 1
        share = (memory.on[c, a, i] + 1.0) / (memory.size[c, a] + 2.0)  # Laplace's rule
        memory.likely[c, a, i, 0], memory.likely[c, a, i, 1] = math.log(1.0 - share), math.log(share)

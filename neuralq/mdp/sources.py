"""Where the rows of a model come from: two functions, or a random generator. `FiniteMDP` checks what is made here."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from neuralq.mdp.outcomes import Outcomes

__all__ = ["garnet_rows", "outcomes_of_functions"]

_REPORTS = 100  # how often a build says how far it is


def outcomes_of_functions(
    num_states: int,
    actions: Callable[[int], Iterable[int]],
    transitions: Callable[[int, int], Iterable[tuple[float, int, float, bool]]],
    progress: Callable[[int, int], None] | None,
) -> tuple[NDArray[np.int64], NDArray[np.int64], Outcomes]:
    """The state and action of every row, and its outcomes, by one call of ``transitions`` for each legal pair.

    Example:
        >>> swap = outcomes_of_functions(2, lambda s: [0], lambda s, a: [(1.0, 1 - s, 5.0, False)], None)
        >>> swap[0].tolist(), swap[2].s_t.tolist()
        ([0, 1], [1, 0])
    """
    pairs: list[tuple[int, int]] = []
    found: list[tuple[float, int, float, bool]] = []
    ends = [0]
    stride = max(1, -(-num_states // _REPORTS))
    for s in range(num_states):
        for a in sorted(actions(s)):
            pairs.append((s, int(a)))
            found.extend(tuple(one) for one in transitions(s, a))  # type: ignore[misc]
            ends.append(len(found))
        if progress is not None and ((s + 1) % stride == 0 or s + 1 == num_states):
            progress(s + 1, num_states)
    columns = np.array(found, dtype=np.float64).reshape(-1, 4)
    s_tm1, a_tm1 = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    outcomes = Outcomes(
        np.array(ends, dtype=np.int64),
        columns[:, 0].copy(),
        columns[:, 1].astype(np.int64),
        columns[:, 2].copy(),
        columns[:, 3] != 0,
    )
    return s_tm1, a_tm1, outcomes


def garnet_rows(
    num_states: int, num_actions: int, branching: int, rng: np.random.Generator
) -> tuple[sparse.csr_array, NDArray[np.float64]]:
    """Random rows ``[K, S]`` of ``branching`` distinct successors each, and their rewards ``[K]``.

    Example:
        >>> garnet_rows(10, 2, 3, np.random.default_rng(0))[0].nnz
        60
    """
    k = num_states * num_actions
    s_t = np.empty((k, branching), dtype=np.int64)
    for j in range(branching):  # Floyd's algorithm: a uniform subset without replacement, all rows at once
        largest = num_states - branching + j
        draw = rng.integers(0, largest + 1, size=k)
        s_t[:, j] = np.where((s_t[:, :j] == draw[:, None]).any(axis=1), largest, draw)
    s_t.sort(axis=1)
    cuts = np.sort(rng.random((k, branching - 1)), axis=1)
    probability = np.diff(cuts, axis=1, prepend=0.0, append=1.0)
    indptr = np.arange(0, k * branching + 1, branching)
    transition = sparse.csr_array((probability.reshape(-1), s_t.reshape(-1), indptr), shape=(k, num_states))
    return transition, rng.standard_normal(k)

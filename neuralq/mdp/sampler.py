"""Draws from a finite model, many rows at once, by inverting the cumulative distribution of each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neuralq.mdp.outcomes import Outcomes

if TYPE_CHECKING:
    from neuralq.mdp.model import FiniteMDP

__all__ = ["Sampler"]


def _outcomes_of_rows(mdp: FiniteMDP) -> Outcomes:
    """The outcomes a model has when only its transition matrix and expected rewards are known."""
    transition, k = mdp.transition, mdp.num_rows
    row = np.repeat(np.arange(k), np.diff(transition.indptr))
    s_t = transition.indices.astype(np.int64)
    keep = transition.data > 0
    ends = np.flatnonzero(mdp.termination > 0)
    row, s_t = np.concatenate([row[keep], ends]), np.concatenate([s_t[keep], mdp.s_tm1[ends]])
    probability = np.concatenate([transition.data[keep], mdp.termination[ends]])
    terminated = np.concatenate([np.zeros(int(keep.sum()), dtype=bool), np.ones(len(ends), dtype=bool)])
    order = np.argsort(row, kind="stable")
    indptr = np.searchsorted(row[order], np.arange(k + 1)).astype(np.int64)
    return Outcomes(indptr, probability[order], s_t[order], mdp.reward[row[order]], terminated[order])


class Sampler:
    """Draws the outcome of many rows at once: one uniform number and one binary search each.

    The cumulative probabilities of row k live in [k, k + 1], so that one search over all of them inverts any row.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> sampler = Sampler(FiniteMDP.garnet(5, 2, 1, seed=0))
        >>> sampler.next_steps(np.array([0, 3]), np.random.default_rng(0))[0].shape
        (2,)
    """

    def __init__(self, mdp: FiniteMDP) -> None:
        source = mdp.outcomes or _outcomes_of_rows(mdp)
        keep = source.probability > 0
        self._row = source.row[keep]
        self._s_t, self._reward = source.s_t[keep], source.reward[keep]
        self._terminated = source.terminated[keep] | mdp.is_terminal[self._s_t]
        running = np.cumsum(source.probability[keep])
        first = np.searchsorted(self._row, np.arange(mdp.num_rows + 1))
        before = np.concatenate([[0.0], running])[first[:-1]]
        within = running - before[self._row]
        mass = np.concatenate([[0.0], running])[first[1:]] - before
        whole = mass > 1 - 1e-9
        within /= np.where(whole, np.maximum(mass, 1e-300), 1.0)[self._row]
        self._cumulative = self._row + within
        self._s_tm1 = mdp.s_tm1
        # Rounding must not push a draw past the last outcome of a full row.
        self._last = np.where(whole & (first[1:] > first[:-1]), first[1:] - 1, first[1:])
        self._discount = mdp.row_discount
        self._random_end = bool(np.any(self._discount < 1))
        self._start = np.cumsum(mdp.start_distribution)

    def first_states(self, num: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """``num`` independent draws from the start distribution."""
        drawn: NDArray[np.int64] = np.searchsorted(self._start, rng.random(num) * self._start[-1], side="right")
        return drawn

    def next_steps(
        self, row: NDArray[np.int64], rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
        """Successor, reward and whether the episode terminates, ``[N]`` each, for one draw of every given row."""
        found = np.searchsorted(self._cumulative, row + rng.random(len(row)), side="right")
        found = np.minimum(found, self._last[row])
        # A draw beyond the listed mass of its row ends the episode where it stands.
        inside = (found < len(self._row)) & (self._row[np.minimum(found, len(self._row) - 1)] == row)
        found = np.where(inside, found, 0)
        s_t = np.where(inside, self._s_t[found], self._s_tm1[row])
        terminated = np.where(inside, self._terminated[found], True)
        if self._random_end:
            terminated |= rng.random(len(row)) >= self._discount[row]
        return s_t, np.where(inside, self._reward[found], 0.0), terminated

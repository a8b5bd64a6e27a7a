"""A finite model laid out for sampling: alias tables, one draw per step whatever the number of outcomes.

The outcomes of pair p = s·A + a are ``first[p]:first[p + 1]``. Walker's (1977) alias method pairs each with another
one, so that a uniform choice followed by one comparison has the right probabilities. A row's discount below 1 is
simulated, as `FiniteMDP` says: with the complementary probability the episode ends after the reward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq.jit import lean_kernel
from neuralq.mdp import AliasedMDP, FiniteMDP
from neuralq.mdp.outcomes import Outcomes

__all__ = ["Model", "ModelArrays", "compile_model", "complete_outcomes", "empty_arrays"]

RESTARTS = ("model", "uniform")


class ModelArrays(NamedTuple):
    """What kernels read. Indices are unsigned: no check for negative ones, which is faster."""

    first: NDArray[np.uint64]
    keep: NDArray[np.float64]
    alias: NDArray[np.uint64]
    s_t: NDArray[np.uint64]
    reward: NDArray[np.float64]
    ends: NDArray[np.bool_]
    start_keep: NDArray[np.float64]
    start_alias: NDArray[np.uint64]
    start_state: NDArray[np.uint64]
    observe: NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class Model:
    """A compiled model: build it once, learn on it with many seeds.

    Args:
        arrays: what kernels read.
        legal: which actions each state (or observation) has, ``[S, A]``.
        max_outcomes: the largest number of outcomes of a pair.
    """

    arrays: ModelArrays
    legal: NDArray[np.bool_]
    max_outcomes: int


def compile_model(source: FiniteMDP | AliasedMDP, restarts: str = "model") -> Model:
    """The alias tables of a model.

    Args:
        source: the model. Of an `AliasedMDP` the learner sees observations: tables are over these, and states that
            look alike share their values.
        restarts: episodes begin in a state drawn from the model's start distribution (``"model"``) or uniformly from
            all states that have an action (``"uniform"``).

    Raises:
        ValueError: another ``restarts``.

    Example:
        >>> model = compile_model(FiniteMDP.garnet(4, 2, 3, seed=0))
        >>> model.max_outcomes, model.arrays.first.tolist()[:3]
        (3, [0, 3, 6])
    """
    check_choice("restarts", restarts, RESTARTS)
    mdp = source.mdp if isinstance(source, AliasedMDP) else source
    outcomes = complete_outcomes(mdp)
    pair, probability = (mdp.s_tm1 * mdp.num_actions + mdp.a_tm1)[outcomes.row], outcomes.probability
    first = np.searchsorted(pair, np.arange(mdp.num_states * mdp.num_actions + 1))
    keep, alias = _alias_tables(first, probability)
    lively = ~mdp.is_terminal
    start = mdp.start_distribution if restarts == "model" else lively / np.count_nonzero(lively)
    states = np.flatnonzero(start > 0)
    start_keep, start_alias = _alias_tables(np.array([0, len(states)]), start[states])
    unsigned = np.uint64
    arrays = ModelArrays(
        first.astype(unsigned), keep, alias, outcomes.s_t.astype(unsigned), outcomes.reward,
        outcomes.terminated,
        start_keep, start_alias, states.astype(unsigned), np.zeros(0, unsigned),
    )  # fmt: skip
    room = int(np.max(np.diff(first)))
    if isinstance(source, FiniteMDP):
        return Model(arrays, mdp.legal, room)
    # A pair of observations can lead wherever any of its states does.
    room *= int(np.max(np.bincount(source.observation)))
    return Model(arrays._replace(observe=source.observation.astype(unsigned)), source.legal, room)


def empty_arrays() -> ModelArrays:
    """Arrays of the right types for kernels that read recorded transitions instead of sampling.

    Example:
        >>> empty_arrays().s_t.dtype
        dtype('uint64')
    """
    index, number = np.zeros(0, np.uint64), np.zeros(0)
    return ModelArrays(index, number, index, index, number, np.zeros(0, bool), number, index, index, index)


def complete_outcomes(mdp: FiniteMDP) -> Outcomes:
    """Everything that can happen in each row, ends included: probabilities of a row sum to 1 and no discount is left.

    Example:
        >>> outcomes = complete_outcomes(FiniteMDP.from_arrays([[[0.25]]], [[2.0]], substochastic=True))
        >>> outcomes.probability.tolist(), outcomes.terminated.tolist()
        ([0.25, 0.75], [False, True])
    """
    row, probability, s_t, reward, terminated = _with_missing_mass(mdp)
    ends = terminated | mdp.is_terminal[s_t]
    goes_on = mdp.row_discount[row]
    split = (goes_on < 1) & ~ends  # these outcomes become two: the episode goes on, or it ends
    row = np.concatenate([row, row[split]])
    ended = (probability * (1 - goes_on))[split]
    probability = np.concatenate([probability * np.where(split, goes_on, 1.0), ended])
    s_t, reward = np.concatenate([s_t, s_t[split]]), np.concatenate([reward, reward[split]])
    ends = np.concatenate([ends, np.ones(len(ended), dtype=bool)])
    order = np.flatnonzero(probability > 0)
    order = order[np.argsort(row[order], kind="stable")]
    indptr = np.searchsorted(row[order], np.arange(mdp.num_rows + 1)).astype(np.int64)
    return Outcomes(indptr, probability[order], s_t[order], reward[order], ends[order])


def _with_missing_mass(
    mdp: FiniteMDP,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Row, probability, successor, reward and end of every outcome; a row's missing mass is one that ends."""
    if mdp.outcomes is None:
        row = np.repeat(np.arange(mdp.num_rows), np.diff(mdp.transition.indptr))
        probability, s_t = mdp.transition.data, mdp.transition.indices.astype(np.int64)
        reward, terminated = mdp.reward[row], np.zeros(len(row), dtype=bool)
        reward_at_end, missing = mdp.reward, mdp.termination
    else:
        given, row = mdp.outcomes, mdp.outcomes.row
        probability, s_t, reward, terminated = given.probability, given.s_t, given.reward, given.terminated
        mass = np.bincount(row, weights=probability, minlength=mdp.num_rows)
        missing = np.where(1 - mass > 1e-9, 1 - mass, 0.0)
        reward_at_end = np.zeros(mdp.num_rows)
    more = np.flatnonzero(missing > 0)
    return (
        np.concatenate([row, more]), np.concatenate([probability, missing[more]]),
        np.concatenate([s_t, mdp.s_tm1[more]]), np.concatenate([reward, reward_at_end[more]]),
        np.concatenate([terminated, np.ones(len(more), dtype=bool)]),
    )  # fmt: skip


def _alias_tables(
    first: NDArray[np.int64], probability: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.uint64]]:
    """Of every outcome, the probability to keep it when drawn, and the outcome taken otherwise."""
    keep, alias = probability.copy(), np.arange(len(probability), dtype=np.uint64)
    _fill_tables(first.astype(np.uint64), keep, alias, np.empty(int(np.max(np.diff(first), initial=1)), np.uint64))
    return keep, alias


@lean_kernel
def _fill_tables(
    first: NDArray[np.uint64], keep: NDArray[np.float64], alias: NDArray[np.uint64], waiting: NDArray[np.uint64]
) -> None:
    """Vose's (1991) construction, pair by pair; ``keep`` holds the probabilities at first.

    ``waiting`` holds outcomes with less than an equal share from its front, those with more from its back.
    """
    for p in range(first.size - 1):
        lo, hi = first[np.uint64(p)], first[np.uint64(p + 1)]
        total = 0.0
        for j in range(lo, hi):
            total += keep[j]
        num_small, num_large, size = 0, 0, waiting.size
        for j in range(lo, hi):
            keep[j] *= np.float64(hi - lo) / total
            if keep[j] < 1.0:
                waiting[num_small] = j
                num_small += 1
            else:
                num_large += 1
                waiting[size - num_large] = j
        while num_small > 0 and num_large > 0:
            num_small -= 1
            less, more = waiting[num_small], waiting[size - num_large]
            alias[less] = more
            keep[more] -= 1.0 - keep[less]
            if keep[more] < 1.0:
                num_large -= 1
                waiting[num_small] = more
                num_small += 1
        for k in range(num_small):  # what rounding left over
            keep[waiting[k]] = 1.0
        for k in range(num_large):
            keep[waiting[size - 1 - k]] = 1.0

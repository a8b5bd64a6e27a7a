"""The optimum over histories of a model that is seen through an observation function, where nothing is left to chance.

If every transition is certain, what can be known after a history is a set of states with weights, one for each first
state that is still possible: its belief. An action moves every state of it, those that ended drop out, and the next
observation says which part is left. So the beliefs that can come up are finitely many wherever rows do not discount,
they form a Markov decision process, and its optimum is that of all policies that remember everything (Åström 1965;
Littman 1996, chapter 6). Weights are kept as fractions, so that two ways to the same belief meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from neuralq.checks import check_discount, check_whole
from neuralq.exact.planning import Solution, solve
from neuralq.mdp import AliasedMDP, FiniteMDP

__all__ = ["HistorySolution", "solve_histories"]

Belief = tuple[tuple[int, Fraction], ...]
"""States that look alike, ascending, and the probability of each."""
Moves = dict[int, tuple[float, dict[int, float]]]
"""By action: the expected reward, and with which discounted probability each belief follows."""


@dataclass(frozen=True, eq=False)
class HistorySolution:
    """The best that can be done by whoever remembers everything that was observed and done.

    Args:
        value: expected return from the start, exact but for ``solution.bound``.
        beliefs: every belief that can come up, its states and their probabilities.
        model: the process of beliefs: state b is ``beliefs[b]``.
        solution: of that process; its policy is the optimal one.
    """

    value: float
    beliefs: tuple[tuple[NDArray[np.int64], NDArray[np.float64]], ...]
    model: FiniteMDP
    solution: Solution


def solve_histories(aliased: AliasedMDP, gamma: float, *, max_beliefs: int = 10_000) -> HistorySolution:
    """The optimum over all policies of observations and actions so far, by dynamic programming over beliefs.

    Args:
        aliased: the model; every row must lead to one state, or to the end, for certain.
        gamma: γ in [0, 1]; 1 as `solve` has it.
        max_beliefs: give up beyond so many.

    Raises:
        ValueError: an argument out of range, a row that leaves something to chance, more beliefs than that, or γ = 1
            where `solve` refuses the process of beliefs.

    Source: Åström 1965; Littman 1996.

    Example:
        Two states look alike; a move to the other one pays 1, a refused one costs 1. After one move it is known where.

        >>> swap = FiniteMDP.from_arrays([[[0, 1], [0, 1]], [[1, 0], [1, 0]]], [[1.0, -1.0], [-1.0, 1.0]])
        >>> round(solve_histories(AliasedMDP(swap, [0, 0]), gamma=0.9).value, 6)
        9.0
    """
    check_discount("gamma", gamma)
    check_whole("max_beliefs", max_beliefs)
    mdp = aliased.mdp
    s_t = _certain_successors(mdp)
    first = [(s, Fraction(float(p))) for s, p in enumerate(mdp.start_distribution) if p > 0]
    numbers: dict[Belief, int] = {}
    begin = {_number(part, numbers): float(mass) for part, mass in _parts(aliased, first)}
    beliefs = list(numbers)
    transitions: list[Moves] = []
    while len(transitions) < len(beliefs):
        transitions.append(_moves(aliased, s_t, beliefs[len(transitions)], numbers))
        beliefs = list(numbers)
        if len(beliefs) > max_beliefs:
            raise ValueError(
                f"more than {max_beliefs} beliefs can come up; raise max_beliefs if there are finitely many (rows that "
                "discount can make new ones for ever)"
            )
    model = _process(transitions, begin, mdp.num_actions)
    solution = solve(model, gamma)
    ways = tuple(
        (np.array([s for s, _ in belief]), np.array([float(weight) for _, weight in belief])) for belief in beliefs
    )
    return HistorySolution(float(model.start_distribution @ solution.v), ways, model, solution)


def _certain_successors(mdp: FiniteMDP) -> NDArray[np.int64]:
    """Where each row leads, ``[K]``; −1 where it ends the episode."""
    transition = mdp.transition.copy()
    transition.eliminate_zeros()
    counts = np.diff(transition.indptr)
    unsure = np.flatnonzero((counts > 1) | ((counts == 1) & (mdp.termination > 0)))
    if unsure.size:
        raise ValueError(
            f"{mdp.row_name(unsure[0])} leaves the next state to chance; the optimum over histories is computed for "
            "certain transitions only: take evaluate_memoryless or best_memoryless for what needs no memory"
        )
    s_t = np.full(mdp.num_rows, -1, dtype=np.int64)
    s_t[counts == 1] = transition.indices
    s_t[(s_t >= 0) & mdp.is_terminal[s_t]] = -1
    return s_t


def _parts(aliased: AliasedMDP, weights: list[tuple[int, Fraction]]) -> list[tuple[Belief, Fraction]]:
    """Weighted states by what they look like, each part as a belief with its mass."""
    apart: dict[int, dict[int, Fraction]] = {}
    for s, weight in weights:
        part = apart.setdefault(int(aliased.observation[s]), {})
        part[s] = part.get(s, Fraction(0)) + weight
    found = []
    for part in apart.values():
        mass = sum(part.values(), Fraction(0))
        found.append((tuple(sorted((s, weight / mass) for s, weight in part.items())), mass))
    return found


def _number(belief: Belief, numbers: dict[Belief, int]) -> int:
    return numbers.setdefault(belief, len(numbers))


def _moves(aliased: AliasedMDP, s_t: NDArray[np.int64], belief: Belief, numbers: dict[Belief, int]) -> Moves:
    """What follows a belief by each legal action; beliefs that are new get their number."""
    mdp, found = aliased.mdp, {}
    for a in np.flatnonzero(mdp.legal[belief[0][0]]).tolist():
        rows = [(int(mdp.row_index[s, a]), weight) for s, weight in belief]
        reward = sum(float(weight) * float(mdp.reward[row]) for row, weight in rows)
        goes_on = [
            (int(s_t[row]), weight * Fraction(float(mdp.row_discount[row])))
            for row, weight in rows
            if s_t[row] >= 0 and mdp.row_discount[row] > 0
        ]
        found[a] = (reward, {_number(part, numbers): float(mass) for part, mass in _parts(aliased, goes_on)})
    return found


def _process(transitions: list[Moves], begin: dict[int, float], num_actions: int) -> FiniteMDP:
    """The Markov decision process of beliefs."""
    rows = [(b, a, *move) for b, moves in enumerate(transitions) for a, move in moves.items()]
    entries = [(k, b_t, mass) for k, row in enumerate(rows) for b_t, mass in row[3].items()]
    at, b_t, mass = np.array(entries, dtype=np.float64).reshape(-1, 3).T
    s_tm1, a_tm1, reward = (np.array([row[i] for row in rows]) for i in range(3))
    shape = (len(rows), len(transitions))
    transition = sparse.csr_array((mass, (at.astype(np.int64), b_t.astype(np.int64))), shape=shape)
    start = np.zeros(len(transitions))
    start[list(begin)] = list(begin.values())
    return FiniteMDP(len(transitions), num_actions, s_tm1, a_tm1, transition, reward, start=start)

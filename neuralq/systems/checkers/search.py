"""Alpha-beta over checkers: so many plies, then as many captures as follow; with or without a memory of positions.

The value of a position is the weighted sum of its terms, from the view of who is to move; a loss is −100, and less
of one by ``ply_penalty`` for each ply that it is away, so that of two wins the nearer one is chosen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.systems.checkers.memory import Memory, find
from neuralq.systems.checkers.terms import NUM_TERMS, evaluate
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.checkers.rules import MAX_MOVES, jumpers, moves, num_steps

__all__ = ["DECIDED", "MOST_PLIES", "WIN", "Desk", "new_desk", "search", "shifted_score"]

WIN = 100.0
DECIDED = 50.0
"""A score beyond this is a win or a loss; a sum of terms is cut at 40."""
_LARGEST = 40.0
MOST_PLIES = 20
_MOST_CAPTURES = 24


class Desk(NamedTuple):
    """What a search works on; one for each thread.

    Args:
        moves: of each ply, ``[P, MAX_MOVES, 5]`` (`neuralq_envs.checkers.rules.moves`); the first row is the root's.
        scores: of the root's moves, ``[MAX_MOVES]``: exact for the best, an upper bound for the others.
        ahead: per ply its best score, alpha and beta, ``[P, 3]``.
        at: per ply the number of moves, and which is next, ``[P, 2]``.
        terms: of a leaf, ``[14]``.
        counts: nodes that were visited, and scores taken from memory, since the desk was made, ``[2]``.
    """

    moves: NDArray[np.int64]
    scores: NDArray[np.float64]
    ahead: NDArray[np.float64]
    at: NDArray[np.int64]
    terms: NDArray[np.float64]
    counts: NDArray[np.int64]


def new_desk() -> Desk:
    """A desk for searches of up to `MOST_PLIES` plies.

    Example:
        >>> new_desk().counts.tolist()
        [0, 0]
    """
    plies = MOST_PLIES + _MOST_CAPTURES + 1
    return Desk(
        np.zeros((plies, MAX_MOVES, 5), np.int64), np.zeros(MAX_MOVES), np.zeros((plies, 3)),
        np.zeros((plies, 2), np.int64), np.zeros(NUM_TERMS), np.zeros(2, np.int64),
    )  # fmt: skip


@lean_kernel
def shifted_score(score: float, plies: float, ply_penalty: float) -> float:
    """A win or loss seen from so many plies further away; other scores stay.

    Example:
        >>> shifted_score(99.5, 2, 0.25), shifted_score(-99.5, 2, 0.25), shifted_score(3.0, 2, 0.25)
        (99.0, -99.0, 3.0)
    """
    if score > DECIDED:
        return score - plies * ply_penalty
    if score < -DECIDED:
        return score + plies * ply_penalty
    return score


@lean_kernel
def _shuffle(rows: NDArray[np.int64], count: int, rng: NDArray[np.uint64]) -> None:
    for i in range(count - 1, 0, -1):
        j = int((i + 1) * uniform(rng))
        for k in range(5):
            rows[i, k], rows[j, k] = rows[j, k], rows[i, k]


@lean_kernel
def _leaf(
    own: int, other: int, kings: int, ply: int, depth: int, weights: NDArray[np.float64], ply_penalty: float,
    memory: Memory, desk: Desk,
) -> tuple[bool, float]:  # fmt: skip
    """Whether the search ends here, and the score for who is to move."""
    place = find(memory, own, other, kings, depth - ply)
    if place >= 0:
        desk.counts[1] += 1
        return True, shifted_score(memory.scores[place], ply, ply_penalty)
    if jumpers(own, other, kings):
        return False, 0.0
    if num_steps(own, other, kings) == 0:
        return True, -WIN + ply * ply_penalty
    if ply < depth:
        return False, 0.0
    value = evaluate(own, other, kings, weights, desk.terms)
    return True, min(max(value, -_LARGEST), _LARGEST)


@lean_kernel
def search(
    own: int, other: int, kings: int, depth: int, weights: NDArray[np.float64], ply_penalty: float,
    memory: Memory, desk: Desk, rng: NDArray[np.uint64],
) -> float:  # fmt: skip
    """The score of a position for the side to move; `Desk.moves` has its moves and `Desk.scores` their scores.

    The root's moves are drawn into a random order, so that of equal ones any may come out best.

    Args:
        own: pieces of the side to move.
        other: pieces of the other side.
        kings: which of both are kings.
        depth: plies, 1 to `MOST_PLIES`; captures that follow are looked at beyond.
        weights: of the terms, ``[14]``.
        ply_penalty: what a win loses for each ply that it is away.
        memory: of positions, or an empty one.
        desk: overwritten.
        rng: draws the order.

    Example:
        >>> from neuralq.systems.checkers.memory import new_memory
        >>> from neuralq.systems.checkers.terms import MATERIAL_ONLY
        >>> from neuralq.tabular import new_stream
        >>> from neuralq_envs.checkers import Position
        >>> one = Position.from_fen("B:W9,10,18,19:B5")  # 5x14x23 leaves one against two
        >>> desk = new_desk()
        >>> search(one.own, one.other, one.kings, 1, MATERIAL_ONLY, 0.01, new_memory(0), desk, new_stream(0))
        -1.0
    """
    ahead, at = desk.ahead, desk.at
    ply = 0
    at[0, 0], at[0, 1] = moves(own, other, kings, desk.moves[0]), 0
    if at[0, 0] == 0:
        return -WIN
    _shuffle(desk.moves[0], at[0, 0], rng)
    ahead[0, 0], ahead[0, 1], ahead[0, 2] = -np.inf, -np.inf, np.inf
    while True:
        if at[ply, 1] == at[ply, 0] or ahead[ply, 0] >= ahead[ply, 2]:
            if ply == 0:
                return ahead[0, 0]  # type: ignore[no-any-return]
            score = -ahead[ply, 0]
            ply -= 1
        else:
            own = desk.moves[ply, at[ply, 1], 0]
            other = desk.moves[ply, at[ply, 1], 1]
            kings = desk.moves[ply, at[ply, 1], 2]
            at[ply, 1] += 1
            desk.counts[0] += 1
            ends, value = _leaf(own, other, kings, ply + 1, depth, weights, ply_penalty, memory, desk)
            if not ends:
                ahead[ply + 1, 0], ahead[ply + 1, 1], ahead[ply + 1, 2] = -np.inf, -ahead[ply, 2], -ahead[ply, 1]
                ply += 1
                at[ply, 0], at[ply, 1] = moves(own, other, kings, desk.moves[ply]), 0
                continue
            score = -value
        if ply == 0:
            desk.scores[at[0, 1] - 1] = score
        ahead[ply, 0] = max(ahead[ply, 0], score)
        ahead[ply, 1] = max(ahead[ply, 1], score)

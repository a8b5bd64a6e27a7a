"""A program that plays checkers on positions: what each move is worth, and which one it would make."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from neuralq.checks import check_whole
from neuralq.systems.checkers.search import DECIDED, MOST_PLIES, WIN, search, shifted_score
from neuralq.systems.checkers.training import new_program
from neuralq.tabular.kernels.random_numbers import Seed, new_stream, uniform
from neuralq_envs.checkers import Move, Position

__all__ = ["LEARNED", "CheckersPlayer", "RankedMove", "plies_to_the_end"]

_PLY_PENALTY = 0.01

LEARNED = (
    1.0, 0.108872, 0.75857, 0.706128, -0.067633, -0.0436, 0.173706, 0.134416, 0.338695, -0.096286, 0.191393, -0.899395,
    0.528281, 1.509655,
)  # fmt: skip
"""What ``train(0)`` comes to, averaged over its last 250 of 500 games."""


class RankedMove(NamedTuple):
    """A move and what the side that makes it expects: in men, or near ±100 for a win or a loss that is seen."""

    move: Move
    score: float


def plies_to_the_end(score: float) -> int | None:
    """How many plies away the win or loss is that a score tells of; None where it tells of none.

    Example:
        >>> [plies_to_the_end(score) for score in (99.95, -99.98, 3.2)]
        [5, 2, None]
    """
    return round((WIN - abs(score)) / _PLY_PENALTY) if abs(score) > DECIDED else None


class CheckersPlayer:
    """A program with a depth of look-ahead; not safe to use from several threads at once.

    Args:
        weights: of the terms, ``[14]``.
        depth: plies of look-ahead, 2 to 20.
        seed: of the draws between equal moves.

    Raises:
        ValueError: weights of another shape, or a depth out of range.

    Example:
        >>> player = CheckersPlayer(depth=4)
        >>> [ranked.move.position.winner for ranked in player.ranked(Position.from_fen("B:W5:B1,K14"))][0]
        0
    """

    def __init__(self, weights: ArrayLike = LEARNED, depth: int = 7, seed: Seed | None = None) -> None:
        check_whole("depth", depth, minimum=2)
        if depth > MOST_PLIES:
            raise ValueError(f"depth must lie in 2..{MOST_PLIES}, got {depth}")
        self._program = new_program(weights, depth, _PLY_PENALTY)
        self._rng = new_stream(np.random.SeedSequence() if seed is None else seed)

    def ranked(self, position: Position) -> list[RankedMove]:
        """Every move with its exact score, the best first; equal ones in a random order.

        Example:
            >>> len(CheckersPlayer(depth=2).ranked(Position.initial()))
            7
        """
        found = []
        for move in position.moves():
            after = move.position
            score = self._search(after, self._program.depth - 1)
            found.append(RankedMove(move, -shifted_score(score, 1.0, _PLY_PENALTY)))
        order = {one.move: float(uniform(self._rng)) for one in found}
        return sorted(found, key=lambda one: (-one.score, order[one.move]))

    def score(self, position: Position) -> float:
        """What the side to move expects; −100 if it cannot move.

        Example:
            >>> CheckersPlayer(depth=2).score(Position.from_fen("B:W32:B"))
            -100.0
        """
        return self._search(position, self._program.depth)

    def _search(self, position: Position, depth: int) -> float:
        program = self._program
        return float(
            search(
                position.own, position.other, position.kings, depth, program.weights, program.ply_penalty,
                program.memory, program.desk, self._rng,
            )
        )  # fmt: skip

"""One life in Woods1 from nothing: how many steps each problem took, and what was learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.systems.bucket_brigade.kernels import forage
from neuralq.tabular.kernels.random_numbers import Seed, new_stream
from neuralq.tabular.kernels.zcs import Zcs, ZcsRates, new_zcs, zcs_strengths
from neuralq_envs.woods import NUM_BITS, NUM_MOVES, REWARD, WOODS1, percepts, successors

__all__ = ["FREE", "LED", "Life", "best_moves", "live", "random_life", "strongest_moves"]

MOST_STEPS = 500
"""After which a problem is broken off."""
SEEN, LED = percepts(), successors()
_SIGNS = np.array(list(WOODS1.replace("\n", "")))
FREE = np.flatnonzero(_SIGNS == ".")
_IS_FOOD = _SIGNS == "F"


@dataclass(frozen=True, eq=False)
class Life:
    """What came of one life.

    Args:
        steps: of each problem, ``[problems]``.
        moves: the move that it takes most likely in each free cell at the end, ``[16]``; empty where nobody learned.
    """

    steps: NDArray[np.int64]
    moves: NDArray[np.int64]

    @property
    def late(self) -> float:
        """Mean steps of the last tenth of its problems."""
        return float(self.steps[-max(len(self.steps) // 10, 1) :].mean())


def live(seed: Seed, rates: ZcsRates = ZcsRates(), num_problems: int = 10_000) -> Life:  # noqa: B008 - frozen
    """A life of ZCS.

    Args:
        seed: of the stream.
        rates: constants.
        num_problems: how many.

    Raises:
        ValueError: no problem.

    Example:
        >>> life = live(0, num_problems=20)
        >>> life.steps.shape, life.moves.shape
        ((20,), (16,))
    """
    check_whole("num_problems", num_problems)
    stream, steps = new_stream(seed), np.zeros(num_problems, np.int64)
    zcs = new_zcs(NUM_BITS, NUM_MOVES, stream, rates=rates)
    forage(zcs, rates, SEEN, LED, _IS_FOOD, FREE, REWARD, MOST_STEPS, stream, steps)
    return Life(steps, strongest_moves(zcs))


def strongest_moves(zcs: Zcs) -> NDArray[np.int64]:
    """The move with most strength behind it in each free cell, ``[16]``.

    Example:
        >>> zcs = new_zcs(NUM_BITS, NUM_MOVES, new_stream(0), 2)
        >>> zcs.cares[:], zcs.wants[:], zcs.action[:], zcs.strength[:] = 0, 0, [3, 5], [1.0, 2.0]
        >>> set(strongest_moves(zcs).tolist())
        {5}
    """
    strengths, moves = np.zeros(NUM_MOVES), np.zeros(len(FREE), np.int64)
    for i, cell in enumerate(FREE):
        zcs_strengths(zcs, int(SEEN[cell]), strengths)
        moves[i] = strengths.argmax()
    return moves


def random_life(seed: Seed, num_problems: int = 10_000) -> Life:
    """A life of moves at random: classifiers that match everything and are never paid.

    Example:
        >>> 20 < random_life(0).late < 40
        True
    """
    stream, steps = new_stream(seed), np.zeros(num_problems, np.int64)
    zcs = new_zcs(NUM_BITS, NUM_MOVES, stream, NUM_MOVES)
    zcs.cares[:], zcs.wants[:], zcs.action[:] = 0, 0, np.arange(NUM_MOVES)
    rates = ZcsRates(beta=0.0, tax=0.0, breeding=0.0, covering=0.0)
    forage(zcs, rates, SEEN, LED, _IS_FOOD, FREE, REWARD, MOST_STEPS, stream, steps)
    return Life(steps, np.zeros(0, np.int64))


def best_moves(moves: NDArray[np.int64]) -> int:
    """How many of these moves, one for each free cell, are on a shortest way to food.

    Args:
        moves: ``[16]``.

    Example:
        >>> best_moves(LED[FREE].argmin(axis=1)) < 16
        True
    """
    away = np.where(_IS_FOOD, 0.0, np.inf)
    for _ in FREE:
        away[FREE] = 1.0 + away[LED[FREE]].min(axis=1)
    return int(np.count_nonzero(away[LED[FREE, moves]] == away[FREE] - 1.0))

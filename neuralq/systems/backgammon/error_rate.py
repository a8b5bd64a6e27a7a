"""How much a player gives away in each decision, by the values of GNU Backgammon's network.

A decision is a position with a roll that can be played in more than one way. Its loss is

    max_i E(i) − E(chosen),   E(i) = −(equity, by the network at zero plies, of the other side in afterstate i),

in points; a game that is over counts as what has been won. It is no luck at all, so some hundreds of decisions tell
apart players that take thousands of games in a match. It is a measure of likeness to that network too: where a player
knows better, it is charged for it.

The decisions come from games of that network against itself with generators seeded with a fixed number: each decision
of a game is taken with a chance of 1/8, so that neighbours, which resemble each other, are rare. The same seed gives
the same decisions to every player, as long as it is the same version of gnubg-nn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.systems.backgammon.match import Player, Side, rolls, turn_taker
from neuralq.systems.backgammon.opponents import GnubgPlayer, gnubg_equity, index_of, require_gnubg
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, START, Board, afterstates, result

__all__ = ["Decision", "ErrorRate", "decisions", "error_rate"]

_SHARE = 1 / 8

Decision = tuple[Board, int, int]
"""The board ``[2, 25]`` as the side to move sees it, and its dice."""


@dataclass(frozen=True, eq=False)
class ErrorRate:
    """What the decisions of a player have lost.

    Args:
        losses: of each decision, in points, at least 0, ``[n]``.

    Example:
        >>> found = ErrorRate(np.array([0.0, 0.0, 0.1, 0.3]))
        >>> found.mean, found.share_of_best
        (0.1, 0.5)
    """

    losses: NDArray[np.float64]

    @property
    def num_decisions(self) -> int:
        """How many."""
        return len(self.losses)

    @property
    def mean(self) -> float:
        """Points lost per decision."""
        return float(self.losses.mean())

    @property
    def standard_error(self) -> float:
        """Of `mean`; NaN for fewer than two decisions."""
        if len(self.losses) < 2:
            return float("nan")
        return float(self.losses.std(ddof=1) / np.sqrt(len(self.losses)))

    @property
    def share_of_best(self) -> float:
        """Share of decisions that lost nothing."""
        return float((self.losses == 0).mean())


def error_rate(player: Player, num_decisions: int = 1000, seed: int = 0, *, plies: int = 1) -> ErrorRate:
    """Mean loss of equity per decision, against GNU Backgammon's network at zero plies.

    Args:
        player: a network, an agent, "random", "pubeval" or "gnubg" (whose losses are zero).
        num_decisions: how many.
        seed: of the games that the decisions come from.
        plies: how far a network looks, 1 or 2.

    Raises:
        MissingExtra: gnubg-nn is not installed.
        ValueError: no decision, an unknown player, other plies.

    Source: the loss in equity per decision by which GNU Backgammon's analysis rates players.
    """
    check_choice("plies", plies, (1, 2))
    package = require_gnubg()
    take_turn, choices = turn_taker(Side.of(player, "player", plies)), np.random.default_rng((seed, 1))
    boards = np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    losses = []
    for board, die_1, die_2 in decisions(num_decisions, seed):
        count = afterstates(board, die_1, die_2, boards)
        expected = [-(result(after) or gnubg_equity(after, package)) for after in boards[:count]]
        chosen = board.copy()
        take_turn(chosen, die_1, die_2, choices)
        losses.append(max(expected) - expected[index_of(chosen, count, boards)])
    return ErrorRate(np.array(losses))


def decisions(num_decisions: int, seed: int) -> Iterator[Decision]:
    """Positions with rolls from games of GNU Backgammon's network against itself, each with more than one way to play.

    Raises:
        MissingExtra: gnubg-nn is not installed.
        ValueError: no decision.
    """
    check_whole("num_decisions", num_decisions)
    gnubg, boards = GnubgPlayer("gnubg"), np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    dice, lots = np.random.default_rng((seed, 2)), np.random.default_rng((seed, 3))
    left = num_decisions
    while left > 0:
        board = START
        for die_1, die_2 in rolls(dice):
            count = afterstates(board, die_1, die_2, boards)
            if count > 1 and left > 0 and lots.random() < _SHARE:
                left -= 1
                yield board.copy(), die_1, die_2
            board = boards[gnubg.choose(board, die_1, die_2, count, boards)].copy()
            if result(board) != 0 or left == 0:
                break

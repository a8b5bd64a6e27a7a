"""The players of GNU Backgammon's library, asked for one turn at a time.

The package gnubg-nn holds GNU Backgammon's networks and Tesauro's pubeval, the linear player that programs have been
measured against since 1993. It is under the GPL, so nothing of it is copied here and nothing here needs it: it is
imported when such a player is made. Its zero plies are what Tesauro calls one: the network's values of the boards in
which a turn can end.

Its answers are taken for what they are, a list of moves of single checkers, and played on our board; what comes out
has to be one of the boards in which our rules let the turn end. Its functions share buffers: one call at a time in a
process.

Source: Tesauro (1993), "Benchmark player pubeval" (rec.games.backgammon).
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from neuralq.checks import MissingExtra
from neuralq.jit import kernel
from neuralq_envs.backgammon.rules import BAR, Board

__all__ = ["INSTALL", "GnubgPlayer", "IllegalTurn", "gnubg_equity", "index_of", "require_gnubg"]

INSTALL = "pip install 'neuralq[gnubg]' (GNU Backgammon's networks, under the GPL)"


class IllegalTurn(ValueError):
    """An opponent has answered with a turn that the rules do not allow."""


def require_gnubg() -> Any:
    """The module gnubg_nn.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        return importlib.import_module("gnubg_nn")
    except ImportError as error:
        raise MissingExtra(f"pubeval and gnubg need the package gnubg-nn: {INSTALL}") from error


class GnubgPlayer:
    """GNU Backgammon's network without looking ahead, or pubeval.

    Args:
        name: "gnubg" or "pubeval".

    Raises:
        MissingExtra: gnubg-nn is not installed.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._package = require_gnubg()

    def choose(self, board: Board, die_1: int, die_2: int, count: int, boards: Board) -> int:
        """Which of the first ``count`` afterstates it leaves.

        Raises:
            IllegalTurn: none of them.
        """
        own, other = board.tolist()
        moves = self._moves(own, other, die_1, die_2)
        index = index_of(_after(own, other, moves), count, boards)
        if index < 0:
            raise IllegalTurn(
                f"{self.name} played {moves} with {die_1} and {die_2} on {board.tolist()}, which is no legal turn; "
                "please report it with these numbers"
            )
        return index

    def _moves(self, own: list[int], other: list[int], die_1: int, die_2: int) -> list[tuple[int, int]]:
        """(from, to), counted from 0 as in our rows; the bar is 24 and off the board −1."""
        if self.name == "gnubg":
            return [(i - 1, j - 1) for i, j in self._package.best_move([other, own], die_1, die_2, 0)]
        flat = self._package.pub_best_move([other, own], die_1, die_2)
        return list(zip(flat[::2], flat[1::2], strict=True))


def gnubg_equity(board: Board, package: Any) -> float:
    """Points that the side to move, about to roll, expects of a game that is not over, by GNU Backgammon's network."""
    win, gammon, backgammon, lost_gammon, lost_backgammon = package.probabilities(
        [board[1].tolist(), board[0].tolist()], 0
    )
    return float(2.0 * win - 1.0 + gammon + backgammon - lost_gammon - lost_backgammon)


def _after(own: list[int], other: list[int], moves: Iterable[tuple[int, int]]) -> Board:
    """The board that the other side meets after these moves, whether they are legal or not; the rows are used up."""
    for source, target in moves:
        own[source] -= 1
        if target >= 0:
            own[target] += 1
            if other[BAR - 1 - target] == 1:
                other[BAR - 1 - target] = 0
                other[BAR] += 1
    return np.array([other, own], np.int8)


@kernel
def index_of(board: Board, count: int, boards: Board) -> int:
    """Where ``board`` is among the first ``count`` of ``boards``; −1 if it is not.

    Example:
        >>> boards = np.zeros((3, 2, 25), np.int8)
        >>> boards[1, 0, 5] = 2
        >>> index_of(boards[1], 3, boards), index_of(boards[1], 1, boards)
        (1, -1)
    """
    for i in range(count):
        same = True
        for side in range(2):
            for point in range(25):
                if boards[i, side, point] != board[side, point]:
                    same = False
                    break
            if not same:
                break
        if same:
            return i
    return -1

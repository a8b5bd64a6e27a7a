"""Tic-tac-toe against an opponent that cannot lose, with the exact value of every square.

Both the opponent's answers and the values that are shown come from the minimax values of all 5,478 positions
(`neuralq_envs.tictactoe.minimax_values`). Among squares that are equally good the opponent draws one.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.apps.web.play import Action, Offer
from neuralq.apps.web.play_requests import point_of, word_of
from neuralq_envs.tictactoe import minimax_values, positions

__all__ = ["TicTacToeGame", "tictactoe"]

_WORDS = {1: "win", 0: "draw", -1: "loss"}
_LINES = ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6))
_SIGNS = {1: "X", -1: "O", 0: ""}

Marks = NDArray[np.int8]  # [9]: 1 where X is, −1 where O is


class TicTacToeGame:
    """Games of one visitor, with the score.

    Args:
        rng: draws between squares that are equally good.

    Example:
        >>> game = TicTacToeGame(np.random.default_rng(0))
        >>> game.new({"player": "X"})
        >>> game.move({"cell": 4})
        >>> state = game.state()
        >>> state["cells"].count("O"), set(filter(None, state["values"]))  # it has taken a corner: nobody can win
        (1, {'draw'})
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._player = 1  # X
        self._boards: list[Marks] = [np.zeros(9, np.int8)]  # those in which the visitor has been to move, and the last
        self._score = {"you": 0, "draws": 0, "opponent": 0}
        self._result: dict[str, Any] | None = None

    def new(self, given: Mapping[str, Any]) -> None:
        """A new game, as ``player`` X, who begins, or O.

        Raises:
            ValueError: another player.
        """
        self._player = 1 if word_of(given, "player", ("X", "O")) == "X" else -1
        board = np.zeros(9, np.int8)
        self._boards = [board if self._player == 1 else self._answered(board)]
        self._result = None

    def move(self, given: Mapping[str, Any]) -> None:
        """Marks ``cell``, 0 to 8 row by row; the opponent answers.

        Raises:
            ValueError: no cell, one that is taken, or a game that is over.
        """
        cell = point_of(given, "cell", 0, 8)
        if self._result is not None:
            raise ValueError("the game is over; start a new one")
        if self._boards[-1][cell]:
            raise ValueError(f"cell {cell} is taken by {_SIGNS[int(self._boards[-1][cell])]}")
        board = _marked(self._boards[-1], cell)
        if not _is_over(board):
            board = self._answered(board)
        self._boards.append(board)
        if _is_over(board):
            self._finish(board)

    def undo(self, given: Mapping[str, Any]) -> None:
        """Takes back the visitor's last move and the answer to it; a result that had been counted is taken off.

        Raises:
            ValueError: there is none.
        """
        if len(self._boards) == 1:
            raise ValueError("there is nothing to take back, you have not moved in this game")
        if self._result is not None:
            self._score[self._result["winner"] or "draws"] -= 1
            self._result = None
        self._boards.pop()

    def state(self) -> dict[str, Any]:
        """Everything that the page shows."""
        board = self._boards[-1]
        over = self._result is not None
        return {
            "player": _SIGNS[self._player],
            "cells": [_SIGNS[int(mark)] for mark in board],
            "values": [None if over or board[cell] else self._value(_marked(board, cell)) for cell in range(9)],
            "can_undo": len(self._boards) > 1,
            "result": self._result,
            "score": self._score,
        }

    def _value(self, board: Marks) -> str:
        """What the visitor can be sure of."""
        return _WORDS[self._player * _values()[board.tobytes()]]

    def _answered(self, board: Marks) -> Marks:
        """After the opponent's move, drawn among the best."""
        ways = [_marked(board, cell) for cell in np.flatnonzero(board == 0).tolist()]
        worth = [-self._player * _values()[one.tobytes()] for one in ways]
        best = [one for one, value in zip(ways, worth, strict=True) if value == max(worth)]
        return best[self._rng.integers(len(best))]

    def _finish(self, board: Marks) -> None:
        line = _line(board)
        winner = None if line is None else "you" if board[line[0]] == self._player else "opponent"
        self._result = {"winner": winner, "line": line and list(line)}
        self._score[winner or "draws"] += 1


def tictactoe() -> Offer:
    """Tic-tac-toe against the exact answer.

    Example:
        >>> tictactoe().page
        'tictactoe.html'
    """
    actions = {"move": Action(TicTacToeGame.move, ("cell",)), "undo": Action(TicTacToeGame.undo)}
    return Offer("tictactoe.html", TicTacToeGame, ("player",), actions)


@functools.cache
def _values() -> dict[bytes, int]:
    """Who wins each position when both play perfectly, by its marks."""
    return {marks.tobytes(): int(value) for marks, value in zip(positions(), minimax_values(), strict=True)}


def _marked(board: Marks, cell: int) -> Marks:
    """The board after whose turn it is has marked ``cell``."""
    after = board.copy()
    after[cell] = 1 if board.sum() == 0 else -1
    return after


def _line(board: Marks) -> tuple[int, ...] | None:
    return next((line for line in _LINES if abs(int(board[list(line)].sum())) == 3), None)


def _is_over(board: Marks) -> bool:
    return _line(board) is not None or bool(board.all())

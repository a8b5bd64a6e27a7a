"""A trained network as a player: which turn it takes, and what it expects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neuralq.backgammon.network import ValueNetwork, equities
from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.position import check_dice
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, afterstates

__all__ = ["BackgammonAgent", "Chances", "RankedTurn"]


@dataclass(frozen=True, slots=True)
class Chances:
    """How likely each outcome is for one side; a gammon includes a backgammon.

    Args:
        win: of winning, whatever the points.
        gammon: of winning a gammon.
        lost_gammon: of losing one.
    """

    win: float
    gammon: float
    lost_gammon: float

    def turned_around(self) -> Chances:
        """As the other side sees them.

        Example:
            >>> Chances(0.75, 0.25, 0.125).turned_around()
            Chances(win=0.25, gammon=0.125, lost_gammon=0.25)
        """
        return Chances(1.0 - self.win, self.lost_gammon, self.gammon)


@dataclass(frozen=True, slots=True)
class RankedTurn:
    """One way to play a roll: the afterstate, and what the side that plays it then expects."""

    position: Position
    equity: float
    chances: Chances


class BackgammonAgent:
    """Plays the afterstate that is worst for the other side.

    Args:
        network: its values.

    Example:
        >>> agent = BackgammonAgent(ValueNetwork.drawn(40, 4, np.random.default_rng(0)))
        >>> start = Position.initial()
        >>> agent.best_move(start, (3, 1)) in start.afterstates((3, 1))
        True
    """

    def __init__(self, network: ValueNetwork) -> None:
        self.network = network

    def equity(self, position: Position) -> float:
        """Points per game that the side to move, about to roll, expects: money play without a cube, in [−3, 3]."""
        if position.winner is not None:
            return float(position.points if position.winner == position.turn else -position.points)
        return float(equities(self.network.outputs(position.board[None]))[0])

    def chances(self, position: Position) -> Chances:
        """Of the side to move, about to roll."""
        return _chances(self.network.outputs(position.board[None])[0])

    def best_move(self, position: Position, dice: Sequence[int]) -> Position:
        """The afterstate to leave; the other side is to move in it.

        Raises:
            ValueError: dice that are not two numbers of 1 to 6, or a game that is over.
        """
        return self.ranked_turns(position, dice, 1)[0].position

    def ranked_turns(self, position: Position, dice: Sequence[int], num_turns: int | None = None) -> list[RankedTurn]:
        """The best ``num_turns`` afterstates, or all, with what the side to move expects of them; the best first.

        Raises:
            ValueError: dice that are not two numbers of 1 to 6, or a game that is over.

        Example:
            >>> agent = BackgammonAgent(ValueNetwork.drawn(40, 4, np.random.default_rng(0)))
            >>> ranked = agent.ranked_turns(Position.initial(), (3, 1), 5)
            >>> len(ranked), ranked[0].equity >= ranked[1].equity, ranked[0].position.turn
            (5, True, 1)
        """
        die_1, die_2 = check_dice(dice)
        if position.winner is not None:
            raise ValueError(f"the game is over, player {position.winner} has won; start from Position.initial()")
        boards = np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
        boards = boards[: afterstates(position.board, die_1, die_2, boards)]
        y = self.network.outputs(boards)
        others = equities(y)
        turns = []
        for i in np.argsort(others, kind="stable")[:num_turns]:
            after = Position.from_board(boards[i], 1 - position.turn)
            equity = float(after.points) if after.winner is not None else -float(others[i])
            turns.append(RankedTurn(after, equity, _chances(y[i]).turned_around()))
        return turns


def _chances(y: np.ndarray[tuple[int], np.dtype[np.floating]]) -> Chances:
    """Of the outputs of one position; the four chances are made to sum to 1, for nothing else does."""
    if y.size == 1:
        return Chances(float(y[0]), 0.0, 0.0)
    plain, gammon, _, lost_gammon = (y / y.sum()).tolist()
    return Chances(plain + gammon, gammon, lost_gammon)

"""A trained network as a player: which turn it takes, and what it expects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq.systems.backgammon.network import ValueNetwork, equities
from neuralq.systems.backgammon.search import MAX_CANDIDATES, WINDOW, look_ahead
from neuralq.types import Floats
from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.position import check_dice
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, Board, afterstates, result

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
        plies: 1 takes them as they are; 2 looks one roll further (`neuralq.systems.backgammon.search`), which is some
        30 times
            the work.

    Raises:
        ValueError: other plies.

    Example:
        >>> agent = BackgammonAgent(ValueNetwork.drawn(40, 4, np.random.default_rng(0)))
        >>> start = Position.initial()
        >>> agent.best_move(start, (3, 1)) in start.afterstates((3, 1))
        True
    """

    def __init__(self, network: ValueNetwork, plies: int = 1) -> None:
        check_choice("plies", plies, (1, 2))
        self.network = network
        self.plies = plies

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

        At two plies the turns that have been looked into come before those that have not, which are too far behind
        at one ply and keep what they were worth there.

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
        y = self.network.outputs(boards).astype(np.float64)
        others = equities(y)
        for i in np.flatnonzero(boards[:, 1].sum(1) == 0):
            others[i] = result(boards[i])
        order = np.argsort(others, kind="stable")
        if self.plies == 2:
            order = self._look_into(boards, y, others, order)
        return [
            RankedTurn(
                Position.from_board(boards[i], 1 - position.turn),
                -float(others[i]),
                _chances(y[i]).turned_around(),
            )
            for i in order[:num_turns]
        ]

    def _look_into(self, boards: Board, y: Floats, others: Floats, order: NDArray[np.intp]) -> NDArray[np.intp]:
        """Puts what two plies say of the best into ``y`` and ``others``, and returns the new order."""
        net, best = self.network, order[:MAX_CANDIDATES]
        best = best[others[best] <= others[order[0]] + WINDOW]
        ours = np.empty(net.num_outputs)
        for i in best:
            if boards[i, 1].any():
                others[i] = -look_ahead(boards[i], net.w, net.v, net.c, net.scratch, ours)
                y[i] = 1.0 - ours if net.num_outputs == 1 else np.roll(ours, net.num_outputs // 2)
        return np.concatenate([best[np.argsort(others[best], kind="stable")], order[len(best) :]])


def _chances(y: np.ndarray[tuple[int], np.dtype[np.floating]]) -> Chances:
    """Of the outputs of one position; they are made to sum to 1, for nothing else does."""
    if y.size == 1:
        return Chances(float(y[0]), 0.0, 0.0)
    won, lost = (y / y.sum()).reshape(2, -1)
    return Chances(float(won.sum()), float(won[1:].sum()), float(lost[1:].sum()))

"""One position of backgammon, played for money without a cube: its legal turns, its winner, its names and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq_envs.backgammon import drawing
from neuralq_envs.backgammon.gnubg_id import read_id, write_id
from neuralq_envs.backgammon.inputs import NUM_INPUTS, tesauro_dense
from neuralq_envs.backgammon.rules import BAR, MAX_AFTERSTATES, NUM_CHECKERS, START, Board, afterstates, result

__all__ = ["Position", "check_dice"]

_POINTS = 24


@dataclass(frozen=True, slots=True)
class Position:
    """The checkers of both sides and who is to move; it cannot be changed, and it can be a key of a dict.

    Both sides obey the same rules, each counting from its own end of the board, so a position is what the side to
    move sees. Two are equal if it sees the same, whichever of the players 0 and 1 it is: as with GNU Backgammon's
    IDs, ``Position.from_gnubg_id(p.gnubg_id) == p``. ``turn`` only remembers the player, for `winner` and drawings.

    Args:
        own: how many checkers the side to move has on its points 1 to 24 and its bar, 25 bytes.
        other: those of the other side, counted from its own end: its point i is the other's point 25 − i.
        turn: the player to move, 0 or 1.

    Raises:
        ValueError: rows that are not 25 counts with at most 15 checkers, a point held by both sides, two winners, or
            another player.

    Example:
        >>> start = Position.initial()
        >>> after = Position.from_gnubg_id("sGfwATDgc/ABMA", turn=1)  # 8/5 6/5 has been played
        >>> after in start.afterstates((3, 1)), start.turn, start.afterstates((3, 1))[0].turn
        (True, 0, 1)
    """

    own: bytes
    other: bytes
    turn: int = field(default=0, compare=False)

    def __post_init__(self) -> None:
        for row in (self.own, self.other):
            if len(row) != 25 or sum(row) > NUM_CHECKERS:
                raise ValueError(
                    f"a side has at most {NUM_CHECKERS} checkers on 24 points and its bar, 25 numbers, got {list(row)}"
                )
        for point, (n, facing) in enumerate(zip(self.own[:_POINTS], self.other[_POINTS - 1 :: -1], strict=True)):
            if n and facing:
                raise ValueError(f"a point belongs to one side, got checkers of both on point {point + 1}")
        if not any(self.own) and not any(self.other):
            raise ValueError("one side at most has borne off all its checkers, got two boards without any")
        if self.turn not in (0, 1):
            raise ValueError(f"turn must be 0 or 1, the player to move, got {self.turn!r}")

    @classmethod
    def initial(cls, turn: int = 0) -> Position:
        """The position in which every game begins.

        Example:
            >>> Position.initial().gnubg_id
            '4HPwATDgc/ABMA'
        """
        return cls.from_board(START, turn)

    @classmethod
    def from_gnubg_id(cls, text: str, turn: int = 0) -> Position:
        """The position with GNU Backgammon's position ID ``text``, 14 characters.

        Raises:
            ValueError: no position ID, or one of a board that is no position.

        Example:
            >>> Position.from_gnubg_id("4HPwATDgc/ABMA") == Position.initial()
            True
        """
        own, other = read_id(text)
        return cls(bytes(own), bytes(other), turn)

    @classmethod
    def from_board(cls, board: ArrayLike, turn: int = 0) -> Position:
        """The position with these checkers, ``[2, 25]``: row 0 is ``own``, row 1 ``other``.

        Raises:
            ValueError: another shape, numbers that are no counts, or a board that is no position.

        Example:
            >>> Position.from_board(Position.initial().board).turn
            0
        """
        rows = np.asarray(board)
        if rows.shape != (2, 25) or rows.dtype.kind not in "iu" or not ((rows >= 0) & (rows <= NUM_CHECKERS)).all():
            raise ValueError(f"a board must be whole numbers of 0 to {NUM_CHECKERS}, [2, 25], got {rows.tolist()}")
        own, other = (bytes(row.tolist()) for row in rows)
        return cls(own, other, turn)

    @property
    def board(self) -> Board:
        """A new int8 array ``[2, 25]``: the side to move, then the other side."""
        return np.frombuffer(self.own + self.other, dtype=np.int8).reshape(2, 25).copy()

    @property
    def off(self) -> tuple[int, int]:
        """How many checkers the side to move and the other side have borne off."""
        return NUM_CHECKERS - sum(self.own), NUM_CHECKERS - sum(self.other)

    @property
    def pips(self) -> tuple[int, int]:
        """What the dice must add up to for the side to move and for the other side to bear off, if nobody is hit.

        Example:
            >>> Position.initial().pips
            (167, 167)
        """
        own, other = (sum((i + 1) * n for i, n in enumerate(row)) for row in (self.own, self.other))
        return own, other

    @property
    def gnubg_id(self) -> str:
        """GNU Backgammon's position ID, 14 characters."""
        return write_id(self.own, self.other)

    @property
    def winner(self) -> int | None:
        """The player, 0 or 1, that has borne off all its checkers; None while the game goes on.

        Example:
            >>> last = Position.from_board([[1] + 24 * [0], [2] + 24 * [0]], turn=1)
            >>> last.winner, [(after.winner, after.points) for after in last.afterstates((3, 1))]
            (None, [(1, 1)])
        """
        won = result(self.board)
        return None if won == 0 else self.turn if won > 0 else 1 - self.turn

    @property
    def points(self) -> int:
        """What the winner gets: 1, for a gammon 2, for a backgammon 3; 0 while the game goes on."""
        return abs(result(self.board))

    def afterstates(self, dice: Sequence[int]) -> list[Position]:
        """Every position in which a turn with these dice can end, each once; the other side is to move in them.

        Where no checker can move there is one: the same board with the other side to move.

        Raises:
            ValueError: dice that are not two numbers of 1 to 6, or a game that is over.

        Example:
            >>> len(Position.initial().afterstates((3, 1)))
            16
        """
        die_1, die_2 = check_dice(dice)
        if not any(self.own) or not any(self.other):
            raise ValueError(f"the game is over, player {self.winner} has won; start from Position.initial()")
        out = np.empty((MAX_AFTERSTATES, 2, 25), dtype=np.int8)
        count = afterstates(self.board, die_1, die_2, out)
        rows = out[:count].tobytes()
        return [Position(rows[i : i + 25], rows[i + 25 : i + 50], 1 - self.turn) for i in range(0, 50 * count, 50)]

    def passed(self) -> Position:
        """The same board with the other side to move.

        Example:
            >>> Position.from_gnubg_id("sGfwATDgc/ABMA").passed().gnubg_id
            '4HPwATCwZ/ABMA'
        """
        return Position(self.other, self.own, 1 - self.turn)

    def mirrored(self) -> Position:
        """The position with the players exchanged: equal, for the side to move sees the same, but ``turn`` changes.

        Example:
            >>> start = Position.initial()
            >>> start.mirrored() == start, start.mirrored().turn
            (True, 1)
        """
        return Position(self.own, self.other, 1 - self.turn)

    def inputs(self) -> NDArray[np.float32]:
        """Tesauro's inputs (`neuralq_envs.backgammon.inputs`), float32 ``[198]``.

        Example:
            >>> Position.initial(turn=1).inputs()[196:].tolist()
            [0.0, 1.0]
        """
        x = np.empty(NUM_INPUTS, dtype=np.float32)
        tesauro_dense(self.board, self.turn, x)
        return x

    def text(self, seat: int = 0, dice: Sequence[int] | None = None) -> str:
        """The board in letters, as player ``seat`` sees it (`drawing.text`)."""
        return drawing.text(*self._seen_from(seat), self.turn == seat, seat, None if dice is None else check_dice(dice))

    def svg(self, seat: int = 0, dice: Sequence[int] | None = None) -> str:
        """The board as an SVG picture, as player ``seat`` sees it (`drawing.svg`)."""
        return drawing.svg(*self._seen_from(seat), self.turn == seat, seat, None if dice is None else check_dice(dice))

    def __str__(self) -> str:
        return self.text()

    def __repr__(self) -> str:
        return f"Position.from_gnubg_id({self.gnubg_id!r}, turn={self.turn})"

    def _seen_from(self, seat: int) -> tuple[bytes, bytes]:
        if seat not in (0, 1):
            raise ValueError(f"seat must be 0 or 1, one of the players, got {seat!r}")
        return (self.own, self.other) if self.turn == seat else (self.other, self.own)


def check_dice(dice: Sequence[int]) -> tuple[int, int]:
    """``dice`` are two whole numbers of 1 to 6, which are returned.

    Raises:
        ValueError: otherwise.

    Example:
        >>> check_dice((3, 1))
        (3, 1)
    """
    if len(dice) != 2 or any(die not in (1, 2, 3, 4, 5, 6) for die in dice):
        raise ValueError(f"dice must be two numbers of 1 to 6, got {dice!r}")
    return int(dice[0]), int(dice[1])


assert BAR == _POINTS  # the bar is what comes after the last point, here and in the IDs

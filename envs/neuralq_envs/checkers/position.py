"""One position of checkers: its legal moves, its names and its picture in letters."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass

import numpy as np

from neuralq_envs.checkers.rules import LAST_ROW, MAX_MOVES, SQUARES, START, moves, shifted, turned

__all__ = ["COLOURS", "MOST_QUIET_PLIES", "NUM_PIECES", "Move", "Position", "bit_of", "square_of"]

NUM_PIECES = 12
MOST_QUIET_PLIES = 60
"""A game in which nothing was captured and no man moved for so many plies is a draw."""
COLOURS = ("black", "white")
"""Black begins, from squares 1 to 12."""

_SIGNS = {(0, False): "b", (0, True): "B", (1, False): "w", (1, True): "W"}
_FEN = re.compile(r"([BW]):([BW])([^:]*):([BW])([^:]*)")


def bit_of(square: int, turn: int) -> int:
    """The bit of a square 1 to 32 as the side ``turn`` sees it.

    Example:
        >>> bit_of(1, 0), bit_of(9, 0) == 1 << 9, bit_of(32, 1)
        (1, True, 1)
    """
    i = square - 1 if turn == 0 else 32 - square
    return 1 << i + i // 8


def square_of(bit: int, turn: int) -> int:
    """The square 1 to 32 of a bit as the side ``turn`` sees it.

    Example:
        >>> [square_of(bit_of(square, turn), turn) for square in (1, 20, 32) for turn in (0, 1)]
        [1, 1, 20, 20, 32, 32]
    """
    b = bit.bit_length() - 1
    i = b - b // 9
    return i + 1 if turn == 0 else 32 - i


@dataclass(frozen=True, slots=True)
class Move:
    """A legal move.

    Args:
        squares: 1 to 32, where the piece stands, and where it lands after each step or jump.
        taken: the squares of what it captures, in order.
        directions: of each step or jump, as the side that moves sees it: 0 up to the right, 1 up to the left, 2 down
            to the left, 3 down to the right.
        position: what it leaves, the other side to move.
    """

    squares: tuple[int, ...]
    taken: tuple[int, ...]
    directions: tuple[int, ...]
    position: Position

    def __str__(self) -> str:
        """As players write it: ``11-15``, or ``15x22x29`` for captures."""
        return ("x" if self.taken else "-").join(map(str, self.squares))


@dataclass(frozen=True, slots=True)
class Position:
    """The pieces of both sides and who is to move; it cannot be changed, and it can be a key of a dict.

    Args:
        own: pieces of the side to move, as bits of `neuralq_envs.checkers.rules`, seen by that side.
        other: pieces of the other side.
        kings: which of both are kings.
        turn: the side to move, 0 for black, which begins, or 1 for white.

    Raises:
        ValueError: bits that are no squares, a square that both sides hold, more than 12 pieces of a side, kings that
            are no pieces, a man on the row where it would be a king, or another side.

    Example:
        >>> start = Position.initial()
        >>> [str(move) for move in start.moves()]
        ['9-13', '10-14', '11-15', '12-16', '9-14', '10-15', '11-16']
        >>> print(start.moves()[2].position)
        . b . b . b . b
        b . b . b . b .
        . b . b . . . b
        . . . . b . . .
        . . . . . . . .
        w . w . w . w .
        . w . w . w . w
        w . w . w . w .
        white to move
    """

    own: int
    other: int
    kings: int
    turn: int = 0

    def __post_init__(self) -> None:
        if self.turn not in (0, 1):
            raise ValueError(f"turn must be 0 (black) or 1 (white), the side to move, got {self.turn!r}")
        sides = {COLOURS[self.turn]: self.own, COLOURS[1 - self.turn]: self.other}
        for colour, pieces in sides.items():
            if not 0 <= pieces <= SQUARES or pieces & ~SQUARES:
                raise ValueError(f"{colour} has bits that are no squares: {pieces & ~SQUARES:b} of {pieces:b}")
            if pieces.bit_count() > NUM_PIECES:
                raise ValueError(f"a side has at most {NUM_PIECES} pieces, got {pieces.bit_count()} of {colour}")
        if self.own & self.other:
            squares = ", ".join(str(square_of(bit, self.turn)) for bit in _bits(self.own & self.other))
            raise ValueError(f"a square belongs to one side, got pieces of both on {squares}")
        if self.kings & ~(self.own | self.other):
            raise ValueError("kings must be pieces of a side, got a king where no piece is")
        uncrowned = (self.own & LAST_ROW | self.other & turned(LAST_ROW)) & ~self.kings
        if uncrowned:
            raise ValueError(
                f"a man on its last row is a king: write K{square_of(uncrowned & -uncrowned, self.turn)} "
                f"instead of {square_of(uncrowned & -uncrowned, self.turn)}"
            )

    @classmethod
    def initial(cls) -> Position:
        """The position in which every game begins, with black to move.

        Example:
            >>> Position.initial().fen
            'B:W21,22,23,24,25,26,27,28,29,30,31,32:B1,2,3,4,5,6,7,8,9,10,11,12'
        """
        return cls(*START)

    @classmethod
    def from_fen(cls, text: str) -> Position:
        """The position that a line of portable draughts notation describes.

        Args:
            text: the side to move, then the squares of each side, a K before those of kings: ``W:W21,K5:B1,2``.

        Raises:
            ValueError: no such line, or one of a board that is no position.

        Example:
            >>> Position.from_fen("W:W21,K5:B1,2").turn
            1
            >>> Position.from_fen("B:W32:B" + ",".join(map(str, range(1, 14))))
            Traceback (most recent call last):
            ValueError: a side has at most 12 pieces, got 13 of black
        """
        found = _FEN.fullmatch(text.strip().rstrip(".").replace(" ", "").upper())
        if found is None or {found[2], found[4]} != {"B", "W"}:
            shown = text if len(text) <= 60 else text[:57] + "..."
            raise ValueError(f"a position must be written like 'B:W21,22,K30:B1,2,K15', got {shown!r}")
        turn = "BW".index(found[1])
        pieces, kings = [0, 0], 0
        for colour, squares in ((found[2], found[3]), (found[4], found[5])):
            for written in filter(None, squares.split(",")):
                square = written.removeprefix("K")
                if not (square.isascii() and square.isdecimal()) or not 1 <= int(square) <= 32:
                    raise ValueError(f"squares are 1 to 32, with a K before them for a king, got {written[:20]!r}")
                bit = bit_of(int(square), turn)
                if pieces["BW".index(colour)] & bit:
                    raise ValueError(f"a square holds one piece, got {square} twice for {COLOURS['BW'.index(colour)]}")
                pieces["BW".index(colour)] |= bit
                kings |= bit if written.startswith("K") else 0
        return cls(pieces[turn], pieces[1 - turn], kings, turn)

    @property
    def fen(self) -> str:
        """The line of portable draughts notation that `from_fen` reads."""
        rows = []
        for side in (1, 0):
            held = [n for n, (colour, _) in sorted(self.pieces().items()) if colour == side]
            rows.append("BW"[side] + ",".join(f"{'K' * self.pieces()[n][1]}{n}" for n in held))
        return f"{'BW'[self.turn]}:{rows[0]}:{rows[1]}"

    @property
    def winner(self) -> int | None:
        """The side that has won, since the other one cannot move; None while the game goes on.

        Example:
            >>> Position.from_fen("W:W:B1").winner, Position.initial().winner
            (0, None)
        """
        return None if len(_moves(self.own, self.other, self.kings)) else 1 - self.turn

    def pieces(self) -> dict[int, tuple[int, bool]]:
        """What stands on each square 1 to 32 that is not empty: its side, and whether it is a king."""
        sides = ((self.own, self.turn), (self.other, 1 - self.turn))
        return {
            square_of(bit, self.turn): (side, bool(self.kings & bit)) for pieces, side in sides for bit in _bits(pieces)
        }

    def moves(self) -> list[Move]:
        """Every legal move; none if the side to move has lost.

        Example:
            >>> [str(move) for move in Position.from_fen("B:W9,10,18,19:B5,6").moves()]
            ['5x14x23', '6x13', '6x15x22', '6x15x24']
        """
        found = []
        for own, other, kings, source, path in _moves(self.own, self.other, self.kings).tolist():
            squares, taken, at = [square_of(source, self.turn)], [], source
            directions = tuple(path >> 2 * i & 3 for i in range((path.bit_length() - 1) // 2 - 1, -1, -1))
            for direction in directions:
                at = int(shifted(at, direction))
                if self.other & at:
                    taken.append(square_of(at, self.turn))
                    at = int(shifted(at, direction))
                squares.append(square_of(at, self.turn))
            after = Position(own, other, kings, 1 - self.turn)
            found.append(Move(tuple(squares), tuple(taken), directions, after))
        return found

    def __str__(self) -> str:
        """Eight lines from square 1 on: ``b`` and ``w`` are men, ``B`` and ``W`` kings; and who is to move."""
        held = self.pieces()
        rows = []
        for row in range(8):
            signs = ["."] * 8
            for i in range(4):
                square = 4 * row + i + 1
                if square in held:
                    signs[2 * i + 1 - row % 2] = _SIGNS[held[square]]
            rows.append(" ".join(signs))
        return "\n".join([*rows, f"{COLOURS[self.turn]} to move"])


@functools.lru_cache(maxsize=4096)
def _moves(own: int, other: int, kings: int) -> np.ndarray:
    out = np.empty((MAX_MOVES, 5), np.int64)
    return out[: moves(own, other, kings, out)].copy()


def _bits(pieces: int) -> list[int]:
    return [1 << bit for bit in range(pieces.bit_length()) if pieces >> bit & 1]

"""The board as a picture of pixels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from neuralq_envs.canvas import CELL, GREY, INK, PAPER, blank, disk, frame, write

__all__ = ["pixels"]

_DARK = (150, 120, 95)
_COLOURS = (INK, PAPER)
_LETTERS = (PAPER, INK)


def pixels(pieces: Mapping[int, tuple[int, bool]], marked: int | None = None) -> NDArray[np.uint8]:
    """Uint8 ``[384, 384, 3]`` with square 1 at the top: black pieces dark, white ones light, a K on kings.

    Args:
        pieces: side and whether a king, by square 1 to 32.
        marked: a square that is framed.

    Example:
        >>> pixels({1: (0, False), 32: (1, True)}).shape
        (384, 384, 3)
    """
    picture = blank(8 * CELL, 8 * CELL)
    middle = CELL / 2 - 0.5
    for square in range(1, 33):
        row, i = divmod(square - 1, 4)
        column = 2 * i + 1 - row % 2
        field = picture[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]  # a view
        field[:] = _DARK
        if square in pieces:
            side, is_king = pieces[square]
            disk(field, (middle, middle), 0.42 * CELL, GREY)
            disk(field, (middle, middle), 0.42 * CELL - 2, _COLOURS[side])
            if is_king:
                write(field, "K", (middle, middle), _LETTERS[side])
        if square == marked:
            frame(field, GREY, 3)
    frame(picture)
    return picture

"""Small pictures made of arrays: frames, disks, strokes and an alphabet of 3 x 5 dots; drawing needs no library."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "BLUE",
    "CELL",
    "GREEN",
    "GREY",
    "INK",
    "PAPER",
    "RED",
    "Colour",
    "blank",
    "disk",
    "frame",
    "stroke",
    "write",
]

Colour = tuple[int, int, int]
CELL = 48  # pixels: the side of a grid's cell
PAPER: Colour = (255, 255, 255)
INK: Colour = (70, 70, 70)
GREY: Colour = (215, 215, 215)
GREEN: Colour = (170, 215, 170)
RED: Colour = (235, 170, 160)
BLUE: Colour = (40, 90, 190)

# Five rows of three bits each, one octal digit per row.
_GLYPHS = {
    **dict(zip("0123456789", "75557 26227 71747 71717 55711 74717 74757 71122 75757 75717".split(), strict=True)),
    **dict(zip("ABCDEFG", "25755 65656 34443 65556 74647 74644 34553".split(), strict=True)),
    **dict(zip("HIJKLMN", "55755 72227 11152 55655 44447 57755 65555".split(), strict=True)),
    **dict(zip("OPQRSTU", "25552 65644 25563 65655 34216 72222 55557".split(), strict=True)),
    **dict(zip("VWXYZ-+. ", "55552 55775 55255 55222 71247 00700 02720 00002 00000".split(), strict=True)),
}


def blank(height: int, width: int) -> NDArray[np.uint8]:
    """A white picture, uint8 ``[height, width, 3]``.

    Example:
        >>> blank(2, 3).shape
        (2, 3, 3)
    """
    return np.full((height, width, 3), PAPER, dtype=np.uint8)


def frame(square: NDArray[np.uint8], colour: Colour = INK, width: int = 1) -> None:
    """Draws the border of a picture, or of a part of one, in place.

    Example:
        >>> picture = blank(3, 3)
        >>> frame(picture, (0, 0, 0))
        >>> int((picture == 0).all(axis=2).sum())
        8
    """
    square[:width], square[-width:] = colour, colour
    square[:, :width], square[:, -width:] = colour, colour


def disk(picture: NDArray[np.uint8], centre: tuple[float, float], radius: float, colour: Colour) -> None:
    """Fills a disk in place; ``centre`` is (row, column) in pixels.

    Example:
        >>> picture = blank(5, 5)
        >>> disk(picture, (2, 2), 1.1, (0, 0, 0))
        >>> int((picture == 0).all(axis=2).sum())
        5
    """
    (top, bottom), (left, right) = ((max(int(c - radius), 0), int(c + radius) + 2) for c in centre)
    around = picture[top:bottom, left:right]  # a view
    down, across = np.ogrid[: around.shape[0], : around.shape[1]]
    around[(down + top - centre[0]) ** 2 + (across + left - centre[1]) ** 2 < radius**2] = colour


def stroke(picture: NDArray[np.uint8], points: NDArray[np.float64], colour: Colour = INK, width: float = 2) -> None:
    """Draws a line through ``points`` (row, column), ``[N, 2]``, in place.

    Example:
        >>> picture = blank(3, 5)
        >>> stroke(picture, np.array([[1.0, 0.0], [1.0, 4.0]]), (0, 0, 0), width=1)
        >>> int((picture == 0).all(axis=2).sum())
        5
    """
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    along = np.linspace(0, lengths[-1], int(2 * lengths[-1]) + 2)
    for row, column in np.stack([np.interp(along, lengths, points[:, i]) for i in (0, 1)], axis=1):
        top, left = round(row - (width - 1) / 2), round(column - (width - 1) / 2)
        picture[max(top, 0) : top + round(width), max(left, 0) : left + round(width)] = colour


def write(
    picture: NDArray[np.uint8], text: str, centre: tuple[float, float], colour: Colour = INK, scale: int = 3
) -> None:
    r"""Writes capitals, digits and signs in place, centred at (row, column).

    Args:
        picture: uint8 ``[H, W, 3]``.
        text: of the signs A-Z, 0-9, ``-``, ``+``, ``.`` and space; it must fit into the picture.
        centre: (row, column) in pixels.
        colour: of the ink.
        scale: pixels per dot of a letter, which is 3 dots wide and 5 high.

    Raises:
        ValueError: a sign that the alphabet does not have.

    Example:
        >>> picture = blank(5, 7)
        >>> write(picture, "HI", (2, 3), (0, 0, 0), scale=1)
        >>> print("\n".join("".join(".#"[int(not dot)] for dot in row) for row in picture[..., 0]))
        #.#.###
        #.#..#.
        ###..#.
        #.#..#.
        #.#.###
    """
    unknown = [sign for sign in text if sign not in _GLYPHS]
    if unknown:
        raise ValueError(f"the alphabet has no {unknown[0]!r}; it has {''.join(_GLYPHS)!r}")
    dots = np.zeros((5, max(4 * len(text) - 1, 0)), dtype=bool)
    for i, sign in enumerate(text):
        for row, digit in enumerate(_GLYPHS[sign]):
            dots[row, 4 * i : 4 * i + 3] = [int(digit) >> 2 & 1, int(digit) >> 1 & 1, int(digit) & 1]
    stencil = np.kron(dots, np.ones((scale, scale), dtype=bool))
    top, left = (round(c - (size - 1) / 2) for c, size in zip(centre, stencil.shape, strict=True))
    picture[top : top + stencil.shape[0], left : left + stencil.shape[1]][stencil] = colour

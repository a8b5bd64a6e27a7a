"""A grid from above as an SVG element: cells in the colour of what they look like, with what is done there as arrows.

Cells that look like no other are white. Lines and letters outside the cells take the colour of the page (``--ink``), so
that the picture is light or dark as the page is.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from neuralq_envs.grids import Grid

__all__ = ["maze_svg", "percept_colours"]

_CELL = 56
_TURNS = (0, 90, 180, 270)  # of an arrow that points north


def percept_colours(grid: Grid, percepts: NDArray[np.int64]) -> dict[int, str]:
    """A light colour for each percept that more than one free cell has, white for the others.

    Example:
        >>> percept_colours(Grid(".G."), np.array([0, 1, 0]))
        {0: 'hsl(20 75% 80%)', 1: '#ffffff'}
    """
    inside = [s for s, sign in enumerate(grid.signs) if sign not in "#x"]
    numbers, counts = np.unique(percepts[inside], return_counts=True)
    shared = numbers[counts > 1].tolist()
    turn = 360 / max(len(shared), 1)
    return {
        o: f"hsl({(20 + turn * shared.index(o)) % 360:.0f} 75% 80%)" if o in shared else "#ffffff"
        for o in numbers.tolist()
    }


def maze_svg(
    grid: Grid, percepts: NDArray[np.int64], actions: Sequence[Sequence[int]], said: str, max_width: str = "32rem"
) -> str:
    """The grid with the number of each cell's percept, and arrows.

    Args:
        grid: the grid.
        percepts: of every cell, ``[S]``.
        actions: of every cell, what is done there (0 north, 1 east, 2 south, 3 west); nothing for none.
        said: for those who cannot see it.
        max_width: of the element.

    Example:
        >>> svg = maze_svg(Grid(".#G"), np.array([0, 0, 1]), [[1], [], []], "a maze")
        >>> svg.count("<rect"), svg.count("<path")
        (3, 1)
    """
    colours, columns = percept_colours(grid, percepts), grid.num_columns
    width, height = columns * _CELL, grid.num_rows * _CELL
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-2 -2 {width + 4} {height + 4}" role="img" '
        f'style="display:block;width:100%;max-width:{max_width}" font-family="sans-serif" '
        f'aria-label="{escape(said, quote=True)}">'
    ]
    for s, sign in enumerate(grid.signs):
        x, y = s % columns * _CELL, s // columns * _CELL
        fill = "#5b6068" if sign in "#x" else colours[int(percepts[s])]
        parts.append(f'<rect x="{x}" y="{y}" width="{_CELL}" height="{_CELL}" fill="{fill}" stroke="#5b6068"/>')
        if sign in "GT":
            parts.append(_text(x + _CELL / 2, y + 37, 24, sign, "middle"))
        elif sign not in "#x":
            parts.append(_text(x + 5, y + 15, 12, str(percepts[s]), "start"))
        for a in actions[s]:
            place = f"translate({x + _CELL / 2:g} {y + _CELL / 2 + 3:g}) rotate({_TURNS[a]})"
            parts.append(f'<path transform="{place}" d="M-2 14V-4H-7L0 -15L7 -4H2V14z" fill="#1b1f24"/>')
    return "\n".join([*parts, "</svg>"])


def _text(x: float, y: float, size: int, text: str, anchor: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" font-size="{size}" fill="#1b1f24" text-anchor="{anchor}">{escape(text)}</text>'

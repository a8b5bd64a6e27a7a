"""Values and policies of grid worlds as drawings."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.runs.report.claims import Arrow, GridDrawing, Square

__all__ = ["best_actions", "policy_grid", "q_grid", "short"]

_WALLS = "#x"


def short(value: float) -> str:
    """A value in as few characters as it needs, at most three decimals.

    Example:
        >>> short(72.9), short(100.0), short(2 / 3)
        ('72.9', '100', '0.667')
    """
    return f"{value:.3f}".rstrip("0").rstrip(".") if abs(value) < 1e5 else f"{value:.3g}"


def best_actions(q: ArrayLike, tol: float = 1e-9) -> NDArray[np.bool_]:
    """Every action that is the best of its state but for rounding, ``[S, A]``; NaN marks illegal ones.

    Args:
        q: values ``[S, A]``.
        tol: how far below the best an action may be, as a share of the largest |q|: ties do not depend on the unit.

    Example:
        >>> best_actions([[1.0, 1.0, np.nan]]).tolist()
        [[True, True, False]]
    """
    values = np.asarray(q, dtype=np.float64)
    legal = np.isfinite(values)
    values = np.where(legal, values, -np.inf)
    slack = tol * float(np.abs(values[legal]).max(initial=0.0))
    return np.asarray((values >= values.max(axis=1, keepdims=True) - slack) & legal)


def policy_grid(title: str, signs: str, num_columns: int, v: ArrayLike, actions: NDArray[np.bool_]) -> GridDrawing:
    """A map with the value of every cell and an arrow for every action given; goals and traps keep their sign.

    Args:
        title: of the drawing.
        signs: one sign per cell, row by row; ``#`` is a wall.
        num_columns: width.
        v: value of every cell, ``[S]``.
        actions: which arrows to draw, ``[S, A]``; the first four are north, east, south, west.

    Example:
        >>> policy_grid("", ".G", 2, [1.0, 0.0], np.array([[0, 1, 0, 0], [0, 0, 0, 0]], dtype=bool)).cells[1].label
        'G'
    """
    cells = []
    for sign, value, chosen in zip(signs, np.asarray(v, dtype=np.float64), actions, strict=True):
        if sign in _WALLS:
            cells.append(Square(wall=True))
        elif chosen.any():
            cells.append(Square(short(float(value)), tuple(Arrow(int(a)) for a in np.flatnonzero(chosen[:4]))))
        else:
            cells.append(Square(sign if sign.isalpha() else short(float(value))))
    return GridDrawing(title, num_columns, tuple(cells))


def q_grid(title: str, signs: str, num_columns: int, q: ArrayLike) -> GridDrawing:
    """A map with the value of every action beside its arrow, the best ones marked.

    Example:
        >>> q_grid("", ".G", 2, [[np.nan, 1.0, np.nan, np.nan], [np.nan] * 4]).cells[0].arrows[0].text
        '1'
    """
    values = np.asarray(q, dtype=np.float64)
    best = best_actions(values) & (values != 0)  # a table of zeros has no best action yet
    cells = []
    for s, sign in enumerate(signs):
        legal = np.flatnonzero(np.isfinite(values[s, :4]))
        arrows = tuple(Arrow(int(a), short(float(values[s, a])), bool(best[s, a])) for a in legal)
        cells.append(Square(sign if sign.isalpha() else "", arrows, sign in _WALLS))
    return GridDrawing(title, num_columns, tuple(cells))

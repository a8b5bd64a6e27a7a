"""What a page of the chapter found: numbers beside the printed ones, drawings and a short explanation.

A page is a function without required arguments that returns a `ChapterPage`. It prints nothing;
`neuralq.apps.pages.text` and `neuralq.apps.pages.svg` show it, and tests read its numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from neuralq.types import Array

__all__ = [
    "Arrow",
    "ChapterPage",
    "Chart",
    "Drawing",
    "GridDrawing",
    "Row",
    "Series",
    "Square",
    "claim",
    "misprint",
    "number",
    "own",
    "spread",
]

AGREES, DIFFERS, MISPRINT, OURS = "agrees", "differs", "misprint", "ours"


@dataclass(frozen=True)
class Row:
    """One quantity: what was printed and what we computed.

    Args:
        what: its name.
        book: what was printed, or what a theorem demands; empty where there is nothing to compare with.
        ours: what was computed.
        verdict: ``"agrees"``, ``"differs"``, ``"misprint"`` (ours is right, as the note explains) or ``"ours"``.
        note: one line for the reader.
    """

    what: str
    book: float | str
    ours: float | str
    verdict: str
    note: str = ""


@dataclass(frozen=True)
class Arrow:
    """A move out of a cell: 0 north, 1 east, 2 south, 3 west, its value as text or nothing, and if it is best."""

    direction: int
    text: str = ""
    best: bool = True


@dataclass(frozen=True)
class Square:
    """One cell of a drawn grid: its label, its moves, and whether it is a wall."""

    label: str = ""
    arrows: tuple[Arrow, ...] = ()
    wall: bool = False


@dataclass(frozen=True)
class GridDrawing:
    """A grid with arrows and values; ``cells`` row by row from the top left."""

    title: str
    num_columns: int
    cells: tuple[Square, ...]


@dataclass(frozen=True)
class Series:
    """A curve, with the interval over seeds where there is one; kept as tuples of numbers."""

    name: str
    x: Sequence[float] | Array
    y: Sequence[float] | Array
    low: Sequence[float] | Array = ()
    high: Sequence[float] | Array = ()

    def __post_init__(self) -> None:
        for name in ("x", "y", "low", "high"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))


@dataclass(frozen=True)
class Chart:
    """Curves over one axis; both axes linear unless ``log_y``."""

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    log_y: bool = False

    def height_of(self, y: float) -> float:
        """Where a value stands along the upward axis."""
        return math.log10(max(y, 1e-12)) if self.log_y else y


Drawing = GridDrawing | Chart


@dataclass(frozen=True)
class ChapterPage:
    """The result of one page.

    Args:
        page: its name on the command line.
        title: what it shows.
        section: where in Mitchell 1997.
        text: the explanation, one paragraph per entry.
        rows: numbers, printed and computed.
        drawings: grids and charts.
    """

    page: str
    title: str
    section: str
    text: tuple[str, ...]
    rows: tuple[Row, ...]
    drawings: tuple[Drawing, ...] = ()

    @property
    def reproduced(self) -> bool:
        """Whether nothing differs from what was printed, known misprints aside."""
        return all(row.verdict != DIFFERS for row in self.rows)

    def plain(self) -> dict[str, Any]:
        """Everything but the drawings, ready for JSON."""
        return {
            "page": self.page,
            "title": self.title,
            "section": self.section,
            "reproduced": self.reproduced,
            "rows": [asdict(row) for row in self.rows],
        }


def number(what: str, book: float, ours: float, tol: float = 1e-9, note: str = "") -> Row:
    """A printed number agrees with ours when they differ by at most ``tol``.

    Example:
        >>> number("V*", 90.0, 89.0).verdict
        'differs'
    """
    agrees = math.isfinite(ours) and abs(ours - book) <= tol
    return Row(what, float(book), float(ours), AGREES if agrees else DIFFERS, note)


def claim(what: str, book: str, ours: float | str, holds: bool, note: str = "") -> Row:
    """A statement, of the book or of a theorem, agrees when it holds for what was computed.

    Example:
        >>> claim("largest factor", "at most 0.9", 0.81, holds=0.81 <= 0.9).verdict
        'agrees'
    """
    return Row(what, book, ours, AGREES if holds else DIFFERS, note)


def misprint(what: str, book: float | str, right: float, ours: float, note: str, tol: float = 1e-9) -> Row:
    """A printed value known to be wrong: ours must equal the right one, and must not equal the printed one.

    Example:
        >>> misprint("Q", 72.0, 72.9, 72.9, "digits lost").verdict
        'misprint'
    """
    sound = abs(ours - right) <= tol and (isinstance(book, str) or abs(ours - book) > tol)
    return Row(what, book, float(ours), MISPRINT if sound else DIFFERS, note)


def own(what: str, ours: float | str, note: str = "") -> Row:
    """A number of ours that has no printed counterpart.

    Example:
        >>> own("updates", 12).verdict
        'ours'
    """
    return Row(what, "", ours, OURS, note)


def spread(values: ArrayLike) -> str:
    """Median over seeds and the interval that holds 95% of them, as text.

    Example:
        >>> spread([1.0, 2.0, 3.0])
        '2 [1.05, 2.95]'
    """
    low, middle, high = np.quantile(np.asarray(values, dtype=np.float64), [0.025, 0.5, 0.975])
    return f"{middle:.4g} [{low:.4g}, {high:.4g}]"

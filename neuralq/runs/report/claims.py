"""What a page of the chapter found: numbers beside the printed ones, drawings and a short explanation.

Whoever finds something returns a `ChapterPage` and prints nothing; `neuralq.apps.pages` shows it as text, as SVG and as
HTML, and tests read its numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from neuralq.runs.sweep.statistics import median_interval
from neuralq.types import Array

__all__ = [
    "Arrow",
    "ChapterPage",
    "Chart",
    "Drawing",
    "GridDrawing",
    "Measured",
    "Picture",
    "Row",
    "Series",
    "Square",
    "claim",
    "misprint",
    "number",
    "own",
    "published",
    "spread",
]

AGREES, DIFFERS, MISPRINT, OURS = "agrees", "differs", "misprint", "ours"
NOT_REPRODUCED = "not reproduced"


@dataclass(frozen=True)
class Row:
    """One quantity: what was printed and what we computed.

    Args:
        what: its name.
        book: what was printed, or what a theorem demands; empty where there is nothing to compare with.
        ours: what was computed.
        verdict: ``"agrees"``, ``"differs"``, ``"misprint"`` (ours is right, as the note explains), ``"ours"``, or
            ``"not reproduced"`` (an experiment that somebody published came out otherwise here).
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


@dataclass(frozen=True)
class Picture:
    """A finished SVG element, with what is to be seen in it; for HTML only.

    Args:
        title: of the picture.
        svg: the element; it may stand in more than that, such as a button that stops it.
        caption: what is to be seen.
    """

    title: str
    svg: str
    caption: str


Drawing = GridDrawing | Chart | Picture


@dataclass(frozen=True)
class Measured:
    """A quantity measured with several seeds.

    Args:
        what: its name and unit.
        values: one for each seed.
        limit: where measuring stopped: a value of that is one of at least that; None where there is no limit.
    """

    what: str
    values: tuple[float, ...]
    limit: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(map(float, self.values)))

    @property
    def median(self) -> float:
        """Of the seeds."""
        return float(np.median(self.values))

    @property
    def interval(self) -> tuple[float, float] | None:
        """What the true median lies in with 95 %; None for fewer than six seeds."""
        return median_interval(self.values)

    def __str__(self) -> str:
        """Median and interval; of few seeds, median and range.

        Example:
            >>> str(Measured("steps", (1, 2, 3, 4, 5, 6, 40), limit=40)), str(Measured("steps", (1, 2, 4)))
            ('4 [1, over 40]', '2 (3 seeds: 1 to 4)')
        """
        low, high = map(self._said, self.interval or (min(self.values), max(self.values)))
        middle = self._said(self.median)
        if low == middle == high:
            return middle
        if self.interval is None:
            return f"{middle} ({len(self.values)} seeds: {low} to {high})"
        return f"{middle} [{low}, {high}]"

    def _said(self, value: float) -> str:
        beyond = self.limit is not None and value >= self.limit
        shown = self.limit if beyond and self.limit is not None else value
        return ("over " if beyond else "") + (f"{shown:,.0f}" if abs(shown) >= 1000 else f"{shown:.4g}")

    def plain(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        low, high = self.interval or (None, None)
        return {
            "what": self.what, "values": list(self.values), "limit": self.limit,
            "median": self.median, "low": low, "high": high,
        }  # fmt: skip


@dataclass(frozen=True)
class ChapterPage:
    """The result of one page.

    Args:
        page: its name on the command line.
        title: what it shows.
        section: where in Mitchell 1997.
        text: the explanation, one paragraph per entry.
        rows: numbers, printed and computed.
        drawings: grids, charts and pictures.
        source: whose experiment it is, if it is not the book's own.
        measured: what was measured with several seeds.
        facts: what it is made of, by name.
    """

    page: str
    title: str
    section: str
    text: tuple[str, ...]
    rows: tuple[Row, ...]
    drawings: tuple[Drawing, ...] = ()
    source: str = ""
    measured: tuple[Measured, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)

    @property
    def reproduced(self) -> bool:
        """Whether nothing differs from what was printed or published, known misprints aside."""
        return all(row.verdict not in (DIFFERS, NOT_REPRODUCED) for row in self.rows)

    @property
    def wrong(self) -> list[str]:
        """What differs although it is exact: something is broken, here or in the book."""
        return [row.what for row in self.rows if row.verdict == DIFFERS]

    @property
    def where(self) -> str:
        """The place in the book, and whose experiment it is."""
        return f"Mitchell 1997, {self.section}" + (f"; {self.source}" if self.source else "")

    def plain(self) -> dict[str, Any]:
        """Everything but the drawings, ready for JSON."""
        return {
            "page": self.page,
            "title": self.title,
            "section": self.section,
            "reproduced": self.reproduced,
            "rows": [asdict(row) for row in self.rows],
            "measured": [one.plain() for one in self.measured],
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


def published(what: str, book: str, ours: float | str, holds: bool, note: str = "") -> Row:
    """What was published of an experiment, beside what ours gave; where it does not hold, that is a result too.

    Example:
        >>> published("median failures", "at most 100", 130.0, holds=False).verdict
        'not reproduced'
    """
    return Row(what, book, ours, AGREES if holds else NOT_REPRODUCED, note)


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

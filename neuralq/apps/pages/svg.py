"""A page's drawings as one SVG file, written as plain text: nothing else is needed to make it.

Letters are text, so a reader's own font is used; every drawing is titled for screen readers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from html import escape

from neuralq.figures import COLOURS
from neuralq.runs.report.claims import Arrow, ChapterPage, Chart, GridDrawing, Picture, Series, Square

__all__ = ["page_svg"]

_INK, _PALE, _GOAL = "#222222", "#999999", "#d7ecd9"
_WIDTH, _MARGIN, _TITLE = 640, 20, 34
_PLOT_HEIGHT, _LEFT, _BOTTOM = 240, 62, 46
_STEPS = ((0, -1), (1, 0), (0, 1), (-1, 0))  # x and y of north, east, south, west


def page_svg(page: ChapterPage) -> str:
    """The grids and charts of a page, one below the other.

    Raises:
        ValueError: the page has none.

    Example:
        >>> from neuralq.runs.report.claims import Square
        >>> page = ChapterPage("p", "a page", "13.2", (), (), (GridDrawing("one cell", 1, (Square("9"),)),))
        >>> page_svg(page).startswith("<svg")
        True
    """
    drawings = [drawing for drawing in page.drawings if not isinstance(drawing, Picture)]
    if not drawings:
        raise ValueError(f"the page {page.page!r} has no grid or chart to draw")
    parts: list[str] = []
    top = float(_MARGIN)
    for drawing in drawings:
        height, lines = _grid(drawing) if isinstance(drawing, GridDrawing) else _chart(drawing)
        heading = _text(_MARGIN, top + 16, drawing.title, size=15, anchor="start", weight="bold")
        parts.append(f'<g role="img"><title>{escape(drawing.title)}</title>{heading}')
        parts.append(f'<g transform="translate(0 {top + _TITLE})">')
        parts += [*lines, "</g></g>"]
        top += _TITLE + height + _MARGIN
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {top:.0f}" width="{_WIDTH}" height="{top:.0f}" '
        f'font-family="sans-serif"><title>{escape(page.title)}</title>'
        '<rect width="100%" height="100%" fill="white"/>'
    )
    return "\n".join([head, *parts, "</svg>\n"])


def _text(
    x: float, y: float, text: str, size: float, anchor: str = "middle", weight: str = "normal", fill: str = _INK
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}" font-weight="{weight}" '
        f'fill="{fill}">{escape(text)}</text>'
    )


def _grid(grid: GridDrawing) -> tuple[float, list[str]]:
    num_rows = math.ceil(len(grid.cells) / grid.num_columns)
    valued = any(arrow.text for cell in grid.cells for arrow in cell.arrows)
    side = min(130.0 if valued else 96.0, (_WIDTH - 2 * _MARGIN) / grid.num_columns)
    lines = []
    for s, cell in enumerate(grid.cells):
        x, y = _MARGIN + s % grid.num_columns * side, s // grid.num_columns * side
        ground = _INK if cell.wall else _GOAL if cell.label.isalpha() and not cell.arrows else "white"
        lines.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{side:.1f}" height="{side:.1f}" fill="{ground}" stroke="{_PALE}"/>'
        )
        lines += _cell(cell, x + side / 2, y + side / 2, side)
    return num_rows * side, lines


def _cell(cell: Square, x: float, y: float, side: float) -> Iterator[str]:
    if cell.label:
        yield _text(x, y + side * 0.06, cell.label, size=max(8.0, side * 0.17), weight="bold")
    for arrow in cell.arrows:
        yield from _arrow(arrow, x, y, side)


def _arrow(arrow: Arrow, x: float, y: float, side: float) -> Iterator[str]:
    """From a quarter of the cell to near its border, the value beside it."""
    dx, dy = _STEPS[arrow.direction]
    start, tip, wing = side * 0.27, side * 0.45, side * 0.06
    x0, y0, x1, y1 = x + dx * start, y + dy * start, x + dx * tip, y + dy * tip
    colour, width = (COLOURS[0], 2.4) if arrow.best else (_PALE, 1.2)
    bx, by = x1 - dx * wing, y1 - dy * wing  # where the head begins
    yield (
        f'<path d="M{x0:.1f} {y0:.1f}L{bx:.1f} {by:.1f}" stroke="{colour}" stroke-width="{width}"/>'
        f'<path d="M{x1:.1f} {y1:.1f}L{bx - dy * wing:.1f} {by - dx * wing:.1f}L{bx + dy * wing:.1f} '
        f'{by + dx * wing:.1f}Z" fill="{colour}"/>'
    )
    if arrow.text:
        size = side * 0.105
        at_x, at_y, anchor = (
            (x + dx * side * 0.36, y - size * 1.15, "middle") if dx else (x + 5, y + dy * side * 0.33, "start")
        )
        weight = "bold" if arrow.best else "normal"
        yield _text(at_x, at_y + size * 0.35, arrow.text, size=size, anchor=anchor, weight=weight)


def _chart(chart: Chart) -> tuple[float, list[str]]:
    """Axes, a band and a line for each curve, and its name in its colour below."""
    shown = [chart.height_of(y) for one in chart.series for part in (one.y, one.low, one.high) for y in part]
    xs = [x for one in chart.series for x in one.x]
    low, high = min(shown), max(shown)
    low, high = (low, high) if high > low else (low - 1, high + 1)
    first, last = min(xs), max(xs) if max(xs) > min(xs) else min(xs) + 1

    def place(x: float, y: float) -> str:
        across = _LEFT + (x - first) / (last - first) * (_WIDTH - _LEFT - _MARGIN)
        return f"{across:.1f} {_PLOT_HEIGHT - (chart.height_of(y) - low) / (high - low) * _PLOT_HEIGHT:.1f}"

    lines = [f'<path d="M{_LEFT} 0V{_PLOT_HEIGHT}H{_WIDTH - _MARGIN}" fill="none" stroke="{_PALE}"/>']
    for level in (low, (low + high) / 2, high):
        y = _PLOT_HEIGHT - (level - low) / (high - low) * _PLOT_HEIGHT
        value = 10**level if chart.log_y else level
        lines.append(_text(_LEFT - 6, y + 4, f"{value:.3g}", size=11, anchor="end"))
    for x in (first, (first + last) / 2, last):
        at = _LEFT + (x - first) / (last - first) * (_WIDTH - _LEFT - _MARGIN)
        lines.append(_text(at, _PLOT_HEIGHT + 16, f"{x:.4g}", size=11))
    lines.append(_text(_WIDTH / 2, _PLOT_HEIGHT + 34, f"{chart.x_label}; upwards: {chart.y_label}", size=12))
    for i, one in enumerate(chart.series):
        lines += _curve(one, COLOURS[i % len(COLOURS)], _PLOT_HEIGHT + _BOTTOM + 8 + 18 * i, place)
    return _PLOT_HEIGHT + _BOTTOM + 18 * len(chart.series), lines


def _curve(one: Series, colour: str, y_name: float, place: Callable[[float, float], str]) -> Iterator[str]:
    if one.low:
        there = [place(x, y) for x, y in zip(one.x, one.high, strict=True)]
        back = [place(x, y) for x, y in zip(one.x, one.low, strict=True)][::-1]
        yield f'<polygon points="{" ".join(there + back)}" fill="{colour}" opacity="0.18"/>'
    points = " ".join(place(x, y) for x, y in zip(one.x, one.y, strict=True))
    yield f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>'
    yield f'<path d="M{_LEFT} {y_name - 4}h24" stroke="{colour}" stroke-width="3"/>'
    yield _text(_LEFT + 32, y_name, one.name, size=12, anchor="start")

"""The map of a grid world: what was learned, and how far it is from the exact answer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from neuralq.figures import at_least, draw_svg
from neuralq.runs.folder.files import as_float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["grid_svg"]

_ARROWS = "↑→↓←"
_MOST_CELLS = 400
_COLUMNS = ("signs", "arrows", "optimal", "learned", "error")
_PIXELS = 46
"""Of a cell, at least: a wide map scrolls where there is less room."""


def grid_svg(drawing: Mapping[str, Any], *, name: str = "grid") -> tuple[str, str] | None:
    """Two maps, values with the greedy action of each cell and errors, and what they show; None without a grid.

    Args:
        drawing: columns of one entry per cell, row by row from the top left: "signs", "arrows" (0 to 3, clockwise from
            up), "optimal" (whether that action is), "learned" values, the "error" (largest |Q − Q*| over the actions)
            and "visited", which may be None; and "num_columns".
        name: prefix of the ids in the SVG.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    width = drawing.get("num_columns")
    columns = [drawing.get(key) for key in _COLUMNS]
    if not isinstance(width, int) or width < 1 or not all(isinstance(column, list) for column in columns):
        return None
    signs, arrows, optimal, learned, wrong = columns
    count = len(signs)  # type: ignore[arg-type]
    known = drawing.get("visited")
    visited = known if isinstance(known, list) else [True] * count
    if not 0 < count <= _MOST_CELLS or count % width or any(len(one) != count for one in (*columns, visited)):  # type: ignore[arg-type]
        return None
    v, error = (np.array([as_float(x) for x in column]).reshape(-1, width) for column in (learned, wrong))  # type: ignore[union-attr]
    height = len(v)

    def paint(figure: Figure) -> None:
        panels = figure.subplots(1, 2) if width <= 6 else figure.subplots(2, 1)
        _paint_map(panels[0], v, "value and greedy action", "cividis", below=0.3)
        _paint_map(panels[1], error, "largest |Q − Q*| of the actions", "Oranges", below=0.0)
        cells = zip(signs, arrows, optimal, visited, v.ravel(), strict=True)  # type: ignore[arg-type]
        for i, (sign, arrow, right_way, seen, value) in enumerate(cells):
            y, x = divmod(i, width)
            if isinstance(arrow, int) and 0 <= arrow < 4 and math.isfinite(value):
                ink = {"color": _ink(value, v), "alpha": 1.0 if seen else 0.5}
                panels[0].text(x, y - 0.14, _ARROWS[arrow], ha="center", va="center", fontsize=14, **ink)
                if not right_way:
                    panels[0].plot(x, y - 0.14, marker="s", ms=15, mfc="none", mec="#d55e00", mew=2)
            elif isinstance(sign, str):
                for axes in panels:
                    axes.text(x, y, sign[:2], ha="center", va="center", color="#888888")

    size = (6.4, 0.5 + 3.0 * height / width) if width <= 6 else (6.4, 1.0 + 2 * 6.2 * height / width)
    worst = f"{np.nanmax(error):.3g}" if np.isfinite(error).any() else "unknown"
    svg = draw_svg(name, "Map of the grid", f"Values and greedy actions, and errors up to {worst}.", size, paint)
    pale = ", pale in states that were never visited" if isinstance(known, list) else ""
    words = (
        f"Arrows are greedy actions{pale}; a frame marks one that is not optimal. On the right, or below, the error of "
        "each state: the largest |Q − Q*| over its actions."
    )
    return at_least(svg, _PIXELS * (2 * width if width <= 6 else width)), words


def _paint_map(axes: Axes, values: Any, title: str, shades: str, below: float) -> None:
    """Cells in colour, as outlines and not as an image, which the page could not load; their numbers, so far below."""
    shown = np.ma.masked_invalid(np.clip(values, -1e150, 1e150))
    height, width = shown.shape
    edges = np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5
    most = float(shown.max()) * 1.5 if shades == "Oranges" and shown.count() and shown.max() > 0 else None
    axes.pcolormesh(*edges, shown, cmap=shades, vmax=most, edgecolors="#888888", linewidth=0.4)
    axes.set(title=title, xticks=[], yticks=[], ylim=(height - 0.5, -0.5), aspect="equal")
    axes.title.set_fontsize(11)
    axes.grid(visible=False)
    for edge in axes.spines.values():
        edge.set_visible(False)
    if width > 12:
        return
    for (y, x), value in np.ndenumerate(shown.filled(np.nan)):
        if math.isfinite(value):
            size = 8
            axes.text(
                x,
                y + below,
                f"{value:.3g}",
                ha="center",
                va="center",
                fontsize=size,
                color="#111111" if shades == "Oranges" else _ink(value, shown.filled(np.nan)),
            )


def _ink(value: float, values: Any) -> str:
    low, high = np.nanmin(values), np.nanmax(values)
    return "#111111" if high > low and (value - low) / (high - low) > 0.55 else "#ffffff"

"""Drawings as lines of text for a terminal: boxes with arrows and values, and curves as bars."""

from __future__ import annotations

import math

from neuralq.runs.report.claims import Chart, GridDrawing, Series, Square

__all__ = ["ARROWS", "drawing_lines", "shown"]

ARROWS = "↑→↓←"
_BARS = "▁▂▃▄▅▆▇█"
_BAR_COLUMNS = 48


def shown(value: float | str) -> str:
    """A number with six significant digits, text as it is.

    Example:
        >>> shown(72.9), shown(1 / 3), shown("all")
        ('72.9', '0.333333', 'all')
    """
    return value if isinstance(value, str) else f"{value:.6g}"


def drawing_lines(drawing: GridDrawing | Chart) -> list[str]:
    r"""A grid as boxes, a chart as one row of bars per curve, under its title.

    Example:
        >>> print("\n".join(drawing_lines(GridDrawing("two cells", 2, (Square("9"), Square("G"))))))
        two cells
        ┌───────┬───────┐
        │   9   │   G   │
        └───────┴───────┘
    """
    if isinstance(drawing, GridDrawing):
        return [drawing.title, *_grid_lines(drawing)]
    return [drawing.title, *_chart_lines(drawing)]


def _grid_lines(grid: GridDrawing) -> list[str]:
    valued = any(arrow.text for cell in grid.cells for arrow in cell.arrows)
    blocks = [_valued_block(cell) if valued else _plain_block(cell) for cell in grid.cells]
    width = max(7, max(len(line) for block in blocks for line in block) + 2)
    rows = [blocks[i : i + grid.num_columns] for i in range(0, len(blocks), grid.num_columns)]
    walls = [cell.wall for cell in grid.cells]

    def rule(left: str, middle: str, right: str) -> str:
        return left + middle.join(["─" * width] * grid.num_columns) + right

    lines = [rule("┌", "┬", "┐")]
    for r, row in enumerate(rows):
        if r:
            lines.append(rule("├", "┼", "┤"))
        for k in range(len(row[0])):
            parts = [
                "█" * width if walls[r * grid.num_columns + c] else block[k].center(width)
                for c, block in enumerate(row)
            ]
            lines.append("│" + "│".join(parts) + "│")
    return [*lines, rule("└", "┴", "┘")]


def _plain_block(cell: Square) -> list[str]:
    arrows = "".join(ARROWS[arrow.direction] for arrow in cell.arrows)
    return [f"{cell.label} {arrows}" if arrows else cell.label]


def _valued_block(cell: Square) -> list[str]:
    """North above, west and east beside the label, south below; a star marks the best."""
    sides = {arrow.direction: f"{ARROWS[arrow.direction]}{arrow.text}{'*' * arrow.best}" for arrow in cell.arrows}
    size = max((len(side) for direction, side in sides.items() if direction % 2), default=0)
    middle = f"{sides.get(3, ''):<{size}} {cell.label or ' '} {sides.get(1, ''):>{size}}"
    return [sides.get(0, ""), middle, sides.get(2, "")]


def _chart_lines(chart: Chart) -> list[str]:
    values = [chart.height_of(y) for one in chart.series for y in one.y if math.isfinite(y)]
    low, high = min(values), max(values)
    width = max(len(one.name) for one in chart.series)
    scale = ", logarithmic" if chart.log_y else ""
    first, last = chart.series[0].x[0], chart.series[0].x[-1]
    lines = [f"{chart.y_label}{scale}, by {chart.x_label} {shown(first)} … {shown(last)}"]
    return lines + [f"{one.name:>{width}} {_bars(one, low, high, chart)}" for one in chart.series]


def _bars(one: Series, low: float, high: float, chart: Chart) -> str:
    count = min(len(one.y), _BAR_COLUMNS)
    picked = [one.y[round(i * (len(one.y) - 1) / max(count - 1, 1))] for i in range(count)]
    top, span = len(_BARS) - 1, (high - low) or 1.0
    bars = "".join(_BARS[min(top, max(0, round((chart.height_of(y) - low) / span * top)))] for y in picked)
    return f"{bars}  {shown(one.y[0])} → {shown(one.y[-1])}"

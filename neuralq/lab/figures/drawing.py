"""A figure as what it shows: curves in panels, with a caption; and one painter for all of them.

A function that makes a figure returns its numbers, so that they can be tested without looking at a picture. Solid lines
and points are what was run, bands the middle of many seeds; dashed lines are exact and were known before.
"""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from neuralq.figures import COLOURS, MARKERS, draw_png, draw_svg, tame
from neuralq.types import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["EXACT", "Drawing", "Panel", "Series", "png_of", "svg_of"]

EXACT = 6
"""The colour (black) of an exact line that belongs to no single curve."""

_WIDTH = 4.6  # inches of a panel
_CAPTION_LINES = 0.17  # inches per line


@dataclass(frozen=True, eq=False)
class Series:
    """One line or row of points.

    Args:
        label: its name, in the legend where it is listed.
        x: ``[k]``.
        y: ``[k]``.
        style: ``"line"`` (what was run), ``"dashed"`` (exact), ``"dotted"`` (a guide), ``"points"`` (measured) or
            ``"rings"`` (points that let others be seen).
        colour: index into the colours of all reports.
        low: lower edge of a band, ``[k]``.
        high: upper edge of a band, ``[k]``.
        listed: whether the legend names it.
    """

    label: str
    x: Floats
    y: Floats
    style: Literal["line", "dashed", "dotted", "points", "rings"] = "line"
    colour: int = 0
    low: Floats | None = None
    high: Floats | None = None
    listed: bool = True


@dataclass(frozen=True, eq=False)
class Panel:
    """One pair of axes.

    Args:
        title: above it.
        x_label: below it.
        y_label: beside it.
        curves: from back to front.
        x_scale: ``"linear"`` or ``"log"``.
        y_scale: ``"linear"``, ``"log"`` or ``"symlog"``.
        x_limits: shown range; None for what the curves need.
        y_limits: likewise.
        verticals: where a vertical line stands, with its label, such as a critical value.
        horizontals: likewise.
        legend: where the legend stands, in matplotlib's words.
        legend_columns: of the legend.
        same_units: whether both axes have the same scale, for paths in a plane.
    """

    title: str
    x_label: str
    y_label: str
    curves: tuple[Series, ...]
    x_scale: Literal["linear", "log"] = "linear"
    y_scale: Literal["linear", "log", "symlog"] = "linear"
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    verticals: tuple[tuple[float, str], ...] = ()
    horizontals: tuple[tuple[float, str], ...] = ()
    legend: Literal["best", "upper left", "upper right", "lower left", "lower right"] = "best"
    legend_columns: int = 1
    same_units: bool = False

    def curve(self, label: str, style: str = "line") -> Series:
        """The curve of that label and style.

        Raises:
            ValueError: there is none.

        Example:
            >>> import numpy as np
            >>> panel = Panel("", "", "", (Series("w", np.zeros(1), np.ones(1)),))
            >>> panel.curve("w").y.tolist()
            [1.0]
        """
        for curve in self.curves:
            if (curve.label, curve.style) == (label, style):
                return curve
        there = ", ".join(f"{curve.label!r} ({curve.style})" for curve in self.curves)
        raise ValueError(f"the panel {self.title!r} has no curve {label!r} ({style}); it has {there}")


@dataclass(frozen=True, eq=False)
class Drawing:
    """A figure and all that is said about it.

    Args:
        name: of its files; letters, digits and ``-``.
        title: a claim.
        source: who published it.
        caption: what is exact, what is sampled, and all settings.
        panels: from left to right.
        height: of a panel, in inches.
        known: numbers worth printing beside the picture, by name.
    """

    name: str
    title: str
    source: str
    caption: str
    panels: tuple[Panel, ...]
    height: float = 3.3
    known: dict[str, float] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Caption and source."""
        return f"{self.caption} Source: {self.source}."


def svg_of(drawing: Drawing, with_caption: bool = True) -> str:
    """The figure as an ``<svg>`` element; the caption is its description in any case.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    size, text = _layout(drawing, with_caption)
    return _compact(draw_svg(drawing.name, drawing.title, drawing.text, size, lambda f: _paint(f, drawing, text)))


def png_of(drawing: Drawing, with_caption: bool = True) -> bytes:
    """The figure as a PNG file.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    size, text = _layout(drawing, with_caption)
    return draw_png(size, lambda figure: _paint(figure, drawing, text))


def _compact(svg: str) -> str:
    """The same picture in two thirds of the bytes: hundredths of a point, no names that nothing refers to."""
    # What is below 1 may be a factor, not a place, and stays as it is.
    svg = re.sub(r"-?[1-9]\d*\.\d{3,}", lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), svg)
    svg = re.sub(r'<g id="[^"]*">', "<g>", svg).replace("-DejaVuSans-", "-")
    svg = re.sub(r"\s*\n\s*", "\n", svg)
    svg = re.sub(r"\n(?=[A-Za-z]? ?-?[\d.]|z)|(?<=z)\n", " ", svg)
    svg = re.sub(r' style="[^"]*"', lambda style: " " + style[0].replace(": ", ":").replace("; ", ";").strip(), svg)
    # After M or L more places are lines without saying so.
    return re.sub(r"[ML] \S+ \S+(?: L \S+ \S+)+", lambda path: path[0].replace(" L ", " "), svg)


def _layout(drawing: Drawing, with_caption: bool) -> tuple[tuple[float, float], list[str]]:
    """Width and height in inches, and the lines of the caption."""
    width = _WIDTH * len(drawing.panels) if len(drawing.panels) > 1 else 5.6
    lines = textwrap.wrap(drawing.text, int(width * 14.2)) if with_caption else []
    return (width, drawing.height + 0.35 + _CAPTION_LINES * len(lines)), lines


def _paint(figure: Figure, drawing: Drawing, caption: list[str]) -> None:
    figure.suptitle(drawing.title, x=0.01, ha="left", fontsize=12.5)
    all_axes = figure.subplots(1, len(drawing.panels), squeeze=False)[0]
    for axes, panel in zip(all_axes, drawing.panels, strict=True):
        _paint_panel(axes, panel)
    if caption:
        figure.supxlabel("\n".join(caption), x=0.01, ha="left", fontsize=8.5, color="#333333", linespacing=1.35)


def _paint_panel(axes: Axes, panel: Panel) -> None:
    axes.set_xscale(panel.x_scale)
    if panel.y_scale == "symlog":
        axes.set_yscale("symlog", linthresh=1.0)
    else:
        axes.set_yscale(panel.y_scale)
    for value, label in panel.horizontals:
        axes.axhline(value, color="#555555", linestyle=":", linewidth=1.3, label=label)
    for value, label in panel.verticals:
        axes.axvline(value, color="#555555", linestyle=":", linewidth=1.3, label=label)
    for curve in panel.curves:
        _paint_curve(axes, curve)
    _paint_ticks(axes, panel)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    if panel.title:
        axes.set_title(panel.title, loc="left", fontsize=10.5)
    if panel.x_limits is not None:
        axes.set_xlim(*panel.x_limits)
    if panel.y_limits is not None:
        axes.set_ylim(*panel.y_limits)
    if panel.same_units:
        axes.set_aspect("equal", adjustable="box")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc=panel.legend, ncols=panel.legend_columns, fontsize=8.5, handlelength=1.7,
                    frameon=True, framealpha=0.85, edgecolor="none", borderpad=0.2)  # fmt: skip


def _paint_ticks(axes: Axes, panel: Panel) -> None:
    """Few enough numbers along x that none touches the next."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, ScalarFormatter

    if panel.x_scale == "log":
        axes.xaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))


def _paint_curve(axes: Axes, curve: Series) -> None:
    colour = COLOURS[curve.colour % len(COLOURS)]
    x, y, label = tame(curve.x), tame(curve.y), curve.label if curve.listed else None
    if curve.low is not None and curve.high is not None:
        axes.fill_between(x, tame(curve.low), tame(curve.high), color=colour, alpha=0.2, linewidth=0)
    if curve.style in ("points", "rings"):
        inside = "none" if curve.style == "rings" else colour
        marker = MARKERS[curve.colour % len(MARKERS)]
        axes.plot(x, y, color=colour, linestyle="", marker=marker, markerfacecolor=inside, label=label, zorder=4)
        return
    looks = {"line": ("-", 1.8, 2.5), "dashed": ("--", 1.4, 3.5), "dotted": (":", 1.3, 2.0)}
    dashes, width, order = looks[curve.style]
    axes.plot(x, y, color=colour, linestyle=dashes, linewidth=width, zorder=order, label=label)

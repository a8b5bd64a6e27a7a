"""Matplotlib figures as inline SVG: responsive, titled for screen readers, the same bytes for the same input.

Letters are drawn as paths, so a page looks the same wherever it is opened. Every id inside an SVG is prefixed with the
figure's name: ids must be unique in a page that holds several.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from neuralq.checks import MissingExtra

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "MARKERS", "at_least", "band", "draw_png", "draw_svg", "scale_axis", "steps_axis", "tame"]

# Okabe and Ito (2008), "Color universal design": told apart with every common colour blindness.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

_STYLE: dict[str, Any] = {
    "svg.hashsalt": "neuralq",
    "svg.fonttype": "path",
    "font.family": "sans-serif",
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "lines.linewidth": 1.8,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "legend.fontsize": 10,
}
_HUGE = 1e150  # what is larger is drawn here: the ticks of an axis that spans the whole of float64 overflow


def draw_svg(
    name: str, title: str, description: str, size_inches: tuple[float, float], paint: Callable[[Figure], None]
) -> str:
    """An ``<svg>`` element as wide as its container, painted by ``paint`` on an empty figure.

    Args:
        name: prefix of every id inside; unique within a page; letters, digits and ``-``.
        title: short name, read by screen readers.
        description: what is to be seen, for those who cannot see it.
        size_inches: width and height; 11 points of text are legible on a phone up to a width of about 6 inches.
        paint: draws.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    buffer = io.StringIO()
    with _painted(size_inches, paint) as figure:
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    return _inline(buffer.getvalue(), name, title, description)


def draw_png(size_inches: tuple[float, float], paint: Callable[[Figure], None], dots_per_inch: int = 150) -> bytes:
    """The same figure as a PNG file on white, for where an SVG cannot go.

    Args:
        size_inches: width and height.
        paint: draws.
        dots_per_inch: resolution.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    buffer = io.BytesIO()
    with _painted(size_inches, paint) as figure:
        figure.savefig(buffer, format="png", dpi=dots_per_inch, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


@contextmanager
def _painted(size_inches: tuple[float, float], paint: Callable[[Figure], None]) -> Iterator[Figure]:
    """The painted figure, while the house's style holds: text is laid out when a file is written."""
    try:
        from matplotlib import style
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra(
            f'figures need matplotlib ({error}); install it with: pip install "neuralq[plot]"'
        ) from error
    with style.context(["default", _STYLE]), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a glyph that the font lacks, a layout too tight: the figure is still right
        figure = Figure(figsize=size_inches, layout="constrained")
        FigureCanvasSVG(figure)
        paint(figure)
        yield figure


def _inline(text: str, name: str, title: str, description: str) -> str:
    """The SVG file made fit to stand inside a page: no prolog, no outside names, own ids, own style, a title."""
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\n?", "", text, flags=re.DOTALL).replace("xlink:href=", "href=")
    text = re.sub(r'(\s(?:id|clip-path|href|style)=")([^"]*)"', lambda m: f'{m[1]}{_prefixed(m[0], m[2], name)}"', text)
    text = re.sub(r"(<style[^>]*>)\s*\*\s*\{", rf"\1#{name} * {{", text)
    box = re.search(r'viewBox="([^"]+)"', text)
    assert box is not None, "matplotlib always writes a viewBox"
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" id="{name}" class="figure" viewBox="{box[1]}" role="img" '
        f'aria-labelledby="{name}-title {name}-description">\n'
        f'<title id="{name}-title">{escape(title)}</title>\n<desc id="{name}-description">{escape(description)}</desc>'
    )
    return head + text[text.index(">") + 1 :].rstrip()


def at_least(svg: str, pixels: int) -> str:
    """The same element, never narrower than so many pixels: where there is less room, what holds it has to scroll.

    Example:
        >>> at_least('<svg viewBox="0 0 1 1">', 500)
        '<svg style="min-width:500px" viewBox="0 0 1 1">'
    """
    return svg.replace("<svg ", f'<svg style="min-width:{pixels}px" ', 1)


def _prefixed(attribute: str, value: str, name: str) -> str:
    if attribute.lstrip().startswith("id="):
        return f"{name}-{value}"
    if attribute.lstrip().startswith("href="):
        return value.replace("#", f"#{name}-", 1)
    return value.replace("url(#", f"url(#{name}-")


def tame(values: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Values within what can be drawn: NaN and infinities become gaps, huge ones go to the edge."""
    array = np.asarray(values, np.float64)
    return np.where(np.isfinite(array), np.clip(array, -_HUGE, _HUGE), np.nan)


def band(axes: Axes, x: np.ndarray[Any, Any], low: Any, high: Any, colour: str, label: str = "") -> None:
    """What lies between two curves, filled; an upright line where there is one point."""
    low, high = tame(low), tame(high)
    if len(x) == 1:
        axes.vlines(x, low, high, color=colour, alpha=0.5, linewidth=3, label=label)
    else:
        axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0, label=label)


def scale_axis(axes: Axes, values: np.ndarray[Any, np.dtype[np.float64]]) -> None:
    """Logarithmic where most positive values span over three decades, symmetric so where signed ones grow huge."""
    kept = values[np.isfinite(values)]
    if not kept.size:
        return
    low = np.quantile(kept, 0.05)  # one value near zero is no reason to stretch the axis
    if kept.min() > 0 and np.log10(kept.max()) - np.log10(low) > 3:
        axes.set_yscale("log")
    elif np.abs(kept).max() > 1e6:
        axes.set_yscale("symlog", linthresh=1.0)


def steps_axis(axes: Axes, label: str) -> None:
    """Counts along x, written 20k for 20 000."""
    from matplotlib.ticker import EngFormatter, MaxNLocator

    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlabel(label)

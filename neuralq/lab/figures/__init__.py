"""The published figures of divergence, drawn anew: what was run over what is exact.

A function per figure returns a `Drawing`: the numbers, with a caption that says which are exact and which are sampled.
`svg_of` and `png_of` draw any of them; that needs the extra ``plot`` (matplotlib), which is imported there.
"""

from __future__ import annotations

from collections.abc import Callable

from neuralq.lab.figures.cures import figure_critical_curves, figure_representations
from neuralq.lab.figures.drawing import Drawing, Panel, Series, png_of, svg_of
from neuralq.lab.figures.fitted_grid import figure_fitted
from neuralq.lab.figures.hall import figure_hall
from neuralq.lab.figures.spiral import figure_spiral
from neuralq.lab.figures.star import figure_11_2, figure_11_5, figure_11_6
from neuralq.lab.figures.states import figure_chattering, figure_kolter

__all__ = ["FIGURES", "Drawing", "Panel", "Series", "png_of", "svg_of"]

FIGURES: dict[str, Callable[[], Drawing]] = {
    "sb-11-2": figure_11_2,
    "sb-11-5": figure_11_5,
    "sb-11-6": figure_11_6,
    "hall": figure_hall,
    "spiral": figure_spiral,
    "kolter": figure_kolter,
    "chattering": figure_chattering,
    "fitted": figure_fitted,
    "star-five": figure_representations,
    "critical-curves": figure_critical_curves,
}
"""What makes the figure of each name, with its published settings."""

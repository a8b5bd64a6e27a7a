"""Reports: one self-contained HTML page per run, readable on a phone, printable, free of scripts and outside resources.

Drawing needs the extra ``plot`` (matplotlib), which is imported when the first figure is drawn.
"""

from __future__ import annotations

from neuralq.report.curves import learning_curve_svg, signals_svg
from neuralq.report.demo import write_demo_report
from neuralq.report.divergence import DivergenceResult, divergence_svg, growth_table, values_table
from neuralq.report.page import Page
from neuralq.report.readings import read_metrics
from neuralq.report.run import write_report
from neuralq.report.svg import MissingExtra

__all__ = [
    "DivergenceResult",
    "MissingExtra",
    "Page",
    "divergence_svg",
    "growth_table",
    "learning_curve_svg",
    "read_metrics",
    "signals_svg",
    "values_table",
    "write_demo_report",
    "write_report",
]

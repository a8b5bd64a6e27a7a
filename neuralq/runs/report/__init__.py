"""Reports: one self-contained HTML page per run, readable on a phone, printable, free of scripts and outside resources.

Drawing needs the extra ``plot`` (matplotlib), which is imported when the first figure is drawn.
"""

from __future__ import annotations

from neuralq.checks import MissingExtra
from neuralq.runs.folder.files import read_rows
from neuralq.runs.report.curves import learning_curve_svg, signals_svg
from neuralq.runs.report.page import Page
from neuralq.runs.report.run import write_report
from neuralq.runs.report.sweep import write_sweep_report

__all__ = [
    "MissingExtra",
    "Page",
    "learning_curve_svg",
    "read_rows",
    "signals_svg",
    "write_report",
    "write_sweep_report",
]

"""The figures of one run: the learning curve, and the signals that tell whether learning is sound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from neuralq.figures import COLOURS, band, draw_svg, scale_axis, steps_axis, tame
from neuralq.runs.folder.files import as_float
from neuralq.runs.report.readings import Row, finite_series, quartiles, standard_errors, thin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["SIGNALS", "curve_words", "learning_curve_svg", "mark_changes", "signals_svg"]

SIGNALS = {"abs_td_error": "mean |δ|", "max_q": "largest Q", "loss": "loss"}
"""Columns of a training row drawn by `signals_svg`, with their axis labels."""


def learning_curve_svg(
    rows: Sequence[Row], target: float | None = None, *, changed_at: Sequence[float] = (), name: str = "learning-curve"
) -> str:
    """Training return and greedy return against environment steps, with the quartiles of each evaluation as a band.

    Args:
        rows: rows of ``metrics.jsonl``.
        target: return that was to be reached, drawn as a line.
        changed_at: steps at which the run went on with other settings, marked.
        name: prefix of the ids in the SVG, unique in its page.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    train_steps, train_returns = finite_series(rows, "train", "episode_return")
    greedy_steps, greedy_returns = finite_series(rows, "evaluation", "greedy_return")
    of_chances = _all_or_nothing(rows)
    band_steps, low, high = standard_errors(rows) if of_chances else quartiles(rows)
    words = "± standard error" if of_chances else "its middle half of episodes"

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        if len(train_steps):
            x, y = thin(train_steps, tame(train_returns))
            axes.plot(x, y, color=COLOURS[1], linestyle="--", linewidth=1.4, label="training (exploring)")
        if len(greedy_steps):
            if len(band_steps):
                band(axes, band_steps, low, high, COLOURS[0], words)
            every = max(1, len(greedy_steps) // 40)
            axes.plot(greedy_steps, tame(greedy_returns), color=COLOURS[0], marker="o", markevery=every,
                      label="greedy policy (mean)")  # fmt: skip
        if target is not None:
            axes.axhline(target, color="#555555", linestyle=":", linewidth=1.4, label=f"target {target:g}")
        mark_changes(axes, changed_at)
        if not len(train_steps) and not len(greedy_steps):
            axes.text(0.5, 0.5, "no finished episode yet", transform=axes.transAxes, ha="center", color="#555555")
        steps_axis(axes, "environment steps")
        axes.set_ylabel("return per episode")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=2)

    return draw_svg(name, "Learning curve", _describe_curve(rows, target), (5.2, 3.8), paint)


def mark_changes(axes: Axes, changed_at: Sequence[float]) -> None:
    """Upright lines where settings changed."""
    for number, at in enumerate(changed_at):
        label = "settings changed" if number == 0 else None
        axes.axvline(at, color=COLOURS[2], linestyle="-.", linewidth=1.3, label=label)


def _all_or_nothing(rows: Sequence[Row]) -> bool:
    """Whether every greedy episode scores one of two returns: then the middle half of them is the whole range."""
    listed = [
        row["returns"] for row in rows if row.get("kind") == "evaluation" and isinstance(row.get("returns"), list)
    ]
    seen = {as_float(value) for returns in listed for value in returns}
    return 0 < len(seen) <= 2 and all(map(math.isfinite, seen))


def curve_words(rows: Sequence[Row]) -> str:
    """What the learning curve shows."""
    band = (
        "is one standard error wide on each side" if _all_or_nothing(rows) else "holds the middle half of its episodes"
    )
    return (
        f"The line of dots is the policy without exploration; the band {band}. Training episodes still explore, so "
        "they may score lower."
    )


def _describe_curve(rows: Sequence[Row], target: float | None) -> str:
    steps, returns = finite_series(rows, "evaluation", "greedy_return")
    if not len(steps):
        return "No greedy evaluation has been recorded yet."
    best = int(returns.argmax())
    text = (
        f"Greedy return {returns[0]:.4g} at {steps[0]:,.0f} environment steps, {returns[-1]:.4g} at {steps[-1]:,.0f}; "
    )
    text += f"best {returns[best]:.4g} at {steps[best]:,.0f}."
    return text if target is None else f"{text} Target {target:g}."


def signals_svg(rows: Sequence[Row], *, changed_at: Sequence[float] = (), name: str = "signals") -> str | None:
    """The TD error, the largest Q and the loss against environment steps; None where none of them was recorded.

    An axis is logarithmic when most of its values span over three decades.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    found = {label: finite_series(rows, "train", column) for column, label in SIGNALS.items()}
    series = {label: pair for label, pair in found.items() if len(pair[0])}
    if not series:
        return None

    def paint(figure: Figure) -> None:
        panels = figure.subplots(len(series), 1, sharex=True, squeeze=False)[:, 0]
        for number, (axes, (label, (steps, values))) in enumerate(zip(panels, series.items(), strict=True)):
            x, y = thin(steps, tame(values))
            axes.plot(x, y, color=COLOURS[number], linewidth=1.5, marker="." if len(x) < 3 else "")
            mark_changes(axes, changed_at)
            scale_axis(axes, y)
            axes.set_ylabel(label)
        steps_axis(panels[-1], "environment steps")
        figure.align_ylabels(panels)

    ends = "; ".join(f"{label} from {y[0]:.3g} to {y[-1]:.3g}" for label, (_, y) in series.items())
    return draw_svg(name, "Learning signals", f"{ends}.", (5.2, 1.2 + 1.4 * len(series)), paint)

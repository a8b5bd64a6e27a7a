"""Prediction beside measurement: growth of the error of each representation, and its values beside the exact ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg, steps_axis, tame
from neuralq.runs.report.page import format_number, html_table
from neuralq.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["DivergenceResult", "divergence_svg", "growth_table", "values_table"]


class DivergenceResult(Protocol):
    """What is drawn of a divergence experiment with one representation."""

    @property
    def representation(self) -> str:
        """Its name."""
        ...

    @property
    def predicted_growth(self) -> float:
        """Factor by which one sweep was said to multiply the error; above 1 it grows."""
        ...

    @property
    def prediction_scope(self) -> str:
        """``"global"`` where the prediction holds everywhere, ``"local"`` where it holds near the starting weights."""
        ...

    @property
    def verdict(self) -> str:
        """The prediction in words."""
        ...

    @property
    def measured_growth(self) -> float:
        """Factor per sweep that was measured."""
        ...

    @property
    def steps(self) -> int | Array:
        """Sweeps at which the error was measured, ``[k]``; or their number k - 1, when it was before and after each."""
        ...

    @property
    def rmsve(self) -> Array:
        """Root mean squared value error at these steps, ``[k]``."""
        ...

    @property
    def values(self) -> Array:
        """Learned values at the end, one per state."""
        ...

    @property
    def exact_values(self) -> Array:
        """True values, one per state."""
        ...


def divergence_svg(results: Sequence[DivergenceResult], *, name: str = "divergence") -> str:
    """The error of each representation against sweeps on a logarithmic axis; dashed: the growth predicted beforehand.

    A prediction starts at the first measured error e₀ and follows e₀·gⁿ.

    Raises:
        MissingExtra: matplotlib is not installed.
    """

    def paint(figure: Figure) -> None:
        from matplotlib.lines import Line2D

        axes = figure.subplots()
        axes.set_yscale("log")
        handles, shown = [], []
        for number, result in enumerate(results):
            colour = COLOURS[number % len(COLOURS)]
            marker = MARKERS[number % len(MARKERS)]
            steps, errors = _sweeps(result), _positive(result.rmsve)
            every = (number * 2, max(1, len(steps) // 8)) if len(steps) > 16 else None
            axes.plot(steps, errors, color=colour, marker=marker, markevery=every)
            shown.append(errors[np.isfinite(errors)])
            axes.plot(steps, _predicted(result), color=colour, linestyle="--", linewidth=1.2)
            label = result.representation.replace("$", r"\$").lstrip("_")
            handles.append(Line2D([], [], color=colour, marker=marker, label=label))
        handles.append(Line2D([], [], color="#555555", linestyle="--", linewidth=1.2, label="predicted growth"))
        everything = np.concatenate([np.empty(0), *shown])
        if everything.size:  # the measured errors set the frame; a dashed line may leave it
            low, high = np.log10(everything.min()), np.log10(everything.max())
            margin = max(0.05 * (high - low), 0.15)
            axes.set_ylim(10 ** (low - margin), 10 ** (high + margin))
        steps_axis(axes, "sweeps over the states")
        axes.set_ylabel("value error (RMSVE)")
        figure.legend(handles=handles, loc="outside upper left", ncols=3)

    description = " ".join(
        f"{result.representation}: predicted growth {format_number(result.predicted_growth)} per sweep, "
        f"measured {format_number(result.measured_growth)}, {result.verdict}."
        for result in results
    )
    return draw_svg(name, "Value error of each representation", description, (5.2, 4.2), paint)


def _positive(errors: Array) -> Array:
    """Errors that a logarithmic axis can show; zero, NaN and infinity become gaps."""
    array = tame(errors)
    return np.where(array > 1e-150, array, np.nan)


def _sweeps(result: DivergenceResult) -> Array:
    steps = np.asarray(result.steps, np.float64)
    return steps if steps.ndim else np.arange(len(result.rmsve), dtype=np.float64)


def _predicted(result: DivergenceResult) -> Array:
    steps, errors = _sweeps(result), _positive(result.rmsve)
    growth = float(result.predicted_growth)
    if not len(errors) or not math.isfinite(errors[0]) or not (math.isfinite(growth) and growth > 0):
        return np.full(len(steps), np.nan)
    exponent = math.log10(errors[0]) + (steps - steps[0]) * math.log10(growth)  # as exponents: gⁿ overflows float64
    return np.where(np.abs(exponent) < 150, 10.0 ** np.clip(exponent, -150, 150), np.nan)


def growth_table(results: Sequence[DivergenceResult]) -> str:
    """An HTML table: what was predicted for each representation before the first update, and what was measured."""
    header = ["representation", "predicted growth", "prediction holds", "verdict", "measured growth", "last error"]
    scopes = {"global": "everywhere", "local": "near the start"}
    body = [
        [
            result.representation,
            format_number(result.predicted_growth, 8),
            scopes.get(result.prediction_scope, result.prediction_scope),
            result.verdict,
            format_number(result.measured_growth, 8),
            format_number(float(result.rmsve[-1]) if len(result.rmsve) else math.nan),
        ]
        for result in results
    ]
    return html_table("Growth of the error per sweep: below 1 it dies out, above 1 it multiplies", header, body)


def values_table(results: Sequence[DivergenceResult]) -> str:
    """An HTML table: the exact value of every state beside what each representation learned."""
    if not results:
        return html_table("Exact and learned values", ["state", "exact"], [])
    exact = np.ravel(results[0].exact_values)
    columns = [np.ravel(result.values) for result in results]
    body = [
        [str(state), format_number(float(value)), *(format_number(float(column[state])) for column in columns)]
        for state, value in enumerate(exact)
    ]
    header = ["state", "exact", *(result.representation for result in results)]
    return html_table("Exact and learned values of every state", header, body)

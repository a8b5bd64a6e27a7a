"""The page of the demo: a network that learns, and one update rule that is safe in a table and explodes elsewhere.

Prediction stands beside measurement: the growth of the error of each representation, and its values beside the exact
ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg, steps_axis, tame
from neuralq.runs.folder.files import as_float
from neuralq.runs.report.curves import learning_curve_svg
from neuralq.runs.report.page import Page, facts_table, format_number, html_table
from neuralq.runs.report.readings import Row
from neuralq.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from neuralq.lab import RepresentationResult

__all__ = ["divergence_svg", "growth_table", "values_table", "write_demo_report"]


def write_demo_report(
    path: str | Path,
    training_rows: Sequence[Row],
    training_facts: Mapping[str, Any],
    baird_results: Sequence[RepresentationResult],
    *,
    target: float | None = None,
) -> Path:
    """Writes one page with a learning curve and the divergence of Baird's star, explained for a student.

    Args:
        path: file to write.
        training_rows: rows of the training run's ``metrics.jsonl``.
        training_facts: what to say of it (names may use underscores); ``target_return``, ``stop_at_return`` or
            ``target`` serves as the target when none is given.
        baird_results: one result per representation, in the order in which to show them.
        target: return that training was to reach.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    if target is None:
        named = (as_float(training_facts.get(key)) for key in ("target_return", "stop_at_return", "target"))
        target = next((value for value in named if math.isfinite(value)), None)
    page = Page(
        "Learning values with a network",
        "First where it works, then where an update goes wrong, and how that could be known before the first step.",
    )
    _add_training(page, training_rows, training_facts, target)
    _add_star(page, baird_results)
    return page.write(Path(path))


def _add_training(page: Page, rows: Sequence[Row], facts: Mapping[str, Any], target: float | None) -> None:
    page.heading("1. A network learns")
    page.paragraph(
        "A Q-network guesses, for every action, how much reward is still to come. After each stretch of experience "
        "TD(λ) moves every guess towards the rewards that followed plus a later guess. Playing means taking the action "
        "with the highest guess; that is the greedy policy."
    )
    page.figure(
        learning_curve_svg(rows, target, name="demo-learning"),
        "Dots: the greedy policy, averaged over its test episodes; band: the middle half of them. Dashed: training "
        "episodes, in which some actions are still tried at random.",
    )
    page.table(facts_table({key.replace("_", " "): value for key, value in facts.items()}))


def _add_star(page: Page, results: Sequence[RepresentationResult]) -> None:
    page.heading("2. The same update, five representations")
    page.paragraph(
        "Baird's star has no reward at all, so the exact value of every state is 0 and any other number is an error. "
        "Each sweep updates all states equally, although the policy being judged would soon stay in a single one. "
        "Nothing is random here: only the way in which the values are stored differs."
    )
    page.table(growth_table(results))
    page.figure(
        divergence_svg(results, name="demo-divergence"),
        "Solid: measured error. Dashed: the growth computed before the first update, drawn from the starting error. "
        "The axis is logarithmic: a straight line upward is growth by a constant factor.",
    )
    page.paragraph(
        "In a table each state has its own number, and an update moves that number alone. With shared weights an "
        "update of one state moves others too; when it lifts the value that it aims at more than its own, the next aim "
        "is higher still. For the table and for linear features one matrix says whether this happens, and by what "
        "factor per sweep, from every starting point. For a network the same matrix is made from its derivatives at "
        "the starting weights, so the prediction holds there and may lose its hold as the weights move away."
    )
    page.heading("3. Exact values beside learned ones")
    page.table(values_table(results))


def divergence_svg(results: Sequence[RepresentationResult], *, name: str = "divergence") -> str:
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


def _sweeps(result: RepresentationResult) -> Array:
    steps = np.asarray(result.steps, np.float64)
    return steps if steps.ndim else np.arange(len(result.rmsve), dtype=np.float64)


def _predicted(result: RepresentationResult) -> Array:
    steps, errors = _sweeps(result), _positive(result.rmsve)
    growth = float(result.predicted_growth)
    if not len(errors) or not math.isfinite(errors[0]) or not (math.isfinite(growth) and growth > 0):
        return np.full(len(steps), np.nan)
    exponent = math.log10(errors[0]) + (steps - steps[0]) * math.log10(growth)  # as exponents: gⁿ overflows float64
    return np.where(np.abs(exponent) < 150, 10.0 ** np.clip(exponent, -150, 150), np.nan)


def growth_table(results: Sequence[RepresentationResult]) -> str:
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


def values_table(results: Sequence[RepresentationResult]) -> str:
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

"""The page of the demo: a network that learns, and one update rule that is safe in a table and explodes elsewhere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuralq.runs.report.curves import learning_curve_svg
from neuralq.runs.report.divergence import DivergenceResult, divergence_svg, growth_table, values_table
from neuralq.runs.report.page import Page, facts_table
from neuralq.runs.report.readings import Row, as_float

__all__ = ["write_demo_report"]


def write_demo_report(
    path: str | Path,
    training_rows: Sequence[Row],
    training_facts: Mapping[str, Any],
    baird_results: Sequence[DivergenceResult],
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


def _add_star(page: Page, results: Sequence[DivergenceResult]) -> None:
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

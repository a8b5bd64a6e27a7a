"""Runs by the value of one option, whatever else they differ in: what that option does on the whole."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neuralq.figures import COLOURS, draw_png, draw_svg, tame
from neuralq.runs.folder.files import as_float
from neuralq.runs.report.comparison import Group, SeedRun
from neuralq.runs.report.page import format_value

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["by_option", "option_names", "option_png", "option_svg"]

_SIZE = (7.0, 3.6)


def option_names(groups: Sequence[Group]) -> list[str]:
    """Options in which groups differ, as they are typed.

    Example:
        >>> option_names([Group("a", "", {"rollout.lambda_": 0.5, "gamma": 1}, ())])
        ['lambda', 'gamma']
    """
    return list(dict.fromkeys(n.rpartition(".")[2].rstrip("_") for group in groups for n in group.settings))


def by_option(groups: Sequence[Group], by: str) -> list[Group]:
    """One group for each value of an option, smaller numbers first; what else differed makes the tasks of its runs.

    Args:
        groups: of runs that differ in their seed alone.
        by: the option, as it is typed; with a dot after the learner that has it, or without.

    Raises:
        ValueError: if they do not differ in it.
    """
    wanted = re.sub(r"(^|\.)lambda$", r"\1lambda_", by.replace("-", "_"))
    every = dict.fromkeys(name for group in groups for name in group.settings)
    names = [name for name in every if name == wanted or name.partition(".")[2] == wanted]
    if not names:
        differing = ", ".join(option_names(groups)) or "their seed alone"
        raise ValueError(f"the runs do not differ in an option {by}; they differ in {differing}")
    found: dict[str, tuple[Any, list[SeedRun]]] = {}
    for group in groups:
        value = next((group.settings[name] for name in names if name in group.settings), None)
        task = json.dumps({n: v for n, v in group.settings.items() if n not in names}, sort_keys=True, default=str)
        of_value = found.setdefault(json.dumps(value, default=str), (value, []))
        of_value[1].extend(dataclasses.replace(run, task=task) for run in group.runs)
    told = by.replace("_", "-").rstrip("-")
    ordered = sorted(found.values(), key=lambda one: _place_of(one[0]))
    return [Group(f"{told} {value}", format_value(value), {}, tuple(runs)) for value, runs in ordered]


def _place_of(value: Any) -> tuple[bool, float, str]:
    number = as_float(value)
    return (math.isnan(number), 0.0 if math.isnan(number) else number, str(value))


def option_svg(groups: Sequence[Group], by: str) -> str:
    """What the agents score at each value of an option, as an ``<svg>`` element.

    Args:
        groups: from `by_option`.
        by: the option.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    ends = "; ".join(f"{group.label}: {group.estimate.iqm:.4g}" for group in groups)
    name = "by-" + re.sub(r"[^A-Za-z0-9]+", "-", by)
    text = f"Greedy return of the agents at each value of {by}, interquartile mean. {ends}."
    return draw_svg(name, f"Return by {by}", text, _SIZE, lambda figure: _paint(figure, groups, by))


def option_png(groups: Sequence[Group], by: str) -> bytes:
    """The same as a PNG file.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    return draw_png(_SIZE, lambda figure: _paint(figure, groups, by))


def _paint(figure: Figure, groups: Sequence[Group], by: str) -> None:
    """Values at equal distances: rates are chosen by their ratios, and names have no distance."""
    axes, rng = figure.subplots(), np.random.default_rng(0)
    for place, group in enumerate(groups):
        scores = tame(group.returns)
        beside = place + rng.uniform(0.08, 0.28, len(scores))  # so that equal ones are seen
        axes.plot(beside, scores, ".", color=COLOURS[0], alpha=0.35, markersize=5, label="" if place else "one run")
        found = group.estimate
        if found.low is not None and found.high is not None:
            axes.vlines(place, found.low, found.high, color=COLOURS[1], linewidth=2)
        mean = "" if place else "interquartile mean, 95 % interval"
        axes.plot([place], tame([found.iqm]), "o", color=COLOURS[1], label=mean)
    axes.set_xticks(range(len(groups)), [group.label for group in groups])
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_xlabel(by)
    axes.set_ylabel("greedy return per episode")
    figure.legend(loc="outside upper left", ncols=2)

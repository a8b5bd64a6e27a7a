"""The page of a study: what was confirmed on fresh seeds, how much the race had flattered, and what mattered."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuralq.figures import COLOURS, at_least, draw_svg, tame
from neuralq.runs.report.page import Page, format_value, html_table, short_number, tiles
from neuralq.runs.sweep.statistics import Estimate
from neuralq.runs.tune.asking import importances
from neuralq.runs.tune.confirming import Confirmed, best_so_far, candidates, confirmed, winner
from neuralq.runs.tune.space import Option
from neuralq.runs.tune.study import FRESH, Study
from neuralq.runs.tune.trials import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["verdict", "write_tune_report"]

_PANELS = 6
"""Options whose slices are drawn at once; the others are behind a click."""
_COLUMNS = 3
_LEGIBLE = 600
"""Pixels that slices take; where there is less room they scroll."""
_STATES = {"through": "all seeds", "dropped": "dropped", "racing": "in the race"}
_STYLE = ".rows th, .rows td { white-space: nowrap; }"


def write_tune_report(study: Study) -> Path:
    """Writes ``report.html`` into the folder of a study and returns its path.

    Raises:
        MissingExtra: matplotlib or Optuna is not installed.
    """
    found = confirmed(study)
    env, learner = study.start.plain["env"], study.start.learner
    page = Page(f"{env}, {learner} learner: {len(study.trials)} trials", lead=verdict(study), style=_STYLE)
    page.table(tiles(_tiles(study, found)))
    for line in _warnings(study, found):
        page.paragraph(line, warning=True)
    if found:
        page.heading("Confirmed on fresh seeds")
        page.table(_rows(_confirmed_table(found)))
    best = winner(found)
    if best is not None and best.trial.number:
        page.heading(f"What trial {best.trial.number} has otherwise")
        page.table(_changes(study, best.trial))
    if any(study.standing(trial.number).estimate is not None for trial in study.trials):
        _pictures(page, study)
    page.heading("Trials")
    page.table(_rows(_trials_table(study)))
    page.folded("Where was looked", html_table("The space", ("option", "values"), _space_rows(study)))
    return page.write(study.path / "report.html")


def _rows(table: str) -> str:
    """The same table, each row in one line."""
    return f'<div class="rows">{table}</div>'


def verdict(study: Study) -> str:
    """What came of a study, in a sentence or two."""
    found = confirmed(study)
    best, preset = winner(found), found[0] if found else None
    if best is None or preset is None:
        ahead = best_so_far(study)
        told = "" if ahead is None else f" In the race {_named(ahead[0])} is ahead with {_told(ahead[1])}."
        return f"Nothing has been confirmed on fresh seeds yet, so there is no result.{told}"
    if best.gain is not None:
        return (
            f"On {FRESH} fresh seeds trial {best.trial.number} reaches {_told(best.fresh)}, the preset "
            f"{_told(preset.fresh)}: better by {short_number(best.gain.value)} ({short_number(best.gain.low)} to "
            f"{short_number(best.gain.high)})."
        )
    if len(found) == 1:
        told = f"on {FRESH} fresh seeds it reaches {_told(preset.fresh)}"
        return f"Nothing better than the preset came through the race; {told}."
    others = ", ".join(f"trial {one.trial.number} {_told(one.fresh)}" for one in found[1:])
    return (
        f"Nothing better than the preset was found beyond chance: on {FRESH} fresh seeds it reaches "
        f"{_told(preset.fresh)}; {others}."
    )


def _told(found: Estimate) -> str:
    return f"{short_number(found.iqm)}{_interval(found)}"


def _interval(found: Estimate) -> str:
    if found.low is None or found.high is None:
        return ""
    return f" ({short_number(found.low)} to {short_number(found.high)})"


def _named(trial: Trial) -> str:
    return f"trial {trial.number}" if trial.number else "the preset"


def _tiles(study: Study, found: Sequence[Confirmed]) -> list[tuple[str, str, str]]:
    runs = [run for trial in study.trials for run in trial.runs.values()]
    minutes = sum(run.seconds or 0.0 for run in runs) / 60
    spent = (
        "runs",
        f"{len(runs):,}",
        f"of {len(study.trials)} trials, {short_number(minutes, 2)} minutes all together",
    )
    best = winner(list(found))
    if best is None:
        ahead = best_so_far(study)
        if ahead is None:
            return [spent]
        remark = f"interquartile mean of {_named(ahead[0])} in the race{_interval(ahead[1])}; not a result"
        return [("ahead, not confirmed", short_number(ahead[1].iqm), remark), spent]
    remark = f"{_named(best.trial)}, interquartile mean over {FRESH} fresh seeds{_interval(best.fresh)}"
    preset = found[0]
    entries = [("result", short_number(best.fresh.iqm), remark)]
    if best.trial.number:
        entries.append(("preset", short_number(preset.fresh.iqm), f"on the same seeds{_interval(preset.fresh)}"))
    first = max(found, key=lambda one: one.searched.iqm)
    told = f"its best, {_named(first.trial)}, had {short_number(first.searched.iqm)}{_interval(first.searched)}"
    return [*entries, ("flattered by the race", short_number(first.flattery), told), spent]


def _warnings(study: Study, found: Sequence[Confirmed]) -> list[str]:
    lines = []
    missing = [trial for trial in candidates(study) if trial.number not in {one.trial.number for one in found}]
    if missing:
        names = ", ".join(map(_named, missing))
        lines.append(
            f"Not confirmed for want of time: {names}. Confirm with: neuralq tune {study.start.plain['env']} --dir "
            f"{study.path} --trials {len(study.trials)}"
        )
    failed = [(t, seed, run) for t in study.trials for seed, run in t.runs.items() if run.score is None]
    if failed:
        trial, seed, run = failed[0]
        lines.append(
            f"{len(failed)} runs failed and count as the lowest score of the others; the first is seed {seed} of "
            f"{_named(trial)}: {run.reason}"
        )
    return lines


def _confirmed_table(found: Sequence[Confirmed]) -> str:
    body = []
    for one in found:
        gain = "–"
        if one.gain is not None:
            words = "better" if one.is_better else "worse" if one.gain.high < 0 else "not told apart"
            low, high = short_number(one.gain.low), short_number(one.gain.high)
            gain = f"{short_number(one.gain.value)} ({low} to {high}): {words}"
        body.append([_named(one.trial), _told(one.fresh), gain, _told(one.searched), short_number(one.flattery)])
    level = f"{100 * (1 - 0.05 / max(len(found) - 1, 1)):.3g}"
    caption = (
        "Interquartile means of the agents' returns and 95 % bootstrap intervals. Flattery is what the race had more. "
        f"Differences to the preset have {level} % intervals, so that all of them hold together with 95 %."
    )
    return html_table(caption, ("", "fresh seeds", "over the preset", "in the race", "flattery"), body)


def _changes(study: Study, trial: Trial) -> str:
    names = [option.name for option in study.space.options]
    before = study.start.values(names)
    body = [
        [option.shown, format_value(before.get(option.name)), format_value(trial.chosen[option.name])]
        for option in study.space.options
        if option.name in trial.chosen and trial.chosen[option.name] != before.get(option.name)
    ]
    return html_table("What is not named is as in the preset.", ("option", "preset", f"trial {trial.number}"), body)


def _trials_table(study: Study) -> str:
    before = study.start.values([option.name for option in study.space.options])
    order = sorted(study.trials, key=lambda trial: (-_iqm(study, trial), trial.number))
    body = []
    for trial in order:
        standing = study.standing(trial.number)
        found = standing.estimate
        failed = sum(run.score is None for run in trial.runs.values())
        state = _STATES[standing.state] + (f", {failed} failed" if failed else "")
        numbers = ["–", "–"] if found is None else [short_number(found.iqm), _interval(found).strip(" ()")]
        body.append([_named(trial), *numbers, str(standing.num_seeds), state, _chosen(study, trial, before)])
    caption = "The best first, by the race. A dropped trial's interval lay below that of the best before it."
    return html_table(
        caption, ("", "interquartile mean", "95 % interval", "seeds", "race", "other than the preset"), body
    )


def _iqm(study: Study, trial: Trial) -> float:
    found = study.standing(trial.number).estimate
    return -math.inf if found is None else found.iqm


def _chosen(study: Study, trial: Trial, before: Mapping[str, Any]) -> str:
    words = [
        f"{option.shown} {format_value(trial.chosen[option.name])}"
        for option in study.space.options
        if option.name in trial.chosen and trial.chosen[option.name] != before.get(option.name)
    ]
    return ", ".join(words) or "–"


def _space_rows(study: Study) -> list[list[str]]:
    rows = []
    for option in study.space.options:
        if option.values:
            told = ", ".join(map(format_value, option.values))
        else:
            told = f"{format_value(option.low)} to {format_value(option.high)}{', logarithmic' if option.log else ''}"
            told += "".join(f", or {format_value(value)}" for value in option.beside)
        for name, values in option.when.items():
            told += f"; with {name.rstrip('_')} {' or '.join(map(format_value, values))}"
        rows.append([option.shown, told])
    return rows


def _pictures(page: Page, study: Study) -> None:
    page.heading("The race")
    page.figure(
        draw_svg("race", "Trials", "Each trial's interquartile mean.", (7.0, 3.6), lambda f: _paint_race(f, study)),
        "Interquartile mean of every trial and its interval: filled with all seeds, hollow dropped. The line is the "
        "best so far, which selection flatters.",
    )
    shares = importances(study)
    if shares:
        page.heading("What mattered")
        size = (7.0, 0.9 + 0.28 * len(shares))
        text = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items())
        page.figure(
            draw_svg("importance", "Importance of options", text, size, lambda f: _paint_importance(f, shares)),
            "Share of each option in what sets the best trials apart (PED-ANOVA, Watanabe et al. 2023), over the whole "
            "space. With few trials the order is rough.",
        )
    ordered = sorted(study.space.options, key=lambda option: -shares.get(option.shown, 0.0))
    page.heading("Slices")
    page.figure(
        _slices("slices", ordered[:_PANELS], study), "Every trial by one option at a time; the cross is the preset."
    )
    if ordered[_PANELS:]:
        others = f'<div class="scroll">{_slices("others", ordered[_PANELS:], study)}</div>'
        page.folded("Slices of the other options", others)


def _paint_race(figure: Figure, study: Study) -> None:
    from matplotlib.ticker import MaxNLocator

    axes = figure.subplots()
    best = -math.inf
    line: list[float] = []
    for trial in study.trials:
        standing = study.standing(trial.number)
        found = standing.estimate
        if found is not None:
            through = standing.state == "through"
            if found.low is not None and found.high is not None:
                axes.vlines(trial.number, found.low, found.high, color=COLOURS[0], alpha=0.35, linewidth=2)
            face = COLOURS[0] if through else "white"
            axes.plot(trial.number, found.iqm, "o", color=COLOURS[0], markerfacecolor=face)
            best = max(best, found.iqm) if through else best
        line.append(best)
    axes.step(range(len(line)), tame(line), where="post", color=COLOURS[1], label="best so far")
    axes.set_xlabel("trial (0 is the preset)")
    axes.set_ylabel("return of the agents")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside upper left")


def _paint_importance(figure: Figure, shares: Mapping[str, float]) -> None:
    axes = figure.subplots()
    names = list(shares)[::-1]
    axes.barh(names, [100 * shares[name] for name in names], color=COLOURS[0])
    axes.set_xlabel("%")
    axes.grid(axis="y", visible=False)


def _slices(name: str, options: Sequence[Option], study: Study) -> str:
    rows = math.ceil(len(options) / _COLUMNS)
    text = "Interquartile mean of every trial by " + ", ".join(option.shown for option in options)
    size = (7.0, 0.3 + 2.2 * rows)
    return at_least(draw_svg(name, "Slices", text, size, lambda f: _paint_slices(f, options, study, rows)), _LEGIBLE)


def _paint_slices(figure: Figure, options: Sequence[Option], study: Study, rows: int) -> None:
    grid = figure.subplots(rows, _COLUMNS, sharey=True, squeeze=False)
    start = study.start.values([option.name for option in study.space.options])
    for axes, option in zip(grid.flat, options, strict=False):
        _paint_slice(axes, option, study, start)
    for axes in grid.flat[len(options) :]:
        axes.set_visible(False)
    figure.supylabel("return of the agents")


def _paint_slice(axes: Axes, option: Option, study: Study, start: Mapping[str, Any]) -> None:
    points: list[tuple[Any, float, bool]] = []
    for trial in study.trials:
        found = study.standing(trial.number).estimate
        chosen = trial.chosen or start
        if found is not None and option.name in chosen and option.is_active(chosen):
            points.append((chosen[option.name], found.iqm, trial.number == 0))
    special = option.values or option.beside
    words = [format_value(value) for value in special]
    by_value = [(value, y, first) for value, y, first in points if not option.values and value not in option.beside]
    by_word = [(words[special.index(value)], y, first) for value, y, first in points if value in special]
    target = axes
    if by_value and by_word:  # what may stand beside a range has a strip of its own
        axes.set_axis_off()
        target = axes.inset_axes((0.0, 0.0, 0.74, 1.0), sharey=axes)
        _paint_points(axes.inset_axes((0.78, 0.0, 0.22, 1.0), sharey=axes), by_word, hides_y=True)
    if by_value:
        _paint_points(target, by_value)
        _range_axis(target, option)
    elif by_word:
        order = [word for word in words if word in {one[0] for one in by_word}]
        _paint_points(target, [(order.index(word), y, first) for word, y, first in by_word])
        target.set_xticks(range(len(order)), order)
        target.margins(x=0.2)
    (target if by_value else axes).set_title(option.shown, fontsize=10, loc="left")
    for label in target.get_xticklabels():
        label.set_fontsize(8)


def _range_axis(axes: Axes, option: Option) -> None:
    """The whole of an option's range, with few numbers below it."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    if option.log:
        axes.set_xscale("log")
        axes.set_xlim(option.low / 1.2, option.high * 1.2)
        axes.xaxis.set_major_locator(LogLocator(numticks=5))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(4))


def _paint_points(axes: Axes, points: Sequence[tuple[Any, float, bool]], hides_y: bool = False) -> None:
    others = [(x, y) for x, y, first in points if not first]
    preset = [(x, y) for x, y, first in points if first]
    axes.plot([x for x, _ in others], tame(np.array([y for _, y in others])), "o", color=COLOURS[0], alpha=0.6)
    axes.plot([x for x, _ in preset], [y for _, y in preset], "X", color=COLOURS[1], markersize=8)
    axes.tick_params(labelsize=8)
    if hides_y:
        axes.tick_params(labelleft=False)
        axes.margins(x=0.5)

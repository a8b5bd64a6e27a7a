"""The page of a sweep: what its seeds come to together, each of them, and their curves."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from neuralq.runs.folder.files import as_float
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.play_off import Score
from neuralq.runs.report.comparison import Group, algorithm_in, comparison_svg, read_groups
from neuralq.runs.report.options import by_option, option_names, option_svg
from neuralq.runs.report.outcome import sentence
from neuralq.runs.report.page import Page, flatten, html_table, short_number, tiles

__all__ = ["write_sweep_report"]

_MOST_CURVES = 8
_MOST_LINES = 100


def write_sweep_report(sweep_dir: str | Path) -> Path:
    """Writes ``report.html`` into the folder of a sweep and returns its path; seeds that are not there yet are named.

    Raises:
        RunFolderError: no seed has been evaluated yet.
        MissingExtra: matplotlib is not installed.
    """
    folder = Path(sweep_dir)
    groups, left_out = read_groups([folder])
    config = read_config(groups[0].runs[0].path)
    env = str(config.get("env") or folder.resolve().name)
    count = sum(len(group.runs) for group in groups)
    several = len(groups) > 1
    page = Page(f"{env}: {count} {'runs' if several else 'seeds'}", lead=_lead(config))
    ordered = sorted(groups, key=lambda group: -group.estimate.iqm)
    page.table(_combinations(ordered) if several else tiles(_tiles(groups[0])))
    for line in left_out[:_MOST_LINES]:
        page.paragraph(line, warning=True)
    if len(left_out) > _MOST_LINES:
        page.paragraph(f"and {len(left_out) - _MOST_LINES:,} more without a greedy evaluation", warning=True)
    for name in option_names(groups) if several else ():
        page.heading(f"By {name}")
        beside = " over all values of the others" if len(option_names(groups)) > 1 else ""
        page.figure(
            option_svg(by_option(groups, name), name), f"Return of the agents by {name}{beside}; a dot is a run."
        )
    page.heading("Learning curves")
    drawn = f" The best {_MOST_CURVES} of {len(groups)} combinations." if len(groups) > _MOST_CURVES else ""
    page.figure(
        comparison_svg(ordered[:_MOST_CURVES]),
        f"Greedy return: interquartile mean over seeds, with its 95 % interval where there are several.{drawn}",
    )
    page.heading("Seeds")
    for group in ordered[:_MOST_LINES]:
        if several:
            page.folded(group.label, _seeds(group, folder))
        else:
            page.table(_seeds(group, folder))
    return page.write(folder / "report.html")


def _combinations(groups: Sequence[Group]) -> str:
    """Combinations of values, the best first."""
    rows = []
    for group in groups[:_MOST_LINES]:
        found = group.estimate
        known = found.low is not None and found.high is not None
        interval = f"{short_number(found.low or 0.0)} to {short_number(found.high or 0.0)}" if known else "one seed"
        spread = f"{short_number(min(group.returns))} to {short_number(max(group.returns))}"
        seconds = short_number(sum(run.cpu_seconds for run in group.runs))
        rows.append((group.label, short_number(found.iqm), interval, spread, str(len(group.runs)), seconds))
    caption = "Interquartile mean over seeds. The best of many is flattered: confirm it on seeds that did not choose it"
    heads = ("options", "return", "95 % interval", "lowest and highest", "seeds", "CPU-seconds")
    return html_table(f"{caption}.", heads, rows)


def _lead(config: Mapping[str, Any]) -> str:
    gamma, learns = as_float(config.get("gamma")), algorithm_in(dict(flatten(config)))
    parts = [*([learns] if learns else []), *([f"γ = {gamma:g}"] if math.isfinite(gamma) else [])]
    told = f" {sentence(', '.join(parts))}" if parts else ""
    return f"Each seed is a run of its own; none was chosen.{told} Numbers have four digits."


def _tiles(group: Group) -> list[tuple[str, str, str]]:
    found, steps = group.estimate, max(run.env_steps for run in group.runs)
    seconds = sum(run.cpu_seconds for run in group.runs)
    interval = "one seed"
    if found.low is not None and found.high is not None:
        interval = f"95 % interval {short_number(found.low)} to {short_number(found.high)}"
    spread = f"{short_number(min(group.returns))} to {short_number(max(group.returns))}"
    return [
        (
            "return of the agents",
            short_number(found.iqm),
            f"interquartile mean over {len(group.runs)} seeds, {interval}",
        ),
        ("lowest and highest seed", spread, "greedy return of the agent"),
        ("environment steps", f"{steps:,}", f"of the longest run; {short_number(seconds)} CPU-seconds in all"),
    ]


def _seeds(group: Group, folder: Path) -> str:
    """A table whose seeds lead to their own pages, where those have been written."""
    body = ""
    for run in sorted(group.runs, key=lambda one: one.seed):
        page, name = run.path / "report.html", f"seed {run.seed}"
        where = escape(os.path.relpath(page, folder), quote=True)
        told = f'<a href="{where}">{name}</a>' if page.exists() else name
        cells = (
            _with_error(run.score),
            short_number(run.returns[-1]),
            short_number(run.returns.max()),
            f"{run.env_steps:,}",
            short_number(run.cpu_seconds),
        )
        body += f'<tr><th scope="row">{told}</th>' + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>\n"
    heads = ("", "return of the agent", "last evaluation", "best evaluation", "environment steps", "CPU-seconds")
    head = "".join(f'<th scope="col">{one}</th>' for one in heads)
    return f'<div class="scroll"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody>\n</table></div>'


def _with_error(score: Score) -> str:
    error = "" if score.standard_error is None else f" ± {short_number(score.standard_error, 2)}"
    return f"{short_number(score.mean)}{error}{' (best parameters)' if score.agent == 'best' else ''}"

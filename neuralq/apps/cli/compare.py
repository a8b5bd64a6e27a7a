"""``neuralq compare``: runs and sweeps side by side, as a table and as a plot."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.sweeps import refuse_other_kinds
from neuralq.runs.evaluation import shown
from neuralq.runs.report.comparison import Group, comparison_png, comparison_svg, read_groups
from neuralq.runs.report.options import by_option, option_png, option_svg
from neuralq.runs.report.page import format_value

__all__ = ["compare"]

_FORMATS = {".svg", ".png"}
_HEADINGS = ("run", "", "greedy return", "95 % interval", "mean", "steps", "CPU s")


def compare(argv: list[str]) -> int:
    """Compare the greedy returns of the agents of runs, grouped over their seeds."""
    parser = command_parser(
        "compare",
        "Compare runs and sweeps. Runs that differ in their seed alone are one row: the interquartile mean of what "
        "their agents score and its 95 % interval (stratified bootstrap, Agarwal et al. 2021).",
        "neuralq compare runs/* --out curves.svg",
        "neuralq compare SWEEP-A SWEEP-B --json",
        "neuralq compare runs/rates --by learning_rate --out rates.png",
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders and sweep folders")
    parser.add_argument("--out", metavar="FILE", help="also draw the learning curves into this .svg or .png file")
    parser.add_argument(
        "--by", metavar="OPTION", help="one row for each value of this option, over all the others' (stratified)"
    )
    options = parser.parse_args(argv)
    out = None if options.out is None else Path(options.out)
    if out is not None and out.suffix.lower() not in _FORMATS:
        raise Failure(f"--out must end in .svg or .png, got {options.out!r}", 2)
    for path in options.runs:
        refuse_other_kinds(path)
    groups, left_out = _grouped(options)
    for reason in left_out:
        print(f"neuralq: left out: {reason}", file=sys.stderr)
    if out is not None:
        _draw(groups, out, options.by)
    if not options.json:
        _print(groups, "seeds" if options.by is None else "runs")
    plain = {"groups": [group.plain() for group in groups], "left_out": left_out, "out": options.out}
    drawn = "learning curves" if options.by is None else "picture"
    print_result(plain, options.json, [] if out is None else [f"{drawn}: {out}"])
    return 0


def _grouped(options: argparse.Namespace) -> tuple[list[Group], list[str]]:
    groups, left_out = read_groups(options.runs)
    if options.by is None:
        return groups, left_out
    try:
        return by_option(groups, options.by), left_out
    except ValueError as error:
        raise Failure(f"--by: {error}", 2) from error


def _draw(groups: Sequence[Group], out: Path, by: str | None) -> None:
    """The learning curves of each group; by an option what the agents score at each of its values."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix.lower() == ".png":
        out.write_bytes(comparison_png(groups) if by is None else option_png(groups, by))
    else:
        svg = comparison_svg(groups) if by is None else option_svg(groups, by)
        out.write_text(svg + "\n", encoding="utf-8")


def _print(groups: Sequence[Group], counted: str) -> None:
    # A pipe has no width of its own: wide enough for the table, so that nothing is cut.
    width = max(shutil.get_terminal_size((160, 24)).columns, 80)
    console = Console(highlight=False, width=width)
    names = list(dict.fromkeys(name for group in groups for name in group.settings))
    rows = [_numbers(group) for group in groups]
    settings = [[format_value(group.settings.get(name)) for name in names] for group in groups]
    beside = _width([[*_HEADINGS, *names], *map(list.__add__, rows, settings)]) <= width
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in _HEADINGS:
        table.add_column(
            heading or counted, **({"overflow": "fold"} if heading == "run" else {"justify": "right", "no_wrap": True})
        )
    for name in names if beside else ():
        table.add_column(escape(name.rstrip("_")), overflow="fold")
    for row, own in zip(rows, settings, strict=True):
        table.add_row(*map(escape, [*row, *(own if beside else ())]))
    console.print(table)
    if not beside:  # runs of different learners differ in dozens of settings
        for group in groups:
            console.print(escape(f"{group.name}: {_in_words(group)}"), soft_wrap=True)


def _numbers(group: Group) -> list[str]:
    """The cells below `_HEADINGS`."""
    found = group.estimate
    return [
        group.name,
        str(len(group.runs)),
        shown(found.iqm),
        "–" if found.low is None or found.high is None else f"{shown(found.low)} … {shown(found.high)}",
        shown(sum(group.returns) / len(group.runs)),
        _spread([run.env_steps for run in group.runs]),
        _spread([run.cpu_seconds for run in group.runs]),
    ]


def _width(rows: Sequence[Sequence[str]]) -> int:
    """Characters that a table with these rows takes."""
    return sum(max(map(len, column)) + 2 for column in zip(*rows, strict=True))


def _in_words(group: Group) -> str:
    own = {name: value for name, value in group.settings.items() if value is not None}
    return ", ".join(f"{name.rstrip('_')} {format_value(value)}" for name, value in own.items())


def _spread(values: Sequence[float]) -> str:
    """One number, or the smallest and the largest."""
    low, high = min(values), max(values)
    words = [f"{value:,}" if isinstance(value, int) else f"{value:.1f}" for value in (low, high)]
    return words[0] if words[0] == words[1] else "–".join(words)

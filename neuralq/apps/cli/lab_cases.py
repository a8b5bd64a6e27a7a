"""``neuralq lab diagnose``, ``critical``, ``prescribe`` and ``run``: one problem at a time."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from neuralq.apps.cli import Failure, command_parser
from neuralq.apps.cli.lab import Parser, add_problem, chosen_problem, show, spelled
from neuralq.lab import CRITICAL_PARAMETERS, METHODS, Diagnosis, NoBoundary, Remedy, StabilityScan, Trial, scan
from neuralq.lab import diagnose as diagnosis_of
from neuralq.lab import prescribe as remedies_of
from neuralq.lab import run as run_of
from neuralq.lab.comparison import NEUTRAL_BAND, outcome_of
from neuralq.lab.verdicts.remedies import usual_method

__all__ = ["COLOURS", "critical", "diagnose", "prescribe", "run"]

COLOURS = {
    "converges": "green",
    "settles": "green",
    "diverges": "red",
    "grows": "red",
    "mean-stable but variance diverges": "magenta",
    "stable but poor fixed point": "yellow",
    "chatters": "yellow",
    "keeps moving": "yellow",
    "neutral": "cyan",
}
"""Of verdicts and outcomes."""

_SAMPLINGS = ("expected", "iid", "markov")
_ROWS = 12  # of a run's table
_REMEDIES_LEGEND = (
    "updates: until the slowest error is a tenth; error: RMS of the fixed point, and the least possible; runs: whether "
    "single ones settle. --explain tells each in full."
)


def _with_method(parser: Parser, argv: list[str]) -> tuple[argparse.Namespace, dict[str, float]]:
    """The arguments, among them the options of the method that they name."""
    parser.add_argument(
        "--method", default="td", choices=[one.name for one in METHODS], metavar="METHOD",
        help="a name from `neuralq lab list` (default: td); its options follow by name, as in --lambda 0.9",
    )  # fmt: skip
    early = Parser(add_help=False, allow_abbrev=False)
    early.add_argument("--method", default="td")
    name = early.parse_known_args(argv)[0].method
    own = next((one.options for one in METHODS if one.name == name), {})
    group = parser.add_argument_group(f"options of {name}")
    for option, kind in own.items():
        text = f"{kind.label}: {kind.range_text} (default: {kind.default:g})"
        group.add_argument(f"--{spelled(option)}", dest=f"method_{option}", type=float, metavar="X", help=text)
    options = parser.parse_args(argv)
    given = {option: getattr(options, f"method_{option}") for option in own}
    return options, {option: value for option, value in given.items() if value is not None}


def diagnose(argv: list[str]) -> int:
    """Say what a method will do on a problem."""
    parser = command_parser(
        "lab diagnose",
        "What a method will do on a problem, before it is trained: verdict, growth, step-size bounds, fixed point.",
        "neuralq lab diagnose baird",
        "neuralq lab diagnose baird --method td --lambda 0.95 --sampling markov",
        "neuralq lab diagnose kolter --method polyak-target --tau 0.01 --step-size 0.05",
    )
    add_problem(parser, step_size="the problem's own")
    parser.add_argument("--sampling", default="expected", choices=_SAMPLINGS, help="of updates (default: expected)")
    options, given = _with_method(parser, argv)
    problem = chosen_problem(options)
    with Console(file=sys.stderr).status("looking for eigenvalues and bounds"):
        found = diagnosis_of(problem, options.method, options.step_size, options.sampling, **given)
    show(options.json, found.plain(), _headline(found), found.explain(), _numbers(found))
    return 0


def _headline(found: Diagnosis) -> Text:
    title = Text.assemble((found.verdict, f"bold {COLOURS[found.verdict]}"), f"   {found.method} on {found.problem}")
    return title.append(f", α = {found.step_size:g}, {found.sampling} updates", "dim")


def _numbers(found: Diagnosis) -> Table:
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    leading = ", ".join(_complex(value) for value in found.eigenvalues[:4])
    rows = {
        "spectral radius": f"{found.spectral_radius:.9g}" + (f" per {found.updates} updates" * (found.updates > 1)),
        "leading factors": leading + (f", … ({len(found.eigenvalues)} in all)" * (len(found.eigenvalues) > 4)),
        "second moment": _number(found.second_moment_radius),
        "step sizes below": _bound(found.step_size_bound),
        "with variance": _bound(found.step_size_bound_second_moment),
        "doubles in": "" if found.doubling_time is None else f"{found.doubling_time:.4g} updates",
        "error of fixed point": _error(found.rounded(found.fixed_point_error)),
        "least error": _error(found.rounded(found.best_error)),
    }
    for name, text in rows.items():
        if text not in ("", "?"):
            table.add_row(Text(name, "dim"), text)
    return table


def _complex(value: complex) -> str:
    if abs(value.imag) < 1e-12:
        return f"{value.real:.6g}"
    return f"{value.real:.6g}{value.imag:+.3g}i"


def _bound(value: float | None) -> str:
    return "none" if value == 0 else _number(value)


def _number(value: float | None) -> str:
    return "" if value is None else "any" if value == float("inf") else f"{value:.7g}"


def critical(argv: list[str]) -> int:
    """Find where stability changes in one parameter."""
    parameters = {spelled(name): name for name in CRITICAL_PARAMETERS}
    parser = command_parser(
        "lab critical",
        "The values of a parameter at which stability changes, from a scan of its whole range.",
        "neuralq lab critical baird --parameter lambda",
        "neuralq lab critical baird --parameter period --step-size 0.01",
    )
    add_problem(parser, step_size="the limit of small steps, where the method has one")
    parser.add_argument(
        "--parameter", required=True, type=spelled, choices=list(parameters), metavar="P",
        help=f"one of {', '.join(parameters)}",
    )  # fmt: skip
    options, given = _with_method(parser, argv)
    problem = chosen_problem(options)
    with Console(file=sys.stderr).status(f"scanning {options.parameter}"):
        found = scan(problem, parameters[options.parameter], options.method, options.step_size, None, **given)
    show(options.json, found.plain(), *_boundary_lines(found))
    try:
        found.first()
    except NoBoundary as nothing_changes:
        raise Failure(str(nothing_changes)) from nothing_changes
    return 0


def _boundary_lines(found: StabilityScan) -> Iterator[Text]:
    if not found.boundaries:
        return
    how = "in the limit of small steps" if found.step_size is None else f"with α = {found.step_size:g}"
    head = f"{found.method} on {found.problem}, {how}: stability first changes at {found.parameter} = "
    yield Text.assemble(head, (f"{found.boundaries[0]:.12g}", "bold"))
    for low, high, stable in found.intervals:
        word, colour = ("converges", "green") if stable else ("diverges", "red")
        yield Text.assemble("  ", (f"{word:<10}", colour), f"{low:>14.9g} … {high:.9g}")


def prescribe(argv: list[str]) -> int:
    """Say what to change so that learning converges."""
    parser = command_parser(
        "lab prescribe",
        "What to change so that learning converges, the best remedy first, with what each costs.",
        "neuralq lab prescribe baird",
        "neuralq lab prescribe kolter --step-size 0.01",
    )
    add_problem(parser, step_size="the problem's own")
    parser.add_argument("--explain", action="store_true", help="a paragraph on each remedy instead of a table")
    options = parser.parse_args(argv)
    problem = chosen_problem(options)
    with Console(file=sys.stderr).status("trying every kind of remedy (some seconds)"):
        remedies = remedies_of(problem, options.step_size)
    trouble = diagnosis_of(problem, usual_method(problem), options.step_size)
    plain = {
        "problem": problem.name, "verdict": trouble.verdict, "converges": trouble.converges,
        "explanation": trouble.explain(), "remedies": [one.plain() for one in remedies],
    }  # fmt: skip
    parts: list[Any] = [_headline(trouble), trouble.explain()]
    if trouble.converges:
        parts.append("Nothing needs to be changed.")
    elif options.explain:
        parts += [Padding(f"{i}. {one.explain()}", (1, 0, 0, 0)) for i, one in enumerate(remedies, start=1)]
    elif remedies:
        parts += [_remedies(remedies), Text(_REMEDIES_LEGEND, "dim")]
    show(options.json, plain, *parts)
    if not trouble.converges and not remedies:
        raise Failure(f"no single change was found that makes {problem.name} converge at this step size")
    return 0


def _remedies(remedies: list[Remedy]) -> Table:
    table = Table("", "change", box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False, title="remedies, best first")
    table.title_justify = "left"
    for name in ("updates", "error", "least"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("runs", no_wrap=True)
    for i, one in enumerate(remedies, start=1):
        found, updates = one.diagnosis, one.updates_to_tenth
        runs = Text("scatter", "magenta") if one.scatters else "settle" if one.second_moment_radius is not None else "?"
        table.add_row(
            str(i), one.change, f"{updates:,.0f}" if updates < 1e6 else f"{updates:.2g}",
            _error(found.rounded(found.fixed_point_error)), _error(found.rounded(found.best_error)), runs,
        )  # fmt: skip
    return table


def _error(value: float | None) -> str:
    return "?" if value is None else f"{value:.3g}"


def run(argv: list[str]) -> int:
    """Train a method on a problem and hold the result against the diagnosis."""
    parser = command_parser(
        "lab run",
        "Train a method on a problem over many seeds, beside what the diagnosis says.",
        "neuralq lab run baird --num-steps 2000",
        "neuralq lab run baird --method etd --sampling markov --seeds 100",
    )
    add_problem(parser, step_size="the problem's own")
    parser.add_argument("--sampling", default="expected", choices=_SAMPLINGS, help="of updates (default: expected)")
    parser.add_argument("--num-steps", type=int, default=1000, metavar="N", help="updates (default: 1000)")
    parser.add_argument("--seeds", type=int, metavar="N", help="independent runs (default: 1 expected, else 20)")
    parser.add_argument("--seed", type=int, default=0, help="of all of them (default: 0)")
    options, given = _with_method(parser, argv)
    problem = chosen_problem(options)
    if problem.value is not None:
        raise Failure(
            f"the values of {problem.name} are not linear in its weights: `neuralq lab matrix` runs it by TD(0)"
        )
    seeds = options.seeds if options.seeds is not None else 1 if options.sampling == "expected" else 20
    with Console(file=sys.stderr).status(f"{options.num_steps:,} updates of {seeds} run{'s' * (seeds != 1)}"):
        record = run_of(
            problem, options.method, options.num_steps, options.step_size, options.sampling, seeds, options.seed, given
        )
        found = diagnosis_of(problem, options.method, options.step_size, "expected", **given)
    outcome, certain = outcome_of(record), options.sampling == "expected" and found.verdict != "neutral"
    wrong = certain and abs(found.spectral_radius - 1) > NEUTRAL_BAND and outcome == "grows" and found.converges
    plain = {
        **record.plain(), "outcome": outcome, "predicted": found.verdict, "spectral_radius": found.spectral_radius,
        "contradiction": wrong,
    }  # fmt: skip
    show(options.json, plain, _curve(record), *_outcome_lines(record, found))
    if wrong:
        raise Failure(f"the run {outcome}, but the prediction is that it {found.verdict}: please report this")
    return 0


def _curve(record: Trial) -> Table:
    one = record.rmsve.shape[1] == 1
    table = Table("update", "RMSVE", *([] if one else ["10% … 90%"]), "RMSPBE", *([] if one else ["diverged"]))
    for column in table.columns:
        column.justify = "right"
    last = len(record.steps) - 1
    errors, residuals = record.quantiles(), record.quantiles(of="rmspbe")
    for k in sorted({round(last * i / (_ROWS - 1)) for i in range(_ROWS)}):
        gone = int(((record.stopped_at >= 0) & (record.stopped_at <= record.steps[k])).sum())
        spread = [] if one else [f"{errors[k, 0]:.4g} … {errors[k, 2]:.4g}"]
        table.add_row(
            f"{record.steps[k]:,}",
            f"{errors[k, 1]:.6g}",
            *spread,
            f"{residuals[k, 1]:.4g}",
            *([] if one else [str(gone)]),
        )
    return table


def _outcome_lines(record: Trial, found: Diagnosis) -> list[Text]:
    outcome, num_seeds = outcome_of(record), len(record.stopped_at)
    left = int(record.diverged.sum())
    measured = Text.assemble("measured   ", (outcome, COLOURS[outcome]), f", ×{record.growth:.7g} per update")
    if left:
        measured.append(f"; {left} of {num_seeds} passed the cap of {record.cap:.0e}")
    per = f" per {found.updates} updates" if found.updates > 1 else " per update"
    predicted = Text.assemble(
        "predicted  ", (found.verdict, COLOURS[found.verdict]), f", ×{found.spectral_radius:.7g}{per} in the mean"
    )
    return [measured, predicted]

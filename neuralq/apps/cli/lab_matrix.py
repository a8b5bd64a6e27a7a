"""``neuralq lab matrix`` and ``neuralq lab baird``: what is predicted beside what is measured, cell by cell."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import chain, groupby
from multiprocessing import get_context
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from neuralq.apps.cli import Failure, command_parser
from neuralq.apps.cli.lab import Parser, show
from neuralq.apps.cli.lab_cases import COLOURS
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.checks import check_whole
from neuralq.lab import METHODS, PROBLEMS, Cell, Matrix, problem
from neuralq.lab import matrix as matrix_of
from neuralq.lab import method as method_named
from neuralq.lab.comparison import ABSENT, NEUTRAL_BAND
from neuralq.runs.children import safe_path

__all__ = ["baird", "matrix"]

_SIGNS = {
    "converges": "✓",
    "settles": "✓",
    "stable but poor fixed point": "p",
    "diverges": "✗",
    "grows": "✗",
    "chatters": "~",
    "keeps moving": "~",
    "neutral": "=",
}
_SHORT = {"stable but poor fixed point": "poor values"}
_LEGEND = (
    "Each cell: predicted, then measured.  ✓ converges  p converges to poor values  ✗ diverges  ~ moves for ever  "
    "= neutral"
)
_DETAILED = 60  # cells up to which each has a line of its own
_NAME_WIDTH = 22
_CELL_WIDTH = 3

Bar = ProgressBar[tuple[str, str, int, int]]


def matrix(argv: list[str]) -> int:
    """Every problem under every method."""
    options = _parser().parse_args(argv)
    problems = _names(options.problem, [entry.name for entry in PROBLEMS], problem)
    methods = _names(options.method, [one.name for one in METHODS], method_named)
    few = len(problems) * len(methods) <= _DETAILED
    options.workers = (1 if few else os.cpu_count() or 1) if options.workers is None else options.workers
    for name in ("seeds", "num_steps", "workers"):
        check_whole(f"--{name.replace('_', '-')}", getattr(options, name))
    sampled = {name: getattr(options, name) for name in ("sampling", "num_steps", "seed")}
    with _progress(len(problems) * len(methods)) as bar:
        found = _in_parallel(problems, methods, options.workers, bar, num_seeds=options.seeds, **sampled)
    if options.csv is not None:
        found.write_csv(options.csv)
    parts: list[RenderableType] = list(_lines(found.cells)) if options.list or few else list(_grids(found))
    show(
        options.json,
        found.plain(),
        *parts,
        *_findings(found),
        *([Text(f"table: {options.csv}")] if options.csv else []),
    )
    return _status(found)


def _parser() -> Parser:
    parser = command_parser(
        "lab matrix",
        "Every problem under every method: the verdict before a run and what the run does, side by side.\n"
        f"Nothing is claimed where the growth per step is within {NEUTRAL_BAND:g} of 1. Ends with status 1 if any two "
        "disagree.",
        "neuralq lab matrix",
        "neuralq lab matrix --problem baird --problem kolter --csv matrix.csv",
        "neuralq lab matrix --method td --method etd --sampling markov --seeds 20",
    )
    parser.add_argument("--problem", action="append", metavar="NAME", help="only this one; may be repeated")
    parser.add_argument("--method", action="append", metavar="NAME", help="only this one; may be repeated")
    parser.add_argument("--csv", metavar="FILE", help="also write one line per cell to this file")
    parser.add_argument("--list", action="store_true", help="one line per cell, with growths, instead of the grid")
    parser.add_argument(
        "--sampling", default="expected", choices=("expected", "iid", "markov"),
        help="iid or markov: also run from samples (default: expected updates only)",
    )  # fmt: skip
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="sampled runs per cell (default: 20)")
    parser.add_argument("--num-steps", type=int, default=2000, metavar="N", help="updates of each (default: 2000)")
    parser.add_argument("--seed", type=int, default=0, help="of the sampled runs (default: 0)")
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="processes to spread problems on (default: one per core for many cells)",
    )
    return parser


def _names(given: list[str] | None, every: list[str], lookup: Callable[[str], object]) -> list[str]:
    """What was asked for, in the order of the list; `lookup` refuses a name that is not there."""
    for name in given or []:
        if name not in every:
            lookup(name)
    return every if given is None else [name for name in every if name in given]


def _in_parallel(problems: list[str], methods: list[str], workers: int, bar: Bar, **sampled: Any) -> Matrix:
    """The matrix, its rows spread over processes."""
    if workers == 1 or len(problems) == 1:
        return matrix_of(problems, methods, lambda *at: bar(at), **sampled)
    rows = []
    with safe_path(), ProcessPoolExecutor(min(workers, len(problems)), mp_context=get_context("spawn")) as pool:
        waiting = [pool.submit(matrix_of, [name], methods, **sampled) for name in problems]
        for i, one in enumerate(waiting):
            rows.append(one.result())
            bar((problems[i], "", (i + 1) * len(methods), len(problems) * len(methods)))
    return Matrix(tuple(problems), tuple(methods), tuple(chain.from_iterable(row.cells for row in rows)))


def _progress(total: int) -> Bar:
    """A bar for cells, which are reported as problem, method, index and how many there are."""
    return ProgressBar(total, lambda at: Told(at[2], at[:2]))


def _grids(found: Matrix) -> Iterator[RenderableType]:
    """Two signs for each cell, predicted and measured, in as many blocks as the terminal's width asks for."""
    fit = max((Console().width - _NAME_WIDTH) // _CELL_WIDTH, 1)
    blocks = -(-len(found.methods) // fit)
    size = -(-len(found.methods) // blocks)
    for begin in range(0, len(found.methods), size):
        methods = found.methods[begin : begin + size]
        tall = max(map(len, methods))
        table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="")
        table.add_column("", no_wrap=True, min_width=_NAME_WIDTH - 1)
        for name in methods:
            table.add_column("\n".join(name.rjust(tall).replace("-", "¦")), no_wrap=True, vertical="bottom")
        for row in found.problems:
            table.add_row(row, *(_sign(found.cell(row, method)) for method in methods))
        yield table
        yield ""
    yield Text(_LEGEND)


def _sign(cell: Cell) -> Text:
    if cell.absent is not None:
        return Text(cell.absent[0], style="dim")
    assert cell.predicted is not None and cell.measured is not None
    style = "bold white on red" if cell.disagrees else "dim" if cell.neutral else ""
    both = ((name, style or COLOURS[name]) for name in (cell.predicted, cell.measured))
    return Text.assemble(*((_SIGNS[name], colour) for name, colour in both))


def _lines(cells: Sequence[Cell]) -> Iterator[RenderableType]:
    """A table for each problem with a line for each cell, with the numbers."""
    sampled = any(cell.sampled is not None or cell.sampled_absent is not None for cell in cells)
    for problem_name, group in groupby(cells, key=lambda cell: cell.problem):
        table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title=problem_name, title_justify="left")
        for name in ("method", "predicted", "ρ", "measured", *([] if sampled else ["× per update"])):
            table.add_column(name, no_wrap=True)
        if sampled:
            table.add_column("sampled")
        table.add_column("", no_wrap=True)
        for cell in group:
            table.add_row(*_line(cell, sampled))
        yield table


def _line(cell: Cell, sampled: bool) -> list[str | Text]:
    if cell.absent is not None:
        return [cell.method, Text(f"– {cell.absent}", "dim")]
    assert cell.predicted is not None and cell.measured is not None and cell.growth is not None
    mark = Text("disagrees", "bold red") if cell.disagrees else Text("neutral" if cell.neutral else "✓", "dim")
    return [
        cell.method,
        Text(_SHORT.get(cell.predicted, cell.predicted), COLOURS[cell.predicted]),
        _factor(cell.spectral_radius),
        Text(cell.measured, COLOURS[cell.measured]),
        _sampled(cell) if sampled else _factor(cell.growth),
        mark,
    ]


def _factor(value: float | None) -> str:
    return "" if value is None else f"{value:.7f}" if 0.1 < value < 10 else f"{value:.4g}"


def _sampled(cell: Cell) -> Text:
    one = cell.sampled
    if one is None:
        return Text(f"– {cell.sampled_absent}", "dim")
    text = Text(f"×{one.growth:.5g}")
    if one.num_diverged:
        text.append(f", {one.num_diverged}/{one.num_seeds} left", "red")
    if one.second_moment_radius is not None:
        text.append(f" (²{one.second_moment_radius:.5g})", "dim")
    return text


def _findings(found: Matrix) -> Iterator[RenderableType]:
    """Why cells are empty, what is not judged, and every disagreement."""
    words = {cell.absent for cell in found.cells} | {cell.sampled_absent for cell in found.cells}
    for word in (word for word in ABSENT if word in words):
        yield Text.assemble((word[0], "bold"), " ", (word, "bold"), f": {ABSENT[word]}")
    if any(cell.sampled is not None for cell in found.cells):
        yield Text("sampled: growth of the median error; seeds that left; ² growth of the mean square, predicted")
    judged = sum(cell.agree is not None for cell in found.cells)
    wrong = found.disagreements
    yield Text(
        f"{judged} predictions judged, {len(found.neutral)} not: neutral, undecided, or a growth per step within "
        f"{NEUTRAL_BAND:g} of 1.", "dim",
    )  # fmt: skip
    if not wrong:
        yield Text("No disagreement.", "bold green")
        return
    yield Text(f"{len(wrong)} disagree:", "bold red")
    yield from _lines(wrong)


def _status(found: Matrix) -> int:
    wrong = len(found.disagreements)
    if wrong:
        raise Failure(f"{wrong} of {len(found.cells)} cells disagree with their prediction")
    return 0


def baird(argv: list[str]) -> int:
    """The star from every side."""
    parser = command_parser(
        "lab baird",
        "Baird's star: what each representation will do under one update, what it does, and what each method makes\n"
        "of it. Ends with status 1 if a method does not do what was predicted.",
        "neuralq lab baird",
        "neuralq lab baird --gamma 0.85",
    )
    from neuralq.apps.cli.demo import add_star, show_star, star_console, star_of

    add_star(parser)
    options = parser.parse_args(argv)
    one = star_of(options)
    results = show_star(star_console(options), one, options.num_steps, options.seed)
    methods = [name.name for name in METHODS if name.rows != "pairs"]
    with _progress(len(methods)) as bar:
        found = matrix_of([one], methods, lambda *at: bar(at))
    plain = {"baird": [result.plain() for result in results], **found.plain()}
    show(options.json, plain, "", Text("what every method makes of the linear features", "bold"), *_lines(found.cells),
         *_findings(found))  # fmt: skip
    return _status(found)

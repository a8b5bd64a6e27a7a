"""``neuralq chapter``: the figures, exercises and systems of Mitchell 1997, chapter 13, computed and compared."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import textwrap
import time
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from neuralq.apps.chapter import PAGES, run_page
from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.apps.pages.html import page_html
from neuralq.apps.pages.svg import page_svg
from neuralq.apps.pages.text import drawing_lines, shown
from neuralq.figures import draw_svg
from neuralq.runs.report.claims import ChapterPage, Picture
from neuralq.systems import SYSTEMS, run_system, system_named

__all__ = ["chapter"]

_STYLES = {"agrees": "green", "differs": "bold red", "misprint": "yellow", "not reproduced": "yellow", "ours": "dim"}
_FOLDER = Path("runs") / "chapter"


def chapter(argv: list[str]) -> int:
    """List what there is, or run one of it and print its numbers beside the printed ones."""
    options = _read(argv)
    if options.page is None:
        return _list(options)
    written = options.html or (str(_FOLDER / f"{options.page}.html") if options.page in SYSTEMS else None)
    if written is not None:
        _make_room(Path(written))
    began = time.perf_counter()
    page = _run_system(options) if options.page in SYSTEMS else run_page(options.page)
    plain = {**page.plain(), "seconds": time.perf_counter() - began}
    if not options.json:
        _print(page)
    lines = []
    if options.svg is not None:
        Path(options.svg).write_text(page_svg(page), encoding="utf-8")
        plain["svg"] = options.svg
        lines.append(f"drawings: {options.svg}")
    if written is not None:
        page_html(page, shlex.join(["neuralq", "chapter", *argv])).write(Path(written))
        plain["html"] = written
        lines.append(f"page: {written}")
    print_result(plain, options.json, lines)
    if page.wrong:
        raise Failure(f"{options.page}: not reproduced: {'; '.join(page.wrong)}")
    return 0


def _read(argv: list[str]) -> argparse.Namespace:
    """The options, refused where they do not go with what is run."""
    parser = command_parser(
        "chapter",
        "Mitchell's chapter on reinforcement learning (Machine Learning, 1997, chapter 13), run: its figures and "
        "exercises as pages, and the systems that it names, trained from nothing with several seeds beside their "
        "baselines. Without a name, lists them. The exit status is 1 if a number that must come out does not; where an "
        "experiment that somebody published comes out otherwise here, that is said, and the status is 0.",
        "neuralq chapter",
        "neuralq chapter fig-13.2 --svg grid.svg",
        "neuralq chapter ase-ace",
        "neuralq chapter peng-williams --seeds 10 --html pole.html",
    )
    parser.add_argument("page", nargs="?", choices=(*PAGES, *SYSTEMS), metavar="NAME", help="which of them to run")
    parser.add_argument(
        "--svg", metavar="FILE", help="also write the drawings of a figure or exercise to this SVG file"
    )
    parser.add_argument(
        "--html", metavar="FILE", help=f"write a page to this file (a system's default: {_FOLDER}/NAME.html)"
    )
    parser.add_argument("--seeds", type=int, metavar="N", help="of a system: how many seeds (each has its own default)")
    parser.add_argument("--full", action="store_true", help="of a system: the original's size, which can take an hour")
    options = parser.parse_args(argv)
    if options.page is None and (options.svg is not None or options.html is not None):
        raise Failure("--svg and --html need a name, for example: neuralq chapter fig-13.2 --svg grid.svg", 2)
    if options.page not in SYSTEMS and (options.seeds is not None or options.full):
        what = "nothing is named" if options.page is None else f"{options.page} is none"
        raise Failure(f"--seeds and --full are for systems, and {what}; the systems are {', '.join(SYSTEMS)}", 2)
    if options.page in SYSTEMS and options.svg is not None:
        raise Failure(f"--svg is for figures and exercises; {options.page} writes a page: --html FILE", 2)
    if options.seeds is not None and options.seeds < 1:
        raise Failure(f"--seeds must be at least 1, got {options.seeds}", 2)
    return options


def _make_room(path: Path) -> None:
    """The folder that a page goes to; what cannot be written is said before anything is trained."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise Failure(f"{path} {'is a folder' if path.is_dir() else 'cannot be written'}; name a file: --html FILE", 2)


def _list(options: argparse.Namespace) -> int:
    tables = {
        "pages": {name: entry.summary for name, entry in PAGES.items()},
        "systems": {name: entry.summary for name, entry in SYSTEMS.items()},
    }
    width = 1 + max(map(len, (*PAGES, *SYSTEMS)))
    lines = [f"{name:<{width}} {summary}" for table in tables.values() for name, summary in table.items()]
    print_result(tables, options.json, lines)
    return 0


def _run_system(options: argparse.Namespace) -> ChapterPage:
    """Trained under a progress bar, which is made when it is known how much there is to do."""
    draw_svg("nothing", "", "", (1.0, 1.0), lambda figure: None)  # without matplotlib, said now and not at the end
    system = system_named(options.page)
    num_seeds = options.seeds or (system.full_num_seeds if options.full else system.num_seeds)
    total = num_seeds * len(system.contenders)
    bar = ProgressBar[tuple[int, str]](total, lambda at: Told(at[0], [at[1]], f"{at[0]} of {total} trainings"))
    with bar:
        return run_system(system, num_seeds, options.full, lambda finished, _, latest: bar((finished, latest)))


def _print(page: ChapterPage) -> None:
    # A pipe has no width of its own: wide enough for the tables, so that nothing is cut.
    width = min(shutil.get_terminal_size((120, 24)).columns, 120)
    console = Console(highlight=False, width=max(width, 60), soft_wrap=False)
    console.print(f"[bold]{page.title}[/bold] ({page.where})")
    for paragraph in page.text:
        console.print("\n" + textwrap.fill(paragraph, min(console.width, 100)), markup=False)
    for drawing in page.drawings:
        if not isinstance(drawing, Picture):
            print("\n" + "\n".join(drawing_lines(drawing)))  # not wrapped: a grid that is too wide is still a grid
    table = Table("", "expected", "ours", "", "", box=None, pad_edge=False, header_style="bold")
    for row in page.rows:
        style = _STYLES[row.verdict]
        verdict = "" if row.verdict == "ours" else f"[{style}]{row.verdict}[/{style}]"
        table.add_row(
            *map(escape, (row.what, shown(row.book), shown(row.ours))), verdict, f"[dim]{escape(row.note)}[/dim]"
        )
    console.print()
    console.print(table)

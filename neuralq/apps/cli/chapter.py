"""``neuralq chapter``: the figures, tables and exercises of Mitchell 1997, chapter 13, computed and compared."""

from __future__ import annotations

import shutil
import textwrap
import time
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from neuralq.apps.chapter import PAGES, run_page
from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.pages.page import ChapterPage
from neuralq.apps.pages.svg import page_svg
from neuralq.apps.pages.text import drawing_lines, shown

__all__ = ["chapter"]

_STYLES = {"agrees": "green", "differs": "bold red", "misprint": "yellow", "ours": "dim"}


def chapter(argv: list[str]) -> int:
    """List the pages, or run one and print its numbers beside the printed ones."""
    parser = command_parser(
        "chapter",
        "Mitchell's chapter on reinforcement learning (Machine Learning, 1997, chapter 13) as pages that "
        "run. Without a page, lists them. The exit status is 1 if a number of the book is not reproduced.",
        "neuralq chapter",
        "neuralq chapter fig-13.2 --svg grid.svg",
    )
    parser.add_argument("page", nargs="?", choices=tuple(PAGES), metavar="PAGE", help="which page to run")
    parser.add_argument("--svg", metavar="FILE", help="also write the page's drawings to this SVG file")
    options = parser.parse_args(argv)
    if options.page is None:
        if options.svg is not None:
            raise Failure("--svg needs a page, for example: neuralq chapter fig-13.2 --svg grid.svg", 2)
        lines = [f"{name:<12} {entry.summary}" for name, entry in PAGES.items()]
        print_result({"pages": {name: entry.summary for name, entry in PAGES.items()}}, options.json, lines)
        return 0
    began = time.perf_counter()
    page = run_page(options.page)
    plain = {**page.plain(), "seconds": time.perf_counter() - began}
    if options.svg is not None:
        Path(options.svg).write_text(page_svg(page), encoding="utf-8")
        plain["svg"] = options.svg
    if not options.json:
        _print(page)
    lines = [f"drawings: {options.svg}"] if options.svg is not None else []
    print_result(plain, options.json, lines)
    if not page.reproduced:
        wrong = [row.what for row in page.rows if row.verdict == "differs"]
        raise Failure(f"{options.page}: not reproduced: {'; '.join(wrong)}")
    return 0


def _print(page: ChapterPage) -> None:
    # A pipe has no width of its own: wide enough for the tables, so that nothing is cut.
    width = min(shutil.get_terminal_size((120, 24)).columns, 120)
    console = Console(highlight=False, width=max(width, 60), soft_wrap=False)
    console.print(f"[bold]{page.title}[/bold] (Mitchell 1997, {page.section})")
    for paragraph in page.text:
        console.print("\n" + textwrap.fill(paragraph, min(console.width, 100)), markup=False)
    for drawing in page.drawings:
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

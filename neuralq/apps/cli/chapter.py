"""``neuralq chapter``: the figures, exercises and systems of Mitchell 1997, chapter 13, computed and compared."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from neuralq.apps.chapter import PAGES, run_page
from neuralq.apps.chapter.site import ELSEWHERE, INDEX, SECTIONS, build_site, by_section, section_of, summary_of, taken
from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.apps.pages.html import page_html
from neuralq.apps.pages.svg import page_svg
from neuralq.apps.pages.text import drawing_lines, shown
from neuralq.figures import draw_svg
from neuralq.runs.report.claims import ChapterPage, Picture
from neuralq.systems import SYSTEMS, System, run_system, system_named

__all__ = ["chapter"]

_STYLES = {"agrees": "green", "differs": "bold red", "misprint": "yellow", "not reproduced": "yellow", "ours": "dim"}
_FOLDER = Path("runs") / "chapter"


def chapter(argv: list[str]) -> int:
    """List what there is, or run one of it and print its numbers beside the printed ones."""
    options = _read(argv)
    if options.all:
        return _build(options, argv)
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
        "baselines. Without a name, lists them section by section, with what each takes; --all makes all of them, "
        "as one linked site. The exit status is 1 if a number that must come out does not; where an "
        "experiment that somebody published comes out otherwise here, that is said, and the status is 0.",
        "neuralq chapter",
        "neuralq chapter fig-13.2 --svg grid.svg",
        "neuralq chapter ase-ace",
        "neuralq chapter peng-williams --seeds 10 --html pole.html",
        "neuralq chapter --all",
    )
    parser.add_argument("--all", action="store_true", help=f"make every page, linked, in a folder ({_FOLDER}/{INDEX})")
    parser.add_argument("page", nargs="?", choices=(*PAGES, *SYSTEMS), metavar="NAME", help="which of them to run")
    parser.add_argument(
        "--svg", metavar="FILE", help="also write the drawings of a figure or exercise to this SVG file"
    )
    parser.add_argument(
        "--html",
        metavar="FILE",
        help=f"write a page to this file (a system's default: {_FOLDER}/NAME.html); with --all, to this folder",
    )
    parser.add_argument("--seeds", type=int, metavar="N", help="of a system: how many seeds (each has its own default)")
    parser.add_argument("--full", action="store_true", help="of a system: the original's size, which can take an hour")
    options = parser.parse_args(argv)
    if options.all and (options.page is not None or options.svg is not None):
        raise Failure(f"--all makes every page; leave {options.page or '--svg'} out", 2)
    if options.page is None and not options.all and (options.svg is not None or options.html is not None):
        raise Failure("--svg and --html need a name, for example: neuralq chapter fig-13.2 --svg grid.svg", 2)
    if not options.all and options.page not in SYSTEMS and (options.seeds is not None or options.full):
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
    """Every page and system by section: what it shows, and what it takes."""
    names = (*PAGES, *SYSTEMS)
    tables = {
        kind: {name: {"shows": summary_of(name), "section": section_of(name), "takes": taken(name)} for name in table}
        for kind, table in (("pages", PAGES), ("systems", SYSTEMS))
    }
    width, wide = max(map(len, names)), max(len(summary_of(name)) for name in names)
    lines = []
    for section, some in by_section(names):
        lines += ["", f"{section} {SECTIONS[section]}"]
        if section in ELSEWHERE:
            other = ELSEWHERE[section]
            lines.append(f"  {other.command}: {other.summary} ({other.takes})")
        lines += [f"  {name:<{width}}  {summary_of(name):<{wide}}  {taken(name):>9}" for name in some]
    lines += ["", "Seconds are of one processor, once kernels are compiled; systems use all there are."]
    print_result(tables, options.json, lines[1:])
    return 0


def _build(options: argparse.Namespace, argv: list[str]) -> int:
    """The whole chapter as a site; status 1 if a number that must come out does not."""
    folder = Path(options.html or _FOLDER)
    if folder.exists() and not folder.is_dir():
        raise Failure(f"{folder} is a file; name a folder: --html FOLDER", 2)
    names = (*PAGES, *SYSTEMS)
    total = len(PAGES) + sum(_num_trainings(system_named(name), options) for name in SYSTEMS)
    before, name = 0, ""
    bar = ProgressBar[tuple[int, str]](total, lambda at: Told(at[0], [at[1]], f"{at[0]} of {total} steps"))

    def make(one: str) -> ChapterPage:
        nonlocal before, name
        name = one
        bar((before, name))
        if name in PAGES:
            page, amount = run_page(name), 1
        else:
            page = _trained(name, options, lambda finished, _, latest: bar((before + finished, f"{name}: {latest}")))
            amount = _num_trainings(system_named(name), options)
        before += amount
        return page

    with bar:
        made = build_site(folder, names, make, shlex.join(["neuralq", "chapter", *argv]))
    index = folder / INDEX
    facts = {one: {"verdict": found.verdict, "seconds": found.seconds} for one, found in made.items()}
    lines = [f"{one}: {found.verdict}" for one, found in made.items()]
    print_result({"index": str(index), "pages": facts}, options.json, [*lines, f"site: {index}"])
    wrong = [f"{one} ({', '.join(found.wrong)})" for one, found in made.items() if found.wrong]
    if wrong:
        raise Failure(f"not reproduced: {'; '.join(wrong)}")
    return 0


def _run_system(options: argparse.Namespace) -> ChapterPage:
    """Trained under a progress bar, which is made when it is known how much there is to do."""
    total = _num_trainings(system_named(options.page), options)
    bar = ProgressBar[tuple[int, str]](total, lambda at: Told(at[0], [at[1]], f"{at[0]} of {total} trainings"))
    with bar:
        return _trained(options.page, options, lambda finished, _, latest: bar((finished, latest)))


def _num_trainings(system: System[Any], options: argparse.Namespace) -> int:
    return _num_seeds(system, options) * len(system.contenders)


def _num_seeds(system: System[Any], options: argparse.Namespace) -> int:
    return options.seeds or (system.full_num_seeds if options.full else system.num_seeds)


def _trained(name: str, options: argparse.Namespace, tell: Callable[[int, int, str], None]) -> ChapterPage:
    draw_svg("nothing", "", "", (1.0, 1.0), lambda figure: None)  # without matplotlib, said now and not at the end
    system = system_named(name)
    return run_system(system, _num_seeds(system, options), options.full, tell)


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

"""The whole chapter as a folder of linked pages: every figure, exercise and system, and a page that lists them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import NamedTuple

from neuralq.apps.chapter import PAGES
from neuralq.apps.pages.html import page_html
from neuralq.runs.report.claims import ChapterPage
from neuralq.runs.report.page import Page
from neuralq.systems import SYSTEMS

__all__ = ["ELSEWHERE", "INDEX", "SECTIONS", "Made", "build_site", "by_section", "section_of", "summary_of", "taken"]

INDEX = "index.html"
SECTIONS = {
    "13.1": "introduction",
    "13.2": "the learning task",
    "13.3": "Q-learning",
    "13.4": "worlds that leave things to chance",
    "13.5": "temporal differences",
    "13.6": "networks in place of a table",
    "13.7": "dynamic programming",
    "13.8": "the systems that the chapter points to",
}
"""Sections of Mitchell 1997, chapter 13, in words of ours."""


class Elsewhere(NamedTuple):
    """Another command that shows what a section is about, what it shows in one line, and what it takes."""

    command: str
    summary: str
    takes: str


ELSEWHERE = {
    "13.1": Elsewhere("neuralq train td-gammon --games 100000", "backgammon, learned by self-play", "90 s"),
    "13.4": Elsewhere("neuralq train FrozenLake-v1 --learner tabular", "Q-learning where moves slip", "3 s"),
    "13.6": Elsewhere("neuralq train CartPole-v1 --layout separate", "one of the chapter's three layouts", "15 s"),
    "13.7": Elsewhere("neuralq solve FrozenLake-v1 --gamma 0.95", "the same values, computed", "2 s"),
}
"""Of sections that have no page."""

_STYLE = """
.contents { width: 100%; }
.contents th[scope=row] { white-space: nowrap; }
.contents td:nth-of-type(2), .contents td:nth-of-type(3) { color: var(--soft); white-space: nowrap; }
.contents .wrong { color: var(--warn); font-weight: 600; }
@media (max-width: 30rem) {
  .contents td:nth-of-type(2) { white-space: normal; }
  .contents td:nth-of-type(3) { display: none; }
}
"""


@dataclass(frozen=True)
class Made:
    """A page that has been made.

    Args:
        title: of the page.
        num_agreeing: claims that came out.
        num_claims: claims that were made.
        wrong: what had to come out and did not.
        seconds: what it took, on this machine.
    """

    title: str
    num_agreeing: int
    num_claims: int
    wrong: tuple[str, ...]
    seconds: float

    @property
    def verdict(self) -> str:
        """In a few words.

        Example:
            >>> Made("t", 3, 4, (), 1.0).verdict, Made("t", 3, 4, ("V*",), 1.0).verdict
            ('3 of 4 come out', 'wrong: V*')
        """
        if self.wrong:
            return f"wrong: {', '.join(self.wrong)}"
        return f"{self.num_agreeing} of {self.num_claims} come out" if self.num_claims else "measured"


def section_of(name: str) -> str:
    """The section that a page or system belongs to.

    Example:
        >>> section_of("sweeping"), section_of("ase-ace")
        ('13.3', '13.8')
    """
    section = PAGES[name].section if name in PAGES else SYSTEMS[name].section
    return ".".join(section.split(".")[:2])


def by_section(names: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Sections in their order, each with those of the names that belong to it, in theirs."""
    for section in SECTIONS:
        yield section, [name for name in names if section_of(name) == section]


def summary_of(name: str) -> str:
    """What a page or system shows, in one line."""
    return PAGES[name].summary if name in PAGES else SYSTEMS[name].summary


def taken(name: str) -> str:
    """What it takes by default, in CPU-seconds, compiled kernels at hand.

    Example:
        >>> taken("fig-13.3")
        'under 1 s'
    """
    seconds = PAGES[name].seconds if name in PAGES else SYSTEMS[name].seconds
    return "under 1 s" if seconds < 1 else f"{seconds} s"


def build_site(
    folder: Path,
    names: Sequence[str],
    make: Callable[[str], ChapterPage],
    command: str,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Made]:
    """Make page after page; the list of them is written anew after each, so that a site that was stopped can be read.

    Args:
        folder: where the pages go, ``NAME.html`` and `INDEX`; it is made if it is not there.
        names: of `PAGES` and `SYSTEMS`, in the order in which they are read.
        make: what makes one.
        command: what makes the site again.
        clock: tells the time in seconds.

    Returns:
        What came of each, by name.
    """
    order = [name for _, some in by_section(names) for name in some]
    made: dict[str, Made] = {}
    _index(order, made, command).write(folder / INDEX)
    for i, name in enumerate(order):
        began = clock()
        page = make(name)
        html = page_html(page, f"neuralq chapter {name}")
        html.links = [("The chapter", INDEX)]
        html.links += [(f"← {order[i - 1]}", f"{order[i - 1]}.html")] if i > 0 else []
        html.links += [(f"{order[i + 1]} →", f"{order[i + 1]}.html")] if i + 1 < len(order) else []
        html.write(folder / f"{name}.html")
        claims = [row for row in page.rows if row.verdict != "ours"]
        agreeing = [row for row in claims if row.verdict in ("agrees", "misprint")]
        made[name] = Made(page.title, len(agreeing), len(claims), tuple(page.wrong), clock() - began)
        _index(order, made, command).write(folder / INDEX)
    return made


def _index(order: Sequence[str], made: Mapping[str, Made], command: str) -> Page:
    page = Page("Reinforcement learning, run", "Mitchell, Machine Learning (1997), chapter 13", _STYLE)
    page.paragraph(
        "Every figure and exercise of the chapter with its numbers beside those that are computed here, and the "
        "systems that it points to, trained from nothing with several seeds beside their baselines. What "
        "was published and did not come out is said on its page."
    )
    for section, names in by_section(order):
        page.heading(f"{section} {SECTIONS[section]}")
        if section in ELSEWHERE:
            other = ELSEWHERE[section]
            page.paragraph(f"{other.command}: {other.summary}; it takes {other.takes}.")
        if not names:
            continue
        rows = "\n".join(_row(name, made.get(name)) for name in names)
        page.table(f'<div class="scroll"><table class="contents"><tbody>\n{rows}\n</tbody></table></div>')
    waiting = len(order) - len(made)
    page.paragraph(f"Made by {command}." if not waiting else f"{waiting} pages are still to be made, by {command}.")
    return page


def _row(name: str, made: Made | None) -> str:
    title = escape(name) if made is None else f'<a href="{escape(name)}.html">{escape(name)}</a>'
    verdict = "" if made is None else escape(made.verdict)
    kind = ' class="wrong"' if made is not None and made.wrong else ""
    seconds = "" if made is None else f"{made.seconds:.0f} s" if made.seconds >= 1 else "under 1 s"
    return (
        f'<tr><th scope="row">{title}</th><td>{escape(summary_of(name))}</td><td{kind}>{verdict}</td>'
        f"<td>{seconds}</td></tr>"
    )

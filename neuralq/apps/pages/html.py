"""A page of the chapter as one HTML file that loads nothing and runs nothing: what was found, in words and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import neuralq
from neuralq.apps.pages.svg import page_svg
from neuralq.apps.pages.text import shown
from neuralq.runs.report.claims import ChapterPage, Chart, GridDrawing, Picture, Row
from neuralq.runs.report.page import Page, facts_table, html_table
from neuralq_envs.pole_film import FILM_STYLE

__all__ = ["page_html"]

_STYLE = """
.claims { width: 100%; }
.claims th[scope=row] { width: 45%; font-weight: 400; }
.claims .note { display: block; color: var(--soft); font-size: .85rem; }
.claims .agrees, .claims .misprint { color: var(--soft); white-space: nowrap; }
.claims .differs, .claims .not-reproduced { color: var(--warn); }
"""

_SIGNS = {"agrees": "✓ agrees", "differs": "✗ differs", "misprint": "misprint", "not reproduced": "✗ not reproduced"}


def page_html(page: ChapterPage, command: str) -> Page:
    """The page, to be written.

    Args:
        page: what was found.
        command: what makes it again.

    Example:
        >>> page = ChapterPage("p", "A title", "13.2", ("What was found.",), (Row("V*", 90.0, 90.0, "agrees"),))
        >>> html = page_html(page, "neuralq chapter p").html()
        >>> "A title" in html and "✓ agrees" in html and "neuralq chapter p" in html
        True
    """
    made = Page(page.title, page.where, _STYLE + FILM_STYLE)
    first, *rest = page.text or ("",)
    made.paragraph(first)
    pictures = [one for one in page.drawings if isinstance(one, Picture)]
    for picture in pictures[:1]:
        made.heading(picture.title)
        made.figure(picture.svg, picture.caption)
    for paragraph in rest:
        made.paragraph(paragraph)
    made.heading("What was claimed, and what came out")
    made.table(_claims([row for row in page.rows if row.verdict != "ours"]))
    for picture in pictures[1:]:
        made.heading(picture.title)
        made.figure(picture.svg, picture.caption)
    drawn = tuple(one for one in page.drawings if isinstance(one, GridDrawing | Chart))
    if drawn:
        svg = page_svg(ChapterPage(page.page, page.title, page.section, (), (), drawn))
        made.figure(svg.replace("<svg ", '<svg class="figure" ', 1), "; ".join(one.title for one in drawn))
    ours = [row for row in page.rows if row.verdict == "ours"]
    if ours:
        made.heading("Measured beside it")
        made.table(_numbers(ours))
    made.heading("What it is made of")
    made.table(facts_table({**page.facts, "made by": command, "version": f"neuralq {neuralq.__version__}"}))
    if page.measured:
        made.folded("Every seed", _seeds(page))
    return made


def _claims(rows: Sequence[Row]) -> str:
    """What was claimed, beside what came out; remarks stand below, so that it fits on a phone."""
    body = "\n".join(
        f"<tr>{_name(row)}<td>{escape(shown(row.book))}</td><td>{escape(shown(row.ours))}</td>"
        f'<td class="{row.verdict.replace(" ", "-")}">{_SIGNS[row.verdict]}</td></tr>'
        for row in rows
    )
    head = "".join(f'<th scope="col">{name}</th>' for name in ("", "claimed", "ours", ""))
    return (
        f'<div class="scroll"><table class="claims">\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def _numbers(rows: Sequence[Row]) -> str:
    body = "\n".join(f"<tr>{_name(row)}<td>{escape(shown(row.ours))}</td></tr>" for row in rows)
    return f'<div class="scroll"><table class="claims"><tbody>\n{body}\n</tbody></table></div>'


def _name(row: Row) -> str:
    note = f'<span class="note">{escape(row.note)}</span>' if row.note else ""
    return f'<th scope="row">{escape(row.what)}{note}</th>'


def _seeds(page: ChapterPage) -> str:
    rows = [
        [one.what, str(one), " ".join(f"{value:.4g}" for value in one.values)] for one in page.measured
    ]  # fmt: skip
    return html_table("by seed, in their order", ("", "median [95 %]", "values"), rows)

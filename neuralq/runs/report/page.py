"""A small HTML5 page: escaped text, tables, figures, one style sheet inside; it loads nothing and runs nothing."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from neuralq.runs.folder.files import write_durably

__all__ = ["Page", "facts_table", "flatten", "format_number", "format_value", "html_table", "short_number", "tiles"]

_STYLE = """
:root {
  color-scheme: light dark;
  --page: #ffffff; --card: #f6f7f9; --ink: #1b1f24; --soft: #525a63; --line: #dfe3e8;
  --warn: #d55e00; --warn-back: #fdf3ec;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #14171a; --card: #1d2126; --ink: #e8ebee; --soft: #a9b2bb; --line: #3d454d;
    --warn: #ff8a4c; --warn-back: #3a2013;
  }
  svg.figure { filter: invert(1) hue-rotate(180deg); } /* ink and grid of the figures, which have no ground */
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 1rem/1.55 system-ui, sans-serif; }
main, header, footer, nav { max-width: 46rem; margin: 0 auto; padding: 0 1rem; }
header { padding-top: 1.5rem; }
nav { display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; padding-top: .8rem; padding-bottom: .4rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .25rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .5rem; }
p { margin: .6rem 0; max-width: 40rem; overflow-wrap: anywhere; }
.lead { color: var(--soft); }
.warning { border-left: .3rem solid var(--warn); padding: .4rem .8rem; background: var(--warn-back); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(13rem, 1fr)); gap: .6rem; margin: 1rem 0; }
.tiles div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .5rem .8rem; }
.tiles dt { color: var(--soft); font-size: .9rem; }
.tiles dd { margin: 0; overflow-wrap: anywhere; }
.tiles dd:nth-of-type(1) { font-size: 1.35rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.tiles dd:nth-of-type(2) { color: var(--soft); font-size: .85rem; }
figure { margin: 1rem 0; }
figcaption { color: var(--soft); font-size: .92rem; }
svg.figure { display: block; width: 100%; height: auto; }
.film { display: grid; grid-template-columns: repeat(auto-fill, minmax(9rem, 1fr)); gap: .5rem; }
.film img { display: block; width: 100%; height: auto; border: 1px solid var(--line); border-radius: 4px; }
.film small { color: var(--soft); }
.scroll { overflow-x: auto; margin: .3rem 0 .8rem; }
table { border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }
.scroll th[scope="row"] { min-width: 4.5rem; }
.caption { color: var(--soft); font-size: .92rem; margin-bottom: 0; }
th, td { text-align: left; vertical-align: top; padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line); }
th { font-weight: 600; }
.facts td { overflow-wrap: anywhere; }
.facts th { min-width: 8rem; }
a { color: inherit; }
summary { cursor: pointer; font-weight: 600; margin: 1.4rem 0 .4rem; }
footer { color: var(--soft); font-size: .85rem; padding-top: 1.5rem; padding-bottom: 2rem; }
@media print { details > * { display: block; } .scroll { overflow: visible; } }
"""


@dataclass(slots=True)
class Page:
    """A page put together from top to bottom; every text is escaped, only figures and tables go in as they are.

    Args:
        title: of the document.
        lead: a sentence below it.
        style: more of a style sheet, put after the page's own.
        links: to other pages, each its words and its address; above and below everything else.

    Example:
        >>> page = Page("Run <1>")
        >>> page.paragraph("a & b")
        >>> "Run &lt;1&gt;" in page.html() and "a &amp; b" in page.html()
        True
    """

    title: str
    lead: str = ""
    style: str = ""
    links: Sequence[tuple[str, str]] = ()
    _body: list[str] = field(default_factory=list)
    _has_pictures: bool = False

    def heading(self, text: str) -> None:
        """A section's heading."""
        self._body.append(f"<h2>{escape(text)}</h2>")

    def paragraph(self, text: str, *, warning: bool = False) -> None:
        """A paragraph of plain text, set apart when it is a warning."""
        self._body.append(f'<p class="warning" role="note">{escape(text)}</p>' if warning else f"<p>{escape(text)}</p>")

    def figure(self, svg: str, caption: str) -> None:
        """An SVG element with a caption."""
        self._body.append(
            f'<figure>\n<div class="scroll">{svg}</div>\n<figcaption>{escape(caption)}</figcaption>\n</figure>'
        )

    def film(self, pictures: Sequence[tuple[bytes, str]], caption: str) -> None:
        """Pictures side by side, PNG files that stand in the page itself, each with its words."""
        self._has_pictures = True
        each = "\n".join(
            f'<div><img src="data:image/png;base64,{base64.b64encode(png).decode()}" alt="{escape(words, quote=True)}">'
            f"<small>{escape(words)}</small></div>"
            for png, words in pictures
        )
        self._body.append(
            f'<figure>\n<div class="film">{each}</div>\n<figcaption>{escape(caption)}</figcaption>\n</figure>'
        )

    def table(self, table: str) -> None:
        """A table made by `html_table` or `facts_table`."""
        self._body.append(table)

    def folded(self, summary: str, table: str) -> None:
        """A table that opens at a click (no script needed)."""
        self._body.append(f"<details>\n<summary>{escape(summary)}</summary>\n{table}\n</details>")

    def html(self) -> str:
        """The whole document."""
        lead = f'\n<p class="lead">{escape(self.lead)}</p>' if self.lead else ""
        body = "\n".join(self._body)
        links = self._links()
        pictures = "; img-src data:" if self._has_pictures else ""
        return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'{pictures}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(self.title)}</title>
<style>{_STYLE}{self.style}</style>
</head>
<body>
{links}<header>
<h1>{escape(self.title)}</h1>{lead}
</header>
<main>
{body}
</main>
{links}<footer>Written by neuralq. This page is one file: it loads nothing and runs nothing.</footer>
</body>
</html>
"""

    def _links(self) -> str:
        if not self.links:
            return ""
        words = " ".join(f'<a href="{escape(address, quote=True)}">{escape(text)}</a>' for text, address in self.links)
        return f"<nav>{words}</nav>\n"

    def write(self, path: Path) -> Path:
        """Writes the document in one move: a reader sees the old page or the new one, never half of one."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, self.html())
        return path


def html_table(caption: str, header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table with column headings; the first cell of each row is its heading; a wide one scrolls by itself."""
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in header)
    rows = "\n".join(f"<tr>{_cells(row)}</tr>" for row in body)
    return (
        f'<p class="caption">{escape(caption)}</p>\n'
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}">\n<table>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>\n</div>"
    )


def tiles(entries: Sequence[tuple[str, str, str]]) -> str:
    """Names, values and remarks as tiles side by side."""
    body = "\n".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd><dd>{escape(remark)}</dd></div>"
        for name, value, remark in entries
    )
    return f'<dl class="tiles">\n{body}\n</dl>'


def facts_table(facts: Mapping[str, Any]) -> str:
    """A table of names and values; nested mappings get dotted names."""
    rows = "\n".join(f"<tr>{_cells((key, format_value(value)))}</tr>" for key, value in flatten(facts))
    return f'<table class="facts">\n<tbody>\n{rows}\n</tbody>\n</table>'


def _cells(row: Sequence[str]) -> str:
    first, *rest = row
    return f'<th scope="row">{escape(first)}</th>' + "".join(f"<td>{escape(cell)}</td>" for cell in rest)


def flatten(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The entries of nested mappings under dotted names.

    Example:
        >>> list(flatten({"learner": {"lr": 0.1}, "seed": 3}))
        [('learner.lr', 0.1), ('seed', 3)]
    """
    for key, value in facts.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def format_number(value: float, digits: int = 4) -> str:
    """A number for reading: whole ones with thousands separators, others with ``digits`` significant ones.

    Example:
        >>> format_number(20480.0), format_number(1.0023925, 8), format_number(-18465369.7), format_number(float("nan"))
        ('20,480', '1.0023925', '-1.847e7', 'not a number')
    """
    if math.isnan(value):
        return "not a number"
    if math.isinf(value):
        return "infinite" if value > 0 else "minus infinite"
    if value == int(value) and abs(value) < 1e15:
        return f"{int(value):,}"
    if 1e4 <= abs(value) < 1e6:
        return f"{value:,.1f}"
    return f"{value:.{digits}g}".replace("e+0", "e").replace("e+", "e").replace("e-0", "e-")


def short_number(value: float, digits: int = 4) -> str:
    """A number rounded to so many significant digits; "unknown" for NaN.

    Example:
        >>> short_number(0.028261), short_number(18.4449, 2), short_number(float("nan"))
        ('0.02826', '18', 'unknown')
    """
    if math.isnan(value):
        return "unknown"
    return format_number(float(f"{value:.{digits}g}") if math.isfinite(value) else value)


def format_value(value: Any) -> str:
    """Any JSON value for reading: yes and no, a dash for null, lists and mappings as JSON.

    Example:
        >>> format_value(None), format_value(True), format_value([64, 64]), format_value(4096)
        ('–', 'yes', '[64, 64]', '4,096')
    """
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{int(value):,}" if abs(int(value)) < 10**15 else str(value)
    if isinstance(value, float | np.floating):
        return format_number(float(value), 6)
    if isinstance(value, str | Path):
        return str(value)
    return json.dumps(value, ensure_ascii=False, default=str)

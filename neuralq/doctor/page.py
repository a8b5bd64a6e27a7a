"""The report as one HTML page that loads nothing: headline, five causes, what was found, figures, the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from neuralq.doctor.findings import CAUSES, Cause, Finding
from neuralq.figures import COLOURS, draw_svg, tame
from neuralq.runs.report.page import Page, format_number, html_table
from neuralq.types import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from neuralq.doctor.report import Report

__all__ = ["page_of"]

_STYLE = """
pre { background: var(--card); padding: .5rem .8rem; font-size: .85rem; border-radius: .3rem;
  white-space: pre-wrap; overflow-wrap: anywhere; }
h3 { font-size: 1rem; margin: 1.4rem 0 .2rem; }
@media (max-width: 40rem) { /* rows of many cells: the words below the numbers */
  tr:has(> :nth-child(4)) { display: flex; flex-wrap: wrap; border-bottom: 1px solid var(--line); }
  tr:has(> :nth-child(4)) > * { flex: 1 1 5rem; min-width: 4.5rem; border: 0; }
  tr > :nth-child(n + 4):last-child { flex-basis: 100%; padding-top: 0; }
}
@media (min-width: 70rem) { .pair { display: grid; grid-template-columns: 1fr 1fr; gap: 1.5rem; } }
"""
_GRADES = {"A": "shown by a controlled experiment", "B": "named by a measurement", "C": "a vital sign, no verdict"}


def page_of(report: Report) -> Page:
    """The page of a report.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    page = Page(f"Examination of {report.subject}", f"on {report.env}, γ = {report.gamma:g}", _STYLE)
    page.paragraph(report.headline, warning=not report.healthy)
    page.heading("Which of the five causes")
    page.table(
        html_table("the best evidence for each", ("cause", "evidence", "grade"), [_triage(report, c) for c in CAUSES])
    )
    named = [one for one in report.findings if one.grade in "AB"]
    if named:
        page.heading("What was found, the first cause first")
        for one in named:
            page.table(_found(one))
    _figures(page, report)
    _vital_signs(page, report)
    if report.experiments:
        page.heading("Experiments")
        page.paragraph(f"In the order {report.experiments}.")
    _factorial(page, report)
    page.heading("What was not measured, and why")
    if report.not_measured:
        page.table(html_table("nothing here speaks for or against", ("", "why"), _by_reason(report.not_measured)))
    else:
        page.paragraph("Everything was measured.")
    rows = [
        [one.id, one.title if one.flagged else "–", _number(one), _threshold(one), one.evidence]
        for one in report.measured
    ]
    page.folded(
        "Everything that was measured", html_table("", ("", "flagged as", "value", "threshold", "in words"), rows)
    )
    return page


def _by_reason(missing: Mapping[str, str]) -> list[list[str]]:
    return [[", ".join(n for n, why in missing.items() if why == one), one] for one in dict.fromkeys(missing.values())]


def _triage(report: Report, cause: Cause) -> list[str]:
    flagged = [one for one in report.findings if one.cause == cause]
    if flagged:
        return [cause, f"{flagged[0].title} ({flagged[0].id})", f"{flagged[0].grade}: {_GRADES[flagged[0].grade]}"]
    looked = [one.id for one in report.measured if one.cause == cause]
    return [cause, f"nothing flagged ({', '.join(looked)})" if looked else "not measured", "–"]


def _found(one: Finding) -> str:
    interval = (
        ""
        if one.interval is None
        else f", 95 % from {format_number(one.interval[0])} to {format_number(one.interval[1])}"
    )
    title, evidence = (escape(text[:1].upper() + text[1:]) for text in (one.title, one.evidence))
    return (
        f"<h3>{title}</h3>\n<p>{evidence}.</p>\n<p>{one.id}, "
        f"grade {one.grade} "
        f"({_GRADES[one.grade]}): {format_number(one.value)}{interval}; {escape(_threshold(one))}.</p>\n"
        f"<p>Remedy: {escape(one.remedy)}.</p>\n<p>This would confirm it:</p>\n<pre>{escape(one.confirm)}</pre>"
    )


def _number(one: Finding) -> str:
    if one.interval is None:
        return format_number(one.value)
    return f"{format_number(one.value)} ({format_number(one.interval[0])} to {format_number(one.interval[1])})"


def _threshold(one: Finding) -> str:
    bound = "" if one.threshold is None else f"threshold {format_number(one.threshold)}"
    return ", ".join(filter(None, (bound, one.source))) or "–"


def _figures(page: Page, report: Report) -> None:
    pairs, starts = report.drawn.get("pairs"), report.drawn.get("starts")
    if pairs is None or starts is None:
        return
    mistakes = {} if report.healthy else {n: line for n, line in report.drawn.items() if n.startswith("with ")}
    page.heading("Values against returns")
    page.figure(
        _scatter("pairs", pairs[:, 0], pairs[:, 1], "return that followed, discounted", "value Q(s, a)", mistakes),
        "Each point is a step of a greedy episode: what was returned from there, and what the values said. On the "
        "dotted line both agree; above it values are too high."
        + (" The other lines are the values of learners with the two mistakes that fit best." if mistakes else ""),
    )
    page.figure(
        _scatter(
            "starts", starts[:, 0], starts[:, 1], "return of the episode, undiscounted", "value of its first step"
        ),
        "Each point is a greedy episode: what it returned in all, and what its first value promised (discounted).",
    )


def _scatter(
    name: str, x: Floats, y: Floats, below: str, beside: str, lines: Mapping[str, Floats] | None = None
) -> str:  # fmt: skip
    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(tame(x), tame(y), ".", color=COLOURS[0], alpha=0.5)
        if lines is not None:
            ends = np.array([min(float(x.min()), float(y.min())), max(float(x.max()), float(y.max()))])
            axes.plot(tame(ends), tame(ends), color="#555555", linestyle=":", linewidth=1.4, label="value = return")
            for colour, (label, line) in zip(COLOURS[1:], lines.items(), strict=False):
                axes.plot(tame(line[:, 0]), tame(line[:, 1]), color=colour, linewidth=1.4, label=label)
            axes.legend(fontsize="small")
        axes.set_xlabel(below)
        axes.set_ylabel(beside)

    said = (
        f"{len(x)} points; {below} from {x.min():.4g} to {x.max():.4g}, {beside} from {y.min():.4g} to {y.max():.4g}."
    )
    return draw_svg(name, beside, said, (5.2, 3.6), paint)


_SIGNS = {
    "R1": "silent units, beyond the mean of fresh networks (share)",
    "R2": "effective rank of the last hidden layer (directions)",
    "R3": "smallest eigenvalue of the tangent kernel",
    "R4": "greedy actions that one step changes elsewhere (share)",
    "R6a": "distance of the weights from where fresh ones lie",
}


def _vital_signs(page: Page, report: Report) -> None:
    signs = [one for one in report.measured if one.id.startswith("R")]
    if not signs:
        return
    page.heading("The network beside fresh ones")
    drawn = [one for one in signs if one.fresh and one.id in _SIGNS and np.isfinite([one.value, *one.fresh]).all()]
    if drawn:
        page.figure(
            _strips(drawn),
            f"Bars span what {len(drawn[0].fresh)} fresh networks of the same architecture show on the same "
            "observations, with a stroke for each of them; the diamond is this network, the dotted line a threshold "
            "where it lies within sight. To be outside is what learning does; alone it proves nothing.",
        )
    rows = [[one.id, _number(one), _fresh(one), one.evidence] for one in signs]
    page.table(
        html_table("vital signs; alone they prove nothing", ("", "value", "of fresh networks", "in words"), rows)
    )


def _fresh(one: Finding) -> str:
    return f"{format_number(min(one.fresh))} to {format_number(max(one.fresh))}" if one.fresh else "–"


def _strips(signs: Sequence[Finding]) -> str:
    """A strip for each sign: the band of fresh networks, each of them, this network, and the threshold."""

    def paint(figure: Figure) -> None:
        for axes, one in zip(np.atleast_1d(figure.subplots(len(signs), 1)), signs, strict=True):
            low, high = min(one.fresh), max(one.fresh)
            axes.barh(0, high - low, left=low, height=0.9, color=COLOURS[4], alpha=0.5, linewidth=0)
            axes.plot(one.fresh, [0] * len(one.fresh), "|", color=COLOURS[0], markersize=14, alpha=0.8)
            axes.plot(one.value, 0, "D", color=COLOURS[1], markersize=8)
            ends = np.array([low, high, one.value])
            spread = float(np.ptp(ends)) or abs(one.threshold or 1.0)
            if one.threshold is not None and ends.min() - spread <= one.threshold <= ends.max() + spread:
                axes.axvline(one.threshold, color="#555555", linestyle=":", linewidth=1.4)
                ends = np.append(ends, one.threshold)
            axes.set_xlim(ends.min() - 0.08 * spread, ends.max() + 0.08 * spread)
            axes.set_ylim(-1, 1)
            axes.set_yticks([])
            axes.spines["left"].set_visible(False)
            axes.grid(False)
            axes.set_title(f"{one.id}: {_SIGNS[one.id]}", loc="left", fontsize="medium")

    said = "; ".join(
        f"{one.id}, {_SIGNS[one.id]}: {one.value:.3g}, fresh networks {min(one.fresh):.3g} to {max(one.fresh):.3g}"
        for one in signs
    )
    return draw_svg("signs", "vital signs beside fresh networks", said, (5.2, 0.15 + 0.85 * len(signs)), paint)


def _factorial(page: Page, report: Report) -> None:
    cells = report.drawn.get("factorial")
    if cells is None:
        return
    page.heading("Two by two: their learner and body, and ours")
    rows = [
        [name, *(format_number(float(x)) for x in row)]
        for name, row in zip(("their body", "our body"), cells, strict=True)
    ]
    page.table(
        html_table("greedy return, interquartile mean over seeds", ("", "their algorithm", "our algorithm"), rows)
    )

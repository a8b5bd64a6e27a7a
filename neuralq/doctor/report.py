"""The outcome of an examination, the first cause first: for people, as JSON, and as a page."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neuralq.doctor.findings import CAUSES, UNEXPLAINED, Cause, Finding
from neuralq.doctor.page import page_of
from neuralq.types import Array

__all__ = ["Report"]


@dataclass(frozen=True, eq=False)
class Report:
    """The outcome of an examination.

    Args:
        subject: what was examined, in words.
        env: the environment, in words.
        gamma: γ.
        headline: the answer in a sentence.
        findings: what is flagged, the first cause first.
        measured: every measurement, flagged or not.
        not_measured: what could not be measured, and why.
        seconds: how long it took.
        drawn: numbers for the page's figures.
        experiments: in which order experiments were tried, and why; empty without any.
    """

    subject: str
    env: str
    gamma: float
    headline: str
    findings: tuple[Finding, ...]
    measured: tuple[Finding, ...]
    not_measured: Mapping[str, str]
    seconds: float
    drawn: Mapping[str, Array] = field(default_factory=dict)
    experiments: str = ""

    @property
    def healthy(self) -> bool:
        """Whether there is no finding of grade A or B."""
        return not any(one.grade in "AB" for one in self.findings)

    @property
    def cause(self) -> Cause | None:
        """The first cause; None where nothing of grade A or B was found, or where what was found has no cause yet."""
        unexplained = {one.id for one in self.findings if one.grade in "AB"} <= UNEXPLAINED
        return None if self.healthy or unexplained else self.findings[0].cause

    def explain(self) -> str:
        """The report in one screen of text, 24 lines of 80."""
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """The same line by line: the headline, the first finding, the table of causes, what was not measured."""
        named, signs = ([one for one in self.findings if (one.grade == "C") == c] for c in (False, True))
        lines = _wrapped(f"{self.subject} on {self.env}, γ = {self.gamma:g}", 2) + _wrapped(self.headline, 2)
        for one in named[:1]:
            lines += ["", *_wrapped(f"[{one.grade}] {one.id}: {one.evidence}", 3)]
            lines += _wrapped(f"remedy: {one.remedy}", 2)
            lines += _wrapped(f"confirm: {one.confirm.splitlines()[0]}", 3)
        lines += ["", *(_wrapped(f"{cause:<15} {self._best_of(cause)}", 1)[0] for cause in CAUSES)]
        lines += _wrapped(f"experiments: {self.experiments}", 2) if self.experiments else []
        for title, rest in (
            ("and", [f"{one.id} {one.title}" for one in named[1:]]),
            ("signs, no verdicts", [f"{one.id} {one.title}" for one in signs]),
            ("not measured (why: --json)", list(self.not_measured)),
        ):
            lines += _wrapped(f"{title}: {', '.join(rest)}", 2 if title == "and" else 1) if rest else []
        return [
            *lines,
            f"{len(self.measured)} measurements in {self.seconds:.0f} s; all of it: --report FILE or --json",
        ]

    def _best_of(self, cause: Cause) -> str:
        flagged = [one for one in self.findings if one.cause == cause]
        if flagged:
            one = flagged[0]
            return f"{one.id}, grade {one.grade}: {one.title}"
        looked = [one.id for one in self.measured if one.cause == cause]
        return f"nothing flagged ({', '.join(looked)})" if looked else "not measured"

    def plain(self) -> dict[str, Any]:
        """The report as JSON takes it."""
        return {
            "subject": self.subject,
            "env": self.env,
            "gamma": self.gamma,
            "healthy": self.healthy,
            "cause": self.cause,
            "headline": self.headline,
            "findings": [one.plain() for one in self.findings],
            "measured": [one.plain() for one in self.measured],
            "not_measured": dict(self.not_measured),
            "seconds": self.seconds,
            "experiments": self.experiments,
        }

    def write(self, path: str | Path) -> Path:
        """Writes the page, one HTML file that loads nothing (extra plot).

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        return page_of(self).write(Path(path))


def _wrapped(text: str, most: int) -> list[str]:
    """At most so many lines of 80."""
    return textwrap.wrap(
        text, 80, subsequent_indent="    ", max_lines=most, placeholder=" …", break_on_hyphens=False
    ) or [""]  # fmt: skip

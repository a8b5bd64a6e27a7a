"""The outcome of an examination, the first cause first: for people, as JSON, and as a page."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
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
        """The report in one screen of text."""
        return "\n".join(self.lines())

    def lines(self, width: int = 110) -> list[str]:
        """The same line by line: the headline, the first findings, the table of causes, what was not measured."""
        lines = [f"{self.subject} on {self.env}, γ = {self.gamma:g}", self.headline]
        named = [one for one in self.findings if one.grade in "AB"][:4]
        for one in named:
            lines += ["", *_wrapped(one.line(), width), *_wrapped(f"    remedy: {one.remedy}", width, 12)]
            lines += [f"    confirm: {line}" for line in one.confirm.splitlines()[:3]]
        more = len([one for one in self.findings if one.grade in "AB"]) - len(named)
        if more > 0:
            lines.append(f"and {more} more, in the report and with --json")
        lines += ["", *(f"{cause:<15} {self._best_of(cause)}" for cause in CAUSES)]
        signs = [f"{one.id} {one.title}" for one in self.findings if one.grade == "C"]
        if signs:
            lines += _wrapped(f"vital signs, no verdicts: {', '.join(signs)}", width)
        if self.not_measured:
            lines += _wrapped(f"not measured (why: --json): {', '.join(self.not_measured)}", width)
        return [*lines, f"{len(self.measured)} measurements in {self.seconds:.0f} s"]

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
        }

    def write(self, path: str | Path) -> Path:
        """Writes the page, one HTML file that loads nothing (extra plot).

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        return page_of(self).write(Path(path))


def _wrapped(text: str, width: int, indent: int = 4) -> Sequence[str]:
    lead = text[: len(text) - len(text.lstrip())]
    return textwrap.wrap(text, width, initial_indent=lead, subsequent_indent=" " * indent) or [""]

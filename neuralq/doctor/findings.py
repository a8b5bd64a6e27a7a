"""What a measurement says: a finding with its interval, its threshold, the evidence, a remedy and how to confirm it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

__all__ = ["CAUSES", "UNEXPLAINED", "Cause", "Finding", "Grade"]

Cause = Literal["environment", "algorithm", "representation", "data", "luck"]
Grade = Literal["A", "B", "C"]
UNEXPLAINED = {"V1", "V6a", "V7"}
"""Findings that say that the policy is bad and nothing of why."""
CAUSES: tuple[Cause, ...] = ("environment", "algorithm", "representation", "data", "luck")


@dataclass(frozen=True)
class Finding:
    """One measurement and what it says.

    Args:
        id: as in docs/doctor.md: E1 … X4.
        title: in a few words.
        cause: what it speaks for where it is flagged.
        grade: A shown by a controlled experiment, B named by a measurement with its interval, C a vital sign.
        value: what was measured; NaN where it is no number.
        interval: 95 % by bootstrap over episodes; None where there is none.
        threshold: beyond which it is flagged; None where any would be.
        source: of the threshold.
        flagged: whether it is beyond.
        evidence: in a sentence.
        remedy: what to change.
        confirm: the command or lines that would confirm it.
        fresh: the same of eight fresh networks of its architecture; empty where it is not measured of those.
    """

    id: str
    title: str
    cause: Cause
    grade: Grade
    value: float
    interval: tuple[float, float] | None = None
    threshold: float | None = None
    source: str = ""
    flagged: bool = False
    evidence: str = ""
    remedy: str = ""
    confirm: str = ""
    fresh: tuple[float, ...] = ()

    def plain(self) -> dict[str, Any]:
        """The same as JSON takes it: what is not finite is null."""
        given = asdict(self)
        finite = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in given.items()}
        if self.interval is not None:
            finite["interval"] = [bound if math.isfinite(bound) else None for bound in self.interval]
        return finite

    def graded(self, grade: Grade) -> Finding:
        """The same with another grade."""
        return replace(self, grade=grade)

    def line(self) -> str:
        """The grade, the id and the evidence, in a line."""
        return f"[{self.grade}] {self.id} {self.cause}: {self.evidence}"

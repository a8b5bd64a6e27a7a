"""What a sweep comes to, run by run and together."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neuralq.runs.play_off import score_of
from neuralq.runs.sweep.statistics import Estimate, estimate

__all__ = ["RunResult", "Status", "SweepResult"]

_NUMBERS = ("agent_return", "greedy_return", "env_steps", "cpu_seconds", "reached", "parameters_sha256")


@dataclass(frozen=True)
class RunResult:
    """The result of one run.

    Args:
        seed: of the run.
        run_dir: its folder.
        state: as `RunState`; "stopped" of one that was not finished, begun or not.
        reason: why it failed, "" otherwise.
        summary: of its run folder; empty where it has not finished.
        options: in which it differs from other runs of the sweep.
    """

    seed: int
    run_dir: Path
    state: str
    reason: str
    summary: dict[str, Any]
    options: Mapping[str, Any] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """The same as plain values."""
        return {
            "seed": self.seed,
            "options": dict(self.options),
            "state": self.state,
            "reason": self.reason or None,
            "run_dir": str(self.run_dir),
            **{name: self.summary.get(name) for name in _NUMBERS},
        }


@dataclass(frozen=True)
class SweepResult:
    """The result of a sweep: one per run, and the name of the signal that ended it early, if one did."""

    runs: tuple[RunResult, ...]
    interrupted_by: str | None = None

    @property
    def returns(self) -> list[float]:
        """What the agents of the finished runs score."""
        found = (score_of(run.summary) for run in self.runs if run.state == "finished")
        return [score.mean for score in found if score is not None]

    @functools.cached_property
    def estimate(self) -> Estimate | None:
        """Their interquartile mean and its interval; None where no run has finished, or they differ in options."""
        alike = len({str(sorted(run.options.items(), key=str)) for run in self.runs}) == 1
        return estimate(self.returns) if alike and self.returns else None

    def plain(self) -> dict[str, Any]:
        """The same as plain values."""
        found = self.estimate
        return {
            "iqm": None if found is None else found.iqm,
            "low": None if found is None else found.low,
            "high": None if found is None else found.high,
            "num_finished": sum(run.state == "finished" for run in self.runs),
            "num_failed": sum(run.state == "failed" for run in self.runs),
            "interrupted_by": self.interrupted_by,
            "runs": [run.plain() for run in self.runs],
        }


@dataclass(frozen=True)
class Status:
    """How far a sweep has come.

    Args:
        env_steps: of all runs together; one that ended early counts whole.
        total_steps: of all runs together.
        running: names of the runs that are at work.
        num_finished: runs that have finished.
        failed: names of the runs that have failed.
        returns: what the agents of those that have finished score, by name.
    """

    env_steps: int
    total_steps: int
    running: tuple[str, ...]
    num_finished: int
    failed: tuple[str, ...]
    returns: Mapping[str, float]

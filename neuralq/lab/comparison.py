"""Every problem under every method: what the diagnosis predicts beside what a run does, and where the two disagree.

The prediction is `neuralq.lab.diagnose` of the expected update; the measurement is a run of the same update, judged by
nothing but its own record:

    grows           an entry of the weights passed the cap, 1e10 times the largest initial one
    settles         both errors stand still over the last quarter of the run, or move ever more slowly
    keeps moving    neither: a drift, or a policy that switches for ever

A linear update is run a thousand million times, which costs thirty squarings of its matrix and decides every growth per
step outside the neutral band |ρ − 1| < 1e-6. A piecewise one is stepped, and longer while it is undecided.
Inside the band, and where the prediction itself is "neutral", nothing is claimed and so nothing can disagree.

Runs from samples can be set beside them. A growing mean does not bind the few seeds that are run (a rare seed may carry
it), nor does a growing variance; but a mean square that settles leaves no seed room to pass the cap. That is checked.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neuralq.checks import check_choice, check_whole
from neuralq.lab.linear.process import linear_process
from neuralq.lab.linear.sampling import Sampling
from neuralq.lab.methods import METHODS, Method
from neuralq.lab.methods import method as method_named
from neuralq.lab.plain import fields_of, plain
from neuralq.lab.problems import PROBLEMS
from neuralq.lab.problems import problem as problem_named
from neuralq.lab.trial import CAP, Trial, run
from neuralq.lab.verdicts.diagnosis import diagnose
from neuralq.lab.verdicts.moments import known_second_moment
from neuralq.lab.verdicts.words import Verdict
from neuralq.types import Floats, Indices
from neuralq_envs.counterexamples import Problem

__all__ = ["ABSENT", "NEUTRAL_BAND", "Cell", "Matrix", "Sampled", "applies", "matrix", "outcome_of"]

Outcome = Literal["settles", "grows", "keeps moving"]

NEUTRAL_BAND = 1e-6
"""A growth per application this close to 1 is not held against a run."""

ABSENT = {
    "actions": "the method compares actions, and the features of the problem are those of states",
    "nonlinear": "the values are not linear in the weights, and only plain TD(0) is defined there",
    "solves": "the method solves for the weights at once and has no update from single transitions",
    "uncovered": "the samples of the method need a behaviour that reaches every pair of state and action",
}
"""Why a cell is empty: in a word, and in a sentence."""

_APPLICATIONS = 10**9 + 7  # no multiple of the records: a cycle must not look like rest
_STEPPED = (1_077, 10_777, 107_777)
_STILL = 1e-7  # share of the largest error that a curve at rest may still move, from rounding
_EXPECTED: dict[Verdict, Outcome] = {
    "converges": "settles",
    "stable but poor fixed point": "settles",
    "diverges": "grows",
    "chatters": "keeps moving",
}


@dataclass(frozen=True)
class Sampled:
    """What runs from single transitions did.

    Args:
        sampling: ``"iid"`` or ``"markov"``.
        num_seeds: independent runs.
        num_steps: updates of each.
        num_diverged: runs that passed the cap.
        growth: factor per update of the median error over the last half.
        second_moment_radius: predicted growth of the mean square; None where it is not known.
    """

    sampling: Sampling
    num_seeds: int
    num_steps: int
    num_diverged: int
    growth: float
    second_moment_radius: float | None

    @property
    def agree(self) -> bool | None:
        """Whether no seed left where the mean square settles; None where it does not, or is not known."""
        radius = self.second_moment_radius
        return None if radius is None or radius >= 1 - NEUTRAL_BAND else self.num_diverged == 0


@dataclass(frozen=True)
class Cell:
    """One method on one problem.

    Args:
        problem: its name.
        method: its name.
        absent: a key of `ABSENT` where the method does not apply; then nothing else is there.
        predicted: verdict on the expected update.
        spectral_radius: ρ per application of it.
        updates: updates that one application stands for.
        measured: what the run did.
        growth: factor per update of the run's error over its last half, near 1 where it rests.
        num_steps: updates of the run.
        sampled: what sampled runs did, where they were asked for and exist.
        sampled_absent: a key of `ABSENT` where they were asked for and do not.
    """

    problem: str
    method: str
    absent: str | None = None
    predicted: Verdict | None = None
    spectral_radius: float | None = None
    updates: int = 1
    measured: Outcome | None = None
    growth: float | None = None
    num_steps: int = 0
    sampled: Sampled | None = None
    sampled_absent: str | None = None

    @property
    def neutral(self) -> bool:
        """Whether the prediction claims nothing: it is neutral, or its ρ lies in `NEUTRAL_BAND` around 1."""
        if self.predicted is None or self.spectral_radius is None or self.predicted == "chatters":
            return False
        return self.predicted == "neutral" or abs(self.spectral_radius - 1) < NEUTRAL_BAND

    @property
    def agree(self) -> bool | None:
        """Whether prediction and run say the same; None where the method does not apply or nothing is claimed."""
        if self.predicted is None or self.neutral:
            return None
        return self.measured == _EXPECTED.get(self.predicted)

    @property
    def disagrees(self) -> bool:
        """Whether the run, or a sampled one, contradicts its prediction."""
        return self.agree is False or (self.sampled is not None and self.sampled.agree is False)

    def plain(self) -> dict[str, Any]:
        """The cell as text and numbers, the same keys for every cell; sampled ones only where it was sampled."""
        names = ("problem", "method", "predicted", "spectral_radius", "measured", "growth", "num_steps", "neutral")
        row = fields_of(self, *names, "agree", "absent")
        if self.sampled is not None or self.sampled_absent is not None:
            for name in (
                "sampling",
                "num_seeds",
                "num_steps",
                "num_diverged",
                "growth",
                "second_moment_radius",
                "agree",
            ):
                key = f"sampled_{name.removeprefix('num_')}" if name in row else name
                row[key] = plain(getattr(self.sampled, name, None))
            row["sampled_absent"] = self.sampled_absent
        return row


@dataclass(frozen=True)
class Matrix:
    """Cells of every problem under every method, problem by problem.

    Args:
        problems: names, one row each.
        methods: names, one column each.
        cells: row by row.
    """

    problems: tuple[str, ...]
    methods: tuple[str, ...]
    cells: tuple[Cell, ...]

    def cell(self, problem: str, method: str) -> Cell:
        """The cell of a problem and a method.

        Raises:
            ValueError: there is no such row or column.
        """
        if problem not in self.problems or method not in self.methods:
            raise ValueError(f"there is no cell of {method!r} on {problem!r} in this matrix")
        return self.cells[self.problems.index(problem) * len(self.methods) + self.methods.index(method)]

    @property
    def disagreements(self) -> tuple[Cell, ...]:
        """Cells whose run contradicts the prediction."""
        return tuple(cell for cell in self.cells if cell.disagrees)

    @property
    def neutral(self) -> tuple[Cell, ...]:
        """Cells about which nothing is claimed."""
        return tuple(cell for cell in self.cells if cell.neutral)

    def plain(self) -> dict[str, Any]:
        """Everything as text and numbers, as JSON takes it."""
        return {
            "problems": list(self.problems),
            "methods": list(self.methods),
            "neutral_band": NEUTRAL_BAND,
            "num_judged": sum(cell.agree is not None for cell in self.cells),
            "num_neutral": len(self.neutral),
            "num_absent": sum(cell.absent is not None for cell in self.cells),
            "num_disagreements": len(self.disagreements),
            "cells": [cell.plain() for cell in self.cells],
        }

    def write_csv(self, path: str | Path) -> Path:
        """One line per cell."""
        rows = [cell.plain() for cell in self.cells]
        columns = max((list(row) for row in rows), key=len)
        with Path(path).open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(rows)
        return Path(path)


def applies(problem: Problem, method: str) -> str | None:
    """Why a method has no meaning on a problem, as a key of `ABSENT`; None where it has one.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> applies(star(), "td"), applies(star(), "q-learning")
        (None, 'actions')
    """
    if problem.value is not None and method != "td":
        return "nonlinear"
    return "actions" if method_named(method).rows == "pairs" and not problem.learns_q else None


def outcome_of(record: Trial, patient: bool = True) -> Outcome:
    """What a run did, from its own record: whether it passed the cap, and how far its errors moved at the end.

    Args:
        record: the run.
        patient: whether a longer one could follow: then only errors that shrink tenfold in a quarter have settled.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> outcome_of(run(star(), "td", num_steps=10**5)), outcome_of(run(star(), "td", 10**7, options={"eta": 1}))
        ('grows', 'settles')
    """
    if record.diverged.any():
        return "grows"
    curves = np.stack([np.median(record.rmsve, axis=1), np.median(record.rmspbe, axis=1)])
    return _resting(record.steps, curves, patient)


def _resting(steps: Indices, curves: Floats, patient: bool) -> Outcome:
    """By the fastest change of a curve in the third and in the last quarter."""
    speed = np.abs(np.diff(curves, axis=1)) / np.diff(steps)
    size, quarter = np.maximum(curves.max(axis=1), 1e-12), steps[-1] / 4
    third, last = ((steps[1:] > 2 * quarter) & (steps[1:] <= 3 * quarter)), steps[1:] > 3 * quarter
    before, late = (float((speed[:, part] / size[:, None]).max(initial=0.0)) for part in (third, last))
    return "settles" if late * quarter <= _STILL or late < (0.1 if patient else 0.8) * before else "keeps moving"


def matrix(
    problems: Sequence[str | Problem] | None = None,
    methods: Sequence[str] | None = None,
    progress: Callable[[str, str, int, int], None] | None = None,
    *,
    sampling: Sampling = "expected",
    num_seeds: int = 20,
    num_steps: int = 2000,
    seed: int = 0,
) -> Matrix:
    """Every problem under every method, each with its own step size and default options, predicted and measured.

    Args:
        problems: names or problems; all of `neuralq.lab.problems.PROBLEMS` by default.
        methods: names; all of `neuralq.lab.methods.METHODS` by default.
        progress: called as ``progress(problem, method, index, total)`` before each cell.
        sampling: ``"iid"`` or ``"markov"`` adds sampled runs; ``"expected"`` leaves them out.
        num_seeds: sampled runs of each cell.
        num_steps: updates of each sampled run.
        seed: of the sampled runs.

    Raises:
        ValueError: an unknown name, or a count that is not at least 1.

    Example:
        >>> found = matrix(["baird", "baird-tabular"], ["td", "etd", "q-learning"])
        >>> [cell.predicted or cell.absent for cell in found.cells]
        ['diverges', 'converges', 'actions', 'converges', 'converges', 'actions']
        >>> [cell.measured for cell in found.cells], found.disagreements
        (['grows', 'settles', None, 'settles', 'settles', None], ())
    """
    check_choice("sampling", sampling, ("expected", "iid", "markov"))
    check_whole("num_seeds", num_seeds)
    check_whole("num_steps", num_steps)
    rows = [entry.name for entry in PROBLEMS] if problems is None else problems
    made = [problem_named(row) if isinstance(row, str) else row for row in rows]
    columns = [method_named(name) for name in methods or [one.name for one in METHODS]]
    cells: list[Cell] = []
    for one in made:
        for chosen in columns:
            if progress is not None:
                progress(one.name, chosen.name, len(cells), len(made) * len(columns))
            cells.append(_cell(one, chosen, sampling, num_seeds, num_steps, seed))
    return Matrix(tuple(one.name for one in made), tuple(one.name for one in columns), tuple(cells))


def _cell(problem: Problem, chosen: Method, sampling: Sampling, num_seeds: int, num_steps: int, seed: int) -> Cell:
    absent = applies(problem, chosen.name)
    if absent is not None:
        return Cell(problem.name, chosen.name, absent)
    found = diagnose(problem, chosen)
    measured, growth, updates = _measured(problem, chosen)
    sampled = None
    if sampling != "expected":
        absent = "nonlinear" if problem.value is not None else "solves" if chosen.learner is None else None
        if absent is None:
            sampled = _sampled(problem, chosen, sampling, num_seeds, num_steps, seed)
            absent = "uncovered" if sampled is None else None
    return Cell(
        problem.name, chosen.name, None, found.verdict, found.spectral_radius, found.updates, measured, growth,
        updates, sampled, absent,
    )  # fmt: skip


def _measured(problem: Problem, chosen: Method) -> tuple[Outcome, float, int]:
    """What a run does, its growth per update, and its length."""
    if problem.value is not None:
        return _nonlinear_run(problem)
    assert chosen.expected is not None
    expected = chosen.expected(linear_process(problem), chosen.defaults)
    lengths = (_APPLICATIONS * expected.updates_per_sweep,) if expected.linear else _STEPPED
    for length in lengths:
        record = run(problem, chosen.name, num_steps=length)
        outcome = outcome_of(record, patient=length < lengths[-1])
        if outcome != "keeps moving":
            break
    return outcome, record.growth, int(record.steps[-1])


def _nonlinear_run(problem: Problem) -> tuple[Outcome, float, int]:
    """Expected TD(0), θ ← θ + α Σ_s d_s δ_s ∇V_s(θ), on values that are not linear in θ."""
    assert problem.value is not None
    process, value, theta = linear_process(problem), problem.value, problem.initial_weights.copy()
    v, cap = process.v, CAP * max(1.0, float(np.abs(theta).max()))
    every, errors = 16, []
    for step in range(_STEPPED[-1]):
        V = value.values(theta)[process.state]
        if step % every == 0:
            errors.append(float(np.sqrt(process.D @ (V - v) ** 2)))
        if not np.abs(V).max() <= cap:
            half = errors[len(errors) // 2 :]
            return "grows", math.exp(math.log(half[-1] / half[0]) / (every * (len(half) - 1))), step
        delta = process.r + process.gamma * (process.P @ V) - V
        theta = theta + problem.step_size * (value.jacobian(theta)[process.state].T @ (process.D * delta))
    steps = np.arange(len(errors), dtype=np.int64) * every
    half = errors[len(errors) // 2 :]
    growth = float((half[-1] / half[0]) ** (1 / (every * (len(half) - 1)))) if half[0] > 0 else 0.0
    return _resting(steps, np.array([errors]), patient=False), growth, _STEPPED[-1]


def _sampled(problem: Problem, chosen: Method, sampling: Sampling, *sizes: int) -> Sampled | None:
    num_seeds, num_steps, seed = sizes
    try:
        record = run(problem, chosen.name, num_steps, None, sampling, num_seeds, seed)
    except ValueError:
        return None
    second = known_second_moment(problem, chosen, chosen.defaults, problem.step_size, sampling)
    return Sampled(sampling, num_seeds, num_steps, int(record.diverged.sum()), record.growth, second)

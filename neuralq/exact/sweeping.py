"""Whole sweeps over the states: value iteration, Gauss–Seidel, modified policy iteration.

* Value iteration repeats V ← T V. Where all rows go on with one modulus, the middle of the interval [lo, hi] that
  holds V* − T V is added at the end, so the *span* of the change decides when to stop (MacQueen 1966). A row far below
  the best of its state cannot be the best before the values have moved apart by as much: once many rows are that far,
  the others are copied into a smaller model and swept instead, for as long as the sum of all changes allows (temporary
  action elimination, Hastings & van Nunen 1977; Puterman 1994, section 6.7). Every sweep equals one over all rows.
* Gauss–Seidel replaces values as it goes, in alternating directions.
* Modified policy iteration evaluates the present policy by sweeps over its own compact matrix γ P_π until the error
  left is small beside that of the policy (Puterman & Shin 1978). An action gives way only to a strictly better one.

Each stops when what it has is proven good enough, or when sweeps no longer help because rounding is all that is left.
Whatever the exit, the constant is taken out: at the floor of rounding the span says nothing about its size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.exact.kernels import (
    Floats,
    Rows,
    copy_survivors,
    extract_policy,
    improve,
    improve_in_place,
    look_ahead,
    policy_sweep,
    survivors,
    sweep,
)
from neuralq.exact.problem import Found, PlanningProblem

__all__ = ["PolicyMatrix", "gauss_seidel", "modified_policy_iteration", "value_iteration"]


_PATIENCE = 20  # spans shrink fast; one that finds no new low for so long is at the floor of rounding
_LONGEST_PATIENCE = 100_000
_MOST_SHIFTS = (
    4  # how often the constant is taken out at the floor: each time what is left of it is rounding of the last
)
_WORTH_COPYING = 0.2  # share of rows that are far enough below the best
_INNER_SHARE = 0.001  # an evaluation stops when its error is so much smaller than the policy's
_MOST_INNER_SWEEPS = 200


class _Progress:
    """Whether the error still falls.

    A span has no rate that is known. Other errors shrink by 1 − 1/reach at least, so for 1/reach of their size to show
    above rounding it takes up to ``reach`` sweeps.
    """

    def __init__(self, problem: PlanningProblem, *, span: bool) -> None:
        self._best, self._stalled = np.inf, 0
        self._patience = _PATIENCE if span else max(_PATIENCE, min(problem.reach, _LONGEST_PATIENCE))

    def stalls(self, error: float) -> bool:
        self._stalled = 0 if error < self._best else self._stalled + 1
        self._best = min(self._best, error)
        return self._stalled > self._patience


class _Constant:
    """Takes the constant error out of values, where rows go on with one modulus; says when there is no more to do."""

    def __init__(self, problem: PlanningProblem, tol: float) -> None:
        self._problem, self._tol, self._shifts = problem, tol, 0
        self._progress = _Progress(problem, span=problem.uniform)

    def settles(self, v: Floats, least: float, largest: float, *, last: bool) -> bool:
        """Whether ``v = T V`` is as good as asked for, or as sweeps can make it; ``last`` if no sweep is left."""
        problem = self._problem
        down, up = problem.interval(least, largest)
        error = (up - down) / 2 if problem.uniform else max(up, -down, 0.0)
        floor = problem.reach * problem.rounding(v)
        enough = error + floor <= self._tol
        stalls = not enough and (self._progress.stalls(error) or error <= floor)
        if not (enough or stalls or last):
            return False
        if not problem.uniform:
            return True
        shift = (up + down) / 2
        v[problem.acts] += shift
        if not stalls or self._shifts == _MOST_SHIFTS or abs(shift) <= floor:
            return True
        self._shifts += 1
        self._progress = _Progress(problem, span=True)
        return False


def value_iteration(problem: PlanningProblem, tol: float, limit: float, start: Floats | None = None) -> Found:
    """V ← T V from ``start``, or 0, until V* is known within ``tol``."""
    rows, constant = problem.rows, _Constant(problem, tol)
    v, better = np.zeros(len(problem.acts)) if start is None else start.copy(), np.empty(len(problem.acts))
    iterations, backups, slack, before = 0, 0, np.inf, np.inf
    budget = np.inf  # how far values may move apart until a row that was left out can be the best
    # |V| never exceeds reach · max |r|, starting within that; so it need not be looked at after every sweep.
    rounding = 2 * problem.rounding(np.full(1, problem.largest_reward * problem.reach))
    while iterations < limit:
        least, largest, beaten = sweep(rows, v, better, slack + rounding)
        v, better = better, v
        iterations, backups = iterations + 1, backups + len(rows.reward)
        if constant.settles(v, least, largest, last=iterations >= limit):
            break
        drift = _drift(problem, least, largest)
        budget -= drift
        slack = _further_drift(problem, drift, before)
        before = drift
        if budget < 0:
            rows, budget = problem.rows, np.inf
        elif beaten > _WORTH_COPYING * len(rows.reward):
            rows = _surviving(rows, v, slack + rounding)
            budget, backups = min(budget, slack), backups + beaten
    return Found(v, iterations, backups)


def _drift(problem: PlanningProblem, least: float, largest: float) -> float:
    """How much the values of two rows can move against each other when V changes by least..largest."""
    most, low = 1 - 1 / problem.reach, problem.least_modulus
    return (most if largest > 0 else low) * largest - (most if least < 0 else low) * least


def _further_drift(problem: PlanningProblem, drift: float, before: float) -> float:
    """What the drift of all further sweeps will add up to, if it goes on to shrink as now, with a margin."""
    if before == np.inf:
        return np.inf  # nothing is known of the rate yet
    rate = min(drift / before, 1 - 1 / problem.reach) if before > 0 else 0.0
    return 1.5 * drift * rate / (1 - rate)


def _surviving(rows: Rows, v: Floats, slack: float) -> Rows:
    """The rows that may still be optimal."""
    q, kind = np.empty(len(rows.reward)), rows.starts.dtype
    look_ahead(rows, v, q)
    num_rows, num_entries = survivors(rows, q, slack)
    reward = np.empty(num_rows)
    fixed = reward.view()
    fixed.flags.writeable = False  # as in the model: kernels are compiled for one type of array
    out = Rows(
        np.empty(len(rows.starts), dtype=kind),
        np.empty(num_rows + 1, dtype=kind),
        np.empty(num_entries, dtype=kind),
        np.empty(num_entries),
        fixed,
        np.empty(num_rows),
    )
    copy_survivors(rows, q, slack, out, reward)
    return out


def gauss_seidel(problem: PlanningProblem, tol: float, limit: float) -> Found:
    """V(s) ← (T V)(s), state by state, until V* is known within ``tol``."""
    rows, progress = problem.rows, _Progress(problem, span=False)
    v, scratch = np.zeros(len(problem.acts)), np.empty(len(problem.acts))
    iterations, backups = 0, 0
    while iterations < limit:
        change = improve_in_place(rows, v, iterations % 2 == 1)
        iterations, backups = iterations + 1, backups + len(rows.reward)
        allowance = problem.reach * problem.rounding(v)
        if (problem.reach - 1) * change + allowance <= tol:
            # The operator of one whole sweep contracts too, but the proof is about T: ask T.
            least, largest, _ = sweep(rows, v, scratch, np.inf)
            backups += len(rows.reward)
            down, up = problem.interval(least, largest)
            if max(up, -down, 0.0) + allowance <= tol:
                break
        if progress.stalls(change) or change <= problem.rounding(v):
            break
    return Found(v, iterations, backups)


class PolicyMatrix:
    """γ P_π and r_π of a deterministic policy, copied out of the model so that sweeps read nothing else.

    Example:
        >>> from neuralq.exact.problem import prepare
        >>> from neuralq.mdp import FiniteMDP
        >>> problem = prepare(FiniteMDP.from_arrays([[[1.0]]], [[2.0]]), 0.5)
        >>> PolicyMatrix(problem, np.array([0], dtype=np.uint32)).evaluate(np.zeros(1), 0.0, 3, span=False)[0].tolist()
        [3.5]
    """

    def __init__(self, problem: PlanningProblem, best_row: NDArray[np.unsignedinteger]) -> None:
        rows, acts = problem.rows, problem.acts
        used = best_row[acts].astype(np.int64)
        num_entries = int(np.sum(rows.indptr[used + 1] - rows.indptr[used], dtype=np.int64))
        kind = rows.starts.dtype
        self._acts, self.size = acts, len(used)
        self._indptr = np.empty(len(acts) + 1, dtype=kind)
        self._column, self._weight = np.empty(num_entries, dtype=kind), np.empty(num_entries)
        self._reward = np.zeros(len(acts))
        self._reward[acts] = rows.reward[used]
        extract_policy(rows, best_row, self._indptr, self._column, self._weight)

    def evaluate(self, v: Floats, error: float, most_sweeps: int, *, span: bool = True) -> tuple[Floats, int]:
        """V ← r_π + γ P_π V until the change (its span, or its size) is at most ``error``; returns V and the sweeps."""
        other = np.empty_like(v)
        sweeps = 0
        while sweeps < most_sweeps:
            sweeps += 1
            least, largest = policy_sweep(self._indptr, self._column, self._weight, self._reward, self._acts, v, other)
            v, other = other, v
            if (largest - least if span else max(largest, -least)) <= error:
                break
        return v, sweeps


def modified_policy_iteration(problem: PlanningProblem, tol: float, limit: float) -> Found:
    """A sweep of improvement, then sweeps of the policy alone, until V* is known within ``tol``."""
    rows, constant = problem.rows, _Constant(problem, tol)
    v, better = np.zeros(len(problem.acts)), np.empty(len(problem.acts))
    best_row = rows.starts[:-1].copy()
    iterations, backups = 0, 0
    while iterations < limit:
        least, largest = improve(rows, v, better, best_row)
        v, better = better, v
        iterations, backups = iterations + 1, backups + len(rows.reward)
        if constant.settles(v, least, largest, last=iterations >= limit):
            break
        policy = PolicyMatrix(problem, best_row)
        change = largest - least if problem.uniform else max(largest, -least)
        v, sweeps = policy.evaluate(v, _INNER_SHARE * change, _MOST_INNER_SWEEPS, span=problem.uniform)
        backups += sweeps * policy.size
    return Found(v, iterations, backups)

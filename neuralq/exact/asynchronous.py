"""Asynchronous methods: backups where they matter, one state at a time.

* Prioritized sweeping backs up the state whose residual may be largest. The priority of a state is a bound on its
  residual: the sum, over what changed since its last backup, of discounted probability × change. So an empty queue
  proves that no residual exceeds the threshold (Moore & Atkeson 1993; Peng & Williams 1993, who keep the largest term
  instead of the sum, which proves nothing).
* RTDP backs up the states on simulated greedy paths, starting from an upper bound of V* (Barto, Bradtke & Singh 1995).
  Trials start from the model's start distribution; once those are accurate, also where the residual is still too large,
  so that the answer covers every state.
* Labelled RTDP ends a trial at states whose whole greedy future is known to be accurate (Bonet & Geffner 2003).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neuralq.exact.asynchronous_kernels import greedy_trials, predecessors, process_queue, settle
from neuralq.exact.kernels import Floats, sweep
from neuralq.exact.problem import Found, PlanningProblem

__all__ = ["labelled_rtdp", "prioritized_sweeping", "rtdp"]


_TRIALS_BETWEEN_CHECKS = 64
_STALLED_CHECKS = 20


def _threshold(problem: PlanningProblem, tol: float, v: Floats) -> float:
    """A residual that proves the tolerance, or as little as rounding allows."""
    return max(0.5 * tol / problem.reach, problem.rounding(v))


def prioritized_sweeping(problem: PlanningProblem, tol: float, limit: float) -> Found:
    """Backs up the state of largest priority until every residual is proven small; S backups count as an iteration."""
    rows, num_states = problem.rows, len(problem.acts)
    begins = np.zeros(num_states + 1, dtype=np.int64)
    np.cumsum(np.bincount(problem.mdp.transition.indices, minlength=num_states), out=begins[1:])
    state, weight = np.empty(len(rows.column), dtype=rows.starts.dtype), np.empty(len(rows.column))
    predecessors(rows, begins[:-1].copy(), state, weight)
    v, better = np.zeros(num_states), np.empty(num_states)
    sweep(rows, v, better, np.inf)
    scale = np.full(1, problem.reach * problem.largest_reward)
    threshold = _threshold(problem, tol, scale)
    priority = np.abs(better)
    heap, place = np.empty(num_states, dtype=np.int64), np.full(num_states, -1, dtype=np.int64)
    waiting = np.flatnonzero((priority > threshold) & problem.acts)
    waiting = waiting[np.argsort(-priority[waiting], kind="stable")]  # sorted: a heap already
    size = len(waiting)
    heap[:size], place[waiting] = waiting, np.arange(size)
    iterations, backups = 0, len(rows.reward)
    while size > 0 and iterations < limit:
        size, _, used = process_queue(
            rows, begins, state, weight, v, priority, heap, place, size, threshold, num_states
        )
        iterations, backups = iterations + 1, backups + used
    return Found(v, iterations, backups)


def _optimistic(problem: PlanningProblem) -> Floats:
    """An upper bound of V*: the largest reward in every step that any policy can make."""
    most = max(float(problem.mdp.reward.max()), 0.0) * problem.reach
    return np.where(problem.acts, most, 0.0)


def _draw_starts(problem: PlanningProblem, num: int, rng: np.random.Generator) -> NDArray[np.int64]:
    return rng.choice(len(problem.acts), size=num, p=problem.mdp.start_distribution).astype(np.int64)


def rtdp(problem: PlanningProblem, tol: float, limit: float, seed: int) -> Found:
    """Backs up the states on simulated greedy paths; a trial counts as an iteration."""
    rng, rows = np.random.default_rng(seed), problem.rows
    v, better = _optimistic(problem), np.empty(len(problem.acts))
    path = np.empty(10 * len(v) + 100, dtype=np.int64)
    starts = _draw_starts(problem, _TRIALS_BETWEEN_CHECKS, rng)
    iterations, backups, lowest, stalled = 0, 0, math.inf, 0
    pending, since_check = starts, 0
    while iterations < limit:
        pending = pending[: int(min(len(pending), limit - iterations))]
        _, states, used = greedy_trials(rows, v, pending, ~problem.acts, len(path), path, rng)
        iterations, backups, since_check = iterations + len(pending), backups + used, since_check + states
        if since_check >= len(v):  # a check costs as much as a sweep: so often, and no more often
            since_check = 0
            sweep(rows, v, better, np.inf)
            backups += len(rows.reward)
            residual = np.abs(better - v)
            worst, threshold = float(residual.max()), _threshold(problem, tol, v)
            stalled = 0 if worst < lowest else stalled + 1
            lowest = min(lowest, worst)
            if worst <= threshold or (stalled > _STALLED_CHECKS and worst <= 4 * problem.rounding(v)):
                break
            wrong = np.flatnonzero(residual > threshold)
            starts = np.concatenate([_draw_starts(problem, _TRIALS_BETWEEN_CHECKS // 2, rng), rng.permutation(wrong)])
            pending = starts
        else:
            pending = np.concatenate([_draw_starts(problem, _TRIALS_BETWEEN_CHECKS // 2, rng), rng.choice(starts, 64)])
    return Found(v, iterations, backups)


def labelled_rtdp(problem: PlanningProblem, tol: float, limit: float, seed: int) -> Found:
    """RTDP that labels what is accurate and never goes there again; a trial counts as an iteration."""
    rng, rows = np.random.default_rng(seed), problem.rows
    v, settled = _optimistic(problem), ~problem.acts
    seen, path = np.zeros(len(v), dtype=bool), np.empty(10 * len(v) + 100, dtype=np.int64)
    envelope = np.empty(len(v), dtype=np.int64)
    threshold = _threshold(problem, tol, v)
    first = np.flatnonzero(problem.mdp.start_distribution)
    rest = np.flatnonzero(problem.acts & (problem.mdp.start_distribution == 0))
    iterations, backups = 0, 0
    for root in np.concatenate([rng.permutation(first), rng.permutation(rest)]):
        while not settled[root] and iterations < limit:
            steps, _, used = greedy_trials(rows, v, np.full(1, root), settled, len(path), path, rng)
            iterations, backups = iterations + 1, backups + used
            for s in path[:steps][::-1]:
                if not settled[s]:
                    solved, used = settle(rows, v, int(s), threshold, settled, seen, envelope)
                    backups += used
                    if not solved:
                        break
    return Found(v, iterations, backups)

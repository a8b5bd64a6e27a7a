"""Optimal values of a known model, with a proof of how close they are.

However the values V were found, one more application of the Bellman optimality operator T proves what they are worth:
V* lies within `PlanningProblem.interval` of T V, and an allowance for the rounding of that very backup is added. That
makes the reported `bound`, a maximum norm and not a span; a run has converged when it is at most ``tol``. The methods
are described where they are: `sweeping`, `policies`, `asynchronous`, `undiscounted`.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_discount, check_positive, check_whole
from neuralq.exact.asynchronous import labelled_rtdp, prioritized_sweeping, rtdp
from neuralq.exact.kernels import best_of_rows, spread
from neuralq.exact.policies import linear_programming, policy_iteration
from neuralq.exact.problem import Found, PlanningProblem, default_tolerance, is_close_enough, prepare, q_of_rows
from neuralq.exact.sweeping import gauss_seidel, modified_policy_iteration, value_iteration
from neuralq.exact.undiscounted import (
    bellman_ford,
    certified,
    ending_at_rest,
    episodic,
    is_shortest_path,
    path_rounding,
    proper_policy_iteration,
    resting_rows,
)
from neuralq.mdp import FiniteMDP

if TYPE_CHECKING:
    import gymnasium

__all__ = ["METHODS", "Solution", "count_optimal_policies", "optimal_policies", "solve"]

Solver = Callable[[PlanningProblem, float, float], Found]

_SOLVERS: dict[str, Solver] = {
    "value-iteration": value_iteration,
    "gauss-seidel": gauss_seidel,
    "policy-iteration": policy_iteration,
    "modified-policy-iteration": modified_policy_iteration,
    "prioritized-sweeping": prioritized_sweeping,
    "linear-programming": linear_programming,
    "bellman-ford": bellman_ford,
}
_TRIALS = {"rtdp": rtdp, "labelled-rtdp": labelled_rtdp}
METHODS = ("auto", *_SOLVERS, *_TRIALS)
_SPANS = ("value-iteration", "modified-policy-iteration")  # methods that end by sweeps as it is
_SMALL = 2000  # states up to which factoring a policy's matrix is the quickest


@dataclass(frozen=True, eq=False)
class Solution:
    """An answer and how far it can be from the truth.

    Args:
        q: Q* ``[S, A]``, NaN where an action is not legal.
        v: V* ``[S]``, 0 at terminal states.
        policy: an optimal action of every state, ``[S]``; -1 at terminal states. It is the lowest of those that may be
            optimal; with γ = 1 one that leads to an end; after an early stop the best so far.
        optimal_actions: every action that may be optimal given the bound, ``[S, A]``. None that is optimal is missing;
            where ``separated`` is False the bound is too wide to say that each of them is.
        iterations: sweeps, policies evaluated, pivots, trials, or as many backups as there are states, by method.
        backups: applications of the Bellman equation to one state-action pair.
        residual: ‖T V − V‖∞ of the last backup.
        bound: guaranteed ‖v − V*‖∞.
        converged: whether the bound is at most the tolerance asked for, or at the floor of rounding and at most the
            tolerance times the largest |V|.
        seconds: wall-clock time.
        method: the method that found it.
    """

    q: NDArray[np.float64]
    v: NDArray[np.float64]
    policy: NDArray[np.int64]
    optimal_actions: NDArray[np.bool_]
    iterations: int
    backups: int
    residual: float
    bound: float
    converged: bool
    seconds: float
    method: str

    @property
    def separated(self) -> NDArray[np.bool_]:
        """Where ``optimal_actions`` is an answer, ``[S]``: one action is left, or all are optimal within ``tol``."""
        return np.asarray((self.optimal_actions.sum(axis=1) <= 1) | self.converged)


def solve(
    mdp: FiniteMDP | gymnasium.Env[Any, Any],
    gamma: float,
    method: str = "auto",
    tol: float | None = None,
    *,
    max_iterations: int | None = None,
    seed: int = 0,
) -> Solution:
    """The optimal values and every optimal action of a model, within a guaranteed bound.

    Args:
        mdp: the model, or an environment that has one (`FiniteMDP.from_gymnasium`).
        gamma: γ in [0, 1]. With 1 episodes must end: ``"auto"`` and ``"policy-iteration"`` need a policy that ends them
            from every state, and one that never does must earn less; other methods need that every policy ends them.
            Where no end can be reached, but one can rest at reward 0 and earn nothing, V* is 0 (an absorbing goal).
        method: ``"value-iteration"``, ``"gauss-seidel"``, ``"policy-iteration"``, ``"modified-policy-iteration"``,
            ``"prioritized-sweeping"``, ``"linear-programming"``, ``"rtdp"``, ``"labelled-rtdp"``, ``"bellman-ford"``
            (deterministic with γ = 1 only), or ``"auto"``: Bellman–Ford where it applies, policy iteration for small
            models, modified policy iteration for large ones.
        tol: largest ‖v − V*‖∞ to accept; default 1e-8, or a millionth of the largest |reward| where that is less.
            Where rounding allows no less than ``tol``, ``tol`` times the largest |V| is accepted.
        max_iterations: stop after so many, with ``converged=False``; default: until nothing improves any more.
        seed: of the simulated trials of the two RTDP methods.

    Raises:
        ValueError: an argument out of range, a method that does not fit the model, or γ = 1 with episodes that cannot,
            or should not, end; it names the row or state.

    Source: Mitchell 1997, section 13.4; Puterman 1994, chapter 6; Barto, Bradtke & Singh 1995.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[1.0, 2.0]])  # one state: earn 1 or 2 for ever
        >>> answer = solve(mdp, gamma=0.9)
        >>> answer.v.round(6).tolist(), answer.policy.tolist(), answer.converged
        ([20.0], [1], True)
    """
    check_discount("gamma", gamma)
    check_choice("method", method, METHODS)
    if tol is not None:
        check_positive("tol", tol)
    check_whole("seed", seed, minimum=0)
    if max_iterations is not None:
        check_whole("max_iterations", max_iterations)
    began = time.perf_counter()
    mdp = _model(mdp)
    problem = prepare(mdp, gamma)
    tol = tol or default_tolerance(problem)
    resting = resting_rows(problem) if math.isinf(problem.reach) else np.empty(0, dtype=np.int64)
    if resting.size:
        ends = ending_at_rest(mdp, resting)
        answer = solve(ends, gamma, method, tol, max_iterations=max_iterations, seed=seed)
        return _with_rest(problem, resting, answer, began)
    chosen = _automatic(problem) if method == "auto" else method
    limit = math.inf if max_iterations is None else max_iterations
    return _solved(problem, chosen, tol, limit, seed, began)


def _model(given: FiniteMDP | gymnasium.Env[Any, Any]) -> FiniteMDP:
    """A model, or the one inside an environment."""
    if isinstance(given, FiniteMDP):
        return given
    if not hasattr(given, "unwrapped"):
        raise ValueError(
            f"an exact answer needs a FiniteMDP, or an environment that has a table, got {given!r}; neuralq.solve "
            "takes names of environments, too"
        )
    return FiniteMDP.from_gymnasium(given)


def _solved(problem: PlanningProblem, chosen: str, tol: float, limit: float, seed: int, began: float) -> Solution:
    """The answer of a method, and sweeps after it where it is not good enough."""
    if math.isinf(problem.reach) and chosen != "bellman-ford":
        problem = episodic(problem, chosen)
    if chosen in _TRIALS:
        found = _TRIALS[chosen](problem, tol, limit, seed)
    elif chosen == "policy-iteration" and math.isinf(problem.reach):
        found = proper_policy_iteration(problem, tol, limit)
    else:
        found = _SOLVERS[chosen](problem, tol, limit)
    answer = _proven(problem, found, tol, chosen, began)
    if answer.converged or math.isfinite(limit) or chosen in _SPANS or not problem.uniform:
        return answer
    return _swept(problem, answer, tol, began)


def _with_rest(problem: PlanningProblem, resting: NDArray[np.int64], answer: Solution, began: float) -> Solution:
    """An answer for the model that ends at rest, told of the actions that there are at rest."""
    mdp = problem.mdp
    at_rest = np.zeros(mdp.num_states, dtype=bool)
    at_rest[mdp.s_tm1[resting]] = True
    values = q_of_rows(problem, answer.v)
    rows = np.flatnonzero(at_rest[mdp.s_tm1])
    s, a = mdp.s_tm1[rows], mdp.a_tm1[rows]
    q, optimal, policy = answer.q.copy(), answer.optimal_actions.copy(), answer.policy.copy()
    q[s, a] = values[rows]
    optimal[s, a] = values[rows] >= -2 * (answer.bound + answer.residual)
    policy[mdp.s_tm1[resting[::-1]]] = mdp.a_tm1[resting[::-1]]  # the last written is the lowest
    seconds = time.perf_counter() - began
    return replace(answer, q=q, optimal_actions=optimal, policy=policy, seconds=seconds)


def _swept(problem: PlanningProblem, answer: Solution, tol: float, began: float) -> Solution:
    """Sweeps over an answer that is not good enough, if they improve it.

    With a long reach an action that is better by less than the error of V can matter: over all steps it adds up. The
    error is nearly the same in all states, though, and sweeps look at differences.
    """
    found = value_iteration(problem, tol, math.inf, answer.v)
    iterations, backups = answer.iterations + found.iterations, answer.backups + found.backups
    swept = _proven(problem, Found(found.v, iterations, backups), tol, answer.method, began)
    return swept if swept.bound < answer.bound else answer


def _automatic(problem: PlanningProblem) -> str:
    """The method that suits a model."""
    if is_shortest_path(problem):
        return "bellman-ford"
    small = problem.mdp.num_states <= _SMALL or math.isinf(problem.reach)
    return "policy-iteration" if small else "modified-policy-iteration"


def _proven(problem: PlanningProblem, found: Found, tol: float, method: str, began: float) -> Solution:
    """One last application of T, and what it proves."""
    mdp, v, rows = problem.mdp, found.v, problem.rows
    values = q_of_rows(problem, v)
    better, best_row = np.empty(mdp.num_states), np.empty(mdp.num_states, dtype=np.int64)
    least, largest = best_of_rows(rows, values, v, better, best_row)
    residual = max(-least, largest, 0.0) + 0.0
    if method == "bellman-ford":
        floor = path_rounding(problem, v)
        bound = floor if residual == 0 else math.inf
    else:
        problem = certified(problem, v)
        down, up = problem.interval(least, largest)
        floor = problem.reach * problem.rounding(v)
        bound = max(up, -down, 0.0) + floor
    converged = is_close_enough(bound, tol, v, floor)
    q, optimal = np.full((mdp.num_states, mdp.num_actions), np.nan), np.zeros((mdp.num_states, mdp.num_actions), bool)
    policy = np.empty(mdp.num_states, dtype=np.int64)
    # |q − Q*| ≤ ‖V − V*‖ ≤ bound + residual: an optimal action lies within twice that of the best.
    spread(rows, mdp.a_tm1, values, 2 * (bound + residual), q, optimal, policy)
    if problem.gamma == 1 and found.policy is not None:
        best_row = np.minimum(found.policy, mdp.num_rows - 1)  # any row where there is none
    if not converged or problem.gamma == 1:
        policy = np.where(mdp.is_terminal, -1, mdp.a_tm1[best_row])
    backups, seconds = found.backups + mdp.num_rows, time.perf_counter() - began
    return Solution(q, better, policy, optimal, found.iterations, backups, residual, bound, converged, seconds, method)


def count_optimal_policies(answer: Solution) -> int:
    """How many deterministic policies take an optimal action in every state: Π_s |optimal actions of s|.

    Raises:
        ValueError: the bound does not separate the actions of some state.

    Source: Mitchell 1997, exercise 13.1.

    Example:
        >>> twins = FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[2.0, 2.0]])
        >>> count_optimal_policies(solve(twins, gamma=0.5))
        2
    """
    _check_separated(answer)
    return math.prod(int(n) for n in answer.optimal_actions.sum(axis=1) if n)


def optimal_policies(answer: Solution) -> Iterator[NDArray[np.int64]]:
    """Every deterministic optimal policy ``[S]``, one after the other, -1 at terminal states; the last state first.

    Raises:
        ValueError: the bound does not separate the actions of some state.

    Example:
        >>> twins = FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[2.0, 2.0]])
        >>> [policy.tolist() for policy in optimal_policies(solve(twins, gamma=0.5))]
        [[0], [1]]
    """
    _check_separated(answer)
    choices = [np.flatnonzero(row) if row.any() else np.array([-1]) for row in answer.optimal_actions]
    for policy in itertools.product(*choices):
        yield np.array(policy, dtype=np.int64)


def _check_separated(answer: Solution) -> None:
    if not answer.separated.all():
        s = int(np.argmin(answer.separated))
        raise ValueError(
            f"which actions of state {s} are optimal is not known: the error of V may be as large as "
            f"{answer.bound:.3g}; allow more iterations, or a larger tol"
        )

"""Optimal values of a known model, with a proof of how close they are.

Let T be the Bellman optimality operator and c = γ · max over rows of discount · (mass that goes on). T is a
c-contraction in the maximum norm (Puterman 1994, theorem 6.2.3), so for every V

    ‖T V − V*‖∞ ≤ c / (1 − c) · ‖T V − V‖∞.

Both methods end with one more application of T to what they found; its residual, and an allowance for the rounding of
that very backup, make the reported `bound`. A run has converged when the bound is at most ``tol``.

* value iteration repeats V ← T V;
* policy iteration evaluates the policy exactly and changes an action only when another is better by more than rounding
  can produce. So actions of equal value never make it cycle.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_discount, check_positive, check_whole
from neuralq.exact.evaluation import action_values, evaluate
from neuralq.mdp import FiniteMDP

__all__ = ["METHODS", "Solution", "solve"]

METHODS = ("value-iteration", "policy-iteration")


@dataclass(frozen=True, eq=False)
class Solution:
    """An answer and how far it can be from the truth.

    Args:
        q: Q* ``[S, A]``, NaN where an action is not legal.
        v: V* ``[S]``, 0 at terminal states.
        policy: an optimal action of every state, the lowest of those that tie, ``[S]``; -1 at terminal states.
        optimal_actions: every action that may be optimal given the bound, ``[S, A]``. None that is optimal is missing.
        iterations: sweeps, or policies evaluated.
        backups: applications of the Bellman equation to one state-action pair.
        residual: ‖T V − V‖∞ of the last backup.
        bound: guaranteed ‖v − V*‖∞.
        converged: whether the bound is at most the tolerance asked for.
        seconds: wall-clock time.
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


def solve(
    mdp: FiniteMDP,
    gamma: float,
    method: str = "value-iteration",
    tol: float = 1e-8,
    *,
    max_iterations: int | None = None,
) -> Solution:
    """The optimal values and policy of a model, within a guaranteed bound.

    Args:
        mdp: the model.
        gamma: γ in [0, 1]; 1 only where every action may end the episode.
        method: ``"value-iteration"`` or ``"policy-iteration"``.
        tol: largest ‖v − V*‖∞ to accept.
        max_iterations: stop after so many, with ``converged=False``; default: until nothing improves any more.

    Raises:
        ValueError: an argument out of range, or γ = 1 with an action that never ends.

    Source: Mitchell 1997, section 13.4; Puterman 1994, sections 6.3 and 6.4.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[1.0, 2.0]])  # one state: earn 1 or 2 for ever
        >>> answer = solve(mdp, gamma=0.9)
        >>> answer.v.round(6).tolist(), answer.policy.tolist(), answer.converged
        ([20.0], [1], True)
    """
    check_discount("gamma", gamma)
    check_choice("method", method, METHODS)
    check_positive("tol", tol)
    if max_iterations is not None:
        check_whole("max_iterations", max_iterations)
    began = time.perf_counter()
    modulus = _contraction(mdp, gamma)
    run = _value_iteration if method == "value-iteration" else _policy_iteration
    v, iterations, backups = run(mdp, gamma, modulus, tol, max_iterations)
    q = action_values(mdp, v, gamma)
    better = _best(q)
    residual = float(np.max(np.abs(better - v)))
    bound = (modulus * residual + _rounding(mdp, v)) / (1 - modulus)
    # |q − Q*| ≤ c·‖V − V*‖ ≤ bound + residual: an optimal action lies within twice that of the best.
    optimal = np.nan_to_num(q, nan=-np.inf) >= (better - 2 * (bound + residual))[:, None]
    optimal &= mdp.legal
    policy = np.where(mdp.is_terminal, -1, np.argmax(optimal, axis=1))
    seconds = time.perf_counter() - began
    backups += mdp.num_rows
    return Solution(q, better, policy, optimal, iterations, backups, residual, bound, bound <= tol, seconds)


def _contraction(mdp: FiniteMDP, gamma: float) -> float:
    """The modulus of T in the maximum norm."""
    row_modulus = gamma * mdp.row_discount * np.minimum(mdp.row_mass, 1.0)
    modulus = float(np.max(row_modulus))
    if modulus >= 1 - 1e-12:
        raise ValueError(
            f"gamma={gamma} does not contract: {mdp.row_name(int(np.argmax(row_modulus)))} never ends and loses "
            "nothing; use gamma < 1"
        )
    return modulus


def _rounding(mdp: FiniteMDP, v: NDArray[np.float64]) -> float:
    """What rounding can do to one backup: each of its sums is off by half a unit in the last place."""
    longest = int(np.max(np.diff(mdp.transition.indptr), initial=0))
    size = float(np.max(np.abs(mdp.reward)) + np.max(np.abs(v)))
    return (longest + 4) * float(np.finfo(np.float64).eps) * size


def _best(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest legal value of every state; 0 where there is none."""
    top: NDArray[np.float64] = np.max(np.nan_to_num(q, nan=-np.inf), axis=1)
    return np.where(np.isneginf(top), 0.0, top)


def _value_iteration(
    mdp: FiniteMDP, gamma: float, modulus: float, tol: float, max_iterations: int | None
) -> tuple[NDArray[np.float64], int, int]:
    lively = np.flatnonzero(~mdp.is_terminal)
    first_row = mdp.row_starts[lively]
    decay = gamma * mdp.row_discount
    v = np.zeros(mdp.num_states)
    best_residual, stalled, iterations = np.inf, 0, 0
    patience = 20  # residuals shrink by the modulus; one that finds no new low is at the floor of rounding
    while max_iterations is None or iterations < max_iterations:
        better = np.zeros(mdp.num_states)
        better[lively] = np.maximum.reduceat(mdp.reward + decay * (mdp.transition @ v), first_row)
        residual = float(np.max(np.abs(better - v)))
        v, iterations = better, iterations + 1
        reach = tol * (1 - modulus) - modulus * residual
        if residual == 0 or (reach >= 0 and _rounding(mdp, v) <= reach):
            break
        stalled = 0 if residual < best_residual else stalled + 1
        best_residual = min(best_residual, residual)
        if stalled > patience:
            break
    return v, iterations, iterations * mdp.num_rows


def _policy_iteration(
    mdp: FiniteMDP, gamma: float, modulus: float, tol: float, max_iterations: int | None
) -> tuple[NDArray[np.float64], int, int]:
    states = np.arange(mdp.num_states)
    q = action_values(mdp, np.zeros(mdp.num_states), gamma)
    policy = np.argmax(np.nan_to_num(q, nan=-np.inf), axis=1)
    v, iterations = np.zeros(mdp.num_states), 0
    while max_iterations is None or iterations < max_iterations:
        v = evaluate(mdp, policy, gamma)
        q = action_values(mdp, v, gamma)
        iterations += 1
        challenger = np.argmax(np.nan_to_num(q, nan=-np.inf), axis=1)
        gain = np.nan_to_num(q[states, challenger] - q[states, policy], nan=0.0)
        # The incumbent stays unless it is beaten by more than the rounding of two evaluations can explain.
        beaten = gain > 4 * _rounding(mdp, v) / (1 - modulus)
        if not beaten.any():
            break
        policy = np.where(beaten, challenger, policy)
    return v, iterations, iterations * mdp.num_rows

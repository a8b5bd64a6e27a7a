"""Fitted evaluation and fitted Q-iteration on a finite problem with linear features: least squares backed up for ever.

    w ← C⁺ X' D (r + γ P_π X w),      C = X' D X                                       (evaluation)
    w ← C⁺ Φ' D (r + γ P max_a Φ w),  C = Φ' D Φ, a row of Φ for each pair             (Q-iteration)

Every sweep projects the backed-up values on the features in the norm of D. For evaluation it is affine in w, so its
matrix F = γ C⁺ X' D P_π X decides: the errors Xw grow by its spectral radius. The same A = C − γ X' D P X decides TD,
but the thresholds need not agree: F has an eigenvalue beyond 1 in modulus for complex or negative ones as well. On the
two states of Tsitsiklis & Van Roy 1996 with features 1 and 2, F = (6 − 4ε) γ / 5 and both thresholds are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from neuralq.checks import check_positive, check_whole
from neuralq.types import Floats
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["FittedWeights", "evaluation_matrix", "fitted_evaluation", "fitted_q_iteration"]


@dataclass(frozen=True, eq=False)
class FittedWeights:
    """What fitted iteration did to the weights. All numbers are finite.

    Args:
        weights: after k sweeps, ``[k + 1, d]``; row 0 is the start.
        converged: whether the last two agree within the tolerance, as values.
        stopped_on_cap: whether it was stopped because the values grew beyond the cap.
        growth: spectral radius of the sweep at the policy reached, without directions that no value depends on.
    """

    weights: Floats
    converged: bool
    stopped_on_cap: bool
    growth: float

    @property
    def iterations(self) -> int:
        """K, the number of sweeps."""
        return len(self.weights) - 1


def evaluation_matrix(problem: Problem) -> Floats:
    """F = γ C⁺ X' D P_π X, the matrix of fitted evaluation, ``[d, d]``. It converges from everywhere iff ρ(F) < 1.

    Raises:
        ValueError: features of state-action pairs; `fitted_q_iteration` takes those.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 0.0, False)])
        >>> two = Problem.from_mdp(mdp, [[1.0], [2.0]], gamma=0.9, state_distribution=[0.5, 0.5])
        >>> evaluation_matrix(two).round(12).tolist()  # 6γ/5
        [[1.08]]
    """
    project, transition, _ = _evaluation(problem)
    matrix: Floats = problem.gamma * project @ (transition @ problem.features)
    return matrix


def fitted_evaluation(
    problem: Problem, *, num_iterations: int = 1000, tolerance: float = 1e-12, cap: float = 1e10
) -> FittedWeights:
    """Fitted evaluation of the target policy, from the problem's initial weights.

    Args:
        problem: with features of states.
        num_iterations: most sweeps.
        tolerance: largest change of a value that counts as none.
        cap: stop where a value exceeds this many times the largest of the start and of the first sweep.

    Raises:
        ValueError: features of state-action pairs, or a number out of range.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 0.0, False)])
        >>> two = Problem.from_mdp(mdp, [[1.0], [2.0]], gamma=0.9, state_distribution=[0.5, 0.5])
        >>> fitted_evaluation(two, num_iterations=2).weights.round(12).tolist()
        [[1.0], [1.08], [1.1664]]
    """
    project, transition, reward = _evaluation(problem)
    x = problem.features
    table, converged, stopped = _iterate(
        x, project, lambda v: reward + problem.gamma * (transition @ v),
        problem.initial_weights, num_iterations, tolerance, cap,
    )  # fmt: skip
    return FittedWeights(table, converged, stopped, _radius(evaluation_matrix(problem)))


def fitted_q_iteration(
    problem: Problem, *, num_iterations: int = 1000, tolerance: float = 1e-12, cap: float = 1e10
) -> FittedWeights:
    """Fitted Q-iteration: the best action at every successor, least squares over all pairs with weight d(s) μ(a|s).

    Args:
        problem: with features of state-action pairs.
        num_iterations: most sweeps.
        tolerance: largest change of a value that counts as none.
        cap: stop where a value exceeds this many times the largest of the start and of the first sweep.

    Raises:
        ValueError: features of states, or a number out of range.

    Source: Ernst, Geurts & Wehenkel 2005 (with least squares in place of trees).

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(1, 2, lambda s: [0, 1], lambda s, a: [(1.0, 0, float(a), a == 0)])
        >>> table = Problem.from_mdp(mdp, np.eye(2)[None], gamma=0.5)
        >>> fitted_q_iteration(table).weights[-1].round(9).tolist()
        [0.0, 2.0]
    """
    if not problem.learns_q:
        raise ValueError("fitted Q-iteration needs features of state-action pairs [S, A, d]; see fitted_evaluation")
    mdp = problem.mdp
    pairs = (mdp.s_tm1, mdp.a_tm1)
    phi = problem.features[pairs]
    mass = problem.state_distribution[mdp.s_tm1] * problem.behaviour_policy[pairs]
    project = _projection(phi, mass)
    onward = sparse.csr_array(sparse.diags_array(mdp.row_discount) @ mdp.transition)

    def best(q: Floats) -> tuple[Floats, NDArray[np.int64]]:
        table = np.full(mdp.legal.shape, -np.inf)
        table[pairs] = q
        return np.where(mdp.is_terminal, 0.0, table.max(axis=1)), table.argmax(axis=1)

    def back_up(q: Floats) -> Floats:
        target: Floats = mdp.reward + problem.gamma * (onward @ best(q)[0])
        return target

    weights, converged, stopped = _iterate(
        phi, project, back_up, problem.initial_weights, num_iterations, tolerance, cap
    )  # fmt: skip
    greedy = best(phi @ weights[-1])[1]
    chosen = np.where(mdp.is_terminal[:, None], 0.0, problem.features[np.arange(mdp.num_states), greedy])
    return FittedWeights(weights, converged, stopped, _radius(problem.gamma * project @ (onward @ chosen)))


def _evaluation(problem: Problem) -> tuple[Floats, sparse.csr_array, Floats]:
    """C⁺X'D, P_π with discounts, and r_π."""
    if problem.learns_q:
        raise ValueError("fitted evaluation needs features of states [S, d]; see fitted_q_iteration")
    mdp = problem.mdp
    weight = problem.target_policy[mdp.s_tm1, mdp.a_tm1]
    choose = sparse.csr_array((weight, (mdp.s_tm1, np.arange(mdp.num_rows))), shape=(mdp.num_states, mdp.num_rows))
    onward = sparse.csr_array(choose @ (sparse.diags_array(mdp.row_discount) @ mdp.transition))
    return _projection(problem.features, problem.state_distribution), onward, choose @ mdp.reward


def _projection(x: Floats, mass: Floats) -> Floats:
    """C⁺X'D as the pseudo-inverse of √D X, which keeps the digits that forming C would lose."""
    root = np.sqrt(mass)
    return np.asarray(np.linalg.pinv(root[:, None] * x) * root, dtype=np.float64)


def _iterate(
    x: Floats, project: Floats, back_up: Callable[[Floats], Floats], start: Floats,
    num_iterations: int, tolerance: float, cap: float,
) -> tuple[Floats, bool, bool]:  # fmt: skip
    check_whole("num_iterations", num_iterations)
    check_positive("tolerance", tolerance)
    check_positive("cap", cap)
    rows, values = [start], x @ start
    limit, converged, stopped = np.inf, False, False
    for k in range(num_iterations):
        w = project @ back_up(values)
        fresh = x @ w
        if not np.isfinite(fresh).all():
            stopped = True
            break
        if k == 0:
            limit = cap * (max(np.abs(fresh).max(), np.abs(values).max()) or 1.0)
        rows.append(w)
        moved, values = float(np.abs(fresh - values).max()), fresh
        converged, stopped = moved <= tolerance, bool(np.abs(values).max() > limit)
        if converged or stopped:
            break
    return np.array(rows), converged, stopped


def _radius(matrix: Floats) -> float:
    return float(np.abs(np.linalg.eigvals(matrix)).max())

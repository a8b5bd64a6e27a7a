"""Exact policies: policy iteration and linear programming.

* Policy iteration evaluates the policy and changes an action only when another is better by more than the error of that
  evaluation can explain, so actions of equal value never make it cycle (Howard 1960; Puterman 1994, section 6.4).
* The linear program min Σ_s V(s) s.t. V(s) ≥ r + γ P V for every row has V* as its solution, and its dual is positive
  on the rows of an optimal policy (Puterman 1994, section 6.9). That policy is evaluated exactly, for the simplex and
  interior-point methods of HiGHS keep their constraints to 1e-7 only.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from neuralq.exact.kernels import Floats, look_ahead
from neuralq.exact.problem import Found, PlanningProblem
from neuralq.exact.sweeping import PolicyMatrix

__all__ = ["best_rows", "linear_programming", "policy_iteration", "policy_values"]


_MOST_FACTORED = 3000  # states; beyond, the factors of a matrix without structure may not fit into memory
_MOST_STEPS = 1e5  # expected steps up to which sweeps evaluate a policy in reasonable time
_LARGEST_EVALUATION_SWEEPS = 1_000_000


def policy_iteration(
    problem: PlanningProblem, tol: float, limit: float, policy: NDArray[np.int64] | None = None
) -> Found:
    """Policies, each better than the last, until none is; ``policy`` (a row per state) is where to begin."""
    mdp, rows = problem.mdp, problem.rows
    q, states = rows.reward.copy(), np.flatnonzero(problem.acts)
    rows_now = best_rows(problem, q) if policy is None else policy
    v, iterations, backups = np.zeros(mdp.num_states), 0, 0
    while iterations < limit:
        v, error, sweeps = policy_values(problem, rows_now, v)
        look_ahead(rows, v, q)
        iterations, backups = iterations + 1, backups + mdp.num_rows + sweeps * len(states)
        challenger = best_rows(problem, q)
        gain = q[challenger[states]] - q[rows_now[states]]
        beaten = states[gain > 2 * error]
        if not beaten.size:
            break
        rows_now = rows_now.copy()
        rows_now[beaten] = challenger[beaten]
    return Found(v, iterations, backups, rows_now)


def best_rows(problem: PlanningProblem, q: Floats) -> NDArray[np.int64]:
    """The row of largest value of every state, the lowest where several tie, ``[S]``; 0 where there is none."""
    starts, states = problem.mdp.row_starts, np.flatnonzero(problem.acts)
    best = np.maximum.reduceat(q, starts[states])
    counts = np.diff(starts)[states]
    at_best = np.flatnonzero(q == np.repeat(best, counts))
    rows = np.zeros(len(starts) - 1, dtype=np.int64)
    rows[problem.mdp.s_tm1[at_best[::-1]]] = at_best[::-1]  # the last written is the lowest
    return rows


def policy_values(problem: PlanningProblem, policy: NDArray[np.int64], guess: Floats) -> tuple[Floats, float, int]:
    """V_π of a row per state, an estimate of its error, and the sweeps that it took (0 where a matrix was factored)."""
    mdp = problem.mdp
    if mdp.num_states > _MOST_FACTORED and problem.reach <= _MOST_STEPS:
        matrix = PolicyMatrix(problem, policy.astype(problem.rows.starts.dtype))
        scale = problem.rounding(guess) + problem.rounding(np.full(1, problem.largest_reward * problem.reach))
        v, sweeps = matrix.evaluate(guess.copy(), scale, _LARGEST_EVALUATION_SWEEPS, span=False)
        return v, 4 * problem.reach * (problem.rounding(v) + scale), sweeps
    acting = problem.acts.astype(np.float64)
    chosen = sparse.csr_array(mdp.transition[policy])
    system = sparse.eye_array(mdp.num_states) - sparse.diags_array(problem.rows.decay[policy] * acting) @ chosen
    if math.isinf(problem.reach):
        _check_ends(problem, problem.rows.decay[policy], chosen)
    factors = splu(sparse.csc_array(system))
    v = np.asarray(factors.solve(problem.rows.reward[policy] * acting)) + 0.0  # no -0.0 for readers to wonder at
    steps = float(factors.solve(acting).max())  # expected, discounted: so often does the rounding of a step count
    return v, 2 * steps * problem.rounding(v), 0


def _check_ends(problem: PlanningProblem, decay: Floats, chosen: sparse.csr_array) -> None:
    """Every state reaches, against the arrows, one that may end, by missing mass or by a discount below 1.

    Raises:
        ArithmeticError: it does not; the policy has no finite value.
    """
    ends = ~problem.acts | (decay * np.asarray(chosen.sum(axis=1)) < 1 - 1e-9)
    while True:
        more = ends | (chosen @ ends.astype(np.float64) > 0)
        if np.array_equal(more, ends):
            break
        ends = more
    if not ends.all():
        raise ArithmeticError(f"from {problem.mdp.state_name(int(np.argmin(ends)))} it never ends")


def linear_programming(problem: PlanningProblem, tol: float, limit: float) -> Found:
    """The policy that the dual of the linear program puts its weight on, evaluated exactly."""
    from scipy.optimize import linprog  # a fifth of a second, for this one method

    mdp, rows = problem.mdp, problem.rows
    every_row = np.arange(mdp.num_rows)
    chooses = sparse.csr_array((np.ones(mdp.num_rows), (every_row, mdp.s_tm1)), shape=mdp.transition.shape)
    constraints = sparse.diags_array(rows.decay) @ mdp.transition - chooses
    options = {} if limit == np.inf else {"maxiter": int(limit)}
    # Its tolerances are absolute: rewards much smaller than 1 would all be within them. A power of two rounds nothing.
    unit = 2.0 ** math.floor(math.log2(problem.largest_reward or 1.0))
    least = np.where(problem.acts, -np.inf, 0.0)  # terminal values are 0, the least that they may be
    result = linprog(
        np.ones(mdp.num_states),
        A_ub=constraints,
        b_ub=-rows.reward / unit,
        bounds=np.stack([least, np.full(mdp.num_states, np.inf)], axis=1),
        method="highs",
        options=options,
    )
    iterations = int(result.nit or 0)
    if result.x is None or result.ineqlin.marginals is None:  # stopped before it had anything
        return Found(np.zeros(mdp.num_states), iterations, 0)
    occupied = -np.asarray(result.ineqlin.marginals)
    v, _, sweeps = policy_values(problem, best_rows(problem, occupied), unit * np.asarray(result.x, dtype=np.float64))
    return Found(v, iterations, sweeps * int(problem.acts.sum()))

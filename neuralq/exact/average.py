"""Average reward: gain and bias, by multichain policy iteration and by relative value iteration.

The gain g_π(s) = lim (1/n) E[Σ_{t<n} r_t] of a policy solves, with its bias h_π,

    g = P_π g,    g + h = r_π + P_π h,    Σ_s d_C(s) h(s) = 0 on every recurrent class C with stationary d_C

(Puterman 1994, theorem 8.2.6). The gain of a recurrent class is one number; a model is *multichain* if some policy has
several classes, and then the gain may depend on where one starts. What ends an episode leads to rest, at gain 0.

* Policy iteration improves the gain first, then the bias among the actions that keep the gain, and keeps the present
  action on ties (Puterman 1994, section 9.2): right for every model.
* Relative value iteration repeats V ← τ T V + (1 − τ) V, which cures periodic chains; the least and the largest change,
  over τ, enclose the gain wherever it does not depend on the state (Puterman 1994, section 8.5). Where it does, the
  interval does not close: the answer says ``converged=False`` and its bound is the width that is left.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from neuralq.checks import check_choice, check_positive, check_whole
from neuralq.exact.evaluation import policy_process
from neuralq.exact.kernels import Floats
from neuralq.exact.policies import best_rows
from neuralq.exact.problem import PlanningProblem, default_tolerance, is_close_enough, prepare, q_of_rows
from neuralq.mdp import FiniteMDP

__all__ = ["AverageEvaluation", "AverageSolution", "evaluate_average", "solve_average"]


_TIE = 1e-10  # relative: what the linear systems of an evaluation leave behind
_TAU = 0.5


@dataclass(frozen=True, eq=False)
class AverageEvaluation:
    """Long-run behaviour of a policy.

    Args:
        gain: average reward from every state, ``[S]``.
        bias: transient advantage of starting there, ``[S]``, averaging 0 over each recurrent class.
        recurrent_class: the number of the class of every recurrent state, -1 for transient ones, ``[S]``.
    """

    gain: Floats
    bias: Floats
    recurrent_class: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class AverageSolution:
    """The best long-run average reward.

    Args:
        gain: g* ``[S]``.
        bias: the bias of ``policy``, or relative values where value iteration found them, ``[S]``.
        policy: a policy that attains the gain, ``[S]``; -1 at terminal states.
        multichain: whether the policy has more than one recurrent class.
        iterations: policies evaluated, or sweeps.
        bound: guaranteed error of the gain at every state; for policy iteration the residual of the two optimality
            equations, which is rounding.
        converged: whether the bound is at most the tolerance asked for, or at the floor of rounding and at most the
            tolerance times the largest |gain|.
        seconds: wall-clock time.
    """

    gain: Floats
    bias: Floats
    policy: NDArray[np.int64]
    multichain: bool
    iterations: int
    bound: float
    converged: bool
    seconds: float


def evaluate_average(mdp: FiniteMDP, policy: ArrayLike) -> AverageEvaluation:
    """The gain, bias and recurrent classes of a policy.

    Args:
        mdp: the model.
        policy: actions ``[S]`` or probabilities ``[S, A]``.

    Raises:
        ValueError: a policy that `policy_process` refuses.

    Example:
        >>> flip = FiniteMDP.from_arrays([[[0.0, 1.0], [1.0, 0.0]]], [[0.0], [4.0]])
        >>> found = evaluate_average(flip, [0, 0])
        >>> found.gain.tolist(), found.bias.tolist()
        ([2.0, 2.0], [-1.0, 1.0])
    """
    chain, reward = policy_process(mdp, policy)
    num = mdp.num_states
    # What leaves the model rests: one more state, of gain 0.
    missing = np.maximum(1 - np.asarray(chain.sum(axis=1)), 0.0)
    missing[missing < 1e-9] = 0.0
    rest = sparse.csr_array([[1.0]])
    whole = sparse.csr_array(sparse.block_array([[chain, sparse.csr_array(missing[:, None])], [None, rest]]))
    whole.eliminate_zeros()
    earned = np.append(reward, 0.0)
    classes = _recurrent_classes(whole)
    gain, bias = np.zeros(num + 1), np.zeros(num + 1)
    for number in range(classes.max() + 1):
        members = np.flatnonzero(classes == number)
        gain[members], bias[members] = _one_class(sparse.csr_array(whole[members][:, members]), earned[members])
    passing = np.flatnonzero(classes < 0)
    if passing.size:
        rows = sparse.csr_array(whole[passing])
        factors = splu(sparse.csc_array(sparse.eye_array(len(passing)) - rows[:, passing]))
        gain[passing] = factors.solve(rows @ gain)
        bias[passing] = factors.solve(earned[passing] - gain[passing] + rows @ bias)
    return AverageEvaluation(gain[:num], bias[:num], classes[:num])


def _recurrent_classes(chain: sparse.csr_array) -> NDArray[np.int64]:
    """The number of each state's closed communicating class; -1 for states that are left for good."""
    count, label = connected_components(chain, directed=True, connection="strong")
    entries = chain.tocoo()
    leaves = np.zeros(count, dtype=bool)
    leaves[label[entries.row[label[entries.row] != label[entries.col]]]] = True
    number = np.where(leaves, -1, np.cumsum(~leaves) - 1)
    return np.asarray(number[label], dtype=np.int64)


def _one_class(chain: sparse.csr_array, reward: Floats) -> tuple[float, Floats]:
    """Gain and bias of an irreducible chain: h(0) = 0 makes the system regular, then h is shifted to average 0."""
    num = len(reward)
    # Unknowns (g, h(1), ..., h(n−1)): g + h − P h = r.
    system = sparse.lil_array(sparse.eye_array(num) - chain)
    system[:, 0] = 1.0
    factors = splu(sparse.csc_array(system))
    solved = factors.solve(reward)
    # The same matrix, transposed, gives the stationary distribution: d (I − P) = 0, Σ d = 1.
    first = np.zeros(num)
    first[0] = 1.0
    stationary = factors.solve(first, trans="T")
    gain, bias = float(solved[0]), np.append(0.0, solved[1:])
    return gain, bias - float(stationary @ bias)


def solve_average(
    mdp: FiniteMDP, method: str = "policy-iteration", tol: float | None = None, *, max_iterations: int = 100_000
) -> AverageSolution:
    """The largest average reward per step from every state, and a policy that attains it.

    Args:
        mdp: the model; an episode that ends rests at reward 0 for ever.
        method: ``"policy-iteration"`` (any model) or ``"relative-value-iteration"`` (large ones with one gain).
        tol: largest error of the gain to accept; default 1e-8, or a millionth of the largest |reward| where that is
            less. Where rounding allows no less than ``tol``, ``tol`` times the largest |gain| is accepted.
        max_iterations: stop after so many, with ``converged=False``.

    Raises:
        ValueError: an argument out of range.

    Source: Puterman 1994, chapters 8 and 9; Mahadevan 1996.

    Example:
        >>> islands = FiniteMDP.from_arrays([[[1.0, 0.0], [0.0, 1.0]]], [[1.0], [5.0]])
        >>> answer = solve_average(islands)
        >>> answer.gain.tolist(), answer.multichain
        ([1.0, 5.0], True)
    """
    check_choice("method", method, ("policy-iteration", "relative-value-iteration"))
    if tol is not None:
        check_positive("tol", tol)
    check_whole("max_iterations", max_iterations)
    began = time.perf_counter()
    problem = prepare(mdp, 1.0)  # row discounts are chances to go on
    iterate = _policy_iteration if method == "policy-iteration" else _relative_value_iteration
    tol = tol or default_tolerance(problem)
    rows, values, gain, iterations, bound = iterate(problem, tol, max_iterations)
    policy = np.where(mdp.is_terminal, -1, mdp.a_tm1[rows])
    found = evaluate_average(mdp, policy)
    multichain = len(np.unique(found.recurrent_class[found.recurrent_class >= 0])) > 1
    seconds = time.perf_counter() - began
    converged = is_close_enough(bound, tol, gain, problem.rounding(values))
    return AverageSolution(gain, values, policy, multichain, iterations, bound, converged, seconds)


def _policy_iteration(
    problem: PlanningProblem, tol: float, limit: int
) -> tuple[NDArray[np.int64], Floats, Floats, int, float]:
    mdp, states = problem.mdp, np.flatnonzero(problem.acts)
    moves = replace(problem, rows=problem.rows._replace(reward=np.zeros(mdp.num_rows)))
    rows, iterations = best_rows(problem, mdp.reward), 0
    while True:
        policy = np.where(mdp.is_terminal, -1, mdp.a_tm1[rows])
        found = evaluate_average(mdp, policy)
        iterations += 1
        drift = q_of_rows(moves, found.gain)  # P g: where an action leads to, in gain
        size = problem.largest_reward + float(np.abs(found.bias).max())
        tie = _TIE * size
        best_drift = drift[best_rows(problem, drift)]
        worth = q_of_rows(problem, found.bias) - found.gain[mdp.s_tm1]
        worth[drift < best_drift[mdp.s_tm1] - tie] = -np.inf
        by_gain = states[best_drift[states] - drift[rows[states]] > tie]
        challenger = best_rows(problem, drift) if by_gain.size else best_rows(problem, worth)
        lead = worth[challenger[states]] - np.where(np.isfinite(worth[rows[states]]), worth[rows[states]], np.inf)
        beaten = by_gain if by_gain.size else states[lead > tie]
        if not beaten.size or iterations >= limit:
            break
        rows = rows.copy()
        rows[beaten] = challenger[beaten]
    stopped = beaten.size > 0
    gap = float(np.max(best_drift[states] - found.gain[states], initial=0.0))
    excess = float(np.max(worth[challenger[states]] - found.bias[states], initial=0.0))
    bound = np.inf if stopped else max(gap, excess) + float(np.finfo(np.float64).eps) * size
    return rows, found.bias, found.gain, iterations, bound


def _relative_value_iteration(
    problem: PlanningProblem, tol: float, limit: int
) -> tuple[NDArray[np.int64], Floats, Floats, int, float]:
    mdp = problem.mdp
    v, iterations, width = np.zeros(mdp.num_states), 0, np.inf
    ends = mdp.is_terminal.any() or bool(np.any(problem.rows.decay * mdp.row_mass < 1 - 1e-9))
    while iterations < limit:
        q = q_of_rows(problem, v)
        rows = best_rows(problem, q)
        change = np.where(problem.acts, q[rows] - v, 0.0)
        iterations += 1
        low, high = float(change.min()), float(change.max())
        if ends:  # where it rests nothing is earned
            low, high = min(low, 0.0), max(high, 0.0)
        rounding = problem.rounding(v)
        width, gain = (high - low) / 2 + rounding, np.full(mdp.num_states, (low + high) / 2)
        if is_close_enough(width, tol, gain, rounding):
            break
        v = v + _TAU * change
        if not ends:
            v -= v[0]  # only differences matter, and they stay bounded
    return rows, v, gain, iterations, width

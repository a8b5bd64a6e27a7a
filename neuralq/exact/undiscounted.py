"""Undiscounted episodes, γ = 1: proper policies, stochastic shortest paths, and Bellman–Ford.

A policy is proper if it ends its episodes from every state. If all are, T contracts in a weighted norm and every method
works; the weight W is the largest expected number of steps. If some are not, V* is that of the best proper policy as
long as improper ones lose without bound (Bertsekas & Tsitsiklis 1991): policy iteration started from a proper policy
then finds it. Deterministic models are the longest-path problem that Bellman–Ford solves; it has no solution iff a
cycle earns something (a negative cycle where costs are counted).

The value found is certified as follows. Let e be the residual, W as above over the rows within a small gap of the best.
Then V + e W is at least its own backup over these rows, and over the others if their gap exceeds e · max W: so it is an
upper bound of V*. Where those rows allow staying for ever nothing is claimed: ``bound`` is infinite.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from neuralq.exact.kernels import Floats, improve
from neuralq.exact.policies import policy_iteration
from neuralq.exact.problem import Found, PlanningProblem, prepare, q_of_rows, trapped_rows
from neuralq.mdp import FiniteMDP

__all__ = [
    "bellman_ford",
    "certified",
    "ending_at_rest",
    "episodic",
    "is_shortest_path",
    "path_rounding",
    "proper_policy_iteration",
    "resting_rows",
]

_DISCOUNT = "use gamma < 1 with method='auto'"


def episodic(problem: PlanningProblem, method: str) -> PlanningProblem:
    """The problem with its ``reach`` where every policy ends; for policy iteration it may stay infinite.

    Raises:
        ValueError: a policy may go on for ever and the method cannot cope with that.
    """
    trapped = trapped_rows(problem)
    if trapped.size == 0:
        return replace(problem, reach=_most_steps(problem, np.ones(problem.mdp.num_rows, dtype=bool)))
    if method == "policy-iteration":
        return problem
    proper_policy_iteration(problem, 1.0, math.inf)  # the way out must work, and says so itself where it does not
    raise ValueError(
        f"gamma={problem.gamma} does not contract: {problem.mdp.row_name(int(trapped[0]))} can be repeated for ever "
        "in an episode that never ends; use gamma < 1 or method='policy-iteration'"
    )


def proper_policy_iteration(problem: PlanningProblem, tol: float, limit: float) -> Found:
    """Policy iteration from a proper policy.

    Raises:
        ValueError: no policy ends from some state, or one that never ends earns at least as much; it names the state.
    """
    try:
        return policy_iteration(problem, tol, limit, _proper_policy(problem))
    except ArithmeticError as error:
        raise ValueError(
            f"gamma=1 needs episodes that end, but the best policy goes on for ever: {error}; use gamma < 1"
        ) from error


def _proper_policy(problem: PlanningProblem) -> NDArray[np.int64]:
    """A row for every state that leads, with positive probability, one step closer to an end."""
    policy, reached = _ways_to_an_end(problem)
    if not reached.all():
        state = problem.mdp.state_name(int(np.argmin(reached)))
        raise ValueError(f"gamma=1 needs episodes that end, but no policy ends one from {state}; use gamma < 1")
    return policy


def _ways_to_an_end(problem: PlanningProblem) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """A row that leads one step closer to an end, and whether there is one, ``[S]`` each."""
    mdp = problem.mdp
    follow = problem.rows.decay * (mdp.transition @ problem.acts.astype(np.float64))
    closer = follow < 1 - 1e-9
    policy = np.zeros(mdp.num_states, dtype=np.int64)
    reached = ~problem.acts
    while True:
        rows = np.flatnonzero(closer & ~reached[mdp.s_tm1])
        if rows.size == 0:
            break
        policy[mdp.s_tm1[rows]] = rows
        reached[mdp.s_tm1[rows]] = True
        closer = mdp.transition @ (reached & problem.acts).astype(np.float64) > 0
    return policy, reached


def resting_rows(problem: PlanningProblem) -> NDArray[np.int64]:
    """Rows of reward 0 by which a policy rests for ever where no end can be reached, and nothing better can be had.

    From their states no reward above 0 can be reached either, so to rest is optimal there and V* = 0: for planning,
    such a state is an end. The usual grid whose goals lead to themselves at reward 0 is the plainest case.
    """
    mdp = problem.mdp
    _, ends = _ways_to_an_end(problem)
    gains = np.zeros(mdp.num_states, dtype=bool)
    gains[mdp.s_tm1[mdp.reward > 0]] = True
    while True:
        more = gains.copy()
        more[mdp.s_tm1[mdp.transition @ gains.astype(np.float64) > 0]] = True
        if np.array_equal(more, gains):
            break
        gains = more
    return trapped_rows(problem, (mdp.reward == 0) & ~(ends | gains)[mdp.s_tm1])


def ending_at_rest(mdp: FiniteMDP, resting: NDArray[np.int64]) -> FiniteMDP:
    """The model in which every row of the states of ``resting`` rows ends the episode; rows keep their numbers."""
    at_rest = np.zeros(mdp.num_states, dtype=bool)
    at_rest[mdp.s_tm1[resting]] = True
    goes_on = sparse.diags_array((~at_rest[mdp.s_tm1]).astype(np.float64))
    transition = sparse.csr_array(goes_on @ mdp.transition)
    transition.eliminate_zeros()
    return replace(mdp, transition=transition, outcomes=None)


def certified(problem: PlanningProblem, v: Floats) -> PlanningProblem:
    """The problem with a ``reach`` that makes `PlanningProblem.interval` a proof for this ``v``, if there is one."""
    if math.isfinite(problem.reach):
        return problem
    gap = v[problem.mdp.s_tm1] - q_of_rows(problem, v)
    error = 2 * (float(np.max(-gap, initial=0.0)) + problem.rounding(v))
    near = gap <= max(1e-7 * (problem.largest_reward + float(np.abs(v).max())), error)
    covered = np.zeros(problem.mdp.num_states, dtype=bool)
    covered[problem.mdp.s_tm1[near]] = True
    if not covered[problem.acts].all():
        return problem
    reach = _most_steps(problem, near) + 2
    far = gap[~near]
    return replace(problem, reach=reach) if math.isfinite(reach) and np.all(far > error * reach) else problem


def _most_steps(problem: PlanningProblem, keep: NDArray[np.bool_]) -> float:
    """The largest expected number of steps over policies of the rows kept; infinite where one never ends."""
    mdp = problem.mdp
    rows = np.flatnonzero(keep)
    timed = FiniteMDP(
        mdp.num_states,
        mdp.num_actions,
        mdp.s_tm1[rows],
        mdp.a_tm1[rows],
        mdp.transition[rows],
        np.ones(len(rows)),
        problem.rows.decay[rows],
    )
    steps = prepare(timed, 1.0)
    if trapped_rows(steps).size:
        return math.inf
    w = policy_iteration(steps, 1.0, math.inf).v
    # W must exceed its own backup without the step's reward; the least excess, 1 but for rounding, scales it.
    excess = float(np.min(w[timed.s_tm1] - (q_of_rows(steps, w) - 1.0)))
    return float(w.max()) / excess * (1 + 1e-9) if excess > 0.5 else math.inf


def is_shortest_path(problem: PlanningProblem) -> bool:
    """Whether γ = 1 and every action leads to one state for certain, or ends."""
    lengths = np.diff(problem.mdp.transition.indptr)
    return bool(
        problem.gamma == 1
        and np.all(lengths <= 1)
        and np.all(problem.rows.probability == 1)
        and np.all(problem.rows.decay[lengths == 1] == 1)
    )


def bellman_ford(problem: PlanningProblem, tol: float, limit: float) -> Found:
    """Longest paths to an end: V ← T V from −∞, at most S times (Bellman 1958; Ford 1956).

    Raises:
        ValueError: the model is not a shortest-path problem, a cycle earns something, or a state has no path to an end.
    """
    if not is_shortest_path(problem):
        raise ValueError("method 'bellman-ford' needs gamma=1 and actions with a certain outcome; use method='auto'")
    rows, mdp = problem.rows, problem.mdp
    v = np.where(problem.acts, -np.inf, 0.0)
    better, best_row = v.copy(), rows.starts[:-1].copy()
    iterations = 0
    while iterations < limit:
        improve(rows, v, better, best_row)
        iterations += 1
        if np.array_equal(v, better):
            break
        if iterations > mdp.num_states:
            raise ValueError(_earning_cycle(problem, best_row, int(np.argmax(better > v))))
        v, better = better, v
    else:
        return Found(np.where(np.isfinite(v), v, 0.0), iterations, iterations * mdp.num_rows)
    if np.isneginf(v).any():
        state = mdp.state_name(int(np.argmin(v)))
        raise ValueError(f"gamma=1 needs episodes that end, but no path leads to an end from {state}; {_DISCOUNT}")
    return Found(v, iterations, iterations * mdp.num_rows, best_row.astype(np.int64))


def path_rounding(problem: PlanningProblem, v: Floats) -> float:
    """What rounding can do to sums along paths: nothing if all rewards are whole numbers."""
    reward = problem.mdp.reward
    if np.all(reward == np.round(reward)) and problem.largest_reward * len(v) < 2**53:
        return 0.0
    return len(v) * float(np.finfo(np.float64).eps) * (problem.largest_reward + float(np.abs(v).max()))


def _earning_cycle(problem: PlanningProblem, best_row: NDArray[np.unsignedinteger], s: int) -> str:
    """Names the cycle that the last improvement leads into."""
    transition, starts = problem.mdp.transition, problem.mdp.row_starts
    path: list[int] = []
    while s not in path:
        path.append(s)
        row = int(best_row[s])
        if starts[s] == starts[s + 1] or transition.indptr[row] == transition.indptr[row + 1]:
            break
        s = int(transition.indices[transition.indptr[row]])
    cycle = path[path.index(s) :]
    names = " → ".join(problem.mdp.state_name(state) for state in [*cycle, s])
    earned = sum(float(problem.mdp.reward[int(best_row[state])]) for state in cycle)
    return f"the cycle {names} earns {earned:g} each time round, so with gamma=1 values are infinite; {_DISCOUNT}"

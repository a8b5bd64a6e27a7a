"""A finite horizon: the best policy depends on the time that is left.

    V_H(s) = terminal value,   V_t(s) = max_a [ r(s, a) + γ · discount(s, a) · Σ_{s'} P(s'|s, a) V_{t+1}(s') ],   t < H

is Bellman's backward induction (Puterman 1994, section 4.5) for a sum of H rewards (Mitchell 1997, section 13.2, whose
Σ_{i=0..h} has H = h + 1 of them). It is exact but for rounding, at any γ, whether or not episodes end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_discount, check_whole
from neuralq.exact.problem import prepare, q_of_rows
from neuralq.mdp import FiniteMDP

__all__ = ["HorizonSolution", "solve_finite_horizon"]


@dataclass(frozen=True, eq=False)
class HorizonSolution:
    """What is best with H − t rewards to come, for every time t.

    Args:
        v: V_t ``[H + 1, S]``; the last row is the terminal value.
        policy: an optimal action at every time, the lowest of those that tie, ``[H, S]``; -1 at terminal states.
        optimal_actions: every action that may be optimal given the bound, ``[H, S, A]``.
        bound: guaranteed error of every value: what rounding can amount to.
    """

    v: NDArray[np.float64]
    policy: NDArray[np.int64]
    optimal_actions: NDArray[np.bool_]
    bound: float


def solve_finite_horizon(
    mdp: FiniteMDP, horizon: int, gamma: float = 1.0, *, terminal_values: ArrayLike | None = None
) -> HorizonSolution:
    """The best sum of the next ``horizon`` rewards, and the time-dependent policy that earns it.

    Args:
        mdp: the model.
        horizon: H, the number of rewards.
        gamma: γ in [0, 1].
        terminal_values: V_H ``[S]``, default 0; that of terminal states must be 0.

    Raises:
        ValueError: an argument out of range, or terminal values of another shape or not finite.

    Source: Puterman 1994, section 4.5; Mitchell 1997, section 13.2.

    Example:
        >>> stay_or_go = FiniteMDP.from_arrays([[[1.0]], [[0.0]]], [[1.0, 1.5]], substochastic=True)
        >>> answer = solve_finite_horizon(stay_or_go, 3)  # stay for 1 each; leave for 1.5 at the last moment
        >>> answer.v[:, 0].tolist(), answer.policy[:, 0].tolist()
        ([3.5, 2.5, 1.5, 0.0], [0, 0, 1])
    """
    check_whole("horizon", horizon)
    check_discount("gamma", gamma)
    problem = prepare(mdp, gamma)
    v = np.zeros((horizon + 1, mdp.num_states))
    if terminal_values is not None:
        v[horizon] = _checked(mdp, np.asarray(terminal_values, dtype=np.float64))
    policy = np.full((horizon, mdp.num_states), -1, dtype=np.int64)
    optimal = np.zeros((horizon, mdp.num_states, mdp.num_actions), dtype=bool)
    acting = np.flatnonzero(problem.acts)
    bound = 0.0
    for t in range(horizon - 1, -1, -1):
        values = q_of_rows(problem, v[t + 1])
        v[t, acting] = np.maximum.reduceat(values, mdp.row_starts[acting])
        bound += problem.rounding(v[t + 1])
        near = values >= v[t, mdp.s_tm1] - 2 * bound
        optimal[t, mdp.s_tm1[near], mdp.a_tm1[near]] = True
        policy[t, acting] = np.argmax(optimal[t, acting], axis=1)
    return HorizonSolution(v, policy, optimal, bound)


def _checked(mdp: FiniteMDP, terminal: NDArray[np.float64]) -> NDArray[np.float64]:
    if terminal.shape != (mdp.num_states,):
        raise ValueError(f"terminal_values must have shape ({mdp.num_states},), got {terminal.shape}")
    bad = np.flatnonzero(~np.isfinite(terminal) | (mdp.is_terminal & (terminal != 0)))
    if bad.size:
        s = int(bad[0])
        what = "0, for its episode is over" if mdp.is_terminal[s] else "finite"
        raise ValueError(f"terminal_values of {mdp.state_name(s)} must be {what}, got {terminal[s]}")
    return terminal

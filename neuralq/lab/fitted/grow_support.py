"""Grow-Support (Boyan & Moore 1995): fit only through states whose cost-to-go has been confirmed by a rollout.

Fitted iteration diverges because it believes the fit where nothing supports it. Grow-Support starts from the goal,
whose cost is 0, and lets a state x join only with the cost of a real path: an action of x, then the greedy policy of
the present fit V̂ until the goal. The rollout is given up as soon as it has cost more than V̂ promised plus a tolerance,
so what is confirmed is that the fit tells the truth there.

    cost(x) = min over a of [ c(x, a) + rollout(x'_a) ],      rollout(s) given up above V̂(s) + tolerance

Every cost in the support was paid by some path, so it is never below the optimal one and never diverges, whatever the
regressor; the worst that can happen is that the support stops growing. Costs are confirmed again, and kept where they
are lower, as the fit improves. Here γ = 1: costs of whole paths are compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_positive, check_whole
from neuralq.lab.fitted.regressors import FittedRegressor, Regressor
from neuralq.lab.plain import fields_of
from neuralq.types import Floats, Indices
from neuralq_envs.counterexamples.continuous import ContinuousModel

__all__ = ["GrownSupport", "confirmed_costs", "greedy_costs", "grow_support"]

_NEVER = np.inf  # inside a rollout only: a path that was given up


@dataclass(frozen=True, eq=False)
class GrownSupport:
    """What grew: states with confirmed costs, and the fit through them.

    Args:
        states: ``[m, dim]``.
        costs: of an actual path from each to the goal, ``[m]``.
        index: which of the candidates these are, ``[m]``.
        fitted: the regressor on these states; ``fitted.predict(costs, x)`` is V̂.
        history: size of the support after each round.
        complete: whether all candidates joined.
        settled: whether it stopped because nothing changed any more, not because the rounds were used up.
    """

    states: Floats
    costs: Floats
    index: Indices
    fitted: FittedRegressor
    history: tuple[int, ...]
    complete: bool
    settled: bool

    def predict(self, x: Floats) -> Floats:
        """V̂ at any states, ``[q, dim] -> [q]``."""
        return self.fitted.predict(self.costs, x)

    def plain(self) -> dict[str, Any]:
        """How far it grew, as JSON takes it."""
        size = {"num_points": len(self.costs), "max_cost": float(self.costs.max())}
        return {**fields_of(self, "complete", "settled", "history"), **size}


def grow_support(
    model: ContinuousModel,
    candidates: ArrayLike,
    regressor: Regressor,
    *,
    tolerance: float = 0.5,
    max_rounds: int = 200,
    max_steps: int = 500,
) -> GrownSupport:
    """Grow a support from the goal over the candidates, by confirmed costs only.

    Args:
        model: the continuous problem.
        candidates: states that may join, ``[n, dim]``; at least one of them in the goal, or one step from it.
        regressor: what is fitted through the support.
        tolerance: how much more than V̂ a rollout may cost. Too little and nothing is confirmed; more admits detours.
        max_rounds: most rounds of fitting and confirming.
        max_steps: most steps of one rollout.

    Raises:
        ValueError: candidates of another shape, none from which to start, or a number out of range.

    Source: Boyan & Moore 1995, algorithm Grow-Support.

    Example:
        >>> from neuralq.lab.fitted.regressors import LeastSquares
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> from neuralq_envs.counterexamples.continuous import grid_support
        >>> grown = grow_support(gridworld(), grid_support(gridworld(), 11), LeastSquares())
        >>> grown.complete, grown.costs.max().item()
        (True, 19.0)
    """
    check_positive("tolerance", tolerance)
    check_whole("max_rounds", max_rounds)
    points = np.asarray(candidates, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != len(model.low):
        raise ValueError(f"candidates must have shape [n, {len(model.low)}], got {points.shape}")
    costs = _first_costs(model, points)
    history = []
    for _ in range(max_rounds):
        inside = np.flatnonzero(np.isfinite(costs))
        history.append(len(inside))
        fitted = regressor.fit(points[inside])
        found, confirmed = confirmed_costs(
            model, fitted, costs[inside], points, tolerance=tolerance, max_steps=max_steps
        )  # fmt: skip
        better = np.where(confirmed, np.minimum(found, costs), costs)
        better[model.is_goal(points)] = 0.0
        settled = bool((better == costs).all())
        costs = better
        if settled:
            break
    inside = np.flatnonzero(np.isfinite(costs))
    states = points[inside]
    return GrownSupport(
        states, costs[inside], inside, regressor.fit(states), tuple(history), len(inside) == len(points), settled
    )  # fmt: skip


def confirmed_costs(
    model: ContinuousModel,
    fitted: FittedRegressor,
    y: Floats,
    states: Floats,
    *,
    tolerance: float,
    max_steps: int = 500,
) -> tuple[Floats, NDArray[np.bool_]]:
    """The cheapest first action followed by the greedy policy of a fit, where the rollout keeps what the fit promises.

    Args:
        model: the continuous problem.
        fitted: the regressor on its support.
        y: the values there.
        states: from where, ``[n, dim]``.
        tolerance: how much more than V̂ a rollout may cost.
        max_steps: most steps of a rollout.

    Returns:
        The costs, 0 where not confirmed, and which are confirmed; ``[n]`` each.

    Example:
        >>> from neuralq.lab.fitted.regressors import NearestNeighbours
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> near = NearestNeighbours().fit(np.array([[1.0, 1.0]]))
        >>> states = np.array([[0.92, 1.0], [0.0, 0.0]])
        >>> cost, confirmed = confirmed_costs(gridworld(), near, np.zeros(1), states, tolerance=0.1)
        >>> cost.tolist(), confirmed.tolist()
        ([0.5, 0.0], [True, False])
    """
    steps = model.step(states)
    flat = steps.successor.reshape(-1, states.shape[1])
    onward = np.zeros(len(flat))
    ended = steps.ended.reshape(-1)
    if not ended.all():
        promised = fitted.predict(y, flat[~ended]) + tolerance
        onward[~ended] = _rollouts(model, fitted, y, flat[~ended], promised, max_steps)
    failed = ended & ~model.is_goal(flat)
    onward[failed] = _NEVER  # what ended elsewhere confirms no way to the goal
    total = (steps.cost + onward.reshape(steps.cost.shape)).min(axis=1)
    confirmed = np.isfinite(total)
    return np.where(confirmed, total, 0.0), confirmed


def greedy_costs(
    model: ContinuousModel, fitted: FittedRegressor, y: Floats, states: Floats, *, max_steps: int = 500
) -> tuple[Floats, NDArray[np.bool_]]:
    """What the greedy policy of a fit really costs from each state, and whether it reaches the goal at all.

    Args:
        model: the continuous problem.
        fitted: the regressor on its support.
        y: the values there.
        states: from where, ``[n, dim]``.
        max_steps: most steps.

    Returns:
        The costs of the paths, 0 where the goal is not reached, and where it is; ``[n]`` each.

    Example:
        >>> from neuralq.lab.fitted.regressors import LeastSquares, linear_features
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        >>> plane = LeastSquares(linear_features).fit(corners)
        >>> greedy_costs(gridworld(), plane, np.array([20.0, 10.0, 10.0]), np.full((1, 2), 0.5))[0].tolist()
        [9.0]
    """
    goal = model.is_goal(states)
    cost = np.zeros(len(states))
    if not goal.all():
        free = np.full(int((~goal).sum()), _NEVER)
        cost[~goal] = _rollouts(model, fitted, y, states[~goal], free, max_steps)
    reached = np.isfinite(cost)
    return np.where(reached, cost, 0.0), reached


def _first_costs(model: ContinuousModel, points: Floats) -> Floats:
    """0 in the goal; where no candidate lies in it, the cost of the one step that leads there."""
    goal = model.is_goal(points)
    if goal.any():
        return np.where(goal, 0.0, _NEVER)
    steps = model.step(points)
    arrives = steps.ended & model.is_goal(steps.successor.reshape(-1, points.shape[1])).reshape(steps.ended.shape)
    if not arrives.any():
        raise ValueError(f"none of the {len(points)} candidates lies in the goal or one step from it; add some that do")
    costs: Floats = np.where(arrives, steps.cost, _NEVER).min(axis=1)
    return costs


def _rollouts(
    model: ContinuousModel, fitted: FittedRegressor, y: Floats, states: Floats, budget: Floats, max_steps: int
) -> Floats:
    """Cost of the greedy path from each state to the goal, infinite where it fails or passes its budget."""
    total = np.full(len(states), _NEVER)
    walking, now, paid = np.arange(len(states)), states, np.zeros(len(states))
    for _ in range(max_steps):
        steps = model.step(now)
        flat = steps.successor.reshape(-1, now.shape[1])
        ahead = np.where(steps.ended.reshape(-1), 0.0, fitted.predict(y, flat)).reshape(steps.cost.shape)
        a = (steps.cost + ahead).argmin(axis=1)
        every = np.arange(len(now))
        now, ended = steps.successor[every, a], steps.ended[every, a]
        paid = paid + steps.cost[every, a]
        within = paid <= budget[walking]
        arrived = ended & within & model.is_goal(now)
        total[walking[arrived]] = paid[arrived]
        on = within & ~ended
        walking, now, paid = walking[on], now[on], paid[on]
        if not len(walking):
            break
    return total

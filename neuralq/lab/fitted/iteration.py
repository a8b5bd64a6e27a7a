"""Fitted value iteration: back up a support of states, fit a function through the answers, and again.

    y_i ← min_a [ c(x_i, a) + γ V̂(x'_ia) ],      V̂ ← fit(y),      V̂ = 0 where the episode has ended

In cost-to-go notation; y = 0 at support points in the goal. If the fit is a linear smoother with hat matrix H, a sweep
is y ← c_π + γ H_π y with the greedy policy π, and H_π takes from H the rows of the successors that π chooses. So

* H an averager (rows ≥ 0 with sums ≤ 1): the sweep is exact value iteration of a *derived* model, on the support, in
  which a step leads to support point j with probability H(x', j) (Gordon 1995). It converges for γ < 1, and for γ = 1
  with positive costs where the derived model can end from everywhere.
* otherwise the greedy policy that the sweeps arrive at decides: as long as it stays, errors grow by the spectral radius
  of γ H_π. A radius above 1 is divergence, 1 is a drift (the same cost added for ever, no way to the goal), and a
  policy that never settles can keep the sweeps in a bounded cycle without any limit (chattering).

The outcome may depend on the sampling set more than on the problem, and, without a certificate, on the start too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from neuralq.checks import check_discount, check_positive, check_whole
from neuralq.lab.fitted.regressors import Hat, LinearSmoother, Regressor
from neuralq.lab.plain import fields_of
from neuralq.types import Floats, Indices
from neuralq_envs.counterexamples.continuous import ContinuousModel

__all__ = ["FittedRun", "Sweep", "fitted_iteration", "iterate", "sweep_of_model"]

_SHOWN = 11


@dataclass(frozen=True, eq=False)
class Sweep:
    """All that a sweep of fitted iteration needs to know: costs, and the fit at the support and at the successors.

    Args:
        cost: c(x_i, a), ``[n, A]``; infinite where an action is not legal.
        predict: the fit to y at the support and at the successors, ``[n] -> ([n], [n, A])``, 0 where it ended.
        is_goal: support points whose cost-to-go is 0 by definition, ``[n]``.
        hat_next: the rows of H at the successors, ``[n A, n]``, empty where it ended; None if there is no H.
    """

    cost: Floats
    predict: Callable[[Floats], tuple[Floats, Floats]]
    is_goal: NDArray[np.bool_]
    hat_next: Hat | None

    def back_up(self, next_values: Floats, gamma: float) -> tuple[Floats, Indices]:
        """One sweep: the new y and the greedy action of each support point (the lowest of equals)."""
        q = self.cost + gamma * next_values
        policy = q.argmin(axis=1)
        best = np.take_along_axis(q, policy[:, None], axis=1)[:, 0]
        return np.where(self.is_goal, 0.0, best), policy


@dataclass(frozen=True, eq=False)
class FittedRun:
    """What fitted iteration did. All numbers are finite.

    Args:
        values: the fit at the support after k iterations, ``[k + 1, n]``; row 0 is the start.
        targets: y of the last iteration, ``[n]``: what was fitted last.
        policy: the greedy action of each support point in the last backup, ``[n]``.
        policy_changes: at how many support points the greedy action changed, ``[k]``; the first entry is 0.
        error: max over the support of |fit − exact cost-to-go|, ``[k + 1]``; None where that is not known.
        converged: whether the last two y agree within the tolerance.
        stopped_on_cap: whether it was stopped because it grew beyond the cap (or left the floating-point range).
    """

    values: Floats
    targets: Floats
    policy: Indices
    policy_changes: Indices
    error: Floats | None
    converged: bool
    stopped_on_cap: bool

    @property
    def iterations(self) -> int:
        """K, the number of sweeps."""
        return len(self.values) - 1

    @property
    def max_abs(self) -> Floats:
        """Max |V̂| over the support after k iterations, ``[k + 1]``."""
        largest: Floats = np.abs(self.values).max(axis=1)
        return largest

    @property
    def shown(self) -> list[int]:
        """Some numbers of iterations, evenly spread from 0 to the last: enough to see what happened."""
        return sorted({round(self.iterations * i / (_SHOWN - 1)) for i in range(_SHOWN)})

    @property
    def growth(self) -> float:
        """The last ratio of successive max |V̂|; 1 where that is 0."""
        largest = self.max_abs
        return float(largest[-1] / largest[-2]) if len(largest) > 1 and largest[-2] > 0 else 1.0

    def plain(self) -> dict[str, Any]:
        """How it ended, and max |V̂| and the error at the iterations of `shown`, as JSON takes them."""
        largest, shown = self.max_abs, self.shown
        return {
            **fields_of(self, "converged", "stopped_on_cap"),
            "num_points": self.values.shape[1],
            "sweeps": self.iterations,
            "run_growth": self.growth,
            "max_abs": [[k, float(largest[k])] for k in shown],
            "error": None if self.error is None else [[k, float(self.error[k])] for k in shown],
        }


def fitted_iteration(
    model: ContinuousModel,
    support: ArrayLike,
    regressor: Regressor,
    *,
    num_iterations: int = 1000,
    gamma: float = 1.0,
    start: ArrayLike | None = None,
    exact: ArrayLike | None = None,
    tolerance: float = 1e-10,
    cap: float = 1e10,
) -> FittedRun:
    """Fitted value iteration on a support, until nothing changes, a cap is passed or the iterations are used up.

    Args:
        model: the continuous problem.
        support: points to back up, ``[n, dim]``.
        regressor: what is fitted through them.
        num_iterations: most sweeps.
        gamma: γ in [0, 1].
        start: y before the first sweep, ``[n]``; default 0.
        exact: the cost-to-go at the support to compare with; default: the model's own, where γ = 1 and it has one.
        tolerance: largest change of y that counts as none.
        cap: stop where max |y| exceeds this many times its size after the first sweep.

    Raises:
        ValueError: shapes that do not fit, or a number out of range.

    Source: Boyan & Moore 1995; Gordon 1995.

    Example:
        >>> from neuralq.lab.fitted.regressors import LeastSquares, NearestNeighbours
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> from neuralq_envs.counterexamples.continuous import grid_support
        >>> grid = grid_support(gridworld(), 16)
        >>> fitted_iteration(gridworld(), grid, LeastSquares()).stopped_on_cap
        True
        >>> fitted_iteration(gridworld(), grid, NearestNeighbours()).converged
        True
    """
    points = np.asarray(support, dtype=np.float64)
    if exact is None and gamma == 1 and model.cost_to_go is not None:
        exact = model.cost_to_go(points)
    return iterate(
        sweep_of_model(model, points, regressor),
        num_iterations=num_iterations, gamma=gamma, start=start, exact=exact, tolerance=tolerance, cap=cap,
    )  # fmt: skip


def iterate(
    sweep: Sweep,
    *,
    num_iterations: int = 1000,
    gamma: float = 1.0,
    start: ArrayLike | None = None,
    exact: ArrayLike | None = None,
    tolerance: float = 1e-10,
    cap: float = 1e10,
) -> FittedRun:
    """Sweep after sweep: what `fitted_iteration` does once the sweep is known, with its arguments and refusals."""
    check_discount("gamma", gamma)
    check_whole("num_iterations", num_iterations)
    check_positive("tolerance", tolerance)
    check_positive("cap", cap)
    n = len(sweep.cost)
    y = _vector("start", np.zeros(n) if start is None else start, n)
    reference = None if exact is None else _vector("exact", exact, n)
    fit, ahead = sweep.predict(y)
    values, changes = [fit], []
    limit, converged, stopped = np.inf, False, False
    _, policy = sweep.back_up(ahead, gamma)
    for k in range(num_iterations):
        fresh, chosen = sweep.back_up(ahead, gamma)
        fit, ahead = sweep.predict(fresh) if np.isfinite(fresh).all() else (fresh, ahead)
        if not (np.isfinite(fit).all() and np.isfinite(ahead).all()):
            stopped = True
            break
        if k == 0:
            limit = cap * (max(np.abs(fresh).max(), np.abs(y).max()) or 1.0)
        values.append(fit)
        changes.append(int(np.count_nonzero((chosen != policy) & ~sweep.is_goal)))
        moved, y, policy = float(np.abs(fresh - y).max()), fresh, chosen
        converged, stopped = moved <= tolerance, bool(np.abs(y).max() > limit)
        if converged or stopped:
            break
    table = np.array(values)
    error = None if reference is None else np.abs(table - reference).max(axis=1)
    return FittedRun(table, y, policy, np.array(changes, dtype=np.int64), error, converged, stopped)


def sweep_of_model(model: ContinuousModel, support: Floats, regressor: Regressor) -> Sweep:
    """A sweep over a support of a continuous problem; the hat matrix of a linear smoother is taken once.

    Raises:
        ValueError: a support of another shape than ``[n, dim]``.

    Example:
        >>> from neuralq.lab.fitted.regressors import NearestNeighbours
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> sweep_of_model(gridworld(), np.array([[0.0, 0.0], [1.0, 1.0]]), NearestNeighbours()).is_goal.tolist()
        [False, True]
    """
    if support.ndim != 2 or support.shape[1] != len(model.low) or not len(support):
        raise ValueError(f"support must have shape [n, {len(model.low)}] with n >= 1, got {support.shape}")
    steps = model.step(support)
    n, num_actions = steps.cost.shape
    goes_on = ~steps.ended.reshape(-1)
    successor = steps.successor.reshape(n * num_actions, -1)
    fitted = regressor.fit(support)
    is_goal = model.is_goal(support)
    if isinstance(fitted, LinearSmoother):
        at_support, at_next = fitted.operator(support), fitted.operator(successor[goes_on])
        predict = _scatter(lambda y: (at_support(y), at_next(y)), goes_on, num_actions)
        return Sweep(steps.cost, predict, is_goal, _spread(fitted.hat(successor[goes_on]), goes_on))
    queries = np.concatenate([support, successor[goes_on]])

    def both(y: Floats) -> tuple[Floats, Floats]:
        answer = fitted.predict(y, queries)  # one training for all queries
        return answer[:n], answer[n:]

    return Sweep(steps.cost, _scatter(both, goes_on, num_actions), is_goal, None)


def _scatter(
    both: Callable[[Floats], tuple[Floats, Floats]], goes_on: NDArray[np.bool_], num_actions: int
) -> Callable[[Floats], tuple[Floats, Floats]]:
    """The fit at the support and at all successors, from the fit at those that go on; the others are worth 0."""

    def predict(y: Floats) -> tuple[Floats, Floats]:
        here, onward = both(y)
        ahead = np.zeros(len(goes_on))
        ahead[goes_on] = onward
        return here, ahead.reshape(-1, num_actions)

    return predict


def _spread(hat: Hat, goes_on: NDArray[np.bool_]) -> Hat:
    """Rows of the successors that go on, among empty rows for those that do not."""
    if sparse.issparse(hat):
        place = np.flatnonzero(goes_on)
        put = sparse.csr_array((np.ones(len(place)), (place, np.arange(len(place)))), shape=(len(goes_on), len(place)))
        return sparse.csr_array(put @ hat)
    full = np.zeros((len(goes_on), hat.shape[1]))
    full[goes_on] = hat
    return full


def _vector(name: str, values: ArrayLike, n: int) -> Floats:
    out = np.array(values, dtype=np.float64)
    if out.shape != (n,) or not np.isfinite(out).all():
        raise ValueError(f"{name} must hold {n} finite numbers, one per support point, got shape {out.shape}")
    return out

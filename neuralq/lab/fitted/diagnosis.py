"""Why fitted iteration converges or not: a certificate where there is one, else the growth at the policy it reached.

A certificate needs no run: rows of H that are non-negative with sums of at most 1 make every sweep a non-expansion in
the maximum norm. Without one, the sweeps are followed to the greedy policy they arrive at, and the spectral radius of
γ H_π there says how errors grow for as long as that policy stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import ArpackError, eigs

from neuralq.checks import check_discount
from neuralq.lab.fitted.iteration import FittedRun, Sweep, iterate, sweep_of_model
from neuralq.lab.fitted.regressors import Hat, Regressor
from neuralq.lab.plain import fields_of
from neuralq.types import Indices
from neuralq_envs.counterexamples.continuous import ContinuousModel

__all__ = [
    "FittedDiagnosis",
    "diagnose_fitted",
    "hat_norm",
    "is_averager",
    "policy_growth",
]

_ROUNDING = 1e-9  # a row of weights may be off by this much and still count as non-negative with sum 1
_SMALL = 400  # support points up to which all eigenvalues are quicker than some


@dataclass(frozen=True, eq=False)
class FittedDiagnosis:
    """A verdict on fitted iteration, and what it rests on.

    Args:
        verdict: ``"converges"``, ``"diverges"``, ``"drifts"`` (the same cost is added for ever), ``"chatters"``
            (bounded, but the greedy policy never settles), ``"unstable"`` (it settled where any error
            grows, as symmetry allows; rounding drives it off later) or ``"undecided"`` (too few sweeps to tell).
        guaranteed: whether a certificate says so, for any start; otherwise it holds for the start that was run.
        averager: whether the regressor is an averager on this support; None if it is no linear smoother.
        hat_norm: ‖H‖∞ over the successors; None if it is no linear smoother.
        contraction: γ times the largest row sum of an averager, a bound on the rate; None without certificate.
        growth: spectral radius of γ H_π at the greedy policy reached: what the worst error does there. None if it is no
            linear smoother.
        ray_growth: the eigenvalue of γ H_π along which a diverging run grows, in modulus: what the run shows. It is
            less than ``growth`` where symmetry hides the worst direction from the run. None if nothing diverges.
        gamma: γ.
        run: the run that it rests on.
    """

    verdict: str
    guaranteed: bool
    averager: bool | None
    hat_norm: float | None
    contraction: float | None
    growth: float | None
    ray_growth: float | None
    gamma: float
    run: FittedRun

    def explain(self) -> str:
        """The verdict in words.

        Example:
            >>> run = FittedRun(np.zeros((2, 1)), np.zeros(1), np.zeros(1, int), np.zeros(1, int), None, True, False)
            >>> FittedDiagnosis("converges", True, True, 1.0, 0.9, 0.9, None, 0.9, run).explain()
            'Converges for certain: the fit is an average of values, which never exaggerates, and γ shrinks it by 0.9.'
        """
        if self.guaranteed and self.contraction is not None and self.contraction < 1:
            return (
                "Converges for certain: the fit is an average of values, which never exaggerates, and γ shrinks it by "
                f"{self.contraction:.6g}."
            )
        if self.guaranteed:
            return "Converges for certain: the fit is an average of values, and every average path comes to an end."
        ending = {
            "converges": f"Converged from this start, after {self.run.iterations} sweeps.",
            "diverges": f"Diverges: max |V| grew to {self.run.max_abs[-1]:.4g} in {self.run.iterations} sweeps.",
            "drifts": "Drifts: the greedy policy it arrived at never reaches the goal, and each sweep adds a cost.",
            "unstable": "Came to rest at a fixed point that is unstable: symmetry led there, rounding will lead away.",
            "undecided": f"Undecided: after {self.run.iterations} sweeps values grow and the policy still changes.",
            "chatters": "Stays bounded without a limit: the greedy policy keeps changing, so there is no fixed point.",
        }[self.verdict]
        if self.hat_norm is None:
            return f"{ending} A network has no hat matrix, so nothing is certain for another start or support."
        why = f"The fit can exaggerate an error {self.hat_norm:.4g} times (‖H‖∞)"
        return f"{ending} {why}; at the greedy policy reached, errors change by {self.growth:.7g} a sweep" + (
            f", and along the way that this run takes by {self.ray_growth:.7g}." if self.ray_growth is not None else "."
        )

    def plain(self) -> dict[str, Any]:
        """The verdict, what it rests on and the run, as JSON takes them."""
        return {
            **fields_of(self, "verdict", "averager", "hat_norm", "contraction", "growth", "ray_growth", "gamma"),
            "certain": self.guaranteed,
            **self.run.plain(),
            "explanation": self.explain(),
        }


def diagnose_fitted(
    model: ContinuousModel,
    support: ArrayLike,
    regressor: Regressor,
    *,
    gamma: float = 1.0,
    num_iterations: int = 1000,
    start: ArrayLike | None = None,
    exact: ArrayLike | None = None,
    tolerance: float = 1e-10,
) -> FittedDiagnosis:
    """Whether fitted iteration converges on this support, by certificate where there is one and by a run otherwise.

    Args:
        model: the continuous problem.
        support: points to back up, ``[n, dim]``.
        regressor: what is fitted through them.
        gamma: γ in [0, 1].
        num_iterations: most sweeps of the run.
        start: y before the first sweep, ``[n]``; default 0.
        exact: the cost-to-go at the support to compare the run with, ``[n]``; None for no comparison.
        tolerance: largest change of y that counts as none.

    Raises:
        ValueError: what `fitted_iteration` refuses.

    Source: Gordon 1995 (averagers).

    Example:
        >>> from neuralq.lab.fitted.regressors import LeastSquares
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> from neuralq_envs.counterexamples.continuous import grid_support
        >>> found = diagnose_fitted(gridworld(), grid_support(gridworld(), 16), LeastSquares())
        >>> found.verdict, round(found.hat_norm, 4), round(found.growth, 5), round(found.ray_growth, 5)
        ('diverges', 3.0336, 1.09168, 1.08504)
    """
    sweep = sweep_of_model(model, np.asarray(support, dtype=np.float64), regressor)
    run = iterate(sweep, num_iterations=num_iterations, gamma=gamma, start=start, exact=exact, tolerance=tolerance)
    if sweep.hat_next is None:
        return FittedDiagnosis(_verdict(run, None), False, None, None, None, None, None, gamma, run)
    averager = is_averager(sweep.hat_next)
    contraction = gamma * hat_norm(sweep.hat_next) if averager else None
    guaranteed = contraction is not None and (contraction < 1 - _ROUNDING or (gamma == 1 and _always_ends(sweep)))
    growth = policy_growth(sweep, run.policy, gamma)
    verdict = "converges" if guaranteed else _verdict(run, growth)
    ray = _ray_growth(sweep, run, gamma) if verdict == "diverges" else None
    return FittedDiagnosis(
        verdict, guaranteed, averager, hat_norm(sweep.hat_next), contraction, growth, ray, gamma, run
    )  # fmt: skip


def hat_norm(hat: Hat) -> float:
    """‖H‖∞, the most that a fit can exaggerate an error: the largest row sum of |H|.

    Example:
        >>> hat_norm(np.array([[0.5, 0.5], [-1.0, 2.0]]))
        3.0
    """
    return float(np.max(np.asarray(abs(hat).sum(axis=1))))


def is_averager(hat: Hat) -> bool:
    """Whether every row is non-negative and sums to at most 1, up to rounding.

    Source: Gordon 1995.

    Example:
        >>> is_averager(np.array([[0.5, 0.25]])), is_averager(np.array([[-0.1, 1.0]])), is_averager(np.eye(2) * 1.1)
        (True, False, False)
    """
    return bool(hat.min() >= -_ROUNDING and hat_norm(hat) <= 1 + _ROUNDING)


def policy_growth(sweep: Sweep, policy: Indices, gamma: float) -> float:
    """The spectral radius of γ H_π: how errors change in a sweep for as long as the greedy policy is π.

    Args:
        sweep: of a linear smoother.
        policy: π, an action for each support point, ``[n]``.
        gamma: γ in [0, 1].

    Raises:
        ValueError: the regressor has no hat matrix.

    Example:
        >>> ahead = np.array([[0.4, 0.8], [0.4, 0.8]])  # least squares on features 1 and 2; both lead to the second
        >>> sweep = Sweep(np.zeros((2, 1)), lambda y: (y, y[:, None]), np.zeros(2, bool), ahead)
        >>> round(policy_growth(sweep, np.zeros(2, int), 0.9), 12)  # 6γ/5
        1.08
    """
    check_discount("gamma", gamma)
    return float(np.abs(_modes(sweep, policy, gamma)[0]).max())


def _modes(sweep: Sweep, policy: Indices, gamma: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Eigenvalues and eigenvectors of γ H_π: all of a small matrix, the leading ones of a large one."""
    if sweep.hat_next is None:
        raise ValueError("only a linear smoother has a hat matrix; for a network look at the run")
    n, num_actions = sweep.cost.shape
    rows = sweep.hat_next[np.arange(n) * num_actions + policy]
    active = sparse.diags_array(np.where(sweep.is_goal, 0.0, gamma))
    matrix = active @ rows
    if n > _SMALL:
        try:
            return cast("tuple[NDArray[Any], NDArray[Any]]", eigs(matrix, k=6, v0=np.ones(n)))
        except ArpackError:
            pass  # clustered or vanishing eigenvalues: take the long way
    values, vectors = np.linalg.eig(matrix.toarray() if sparse.issparse(matrix) else matrix)
    return values, vectors


def _ray_growth(sweep: Sweep, run: FittedRun, gamma: float) -> float | None:
    """|λ| of the eigenvector that y has become; None if it is no eigenvector (yet)."""
    values, vectors = _modes(sweep, run.policy, gamma)
    y = run.targets / np.linalg.norm(run.targets)
    aligned = np.abs(y @ vectors.conj())  # eigenvectors have length 1
    best = int(aligned.argmax())
    return float(abs(values[best])) if aligned[best] > 1 - 1e-6 else None


def _always_ends(sweep: Sweep) -> bool:
    """Whether costs are positive and the derived model can end from every support point."""
    legal = np.isfinite(sweep.cost) & ~sweep.is_goal[:, None]
    if not (sweep.cost[legal] > 0).all():
        return False
    hat = sparse.csr_array(sweep.hat_next)
    mass = np.asarray(hat.sum(axis=1)).reshape(-1)
    ends = (mass < 1 - _ROUNDING).reshape(sweep.cost.shape) & legal
    reaches = sweep.is_goal | ends.any(axis=1)
    while True:
        onward = ((hat @ reaches.astype(np.float64)).reshape(sweep.cost.shape) > _ROUNDING) & legal
        grown = reaches | onward.any(axis=1)
        if (grown == reaches).all():
            return bool(reaches.all())
        reaches = grown


def _verdict(run: FittedRun, growth: float | None) -> str:
    """What a run shows that no certificate covers: the last quarter against the one before."""
    if run.converged:
        return "unstable" if growth is not None and growth > 1 + 1e-6 else "converges"
    if run.stopped_on_cap:
        return "diverges"
    quarter = max(run.iterations // 4, 1)
    largest = run.max_abs
    recent, before = largest[-quarter:].max(), largest[-2 * quarter : -quarter].max()
    at_rest = not run.policy_changes[-quarter:].any()
    if at_rest and growth is not None and abs(growth - 1) > 1e-6:
        return "diverges" if growth > 1 else "converges"  # slowly: nothing but the tolerance is missing
    if at_rest and growth is not None:
        return "drifts"
    # While it grows and the policy still changes, nothing tells a detour from divergence: the cap is to decide.
    return "chatters" if recent <= before * 1.001 else "undecided"

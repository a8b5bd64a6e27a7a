"""What a method will do on a problem, before it is trained.

The expected update of a linear method is θ ← M θ + c; its eigenvalues, on what it moves, say everything about the mean
(`neuralq.lab.linear.spectrum`). A sampled update has a mean of its own along a chain, and a second moment that may
explode while the mean settles; both follow from the maps of single transitions (`neuralq.lab.verdicts.moments`). Where
the piece changes with the weights, a run is followed through its pieces (`neuralq.lab.verdicts.piecewise`). Where the
values themselves are not linear in the weights, the update is linearised at the initial ones, F' = Jᵀ D (γP − I) J +
Σ_s d_s δ_s ∇²V_s.

Features of less than full column rank are reduced first: redundant weights change no value and no verdict.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_positive
from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import Sampling
from neuralq.lab.linear.spectrum import (
    NEUTRAL,
    Limit,
    first_crossing,
    flow_bound,
    flow_spectrum,
    limit_of,
    moving_spectrum,
    visible_process,
)
from neuralq.lab.methods import Expected, Method, flow
from neuralq.lab.methods import method as method_named
from neuralq.lab.methods.record import Options
from neuralq.lab.verdicts.moments import (
    growth_factors,
    mean_radius,
    second_moment_radius,
    second_moment_stable,
    unknowns,
)
from neuralq.lab.verdicts.piecewise import follow
from neuralq.lab.verdicts.update_maps import UpdateMaps, update_maps
from neuralq.lab.verdicts.words import Diagnosis, Verdict, is_poor
from neuralq.types import Floats
from neuralq_envs.counterexamples import Problem

__all__ = ["Diagnosis", "diagnose"]

Factors = NDArray[np.complex128]

MOST_SCANNED = 1000
"""Unknowns of the second moment beyond which its step-size bound is not looked for: a scan solves a hundred systems."""


@dataclass(frozen=True, eq=False)
class _Case:
    """What is diagnosed: a method on a problem whose features have full column rank."""

    problem: Problem
    method: Method
    options: Options
    alpha: float
    sampling: Sampling
    full: Process
    process: Process
    basis: Floats
    expected: Expected

    @property
    def theta(self) -> Floats:
        """θ at the beginning, in the reduced weights."""
        return self.expected.initial(self.basis.T @ self.problem.initial_weights)

    @property
    def memoryless(self) -> bool:
        """Whether sampled updates are random affine maps, independent of the past but for the row they start from."""
        return self.expected.linear and not self.method.remembers(self.options) and self.sampling != "expected"


def diagnose(
    problem: Problem,
    method: str | Method = "td",
    step_size: float | None = None,
    sampling: Sampling = "expected",
    **method_options: float,
) -> Diagnosis:
    """What a method will do on a problem: verdict, growth, step-size bounds, fixed point and an explanation.

    Args:
        problem: what is learned.
        method: one of `neuralq.lab.methods.METHODS` by name, or a method of your own.
        step_size: α; the problem's own by default.
        sampling: ``"expected"`` (every row updated at once with its weight), ``"iid"`` (rows drawn from D) or
            ``"markov"`` (one chain under the behaviour policy). Methods that remember earlier transitions have no exact
            moments along a chain: their mean is that of the expected update, and their second moment is not given,
            except for ETD the growth of its follow-on's.
        method_options: of the method, by name.

    Raises:
        ValueError: an argument out of range, an unknown method or option, a method without such an update, a trace
            under independent draws (where every transition begins anew), or too many unknowns for exact moments.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> found = diagnose(star(), "td", sampling="markov")
        >>> found.verdict, round(found.spectral_radius, 7), round(found.second_moment_radius, 7)
        ('diverges', 1.0023814, 1.004811)
        >>> diagnose(star(), "td", lambda_=1.0).verdict
        'converges'
    """
    alpha = problem.step_size if step_size is None else step_size
    check_positive("step_size", alpha)
    check_choice("sampling", sampling, ("expected", "iid", "markov"))
    chosen = method_named(method) if isinstance(method, str) else method
    options = chosen.checked(method_options)
    full = linear_process(problem)
    if problem.value is not None:
        return _local(problem, full, chosen, options, alpha, sampling)
    if chosen.expected is None:
        raise ValueError(f"{chosen.title} has no expected update to diagnose; run it instead")
    process, basis = visible_process(full)
    case = _Case(problem, chosen, options, alpha, sampling, full, process, basis, chosen.expected(process, options))
    _check_sampling(case)
    return _linear(case) if case.expected.linear else _piecewise(case)


def _check_sampling(case: _Case) -> None:
    if case.sampling == "expected":
        return
    if case.method.learner is None:
        raise ValueError(f"{case.method.title} solves instead of sampling; use sampling='expected'")
    if case.sampling == "iid" and case.expected.generator is not None and case.method.remembers(case.options):
        raise ValueError(
            f"{case.method.title} with these options looks back at earlier transitions, and independent draws have "
            "none; use sampling='markov' or 'expected'"
        )


def _linear(case: _Case) -> Diagnosis:
    expected, alpha = case.expected, case.alpha
    with np.errstate(over="ignore", invalid="ignore"):
        M, c = expected.at(case.theta, alpha)
    if not np.isfinite(M).all():  # a period is a power of the update
        raise ValueError(
            f"one application of {case.method.title} with α = {alpha:g} multiplies the weights by more than float64 "
            "holds: it diverges; use a smaller step size"
        )
    if expected.generator is not None:
        rates = flow_spectrum(expected.generator[0])
        factors, bound = 1 - alpha * rates, flow_bound(rates)
        limit = limit_of(*expected.generator, case.theta)
    else:
        factors, limit = moving_spectrum(M), limit_of(np.eye(len(c)) - M, c, case.theta)
        bound = _scanned_bound(lambda a: expected.at(case.theta, a)[0], alpha)
    rank, second, second_bound = len(factors), None, None
    if case.memoryless:
        factors, second, bound, second_bound = _moments(case, factors, bound)
    elif case.method.memory_growth is not None and case.sampling == "markov":
        second = case.method.memory_growth(case.process, case.options)
    factors = factors[np.argsort(-np.abs(factors), kind="stable")]
    radius = float(np.abs(factors[0])) if len(factors) else 0.0
    drift = float(np.linalg.norm(limit.drift)) * (alpha if expected.generator is not None else 1.0)
    point, error, best, scale = _errors(case, limit)
    if drift > 0:  # the mean leaves linearly at every step size, and takes the mean square with it
        bound, second_bound = 0.0, None if second_bound is None else 0.0
        radius, second = max(radius, 1.0), None if second is None else max(second, 1.0)
    verdict = _verdict(radius, second, drift, is_poor(error, best, scale, case.problem.gamma))
    return Diagnosis(
        case.problem.name, case.method.title, case.options, alpha, case.sampling,
        verdict in ("converges", "stable but poor fixed point"), verdict,
        radius, second, bound, second_bound,
        _turns(factors), _doubling(radius, expected.updates_per_sweep), factors, rank,
        point, error, best, limit.singularity, drift, scale, updates=expected.updates_per_sweep,
        follow_on=second is not None and not case.memoryless, flow=expected.generator is not None,
    )  # fmt: skip


def _moments(case: _Case, factors: Factors, bound: float) -> tuple[Factors, float | None, float, float | None]:
    """Factors of the mean, radius of the second moment, and the step-size bounds of both."""
    sampling = case.sampling

    def at(step_size: float) -> UpdateMaps:
        return update_maps(case.process, case.method, case.options, step_size)

    maps = at(case.alpha)
    second = second_moment_radius(maps, sampling)
    ends = bound if math.isfinite(bound) else 1e3 * case.alpha
    same = sampling == "iid" and np.allclose(maps.mean()[0], case.expected.at(case.theta, case.alpha)[0], atol=1e-12)
    if not same:  # along a chain, or where a sampled update is not linear in the transition (extragradient)
        factors = growth_factors(maps, sampling)
        if bound > 0 and len(factors):
            bound = first_crossing(lambda a: mean_radius(at(a), sampling) < 1, 1e-2 * ends, 1e2 * ends, factor=1.1)
    if bound == 0 or len(factors) == 0:
        return factors, second, bound, bound
    if unknowns(case.process, case.expected.size, sampling) > MOST_SCANNED:
        return factors, second, bound, None
    second_bound = first_crossing(
        lambda a: second_moment_stable(at(a), sampling), 1e-2 * ends, 1e2 * ends, factor=1.1, floor=1e-6
    )
    return factors, second, bound, second_bound


def _piecewise(case: _Case) -> Diagnosis:
    path = follow(case.expected, case.theta, case.alpha)
    M, c = path.piece
    factors = moving_spectrum(M)
    radius = float(np.abs(factors).max(initial=0.0))
    limit = limit_of(np.eye(len(c)) - M, c, path.theta)
    settled = path.outcome == "converges"
    point, error, best, scale = _errors(case, replace(limit, theta=path.theta if settled else None))
    poor = is_poor(error, best, scale, case.problem.gamma)
    verdict: Verdict = "neutral" if path.outcome == "undecided" else path.outcome
    if settled and poor:
        verdict = "stable but poor fixed point"
    if settled and radius >= 1 - NEUTRAL:  # it starts exactly on a fixed point that is not stable
        settled, verdict = False, "diverges" if radius > 1 + NEUTRAL else "neutral"
    bound = None
    if verdict not in ("chatters", "neutral"):
        bound = _scanned_bound(lambda a: case.expected.at(path.theta, a)[0], case.alpha)
    return Diagnosis(
        case.problem.name, case.method.title, case.options, case.alpha, case.sampling, settled, verdict, radius,
        None, bound, None, _turns(factors), _doubling(radius, 1) if verdict == "diverges" else None, factors,
        len(factors), point, error, best, limit.singularity, 0.0, scale, regions=path.regions,
        flow=_is_flow(case.expected, path.theta, case.alpha),
    )  # fmt: skip


def _local(
    problem: Problem, process: Process, method: Method, options: Options, alpha: float, sampling: Sampling
) -> Diagnosis:
    """TD(0) on values that are not linear in the weights, linearised where it starts."""
    assert problem.value is not None
    if method.name != "td" or any(options.values()):
        raise ValueError(
            f"{problem.name} has values that are not linear in the weights: only plain TD(0) is diagnosed there, "
            f"got {method.title} with {dict(options)}"
        )
    w, P, D = problem.initial_weights, process.P, process.D
    J, V = problem.value.jacobian(w)[process.state], problem.value.values(w)[process.state]
    delta = process.r + process.gamma * (P @ V) - V
    push = J.T @ (D * delta)
    slope = J.T @ (D[:, None] * (process.gamma * (P @ J) - J))
    slope = slope + np.einsum("s,sij->ij", D * delta, problem.value.hessian(w)[process.state])
    case = _Case(problem, method, options, alpha, "expected", process, process, np.eye(len(w)),
                 flow(-slope, push - slope @ w))  # fmt: skip
    found = _linear(case)
    return replace(found, sampling=sampling, local=True, fixed_point=None, fixed_point_error=None, best_error=None)


def _verdict(radius: float, second: float | None, drift: float, poor: bool) -> Verdict:
    if radius > 1 + NEUTRAL:
        return "diverges"
    if drift > 0 or radius >= 1 - NEUTRAL:
        return "neutral"
    if second is not None and second >= 1 - NEUTRAL:
        return "mean-stable but variance diverges"
    return "stable but poor fixed point" if poor else "converges"


def _scanned_bound(matrix_at: Callable[[float], Floats], alpha: float) -> float:
    """The first step size at which a map that is no flow stops being stable."""

    def stable(step_size: float) -> bool:
        return bool(np.abs(moving_spectrum(matrix_at(step_size))).max(initial=0.0) < 1)

    return first_crossing(stable, 1e-3 * alpha, 1e4 * alpha, factor=1.1, floor=1e-2)


def _is_flow(expected: Expected, theta: Floats, alpha: float) -> bool:
    """Whether the change of the piece at θ is proportional to the step size."""
    once, twice = (expected.at(theta, a)[0] - np.eye(len(theta)) for a in (alpha, 2 * alpha))
    return bool(np.allclose(twice, 2 * once, rtol=1e-9, atol=0))


def _errors(case: _Case, limit: Limit) -> tuple[Floats | None, float | None, float | None, float | None]:
    """The fixed point as weights of the problem, its RMSVE, the least RMSVE, and the size of values."""
    point = _in_full(case, limit)
    if case.method.rows == "pairs" and not case.expected.linear:  # its values are those of its own greedy policy
        return point, None, None, None
    process = case.process
    try:
        v = process.v
    except (RuntimeError, ValueError, np.linalg.LinAlgError):  # γ = 1 without end
        return point, None, None, None
    if not np.isfinite(v).all():
        return point, None, None, None
    root = np.sqrt(process.D)
    X, D = process.X, process.D
    if X.size > 1_000_000:  # the residual is exact in first order, whatever the normal equations lose
        w = np.linalg.lstsq(X.T @ (D[:, None] * X), X.T @ (D * v), rcond=None)[0]
    else:
        w = np.linalg.lstsq(root[:, None] * X, root * v, rcond=None)[0]
    best = float(np.linalg.norm(root * (X @ w - v)))
    error = None if point is None else float(np.linalg.norm(root * (case.full.X @ point - v)))
    initial = case.full.X @ case.problem.initial_weights - v
    return point, error, best, float(max(np.linalg.norm(root * v), np.linalg.norm(root * initial)))


def _in_full(case: _Case, limit: Limit) -> Floats | None:
    """The weights of a θ of the reduced problem."""
    if limit.theta is None:
        return None
    d, q = case.basis.shape
    if d == q:
        return limit.theta[:d]
    w0 = case.problem.initial_weights
    if not case.expected.linear:
        return np.asarray(case.basis @ limit.theta[:q] + w0 - case.basis @ (case.basis.T @ w0))
    assert case.method.expected is not None  # what becomes of the weights that nothing sees, the full update knows
    expected = case.method.expected(case.full, case.options)
    start = expected.initial(w0)
    if expected.generator is not None:
        whole = limit_of(*expected.generator, start).theta
    else:
        M, c = expected.at(start, case.alpha)
        whole = limit_of(np.eye(len(c)) - M, c, start).theta
    return None if whole is None else whole[:d]


def _turns(factors: Factors) -> bool:
    """Whether the leading factor is complex or negative."""
    if len(factors) == 0:
        return False
    leading = factors[0]
    return bool(leading.real < 0 or abs(leading.imag) > 1e-9 * abs(1 - leading))


def _doubling(radius: float, updates: int) -> float | None:
    return updates * math.log(2) / math.log(radius) if radius > 1 + NEUTRAL else None

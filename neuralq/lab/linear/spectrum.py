"""What an affine update θ ← M θ + c does in the long run, without the directions that it never moves.

    θ_t − θ_0 = Σ_{k<t} M^k ((M − I) θ_0 + c)

lies in range(M − I) + span(c) for ever, so only M on that space matters: redundant weights, and weights of rows that
are never updated, have the factor 1 and are not instability. With V an orthonormal basis of range(M − I),

    factors             eigenvalues of Vᵀ M V; the largest modulus is the growth per step
    a flow M = I − αG   1 − αλ with λ the eigenvalues of Vᵀ G V, stable for α < min 2 Re(λ)/|λ|² if every Re(λ) > 0
    fixed point         the one reached from θ_0 is θ_0 + V y with Vᵀ(I − M)V y = Vᵀ((M − I) θ_0 + c)
    drift               the part of c outside range(M − I): no point is fixed, and θ moves by it in every step

A direction of range(M − I) on which M is the identity ([[1, 1], [0, 1]]) is a real neutral mode, and stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.lab.linear.process import Process
from neuralq.types import Floats

__all__ = [
    "Limit",
    "first_crossing",
    "flow_bound",
    "flow_spectrum",
    "limit_of",
    "moving_space",
    "moving_spectrum",
    "visible_process",
]

Complexes = NDArray[np.complex128]

NEUTRAL = 1e-9
"""A growth per step this close to 1 cannot be told from 1."""


def visible_process(process: Process) -> tuple[Process, Floats]:
    """The process seen through features of full column rank, and the basis R ``[d, q]`` with X' = X R.

    The same process and R = I where every weight is seen.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> reduced, R = visible_process(linear_process(star()))
        >>> reduced.X.shape, R.shape  # 8 weights for 7 states
        ((7, 7), (8, 7))
    """
    R = process.visible
    if R.shape[1] == process.num_weights:
        return process, np.eye(process.num_weights)
    return process.with_features(process.X @ R), R


def moving_space(*matrices: Floats) -> Floats:
    """An orthonormal basis of the sum of the column spaces, ``[n, r]``.

    Example:
        >>> moving_space(np.array([[3.0, 0.0], [4.0, 0.0]])).round(12).reshape(-1).tolist() in ([.6, .8], [-.6, -.8])
        True
    """
    columns = np.hstack(matrices)
    if columns.shape[1] > columns.shape[0]:  # the same column space in a square matrix: A Aᵀ would square the condition
        columns = np.transpose(np.linalg.qr(columns.T, mode="r"))
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    if len(singular) == 0 or singular[0] == 0:
        return np.zeros((len(columns), 0))
    kept: Floats = left[:, singular > 1e-13 * max(columns.shape) * singular[0]]
    return kept


def moving_spectrum(M: Floats) -> Complexes:
    """The eigenvalues of M on range(M − I), largest modulus first; none where M is the identity.

    Example:
        >>> moving_spectrum(np.diag([1.0, 0.5])).tolist()
        [(0.5+0j)]
    """
    V = moving_space(M - np.eye(len(M)))
    return _descending(np.linalg.eigvals(V.T @ M @ V).astype(np.complex128))


def flow_spectrum(G: Floats) -> Complexes:
    """The eigenvalues of G on range(G), smallest real part first: the rates of θ' = g − G θ.

    Example:
        >>> flow_spectrum(np.diag([2.0, 0.0, -1.0])).tolist()
        [(-1+0j), (2+0j)]
    """
    V = moving_space(G)
    rates = np.linalg.eigvals(V.T @ G @ V).astype(np.complex128)
    return rates[np.argsort(rates.real, kind="stable")]


def flow_bound(rates: Complexes) -> float:
    """The largest a such that I − αG converges for every α < a: min 2 Re(λ)/|λ|², 0 where some Re(λ) is not above 0.

    Example:
        >>> flow_bound(np.array([1.0 + 0j, 4.0])), flow_bound(np.array([-1.0 + 0j])), flow_bound(np.array([]))
        (0.5, 0.0, inf)
    """
    if len(rates) == 0:
        return float("inf")
    if rates.real.min() <= 1e-14 * np.abs(rates).max():
        return 0.0
    return float(np.min(2 * rates.real / np.abs(rates) ** 2))


@dataclass(frozen=True, eq=False)
class Limit:
    """Where an affine update stays from a given start, whether or not it is stable.

    Args:
        theta: the fixed point in θ_0 + range(M − I), ``[n]``; None where there is none, or no single one.
        drift: what each step adds for ever outside range(M − I), ``[n]``; zero where a fixed point exists.
        singularity: σ_min / σ_max of I − M on range(M − I); near 0 a small change moves the fixed point far.
    """

    theta: Floats | None
    drift: Floats
    singularity: float


def limit_of(G: Floats, g: Floats, theta: Floats) -> Limit:
    """The fixed point of θ ← θ + g − G θ that belongs to a start, G = I − M.

    Example:
        >>> limit_of(np.diag([2.0, 0.0]), np.array([1.0, 0.0]), np.array([0.0, 5.0])).theta.round(12).tolist()
        [0.5, 5.0]
        >>> limit_of(np.diag([2.0, 0.0]), np.array([1.0, 0.1]), np.zeros(2)).drift.tolist()
        [0.0, 0.1]
    """
    V = moving_space(G)
    push = g - G @ theta
    drift = g - V @ (V.T @ g)
    # rounding leaves something of both sizes: relative to g, and where g should be 0, relative to weights of order 1
    drifts = np.linalg.norm(drift) > max(1e-9 * np.linalg.norm(g), 1e-13 * np.linalg.norm(G))
    inner = V.T @ G @ V
    singular = np.linalg.svd(inner, compute_uv=False) if V.shape[1] else np.ones(1)
    ratio = float(singular[-1] / singular[0]) if singular[0] > 0 else 0.0
    if drifts or ratio < 1e-14:
        return Limit(None, drift if drifts else np.zeros_like(drift), ratio)
    return Limit(theta + V @ np.linalg.solve(inner, V.T @ push), np.zeros_like(drift), ratio)


def first_crossing(
    stable: Callable[[float], bool], begin: float, end: float, *, factor: float = 1.05, floor: float = 1e-4
) -> float:
    """The largest a such that every scanned α < a is stable, refined by bisection in the step where it first fails.

    The stable set may have gaps, so nothing is concluded from a stable α about smaller ones: the scan starts at
    ``begin`` (or below, down to ``floor * begin``, until it finds a stable α) and climbs by ``factor``.

    Args:
        stable: whether a step size converges.
        begin: where the scan starts.
        end: where it stops; infinity is returned when all is stable up to there.
        factor: ratio of neighbouring step sizes.
        floor: share of ``begin`` below which nothing is tried; 0 is returned then.

    Example:
        >>> round(first_crossing(lambda a: a < 0.3 or a > 0.4, 0.01, 10.0), 9)  # not 10: the gap counts
        0.3
    """
    low = begin
    while not stable(low):
        low /= 2
        if low < floor * begin:
            return 0.0
    high = low * factor
    while stable(high):
        low, high = high, high * factor
        if low > end:
            return float("inf")
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def _descending(factors: Complexes) -> Complexes:
    return factors[np.argsort(-np.abs(factors), kind="stable")]

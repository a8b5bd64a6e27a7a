"""Expected linear TD(λ) as a matrix, and what its eigenvalues say before anything is trained.

With features X ``[S, d]``, the target policy's P and r, and the update distribution D = diag(d):

    A = Xᵀ D (I − γλP)⁻¹ (I − γP) X,    b = Xᵀ D (I − γλP)⁻¹ r,    expected update  w ← w + α (b − A w)

(Sutton & Barto 2018, equation 9.11 for λ = 0; Sutton, Mahmood & White 2016). The error then follows e ← (I − αA) e.
It shrinks iff the spectral radius of I − αA is below 1; some α achieves that iff every eigenvalue has a positive real
part, and then every α below min 2 Re(λ)/|λ|² does. Directions of w that no state can see (X w = 0) never move: they are
removed first, or every redundant set of features would look neutral instead of stable or unstable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from neuralq.checks import check_discount, check_fraction, check_positive
from neuralq.exact.resolvent import resolvent

__all__ = ["Prediction", "predict_expected_td", "rmsve", "td_operator"]


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the expected update will do, known from its matrix alone.

    Args:
        spectral_radius: of I − αA without the null space: the growth of the error per step in the long run.
        min_real_eigenvalue: smallest Re(λ) of A without the null space; below 0, no step size converges.
        converges: whether the error dies out at this step size.
        step_size_bound: every smaller α converges; 0 if none does.
        oscillates: whether the mode that decides it turns: its factor is complex or negative.
        doubling_time: steps in which a growing error doubles; None where it does not grow.
        rank: dimension that remains without the null space.
        eigenvalues: of A without the null space, smallest real part first.
    """

    spectral_radius: float
    min_real_eigenvalue: float
    converges: bool
    step_size_bound: float
    oscillates: bool
    doubling_time: float | None
    rank: int
    eigenvalues: NDArray[np.complex128]


def td_operator(
    P_pi: ArrayLike | sparse.sparray,
    r_pi: ArrayLike,
    features: ArrayLike,
    d: ArrayLike,
    gamma: float,
    lambda_: float = 0.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The matrix A ``[d, d]`` and vector b ``[d]`` of the expected TD(λ) update w ← w + α (b − A w).

    Args:
        P_pi: transitions of the target policy, ``[S, S]``, dense or sparse (it stays so); rows may be substochastic.
        r_pi: its expected rewards, ``[S]``.
        features: X, ``[S, d]``.
        d: how often each state is updated, ``[S]``; it need not be P's own distribution (then it is off-policy).
        gamma: γ in [0, 1].
        lambda_: λ in [0, 1].

    Raises:
        ValueError: γ or λ out of range, or shapes that do not fit.

    Example:
        >>> A, b = td_operator([[0.0, 1.0], [0.0, 1.0]], [0.0, 0.0], [[1.0], [2.0]], [0.5, 0.5], gamma=0.9)
        >>> A.round(12).tolist()  # w → 2w of Tsitsiklis & Van Roy: negative, so it diverges
        [[-0.2]]
    """
    check_discount("gamma", gamma)
    check_fraction("lambda_", lambda_, "for Monte Carlo use lambda_=1")
    P = sparse.csr_array(P_pi) if sparse.issparse(P_pi) else np.asarray(P_pi, dtype=np.float64)
    X, r, weight = (np.asarray(x, dtype=np.float64) for x in (features, r_pi, d))
    num_states = len(r)
    if (
        P.shape != (num_states, num_states)
        or X.shape[:1] != (num_states,)
        or weight.shape != (num_states,)
        or X.ndim != 2
    ):
        raise ValueError(
            "P_pi must be [S, S], r_pi [S], features [S, d] and d [S], "
            f"got {P.shape}, {r.shape}, {X.shape} and {weight.shape}"
        )
    ahead = np.column_stack([X - gamma * (P @ X), r])
    if lambda_ > 0:
        ahead = resolvent(P, ahead, gamma * lambda_)
    both = X.T @ (weight[:, None] * ahead)
    return both[:, :-1], both[:, -1]


def predict_expected_td(A: ArrayLike, step_size: float) -> Prediction:
    """Whether w ← w + α (b − A w) converges, how fast, and for which other step sizes.

    Args:
        A: ``[d, d]``, from `td_operator` or any other expected linear update.
        step_size: α > 0.

    Raises:
        ValueError: A is not a finite square matrix, or the step size is not above 0.

    Example:
        >>> verdict = predict_expected_td([[-0.2]], step_size=0.1)
        >>> verdict.converges, round(verdict.spectral_radius, 12), round(verdict.doubling_time, 2)
        (False, 1.02, 35.0)
    """
    check_positive("step_size", step_size)
    matrix = np.asarray(A, dtype=np.float64)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix).all():
        raise ValueError(f"A must be a finite square matrix, got shape {matrix.shape}")
    seen = _visible_directions(matrix)
    eigenvalues = np.linalg.eigvals(seen.T @ matrix @ seen).astype(np.complex128)
    eigenvalues = eigenvalues[np.argsort(eigenvalues.real, kind="stable")]
    if len(eigenvalues) == 0:  # nothing moves, so nothing is wrong
        return Prediction(0.0, 0.0, True, math.inf, False, None, 0, eigenvalues)
    factors = 1 - step_size * eigenvalues
    leading = factors[np.argmax(np.abs(factors))]
    radius = float(abs(leading))
    smallest = float(eigenvalues[0].real)
    bound = float(np.min(2 * eigenvalues.real / np.abs(eigenvalues) ** 2)) if smallest > 0 else 0.0
    oscillates = bool(leading.real < 0 or abs(leading.imag) > 1e-9 * step_size * np.abs(eigenvalues).max())
    doubling = math.log(2) / math.log(radius) if radius > 1 else None
    return Prediction(radius, smallest, radius < 1, bound, oscillates, doubling, len(eigenvalues), eigenvalues)


def rmsve(v: ArrayLike, v_pi: ArrayLike, d: ArrayLike) -> float:
    """The root mean squared value error √(Σ_s d(s) (V(s) − V_π(s))²) (Sutton & Barto 2018, equation 9.1).

    Example:
        >>> rmsve([3.0, 4.0], [0.0, 0.0], [0.0, 1.0])
        4.0
    """
    error = np.asarray(v, dtype=np.float64) - np.asarray(v_pi, dtype=np.float64)
    return float(np.sqrt(np.sum(np.asarray(d, dtype=np.float64) * error**2)))


def _visible_directions(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """An orthonormal basis of what A moves or is moved by, ``[d, rank]``.

    X w = 0 implies A w = 0 and Aᵀ w = 0. A direction that only one of the two annihilates is a real neutral mode of the
    update, and stays.
    """
    _, singular, right = np.linalg.svd(np.vstack([matrix, matrix.T]), full_matrices=False)
    if len(singular) == 0 or singular[0] == 0:
        return np.zeros((matrix.shape[0], 0))
    tolerance = 1e-12 * max(matrix.shape)
    basis: NDArray[np.float64] = right[singular > tolerance * singular[0]].T
    return basis

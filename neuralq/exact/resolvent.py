"""(I − cP)⁻¹ Y for a chain P of any size, dense or sparse, without ever making a sparse one dense.

With a transition matrix P (rows sum to at most 1) and 0 ≤ c < 1 (or c = 1 where every state leaves for good in the end)
the matrix I − cP is weakly diagonally dominant, so it can be factored without trouble, and iterations converge. Three
ways, by what P is:

    dense               LAPACK
    sparse, narrow      sparse LU. The reverse Cuthill-McKee order gives P a bandwidth b, and the factors then hold
                        at most about 3 n b numbers: walks and grids, where iterations would need many steps
    sparse, wide        BiCGSTAB on blocks of columns, GMRES for what it leaves, to a relative residual of 1e-12:
                        random graphs, whose factors would be almost dense, and which mix in a few steps
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import gmres, splu

from neuralq.exact.kernels import Floats

__all__ = ["resolvent"]


LARGEST_FACTOR = 30_000_000
"""Numbers in the factors of a sparse chain beyond which it is iterated instead: about 400 MB with their indices."""

LARGEST_RATIO = 1e13
"""Largest solution per unit of Y that is believed: what a singular matrix leaves after rounding is larger."""

RESIDUAL = 1e-13
BLOCK = 32
"""Columns iterated together: few enough that 10⁴ rows of them stay in the cache."""
MOST_ITERATIONS = 200


def resolvent(P: Floats | sparse.sparray, Y: Floats, scale: float) -> Floats:
    """The solution Z of (I − c P) Z = Y.

    Args:
        P: transitions, ``[n, n]``, dense or sparse; rows sum to at most 1.
        Y: right-hand sides, ``[n]`` or ``[n, k]``.
        scale: c in [0, 1].

    Raises:
        ValueError: I − cP is singular (c = 1 for a chain that never ends), or the iteration did not reach a relative
            residual of 1e-12 (c too close to 1 for a wide chain).

    Example:
        >>> resolvent(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([1.0, 2.0]), 0.5).tolist()
        [2.0, 2.0]
    """
    try:
        solved = _solved(P, Y, scale)
    except (RuntimeError, np.linalg.LinAlgError):
        solved = np.full_like(Y, np.inf)
    if not np.abs(solved).max(initial=0.0) <= LARGEST_RATIO * np.abs(Y).max(initial=0.0):
        raise ValueError(
            f"I − cP is singular for c = {scale:g}: with γ = 1 a chain that never ends has no finite values; use a "
            "smaller gamma or lambda_"
        )
    return solved


def _solved(P: Floats | sparse.sparray, Y: Floats, scale: float) -> Floats:
    if not sparse.issparse(P):
        return np.asarray(np.linalg.solve(np.eye(len(Y)) - scale * np.asarray(P), Y))
    chain = sparse.csr_array(P)
    n = chain.shape[0]
    order = reverse_cuthill_mckee(sparse.csr_array(chain + chain.T), symmetric_mode=True)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    row, column = chain.nonzero()
    width = int(np.abs(place[row] - place[column]).max(initial=0))
    if n <= 500 or 3 * n * width <= LARGEST_FACTOR:
        inside = sparse.csc_array((sparse.eye_array(n) - scale * chain).tocsr()[order][:, order])
        solved: Floats = splu(inside, permc_spec="NATURAL", diag_pivot_thresh=0.0).solve(np.ascontiguousarray(Y[order]))
        unordered: Floats = np.empty_like(solved)
        unordered[order] = solved
        return unordered
    return _iterate(sparse.csr_array(sparse.eye_array(n) - scale * chain), Y)


def _iterate(system: sparse.csr_array, Y: Floats) -> Floats:
    """Blocks of columns by BiCGSTAB; the columns it leaves unsolved, one by one, by GMRES."""
    columns = Y.reshape(len(Y), -1)
    out = np.empty_like(columns)
    for first in range(0, columns.shape[1], BLOCK):
        block = slice(first, first + BLOCK)
        with np.errstate(all="ignore"):  # a column that breaks down shows in what is left, below
            out[:, block] = _bicgstab(system, np.ascontiguousarray(columns[:, block]))
    size = np.linalg.norm(columns, axis=0)
    left = np.linalg.norm(system @ out - columns, axis=0)
    for k in np.flatnonzero(~(left <= 10 * RESIDUAL * size)):
        out[:, k], _ = gmres(system, columns[:, k], rtol=RESIDUAL, atol=0.0, restart=60, maxiter=50)
        left[k] = np.linalg.norm(system @ out[:, k] - columns[:, k])
        if not left[k] <= 10 * RESIDUAL * size[k]:
            raise ValueError(
                "the chain mixes too slowly for its size: an iterative solution left a relative residual of "
                f"{left[k] / size[k]:.1e}; use a smaller gamma or lambda_, or fewer states"
            )
    return out.reshape(Y.shape)


def _bicgstab(system: sparse.csr_array, Y: Floats) -> Floats:
    """BiCGSTAB on every column of ``[n, k]`` at once (van der Vorst 1992), each with its own coefficients."""
    out, residual, p = np.zeros_like(Y), Y.copy(), Y.copy()
    goal = RESIDUAL * np.linalg.norm(Y, axis=0)
    rho = _dots(Y, residual)
    for _ in range(MOST_ITERATIONS):
        v = system @ p
        alpha = _over(rho, _dots(Y, v))
        residual -= alpha * v
        t = system @ residual
        omega = _over(_dots(t, residual), _dots(t, t))
        out += alpha * p
        out += omega * residual
        residual -= omega * t
        if (np.linalg.norm(residual, axis=0) <= goal).all():
            break
        rho_tm1, rho = rho, _dots(Y, residual)
        p = residual + _over(rho * alpha, rho_tm1 * omega) * (p - omega * v)
    return out


def _dots(x: Floats, y: Floats) -> Floats:
    product: Floats = np.einsum("nk,nk->k", x, y)
    return product


def _over(x: Floats, y: Floats) -> Floats:
    """The ratio, and 0 where a column has broken down or is solved: GMRES takes what is left of it."""
    return np.where(y == 0, 0.0, x / np.where(y == 0, 1.0, y))

"""Exact mean and second moment of a sampled method, from the affine maps of single transitions.

Along transition k a memoryless method changes θ ← M_k θ + c_k, exactly; M_k and c_k are read off the learner itself,
run on 0 and on the unit vectors. With independent draws (row i with chance D_i, then a transition of it)

    E θ     ← E[M] E θ + E[c]
    E θθᵀ   ← E[M θθᵀ Mᵀ] + ...,             grows by the spectral radius of E[M ⊗ M]

Along one chain the next map depends on where the last one led, so moments are kept per row (a Markov jump linear
system; Costa, Fragoso & Marques 2005, chapter 3), n·q unknowns for the mean and n·q² for the second moment:

    m_j ← Σ_{k: i→j} p_k M_k m_i,            V_j ← Σ_{k: i→j} p_k M_k V_i M_kᵀ

where transitions that end an episode lead to the start distribution. Radii are taken on what the maps move, the range
of all M_k − I; along a chain within each class of rows that can reach each other, for the radius of the whole is the
largest of theirs. V keeps being symmetric and positive, so q(q+1)/2 numbers per row suffice, and the growth is that of
a positive operator L. So stability is certain without eigenvalues: it holds iff V − L V = I has a positive solution.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.spectrum import moving_space, visible_process
from neuralq.lab.methods import Method
from neuralq.lab.methods.record import Options
from neuralq.lab.verdicts.update_maps import UpdateMaps, update_maps
from neuralq.types import Floats, Indices
from neuralq_envs.counterexamples import Problem

__all__ = [
    "evolve",
    "growth_factors",
    "known_second_moment",
    "mean_radius",
    "second_moment_radius",
    "second_moment_stable",
    "unknowns",
]


LARGEST_DENSE = 1000
"""Unknowns up to which an operator is written as a matrix; beyond, it is applied without one."""

LARGEST = 400_000
"""Unknowns beyond which exact moments are refused."""


def unknowns(process: Process, size: int, sampling: str) -> int:
    """Numbers in the second moment of θ: q² for independent draws, n q² along a chain; a bound, before reduction."""
    return size * size * (process.num_rows if sampling == "markov" else 1)


def mean_radius(maps: UpdateMaps, sampling: str) -> float:
    """The growth per step of the mean of θ, on what the maps move; 0 where they move nothing.

    Independent draws give that of the expected update; along one chain it differs in second order of α.

    Args:
        maps: from `neuralq.lab.verdicts.update_maps`.
        sampling: ``"iid"`` or ``"markov"``.

    Example:
        >>> from neuralq.lab.verdicts.update_maps import update_maps
        >>> from neuralq.lab.methods.td import TD
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> maps = update_maps(linear_process(star()), TD, TD.checked({}), 0.01)
        >>> round(mean_radius(maps, "iid"), 7), round(mean_radius(maps, "markov"), 7)  # Sutton & Barto 2018, 11.2
        (1.0023925, 1.0023814)
    """
    return float(np.abs(growth_factors(maps, sampling)).max(initial=0.0))


def growth_factors(maps: UpdateMaps, sampling: str) -> NDArray[np.complex128]:
    """The factors per step of the mean of θ, largest modulus first; along large chains the leading ones only."""
    found = [np.zeros(0, dtype=np.complex128)]
    for part in _classes(maps, sampling):
        if sampling == "iid":
            found.append(np.linalg.eigvals(part.mean()[0]).astype(np.complex128))
        else:
            found.append(_leading(part, 1))
    every = np.concatenate(found).astype(np.complex128)
    return every[np.argsort(-np.abs(every), kind="stable")]


def second_moment_radius(maps: UpdateMaps, sampling: str) -> float:
    """The growth per step of E θθᵀ, on what the maps move; below 1 the variance settles, above it explodes.

    Args:
        maps: from `neuralq.lab.verdicts.update_maps`.
        sampling: ``"iid"`` or ``"markov"``.

    Example:
        >>> from neuralq.lab.verdicts.update_maps import update_maps
        >>> from neuralq.lab.methods.td import TD
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> maps = update_maps(linear_process(star()), TD, TD.checked({}), 0.01)
        >>> round(second_moment_radius(maps, "iid"), 7), round(second_moment_radius(maps, "markov"), 7)
        (1.0048556, 1.004811)
    """
    parts = [_one_row(part) if sampling == "iid" else part for part in _classes(maps, sampling)]
    return max((float(np.abs(_leading(part, 2)).max(initial=0.0)) for part in parts), default=0.0)


def second_moment_stable(maps: UpdateMaps, sampling: str) -> bool:
    """Whether the second moment settles, by a linear system where that is cheaper than eigenvalues.

    L maps positive matrices to such, so its radius is below 1 iff V − L V = I has a positive definite solution.
    """
    for part in _classes(maps, sampling):
        one = _one_row(part) if sampling == "iid" else part
        q, rows = one.M.shape[1], np.unique(one.row)
        if len(rows) * q * (q + 1) // 2 > LARGEST_DENSE:
            if np.abs(_leading(one, 2)).max(initial=0.0) >= 1:
                return False
            continue
        L, pack = _dense(one, rows, 2), _triangle(q)
        try:
            V = np.asarray(np.linalg.solve(np.eye(len(L)) - L, np.tile(np.eye(q)[pack], len(rows))), dtype=np.float64)
        except np.linalg.LinAlgError:
            return False
        if not np.isfinite(V).all() or np.linalg.eigvalsh(_unpacked(V.reshape(len(rows), -1), q)).min() <= 0:
            return False
    return True


def evolve(maps: UpdateMaps, theta: Floats, steps: Indices, sampling: str = "markov") -> tuple[Floats, Floats]:
    """The exact E θ ``[R, size]`` and E θθᵀ ``[R, size, size]`` after given numbers of sampled updates from a start.

    Args:
        maps: from `neuralq.lab.verdicts.update_maps`.
        theta: where every seed starts, ``[size]``.
        steps: numbers of updates, rising, ``[R]``.
        sampling: ``"iid"`` or ``"markov"``; a chain begins at a row drawn from D.

    Example:
        >>> one = np.ones((2, 1, 1))
        >>> coin = UpdateMaps(one, np.array([[1.0], [-1.0]]), np.zeros(2, int), np.zeros(2, int), np.full(2, 0.5),
        ...                   np.ones(1), np.ones(1))
        >>> evolve(coin, np.zeros(1), np.array([7]), "iid")[1].round(12).tolist()  # a random walk
        [[[7.0]]]
    """
    size = len(theta)
    M = np.zeros((len(maps.M), size + 1, size + 1))  # of (θ, 1), so that constants are part of the map
    M[:, :size, :size], M[:, :size, size], M[:, size, size] = maps.M, maps.c, 1.0
    both = np.append(theta, 1.0)
    V = maps.D[:, None, None] * np.outer(both, both)
    if sampling == "iid":
        arrive = np.outer(maps.D, maps.probability)
    else:
        arrive = _arrivals(maps, np.arange(maps.num_rows)).toarray() * maps.probability
    found, wanted = [], set(steps.tolist())
    for step in range(int(steps[-1]) + 1):
        if step in wanted:
            found.append(V.sum(axis=0))
        moved = M @ V[maps.row] @ np.swapaxes(M, 1, 2)
        V = (arrive @ moved.reshape(len(M), -1)).reshape(V.shape)
    total = np.array(found)
    return total[:, :size, size], total[:, :size, :size]


def known_second_moment(
    problem: Problem, method: Method, options: Options, step_size: float, sampling: str, most: int = 5_000
) -> float | None:
    """`second_moment_radius` of a method on a problem; None where updates are no random maps, or too many unknowns."""
    process, _ = visible_process(linear_process(problem))
    expected = None if method.expected is None else method.expected(process, options)
    if expected is None or not expected.linear or method.learner is None or method.remembers(options):
        return None
    if unknowns(process, expected.size, sampling) > most:
        return None
    return second_moment_radius(update_maps(process, method, options, step_size), sampling)


def _moved(maps: UpdateMaps, kept: NDArray[np.bool_]) -> Floats:
    """A basis of all that these transitions move."""
    size = maps.M.shape[1]
    change = np.swapaxes(maps.M[kept] - np.eye(size), 0, 1)
    return moving_space(change.reshape(size, -1)) if kept.any() and size else np.zeros((size, 0))


def _classes(maps: UpdateMaps, sampling: str) -> Iterator[UpdateMaps]:
    """The parts whose radii decide, each on what it moves: everything at once, or the classes of a chain."""
    for kept in _parts(maps, sampling):
        V = _moved(maps, kept)
        if kept.any() and V.shape[1]:
            yield maps.within(kept, V)


def _parts(maps: UpdateMaps, sampling: str) -> list[NDArray[np.bool_]]:
    if sampling == "iid":
        return [maps.weight > 0]
    n = maps.num_rows
    arrive = _arrivals(maps, np.arange(n))
    leave = sparse.csr_array((np.ones(len(maps.row)), (np.arange(len(maps.row)), maps.row)), shape=(len(maps.row), n))
    graph = sparse.csr_array((arrive @ leave).T)
    reached, frontier = maps.D > 0, maps.D > 0
    while frontier.any():
        frontier = (graph.T @ frontier.astype(np.float64) > 0) & ~reached
        reached = reached | frontier
    _, label = connected_components(graph, directed=True, connection="strong")
    parts = []
    for each in np.unique(label[reached]):
        inside = label == each
        back = maps.start @ inside > 0  # after an end the chain may be back among these rows
        stays = np.where(maps.next_row >= 0, inside[maps.next_row], back)
        parts.append(inside[maps.row] & stays)
    return parts


def _arrivals(maps: UpdateMaps, rows: Indices) -> sparse.csr_array:
    """Where each transition leads, ``[len(rows), K]``: to one row, or, after an end, to each by its start chance."""
    number = np.full(maps.num_rows + 1, -1, dtype=np.int64)
    number[rows] = np.arange(len(rows))
    goes = np.flatnonzero(number[maps.next_row] >= 0)  # -1 looks at the last entry, which is no row
    ends, begins = np.flatnonzero(maps.next_row < 0), rows[maps.start[rows] > 0]
    to = np.concatenate([number[maps.next_row[goes]], np.repeat(number[begins], len(ends))])
    by = np.concatenate([goes, np.tile(ends, len(begins))])
    share = np.concatenate([np.ones(len(goes)), np.repeat(maps.start[begins], len(ends))])
    return sparse.csr_array((share, (to, by)), shape=(len(rows), len(maps.row)))


def _one_row(maps: UpdateMaps) -> UpdateMaps:
    """Independent draws as a chain over one row."""
    zero = np.zeros(len(maps.row), dtype=np.int64)
    return UpdateMaps(maps.M, maps.c, zero, zero, maps.weight, np.ones(1), np.ones(1))


def _triangle(q: int) -> tuple[Indices, Indices]:
    lower = np.tril_indices(q)
    return np.asarray(lower[0]), np.asarray(lower[1])


def _unpacked(V: Floats, q: int) -> Floats:
    """Lower triangles ``[n, q(q+1)/2]`` as symmetric matrices ``[n, q, q]``."""
    i, j = _triangle(q)
    whole = np.empty((len(V), q, q))
    whole[:, i, j] = V
    whole[:, j, i] = V
    return whole


def _blocks(maps: UpdateMaps, moment: int) -> Floats:
    """p_k M_k, or p_k M_k ⊗ M_k on lower triangles, ``[K, m, m]``."""
    p = maps.probability[:, None, None]
    if moment == 1:
        return np.asarray(p * maps.M)
    i, j = _triangle(maps.M.shape[1])
    M = maps.M
    straight = M[:, i][:, :, i] * M[:, j][:, :, j]
    crossed = M[:, i][:, :, j] * M[:, j][:, :, i]
    return np.asarray(p * np.where(i == j, straight, straight + crossed))


def _dense(maps: UpdateMaps, rows: Indices, moment: int) -> Floats:
    blocks = _blocks(maps, moment)
    n, m = len(rows), blocks.shape[1]
    origin = np.searchsorted(rows, maps.row)
    arrive = _arrivals(maps, rows).tocoo()
    to, by = arrive.coords
    whole = np.zeros((n * n, m * m))
    gather = sparse.csr_array((arrive.data, (to * n + origin[by], by)), shape=(n * n, len(blocks)))
    whole[:] = gather @ blocks.reshape(len(blocks), -1)
    return np.ascontiguousarray(whole.reshape(n, n, m, m).transpose(0, 2, 1, 3)).reshape(n * m, n * m)


def _leading(maps: UpdateMaps, moment: int) -> NDArray[np.complex128]:
    """Leading eigenvalues of the mean (moment 1) or second-moment operator along a chain; all where it is small."""
    q, rows = maps.M.shape[1], np.unique(maps.row)
    size = len(rows) * (q if moment == 1 else q * (q + 1) // 2)
    if size > LARGEST:
        raise ValueError(f"{size} unknowns are too many for exact moments; use sampling='expected', or run the method")
    if size <= LARGEST_DENSE:
        return np.asarray(np.linalg.eigvals(_dense(maps, rows, moment)), dtype=np.complex128)
    arrive, origin = _arrivals(maps, rows), np.searchsorted(rows, maps.row)
    p, transposed, pack = maps.probability, np.swapaxes(maps.M, 1, 2), _triangle(q)

    def apply(x: Floats) -> Floats:
        if moment == 1:
            moved = np.einsum("kij,kj->ki", maps.M, x.reshape(len(rows), q)[origin])
        else:
            V = _unpacked(x.reshape(len(rows), -1), q)
            moved = (maps.M @ V[origin] @ transposed)[:, pack[0], pack[1]]
        return np.asarray(arrive @ (p[:, None] * moved)).reshape(-1)

    operator = LinearOperator((size, size), matvec=apply, dtype=np.float64)
    begin = np.tile(np.eye(q)[pack], len(rows)) if moment == 2 else np.random.default_rng(0).normal(size=size)
    try:
        found = eigs(operator, k=2, ncv=24, which="LM", v0=begin, return_eigenvectors=False, maxiter=100, tol=1e-11)
    except ArpackNoConvergence as stuck:
        found = stuck.eigenvalues
        if len(found) == 0:
            raise
    return np.asarray(found, dtype=np.complex128)

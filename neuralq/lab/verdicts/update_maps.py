"""What one sampled update does along every transition, as an affine map read off the learner itself.

A memoryless method changes θ ← M_k θ + c_k along transition k, exactly. The learner is run once on θ = 0, which gives
c_k, and once on every unit vector e_i, which gives column i of M_k; nothing is derived by hand a second time, so the
mean of the maps can be held against the expected update.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import sample_along
from neuralq.lab.methods import Method
from neuralq.lab.methods.record import Options
from neuralq.types import Floats, Indices

__all__ = ["UpdateMaps", "update_maps"]


LARGEST = 20_000_000
"""Numbers in all maps beyond which they are refused: 160 MB."""

_CHUNK = 2_000_000  # numbers of features in one call of a learner


@dataclass(frozen=True, eq=False)
class UpdateMaps:
    """What one sampled update does to θ along every transition: θ ← M_k θ + c_k.

    Args:
        M: ``[K, size, size]``.
        c: ``[K, size]``.
        row: where each begins, ``[K]``.
        next_row: where each leads, -1 at an end, ``[K]``.
        probability: chance of each given its row, ``[K]``.
        D: chance of each row when rows are drawn independently, and at the beginning of a chain, ``[n]``.
        start: chance of each row after an end, ``[n]``.
    """

    M: Floats
    c: Floats
    row: Indices
    next_row: Indices
    probability: Floats
    D: Floats
    start: Floats

    @property
    def num_rows(self) -> int:
        """How many rows there are, n."""
        return len(self.D)

    @property
    def weight(self) -> Floats:
        """Chance of each transition when rows are drawn independently, ``[K]``."""
        return self.D[self.row] * self.probability

    def mean(self) -> tuple[Floats, Floats]:
        """E[M] and E[c] over independent draws: the expected update."""
        return np.einsum("k,kij->ij", self.weight, self.M), self.weight @ self.c

    def within(self, kept: NDArray[np.bool_], V: Floats) -> UpdateMaps:
        """Some transitions, on the space of an orthonormal basis V that contains all they move; constants left out."""
        M = np.einsum("ai,kab,bj->kij", V, self.M[kept], V, optimize=True)
        c = np.zeros((len(M), V.shape[1]))
        return UpdateMaps(M, c, self.row[kept], self.next_row[kept], self.probability[kept], self.D, self.start)


def update_maps(process: Process, method: Method, options: Options, step_size: float) -> UpdateMaps:
    """The affine map of a memoryless method along every transition, read off its sampled update.

    Where the update looks at a second, independent successor there is one map for every pair of successors.

    Args:
        process: the problem.
        method: which method.
        options: all its options.
        step_size: α.

    Raises:
        ValueError: the method has no sampled update or remembers earlier transitions, or the problem is too large.

    Example:
        >>> from neuralq.lab.methods.td import TD
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> process = linear_process(star())
        >>> maps = update_maps(process, TD, TD.checked({}), 0.01)
        >>> expected = TD.expected(process, TD.checked({})).at(np.zeros(8), 0.01)[0]
        >>> len(maps.M), bool(np.allclose(maps.mean()[0], expected))
        (49, True)
    """
    if method.learner is None or method.expected is None or method.remembers(options):
        raise ValueError(
            f"{method.title} with these options has no memoryless sampled update: it has no map per transition"
        )
    ways, target = process.transitions, process.target_transitions
    size, learner_of = method.expected(process, options).size, method.learner

    def after(theta: Floats, one: Indices, second: Indices) -> Floats:
        learner = learner_of(process, theta[:, : process.num_weights].copy(), options)
        learner.theta[:] = theta
        learner.update(sample_along(process, one, second, np.ones(len(one), dtype=bool)), step_size)
        return learner.theta

    count = np.diff(target.starts)[ways.row]
    first = np.cumsum(count) - count
    one = np.repeat(np.arange(len(ways.row)), count)
    second = target.starts[ways.row[one]] + np.arange(len(one)) - np.repeat(first, count)
    chance = target.probability[second]
    moved = after(np.tile(np.random.default_rng(0).normal(size=size), (len(one), 1)), one, second)
    if (moved == moved[first[one]]).all():  # whatever the second successor is
        one, second, chance = one[first], second[first], np.ones(len(first))
    if len(one) * size * size > LARGEST:
        raise ValueError(
            f"{len(one)} transitions with maps of {size}x{size} are too many for exact moments; "
            "use sampling='expected', or run the method"
        )
    probes = np.vstack([np.zeros(size), np.eye(size)])
    M, c = np.empty((len(one), size, size)), np.empty((len(one), size))
    stride = max(1, _CHUNK // ((size + 1) * max(size, process.num_weights, 1)))
    for k in range(0, len(one), stride):
        some = slice(k, k + stride)
        repeated = (np.repeat(x[some], size + 1) for x in (one, second))
        num = len(one[some])
        found = after(np.tile(probes, (num, 1)), *repeated).reshape(num, size + 1, size)
        c[some] = found[:, 0]
        M[some] = np.swapaxes(found[:, 1:] - found[:, :1], 1, 2)
    row = ways.row[one]
    return UpdateMaps(M, c, row, ways.next_row[one], ways.probability[one] * chance, process.D, process.start)

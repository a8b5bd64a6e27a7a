"""Regressors for fitted iteration: each draws a function through values at support points.

Most of those in use are *linear smoothers*: what they say at a query is a fixed combination of the values given,

    V̂(x) = Σ_i H(x, i) y_i,

so the support decides all, and the hat matrix H is the whole regressor. Two norms matter. ‖H‖∞ = max_x Σ_i |H(x, i)|
above 1 means that the fit can exaggerate: a small error in y may come out larger, and value iteration feeds it back in
(Gordon 1995). A smoother whose rows are non-negative and sum to at most 1 is an *averager*: it never exaggerates, and
fitted value iteration with it is a contraction wherever exact value iteration is. Least squares and locally weighted
regression extrapolate, hence are no averagers; nearest neighbours, interpolation on a grid, aggregation and kernel
smoothing are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy import sparse
from scipy.spatial.distance import cdist

from neuralq.checks import check_choice, check_positive, check_whole
from neuralq.types import Floats, Indices

__all__ = [
    "FittedRegressor",
    "GridInterpolation",
    "Hat",
    "KernelSmoothing",
    "LeastSquares",
    "LinearSmoother",
    "LocallyWeighted",
    "NearestNeighbours",
    "Regressor",
    "StateAggregation",
    "linear_features",
    "quadratic_features",
]

Hat = Any  # a float64 array [queries, support], dense or scipy.sparse.csr_array


class FittedRegressor(Protocol):
    """A regressor that has seen where its support is, but not yet the values there."""

    def predict(self, y: Floats, x_query: Floats) -> Floats:
        """The fit to ``y``, ``[n]``, at ``x_query``, ``[q, dim]``: ``[q]``."""
        ...


class Regressor(Protocol):
    """Anything that can be fitted to values at support points."""

    def fit(self, x_support: Floats) -> FittedRegressor:
        """Prepare for values at ``x_support``, ``[n, dim]``."""
        ...


@dataclass(frozen=True, eq=False)
class LinearSmoother:
    """A fit that is linear in the values: its hat matrix says everything.

    Args:
        hat: H of given queries, ``[q, dim] -> [q, n]``, dense or sparse.
        factors: where H is a product of low rank, features ``[q, dim] -> [q, d]`` and the matrix ``[d, n]`` after them.

    Example:
        >>> mean = LinearSmoother(lambda x: np.full((len(x), 2), 0.5))
        >>> mean.predict(np.array([1.0, 3.0]), np.zeros((1, 2))).tolist()
        [2.0]
    """

    hat: Callable[[Floats], Hat]
    factors: tuple[Callable[[Floats], Floats], Floats] | None = None

    def operator(self, x_query: Floats) -> Callable[[Floats], Floats]:
        """Y ↦ H y at fixed queries, by way of the factors where H has any."""
        if self.factors is not None:
            left, right = self.factors[0](x_query), self.factors[1]
            return lambda y: left @ (right @ y)
        full = self.hat(x_query)
        return lambda y: full @ y

    def predict(self, y: Floats, x_query: Floats) -> Floats:
        """H y."""
        return self.operator(x_query)(y)


def linear_features(x: Floats) -> Floats:
    """1 and the coordinates, ``[q, dim] -> [q, 1 + dim]``.

    Example:
        >>> linear_features(np.array([[2.0, 3.0]])).tolist()
        [[1.0, 2.0, 3.0]]
    """
    return np.concatenate([np.ones((len(x), 1)), x], axis=1)


def quadratic_features(x: Floats) -> Floats:
    """All monomials of degree 2 at most: 1, the coordinates, then their products, ``[q, (dim+1)(dim+2)/2]``.

    Example:
        >>> quadratic_features(np.array([[2.0, 3.0]])).tolist()
        [[1.0, 2.0, 3.0, 4.0, 6.0, 9.0]]
    """
    i, j = np.triu_indices(x.shape[1])
    return np.concatenate([linear_features(x), x[:, i] * x[:, j]], axis=1)


@dataclass(frozen=True)
class LeastSquares:
    """Least squares on given features: H = Φ(x) (Φ'Φ + η I)⁻¹ Φ'; without ridge the shortest of all best weights.

    Args:
        features: Φ, ``[q, dim] -> [q, d]``.
        ridge: η.

    Example:
        >>> line = LeastSquares(linear_features).fit(np.array([[0.0], [1.0]]))
        >>> line.hat(np.array([[2.0]])).round(12).tolist()  # extrapolation has a negative weight
        [[-1.0, 2.0]]
    """

    features: Callable[[Floats], Floats] = quadratic_features
    ridge: float = 0.0

    def fit(self, x_support: Floats) -> LinearSmoother:
        """The pseudo-inverse of the features is taken once.

        Raises:
            ValueError: a negative ridge.
        """
        if not self.ridge >= 0:
            raise ValueError(f"ridge must be at least 0, got {self.ridge}")
        phi = self.features(x_support)
        normal = phi.T @ phi + self.ridge * np.eye(phi.shape[1])
        solve = np.asarray(
            np.linalg.solve(normal, phi.T) if self.ridge > 0 else np.linalg.pinv(phi), dtype=np.float64
        )  # fmt: skip
        return LinearSmoother(lambda x: self.features(x) @ solve, (self.features, solve))


@dataclass(frozen=True)
class NearestNeighbours:
    """The mean of the nearest support points, plain or weighted by inverse distance: an averager.

    Args:
        num_neighbours: k, at most the number of support points.
        weighting: ``"uniform"`` or ``"inverse-distance"``; a query on a support point then takes its value.

    Example:
        >>> two = NearestNeighbours(2, "inverse-distance").fit(np.array([[0.0], [1.0], [5.0]]))
        >>> two.hat(np.array([[0.25]])).toarray().tolist()
        [[0.75, 0.25, 0.0]]
    """

    num_neighbours: int = 1
    weighting: str = "uniform"

    def fit(self, x_support: Floats) -> LinearSmoother:
        """Keep the points; of equally near ones the first count.

        Raises:
            ValueError: more neighbours than points, or an unknown weighting.
        """
        check_whole("num_neighbours", self.num_neighbours)
        check_choice("weighting", self.weighting, ("uniform", "inverse-distance"))
        if self.num_neighbours > len(x_support):
            raise ValueError(f"num_neighbours must be at most the {len(x_support)} points, got {self.num_neighbours}")
        k, n = int(self.num_neighbours), len(x_support)

        def hat(x: Floats) -> Hat:
            distance, index = _nearest(x, x_support, k)
            weight = np.ones_like(distance)
            if self.weighting == "inverse-distance":
                touching = np.asarray(distance <= 1e-12 * (1.0 + distance[:, -1:]))
                met = touching.any(axis=1, keepdims=True)
                weight = np.where(met, touching, 1.0 / np.where(touching, 1.0, distance))
            return _rows(weight / weight.sum(axis=1, keepdims=True), index, n)

        return LinearSmoother(hat)


@dataclass(frozen=True)
class GridInterpolation:
    """Multilinear interpolation where the support is a full grid: an averager. Outside, the nearest edge counts.

    Example:
        >>> corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
        >>> GridInterpolation().fit(corners).hat(np.array([[0.5, 0.25]])).toarray().tolist()
        [[0.375, 0.125, 0.375, 0.125]]
    """

    def fit(self, x_support: Floats) -> LinearSmoother:
        """Find the axes of the grid.

        Raises:
            ValueError: the points are not a full grid.
        """
        axes = [np.unique(column) for column in x_support.T]
        shape = tuple(len(axis) for axis in axes)
        place = np.stack([np.searchsorted(axis, column) for axis, column in zip(axes, x_support.T, strict=True)])
        number = np.full(shape, -1, dtype=np.int64)
        number[tuple(place)] = np.arange(len(x_support))
        if min(shape) < 2 or number.size != len(x_support) or (number < 0).any():
            raise ValueError(
                f"grid interpolation needs a full grid with at least 2 points per side, got {len(x_support)} points "
                f"with {shape} different coordinates; use nearest neighbours or a kernel for scattered points"
            )

        def hat(x: Floats) -> Hat:
            cells, shares = [], []
            for axis, column in zip(axes, x.T, strict=True):
                at = np.clip(np.searchsorted(axis, column, side="right") - 1, 0, len(axis) - 2)
                cells.append(at)
                shares.append(np.clip((column - axis[at]) / (axis[at + 1] - axis[at]), 0.0, 1.0))
            weight, index = [], []
            for corner in np.ndindex(*(2,) * len(axes)):
                parts = [share if up else 1.0 - share for share, up in zip(shares, corner, strict=True)]
                weight.append(np.prod(parts, axis=0))
                index.append(number[tuple(at + up for at, up in zip(cells, corner, strict=True))])
            return _rows(np.stack(weight, axis=1), np.stack(index, axis=1), len(x_support))

        return LinearSmoother(hat)


@dataclass(frozen=True)
class StateAggregation:
    """One value for each box of a partition, the mean of the support points in it: an averager.

    Args:
        low: lower corner of the partitioned box.
        high: upper corner.
        num_per_side: boxes per side; states outside count to the nearest.

    Example:
        >>> halves = StateAggregation((0.0,), (1.0,), 2).fit(np.array([[0.1], [0.3], [0.9]]))
        >>> halves.hat(np.array([[0.4], [0.6]])).toarray().tolist()
        [[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    num_per_side: int

    def _box(self, x: Floats) -> Indices:
        low, high = np.array(self.low), np.array(self.high)
        place = np.clip(np.floor((x - low) / (high - low) * self.num_per_side), 0, self.num_per_side - 1)
        sides = (self.num_per_side,) * len(low)
        box: Indices = np.ravel_multi_index(tuple(place.astype(np.int64).T), sides)
        return box

    def fit(self, x_support: Floats) -> LinearSmoother:
        """Which points share a box; a query in a box without any raises ValueError."""
        check_whole("num_per_side", self.num_per_side)
        num_boxes = self.num_per_side ** len(self.low)
        box, n = self._box(x_support), len(x_support)
        member = sparse.csr_array((np.ones(n), (box, np.arange(n))), shape=(num_boxes, n))
        count = np.bincount(box, minlength=num_boxes)

        def hat(x: Floats) -> Hat:
            at = self._box(x)
            empty = np.flatnonzero(count[at] == 0)
            if empty.size:
                raise ValueError(
                    f"no support point lies in the box of {x[empty[0]].tolist()}; use fewer boxes or more points"
                )
            return sparse.csr_array(sparse.diags_array(1.0 / count[at]) @ member[at])

        return LinearSmoother(hat)


@dataclass(frozen=True)
class KernelSmoothing:
    """The mean of all support points under a Gaussian kernel (Nadaraya 1964, Watson 1964): an averager.

    Args:
        bandwidth: its standard deviation.

    Example:
        >>> smooth = KernelSmoothing(1.0).fit(np.array([[0.0], [1.0]]))
        >>> smooth.hat(np.array([[0.5]])).tolist()
        [[0.5, 0.5]]
    """

    bandwidth: float

    def fit(self, x_support: Floats) -> LinearSmoother:
        """Keep the points.

        Raises:
            ValueError: a bandwidth that is not above 0.
        """
        check_positive("bandwidth", self.bandwidth)

        def hat(x: Floats) -> Hat:
            weight = _gaussian(x, x_support, self.bandwidth)
            return weight / weight.sum(axis=1, keepdims=True)

        return LinearSmoother(hat)


@dataclass(frozen=True)
class LocallyWeighted:
    """A line through the neighbourhood of every query, weighted by a Gaussian (Cleveland & Devlin 1988): no averager.

    Args:
        bandwidth: standard deviation of the weights.
        ridge: added to the normal equations relative to their trace, for queries with few points near.

    Example:
        >>> local = LocallyWeighted(0.5).fit(np.array([[0.0], [1.0], [2.0]]))
        >>> local.predict(np.array([1.0, 3.0, 5.0]), np.array([[3.0]])).round(6).tolist()  # a line is reproduced
        [7.0]
    """

    bandwidth: float
    ridge: float = 1e-12

    def fit(self, x_support: Floats) -> LinearSmoother:
        """Keep the points.

        Raises:
            ValueError: a bandwidth or ridge that is not above 0.
        """
        check_positive("bandwidth", self.bandwidth)
        check_positive("ridge", self.ridge)

        def hat(x: Floats) -> Hat:
            weight = _gaussian(x, x_support, self.bandwidth)
            offset = x_support[None, :, :] - x[:, None, :]  # centred at the query, whose fit is the constant term
            design = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=2)
            weighted = design * weight[:, :, None]
            normal = weighted.transpose(0, 2, 1) @ design
            trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
            first = np.zeros((len(x), design.shape[2], 1))
            first[:, 0] = 1.0
            pick = np.linalg.solve(normal + self.ridge * trace * np.eye(design.shape[2]), first)
            return (weighted @ pick)[:, :, 0]

        return LinearSmoother(hat)


def _gaussian(x: Floats, centres: Floats, bandwidth: float) -> Floats:
    """Gaussian weights of all centres for each query, the nearest one having weight 1."""
    square = ((x[:, None, :] - centres[None, :, :]) ** 2).sum(axis=2)
    weight: Floats = np.exp(-(square - square.min(axis=1, keepdims=True)) / (2 * bandwidth**2))
    return weight


def _nearest(x: Floats, support: Floats, k: int) -> tuple[Floats, Indices]:
    """Distance and number of the k nearest support points, some million pairs at a time."""
    parts = []
    for block in np.array_split(x, 1 + len(x) * len(support) // 4_000_000):
        distance = cdist(block, support)
        # On a grid many distances are equal but for rounding, which must not decide.
        index = np.argsort(np.round(distance, 12), axis=1, kind="stable")[:, :k]
        parts.append((np.take_along_axis(distance, index, axis=1), index.astype(np.int64)))
    return np.concatenate([d for d, _ in parts]), np.concatenate([i for _, i in parts])


def _rows(weight: Floats, index: Indices, num_support: int) -> sparse.csr_array:
    """A sparse hat matrix from k weights and k support points a row."""
    q, k = weight.shape
    starts = np.arange(0, q * k + 1, k)
    return sparse.csr_array((weight.reshape(-1), index.reshape(-1), starts), shape=(q, num_support))

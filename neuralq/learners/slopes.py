"""A small network that is fitted to values and to slopes, in compiled code: what EBNN and TangentProp need most.

Any other network learns slopes by the rules that this one follows: `neuralq.rules.input_slopes`, `squared_slopes` and
an optimiser of PyTorch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_positive, check_whole
from neuralq.q.kernels.slopes import descend_slopes, slope_values

__all__ = ["SlopeNet", "fit_slopes", "new_slope_net"]


@dataclass(frozen=True, eq=False)
class SlopeNet:
    """v(s) = c · tanh(W s + b) + c₀, which knows its own slope.

    Args:
        parameters: W row by row, b, c, c₀: PyTorch's order of ``Sequential(Linear(d, H), Tanh(), Linear(H, 1))``.
        num_inputs: d.

    Example:
        >>> net = SlopeNet(np.array([2.0, 3.0, 0.0, 5.0, 7.0]), num_inputs=2)
        >>> net.values([[0.0, 0.0]]).tolist(), net.slopes([[0.0, 0.0]]).tolist()
        ([7.0], [[10.0, 15.0]])
    """

    parameters: NDArray[np.float64]
    num_inputs: int

    def values(self, s: ArrayLike) -> NDArray[np.float64]:
        """``[*n, d]`` to ``[*n]``."""
        return self._both(s)[0]

    def slopes(self, s: ArrayLike) -> NDArray[np.float64]:
        """∂v/∂s: ``[*n, d]`` to ``[*n, d]``."""
        return self._both(s)[1]

    def module(self) -> torch.nn.Module:
        """The same function for PyTorch, ``[*n, d]`` to ``[*n, 1]`` in float64.

        Example:
            >>> net, s = new_slope_net(2, 3, np.random.default_rng(0)), np.array([[0.3, -0.2]])
            >>> bool(abs(net.module()(torch.from_numpy(s)).item() - net.values(s)[0]) < 1e-12)
            True
        """
        num_hidden = (len(self.parameters) - 1) // (self.num_inputs + 2)
        inner, outer = torch.nn.Linear(self.num_inputs, num_hidden), torch.nn.Linear(num_hidden, 1)
        module = torch.nn.Sequential(inner, torch.nn.Tanh(), outer).double()
        torch.nn.utils.vector_to_parameters(torch.from_numpy(self.parameters.copy()), module.parameters())
        return module

    def _both(self, s: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        given = np.asarray(s, np.float64)
        rows = np.ascontiguousarray(given.reshape(-1, self.num_inputs))
        v, slope = np.empty(len(rows)), np.empty(rows.shape)
        slope_values(self.parameters, rows, v, slope)
        return v.reshape(given.shape[:-1]), slope.reshape(given.shape)


def new_slope_net(num_inputs: int, num_hidden: int, rng: np.random.Generator) -> SlopeNet:
    """A network drawn as PyTorch draws one: every parameter uniform within 1/√(what the layer sees).

    Raises:
        ValueError: a count below 1.

    Example:
        >>> new_slope_net(2, 10, np.random.default_rng(0)).parameters.shape
        (41,)
    """
    check_whole("num_inputs", num_inputs)
    check_whole("num_hidden", num_hidden)
    inner = rng.uniform(-1.0, 1.0, (num_inputs + 1) * num_hidden) / np.sqrt(num_inputs)
    return SlopeNet(np.append(inner, rng.uniform(-1.0, 1.0, num_hidden + 1) / np.sqrt(num_hidden)), num_inputs)


def fit_slopes(
    net: SlopeNet,
    s: ArrayLike,
    y: ArrayLike,
    slope: ArrayLike | None = None,
    weight: ArrayLike = 1.0,
    *,
    num_steps: int = 3000,
    step_size: float = 0.01,
) -> SlopeNet:
    """Another network, fitted to values and slopes from where ``net`` is: Adam on all rows, its step falling to 0.

    The loss is the mean of ½ (v − y)² + ½ weight |∂v/∂s − slope|², that is `neuralq.rules.squared` and
    `squared_slopes`.

    Args:
        net: where to start; not changed.
        s: states, ``[N, d]``.
        y: what their values should be, ``[N]``.
        slope: what their slopes should be, ``[N, d]``; None for values alone.
        weight: how much each slope counts, ``[N]`` or a number, at least 0.
        num_steps: of Adam.
        step_size: of the first step.

    Raises:
        ValueError: shapes that do not go together, a value that is not finite, a weight below 0, or no rows.

    Example:
        Two points of a parabola: only with their tangents does the fit bend down in between.

        >>> s, y, slope = [[-1.0], [1.0]], [1.0, 1.0], [[-2.0], [2.0]]
        >>> net = new_slope_net(1, 8, np.random.default_rng(0))
        >>> bool(fit_slopes(net, s, y, slope).values([[0.0]])[0] < 0.5)
        True
        >>> bool(fit_slopes(net, s, y).values([[0.0]])[0] < 0.5)
        False
    """
    rows = np.array(s, np.float64)
    if rows.ndim != 2 or rows.shape[1] != net.num_inputs or not len(rows):
        raise ValueError(f"s must be [N, {net.num_inputs}] with N of at least 1, got {list(rows.shape)}")
    values = _given("y", y, rows.shape[:1])
    slopes = np.zeros(rows.shape) if slope is None else _given("slope", slope, rows.shape)
    weights = np.zeros(len(rows)) if slope is None else np.broadcast_to(np.asarray(weight, np.float64), rows.shape[:1])
    _given("s", rows, rows.shape)
    weights = _given("weight", weights, rows.shape[:1])
    if (weights < 0).any():
        raise ValueError(f"weight must be at least 0, got {weights.min()!r}")
    check_whole("num_steps", num_steps)
    check_positive("step_size", step_size)
    parameters = net.parameters.copy()
    descend_slopes(parameters, rows, values, slopes, weights, num_steps, step_size, np.empty((5, len(parameters))))
    return SlopeNet(parameters, net.num_inputs)


def _given(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.array(values, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        what = "with numbers that are not finite" if array.shape == shape else ""
        raise ValueError(f"{name} must be finite and of shape {list(shape)}, got {list(array.shape)} {what}".rstrip())
    return array

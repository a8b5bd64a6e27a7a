"""A network with one hidden layer fitted to values and slopes at once, in compiled loops over single rows.

With h = tanh(W s + b), v = c · h + c₀ and ∂v/∂s = Wᵀ (c ∘ (1 − h²)), what is descended is the mean over rows of
½ (v − y)² + ½ μ |∂v/∂s − y'|² (TangentProp: Simard, Victorri, LeCun & Denker 1992, with a weight μ for each row).

The parameters are one vector, in PyTorch's order of ``Sequential(Linear(d, H), Tanh(), Linear(H, 1))``: W row by row,
b, c, c₀; (d + 2) H + 1 numbers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel

__all__ = ["descend_slopes", "slope_gradient", "slope_values"]

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8  # of Adam (Kingma & Ba 2015)


@lean_kernel
def slope_values(
    parameters: NDArray[np.float64], s: NDArray[np.float64], v: NDArray[np.float64], slope: NDArray[np.float64]
) -> None:
    """Writes the values of states and their slopes.

    Args:
        parameters: of the network, ``[P]``.
        s: states, ``[N, d]``.
        v: values, ``[N]``; written.
        slope: ∂v/∂s, ``[N, d]``; written.

    Example:
        tanh(0) is 0 and its slope 1, so v = c₀ and ∂v/∂s = c W.

        >>> v, slope = np.zeros(1), np.zeros((1, 2))
        >>> slope_values(np.array([2.0, 3.0, 0.0, 5.0, 7.0]), np.zeros((1, 2)), v, slope)
        >>> v.tolist(), slope.tolist()
        ([7.0], [[10.0, 15.0]])
    """
    num_inputs = s.shape[1]
    num_hidden = (len(parameters) - 1) // (num_inputs + 2)
    b = num_hidden * num_inputs
    c = b + num_hidden
    for n in range(len(s)):
        v[n] = parameters[c + num_hidden]
        slope[n, :] = 0.0
        for j in range(num_hidden):
            a = parameters[b + j]
            for i in range(num_inputs):
                a += parameters[j * num_inputs + i] * s[n, i]
            h = math.tanh(a)
            v[n] += parameters[c + j] * h
            for i in range(num_inputs):
                slope[n, i] += parameters[c + j] * (1.0 - h * h) * parameters[j * num_inputs + i]


@lean_kernel
def slope_gradient(
    parameters: NDArray[np.float64],
    s: NDArray[np.float64],
    y: NDArray[np.float64],
    slope: NDArray[np.float64],
    mu: NDArray[np.float64],
    gradient: NDArray[np.float64],
    hidden: NDArray[np.float64],
    error: NDArray[np.float64],
) -> Any:
    """Writes the gradient of the mean loss and returns the loss.

    Args:
        parameters: of the network, ``[P]``.
        s: states, ``[N, d]``.
        y: what their values should be, ``[N]``.
        slope: y', what their slopes should be, ``[N, d]``.
        mu: μ, how much each slope counts, ``[N]``; 0 for not at all.
        gradient: ``[P]``; written.
        hidden: room for H numbers.
        error: room for d numbers.

    Example:
        v = 0 should be 1, and the slope 6 should be 4: ½ (0 − 1)² + ½ · 2 (6 − 4)² = 4.5. Of c the derivative is
        μ · 2 W = 8, of c₀ it is v − y.

        >>> s, y, slope, mu, gradient = np.zeros((1, 1)), np.ones(1), np.full((1, 1), 4.0), np.full(1, 2.0), np.zeros(4)
        >>> slope_gradient(np.array([2.0, 0.0, 3.0, 0.0]), s, y, slope, mu, gradient, np.zeros(1), np.zeros(1))
        4.5
        >>> gradient.tolist()
        [12.0, -3.0, 8.0, -1.0]
    """
    num_rows, num_inputs = s.shape
    num_hidden = (len(parameters) - 1) // (num_inputs + 2)
    b = num_hidden * num_inputs
    c = b + num_hidden
    gradient[:] = 0.0
    loss = 0.0
    for n in range(num_rows):
        v = parameters[c + num_hidden]
        for i in range(num_inputs):
            error[i] = -slope[n, i]
        for j in range(num_hidden):
            a = parameters[b + j]
            for i in range(num_inputs):
                a += parameters[j * num_inputs + i] * s[n, i]
            h = math.tanh(a)
            hidden[j] = h
            v += parameters[c + j] * h
            for i in range(num_inputs):
                error[i] += parameters[c + j] * (1.0 - h * h) * parameters[j * num_inputs + i]
        delta = v - y[n]
        loss += 0.5 * delta * delta
        for i in range(num_inputs):
            loss += 0.5 * mu[n] * error[i] * error[i]
        gradient[c + num_hidden] += delta
        for j in range(num_hidden):
            h = hidden[j]
            steep = 1.0 - h * h
            along = 0.0
            for i in range(num_inputs):
                along += error[i] * parameters[j * num_inputs + i]
            gradient[c + j] += delta * h + mu[n] * steep * along
            inner = parameters[c + j] * steep * (delta - 2.0 * mu[n] * h * along)
            gradient[b + j] += inner
            for i in range(num_inputs):
                gradient[j * num_inputs + i] += inner * s[n, i] + mu[n] * parameters[c + j] * steep * error[i]
    for k in range(len(gradient)):
        gradient[k] /= num_rows
    return loss / num_rows


@lean_kernel
def descend_slopes(
    parameters: NDArray[np.float64],
    s: NDArray[np.float64],
    y: NDArray[np.float64],
    slope: NDArray[np.float64],
    mu: NDArray[np.float64],
    num_steps: int,
    step_size: float,
    room: NDArray[np.float64],
) -> float:
    """Steps of Adam on all rows at once, its step size falling in a line to 0; returns the loss before the last one.

    Args:
        parameters: of the network, ``[P]``; changed in place.
        s: states, ``[N, d]``.
        y: what their values should be, ``[N]``.
        slope: what their slopes should be, ``[N, d]``.
        mu: how much each slope counts, ``[N]``.
        num_steps: how many.
        step_size: of the first.
        room: ``[5, P]``, for the gradient, its two means and what lies between.

    Example:
        >>> s, y, room = np.array([[-1.0], [1.0]]), np.array([-0.5, 0.5]), np.zeros((5, 4))
        >>> descend_slopes(np.array([1.0, 0.0, 1.0, 0.0]), s, y, np.zeros((2, 1)), np.zeros(2), 500, 0.01, room) < 1e-6
        True
    """
    gradient, mean, square = room[0], room[1], room[2]
    mean[:] = 0.0
    square[:] = 0.0
    loss = 0.0
    for step in range(num_steps):
        loss = slope_gradient(parameters, s, y, slope, mu, gradient, room[3], room[4])
        rate = step_size * (1.0 - step / num_steps)
        unbias_1, unbias_2 = 1.0 - _BETA_1 ** (step + 1), 1.0 - _BETA_2 ** (step + 1)
        for k in range(len(parameters)):
            mean[k] += (1.0 - _BETA_1) * (gradient[k] - mean[k])
            square[k] += (1.0 - _BETA_2) * (gradient[k] * gradient[k] - square[k])
            parameters[k] -= rate * (mean[k] / unbias_1) / (math.sqrt(square[k] / unbias_2) + _EPSILON)
    return loss

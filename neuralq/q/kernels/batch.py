"""Forward and backward passes of the plain MLP layouts, compiled, on the flat parameter vector.

A small network on a CPU is bound by the framework's cost per operation, not by arithmetic: at 2x64 units and a batch of
64, autograd spends most of its time between kernels. Here one call does a whole pass. The code is held to autograd by
tests/test_engine.py for every layout, loss, activation and normalisation.

The network is described by ``plan``, one row per layer: fan_in, fan_out, and the offsets in the flat vector of weight
``[copies, in, out]``, bias ``[copies, out]``, and scale and shift of the layer normalisation (−1: none, −2: one without
scale and shift), then the units of the layers before. Workspaces hold for each layer a block ``[rows, fan_out]`` behind
theirs: ``acts`` what it gave, ``hats`` the normalised pre-activation, ``deltas`` the gradient with respect to it;
``inverse`` holds 1/σ of each row.

The two entries call `_forward` and `_backward` in one place each, whatever the layout: every further call is inlined
and compiled again, and that was half of the seconds that the first use on a machine takes.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  (np.dot in kernels uses it; loaded here, thread limits set later reach it)

from neuralq.jit import kernel, reassociating_kernel
from neuralq.q.kernels.products import multiply, suits
from neuralq.types import Array

__all__ = [
    "ACTION_INPUT",
    "ACTION_OUTPUT",
    "HUBER",
    "LAYER_NORM_EPS",
    "SEPARATE",
    "SQUARED",
    "VALUE",
    "all_values",
    "loss_gradient",
    "through_activation",
    "wide_inverse",
]


ACTION_OUTPUT, SEPARATE, ACTION_INPUT = 0, 1, 2
SQUARED, HUBER, VALUE = 0, 1, 2
LAYER_NORM_EPS = 1e-5
"""As `torch.nn.functional.layer_norm` has it."""


@reassociating_kernel
def _activate(v: float, activation: int) -> float:
    if activation == 0:
        return v if v > 0 else v * 0
    if activation == 1:
        return math.tanh(v)
    if activation == 3:
        return 1 / (1 + math.exp(-v))
    return v if v > 0 else v * 0.01


@kernel
def wide_inverse(y: Array, mean: float) -> float:
    """1/σ of a row whose squares float32 cannot hold; 0 would make it a constant without a word."""
    total = 0.0
    for j in range(y.size):
        total += (np.float64(y[j]) - np.float64(mean)) * (np.float64(y[j]) - np.float64(mean))
    return 1.0 / math.sqrt(total / y.size + LAYER_NORM_EPS)


@reassociating_kernel
def _normalise_rows(y: Array, scale: Array, shift: Array, hat: Array, inverse: Array, activation: int) -> None:
    rows, width = y.shape
    for i in range(rows):
        total = y[i, 0] * 0
        for j in range(width):
            total += y[i, j]
        mean = total / y.dtype.type(width)
        spread = y[i, 0] * 0
        for j in range(width):
            spread += (y[i, j] - mean) * (y[i, j] - mean)
        inv = y.dtype.type(1.0 / math.sqrt(spread / width + LAYER_NORM_EPS))
        if not spread < np.inf:
            inv = y.dtype.type(wide_inverse(y[i], mean))
        inverse[i] = inv
        if scale.size > 0:
            for j in range(width):
                h = (y[i, j] - mean) * inv
                hat[i, j] = h
                y[i, j] = h * scale[j] + shift[j]
        else:
            for j in range(width):
                h = (y[i, j] - mean) * inv
                hat[i, j] = h
                y[i, j] = h
        if activation == 0:
            for j in range(width):
                y[i, j] = y.dtype.type(0) if y[i, j] <= 0 else y[i, j]  # NaN stays
        else:
            for j in range(width):
                y[i, j] = _activate(y[i, j], activation)


@reassociating_kernel
def _forward(
    params: Array, plan: Array, copy: int, activation: int, x: Array, acts: Array, hats: Array, inverse: Array
) -> Array:
    rows = x.shape[0]
    num_layers = plan.shape[0]
    h, h_at = x.reshape(-1), 0
    for layer in range(num_layers):
        fan_in, fan_out = plan[layer, 0], plan[layer, 1]
        weight_at = plan[layer, 2] + copy * fan_in * fan_out
        bias_at = plan[layer, 3] + copy * fan_out
        block = rows * plan[layer, 6]
        y = acts[block : block + rows * fan_out].reshape(rows, fan_out)
        last = layer == num_layers - 1
        if suits(fan_in, fan_out):
            multiply(h, h_at, fan_in, 1, rows, fan_in, params, weight_at, fan_out, params, bias_at, acts, block)
        else:
            weight = params[weight_at : weight_at + fan_in * fan_out].reshape(fan_in, fan_out)
            np.dot(h[h_at : h_at + rows * fan_in].reshape(rows, fan_in), weight, y)
            for i in range(rows):
                for j in range(fan_out):
                    y[i, j] += params[bias_at + j]
        if not last and plan[layer, 4] != -1:
            width = fan_out if plan[layer, 4] >= 0 else 0  # of scale and shift
            at = max(plan[layer, 4], 0) + copy * width
            scale = params[at : at + width]
            at = max(plan[layer, 5], 0) + copy * width
            shift = params[at : at + width]
            hat = hats[block : block + rows * fan_out].reshape(rows, fan_out)
            _normalise_rows(y, scale, shift, hat, inverse[rows * layer : rows * (layer + 1)], activation)
        elif not last and activation == 0:
            for i in range(rows):
                for j in range(fan_out):
                    y[i, j] = params.dtype.type(0) if y[i, j] <= 0 else y[i, j]  # NaN stays
        elif not last:
            for i in range(rows):
                for j in range(fan_out):
                    y[i, j] = _activate(y[i, j], activation)
        h, h_at = acts, block
    return y


@reassociating_kernel
def through_activation(d: Array, y: Array, activation: int) -> None:
    """Multiply ``d [n]`` by the activation's derivative, which all four give from the output ``y [n]`` alone."""
    if activation == 0:
        for j in range(d.size):
            d[j] = d[j] if y[j] > 0 else d.dtype.type(0)
    elif activation == 1:
        for j in range(d.size):
            d[j] *= d.dtype.type(1) - y[j] * y[j]
    elif activation == 3:
        for j in range(d.size):
            d[j] *= y[j] * (d.dtype.type(1) - y[j])
    else:
        for j in range(d.size):
            d[j] = d[j] if y[j] > 0 else d[j] * d.dtype.type(0.01)


@reassociating_kernel
def _through_norm(d: Array, hat: Array, inverse: Array, scale: Array, grad_scale: Array, grad_shift: Array) -> None:
    """Ba et al. (2016): dy = (g − mean(g) − ŷ·mean(g·ŷ))/σ with g = d·scale, row by row."""
    rows, width = d.shape
    for i in range(rows):
        mean = d[i, 0] * 0
        along = d[i, 0] * 0
        if scale.size > 0:
            for j in range(width):
                grad_shift[j] += d[i, j]
                grad_scale[j] += d[i, j] * hat[i, j]
                d[i, j] *= scale[j]
        for j in range(width):
            mean += d[i, j]
            along += d[i, j] * hat[i, j]
        mean /= d.dtype.type(width)
        along /= d.dtype.type(width)
        inv = inverse[i]
        for j in range(width):
            d[i, j] = (d[i, j] - mean - hat[i, j] * along) * inv


@reassociating_kernel
def _backward(
    params: Array,
    grads: Array,
    plan: Array,
    copy: int,
    activation: int,
    x: Array,
    acts: Array,
    hats: Array,
    inverse: Array,
    deltas: Array,
    spare: Array,
) -> None:
    """Gradient of Σ outputs·(their block of ``deltas``), written over ``grads`` of this copy.

    ``spare`` begins with as many zeros as the widest layer has inputs or outputs; the rest is overwritten.
    """
    rows = x.shape[0]
    zeros = spare.size // 2
    num_layers = plan.shape[0]
    for layer in range(num_layers - 1, -1, -1):
        fan_in, fan_out = plan[layer, 0], plan[layer, 1]
        block = rows * plan[layer, 6]
        end = block + rows * fan_out
        d = deltas[block:end].reshape(rows, fan_out)
        if layer < num_layers - 1:
            through_activation(deltas[block:end], acts[block:end], activation)
            if plan[layer, 4] != -1:
                width = fan_out if plan[layer, 4] >= 0 else 0
                at = max(plan[layer, 4], 0) + copy * width
                scale = params[at : at + width]
                grad_scale = grads[at : at + width]
                at = max(plan[layer, 5], 0) + copy * width
                hat = hats[block:end].reshape(rows, fan_out)
                row_inverse = inverse[rows * layer : rows * (layer + 1)]
                _through_norm(d, hat, row_inverse, scale, grad_scale, grads[at : at + width])
        at = plan[layer, 3] + copy * fan_out
        grad_bias = grads[at : at + fan_out]
        for i in range(rows):
            for j in range(fan_out):
                grad_bias[j] += d[i, j]
        at = plan[layer, 2] + copy * fan_in * fan_out
        h, h_at = x.reshape(-1), 0
        if layer > 0:
            h, h_at = acts, rows * plan[layer - 1, 6]
        if suits(rows, fan_out):
            multiply(h, h_at, 1, fan_in, fan_in, rows, deltas, block, fan_out, spare, 0, grads, at)
        else:
            grad_weight = grads[at : at + fan_in * fan_out].reshape(fan_in, fan_out)
            np.dot(h[h_at : h_at + rows * fan_in].reshape(rows, fan_in).T, d, grad_weight)
        if layer > 0:
            if suits(fan_out, fan_in):
                for j in range(fan_out):
                    for i in range(fan_in):
                        spare[zeros + j * fan_in + i] = params[at + i * fan_out + j]
                multiply(deltas, block, fan_out, 1, rows, fan_out, spare, zeros, fan_in, spare, 0, deltas, h_at)
            else:
                weight = params[at : at + fan_in * fan_out].reshape(fan_in, fan_out)
                np.dot(d, weight.T, deltas[h_at : h_at + rows * fan_in].reshape(rows, fan_in))


@reassociating_kernel
def _pair(pairs: Array, row: int, x: Array, i: int, action: int) -> None:
    """Write state i with a one-hot action. Loops, here and below: slice assignment doubles the compile time."""
    width = x.shape[1]
    for j in range(width):
        pairs[row, j] = x[i, j]
    for j in range(width, pairs.shape[1]):
        pairs[row, j] = 0
    pairs[row, width + action] = 1


@reassociating_kernel
def all_values(
    params: Array,
    plan: Array,
    layout: int,
    num_actions: int,
    activation: int,
    x: Array,
    acts: Array,
    hats: Array,
    inverse: Array,
    pairs: Array,
    out: Array,
) -> None:
    """Action values of every action: rows ``x [B, d]`` into ``out [B, A]``."""
    rows, width = x.shape
    inputs = x
    if layout == ACTION_INPUT:
        inputs = pairs[: rows * num_actions * (width + num_actions)].reshape(rows * num_actions, width + num_actions)
        for i in range(rows):
            for c in range(num_actions):
                _pair(inputs, i * num_actions + c, x, i, c)
    for copy in range(num_actions if layout == SEPARATE else 1):
        q = _forward(params, plan, copy, activation, inputs, acts, hats, inverse)
        if layout == SEPARATE:
            for i in range(rows):
                out[i, copy] = q[i, 0]
        else:
            by_action = q.reshape(rows, num_actions)
            for i in range(rows):
                for c in range(num_actions):
                    out[i, c] = by_action[i, c]


@reassociating_kernel
def _slope(q: float, target: float, weight: float, loss: int, delta: float, rows: int) -> float:
    """d(mean weighted loss)/dq, or ``weight`` itself where the gradient of the value is wanted."""
    if loss == VALUE:
        return weight
    error = target - q
    if loss == HUBER:
        error = min(max(error, -delta), delta)
    return -weight * error / rows


@reassociating_kernel
def loss_gradient(
    params: Array,
    grads: Array,
    plan: Array,
    layout: int,
    num_actions: int,
    activation: int,
    x: Array,
    a: Array,
    target: Array,
    weight: Array,
    loss: int,
    delta: float,
    acts: Array,
    hats: Array,
    inverse: Array,
    pairs: Array,
    deltas: Array,
    spare: Array,
    q_out: Array,
) -> int:
    """Write the loss's gradient over ``grads`` and Q(s, a) ``[B]`` into ``q_out``.

    The loss is the mean over rows of weight·½(target − Q)² or its Huber form; with ``loss=VALUE`` the gradient is that
    of Σ weight·Q(s, a). Returns −1, or the first row whose action does not exist, and then writes nothing.
    """
    rows, width = x.shape
    for i in range(rows):
        if a[i] < 0 or a[i] >= num_actions:
            return i
    for i in range(grads.size):
        grads[i] = 0
    if rows == 0:
        return -1
    top = plan[-1, 6]
    outputs = num_actions if layout == ACTION_OUTPUT else 1
    inputs = x
    for copy in range(num_actions if layout == SEPARATE else 1):
        count = rows
        if layout == SEPARATE:  # this copy sees the samples of its own action
            count = 0
            for i in range(rows):
                if a[i] == copy:
                    for j in range(width):
                        pairs[count * width + j] = x[i, j]
                    count += 1
            if count == 0:
                continue
            inputs = pairs[: count * width].reshape(count, width)
        elif layout == ACTION_INPUT:
            inputs = pairs[: rows * (width + num_actions)].reshape(rows, width + num_actions)
            for i in range(rows):
                _pair(inputs, i, x, i, a[i])
        q = _forward(params, plan, copy, activation, inputs, acts, hats, inverse)
        slope = deltas[count * top : count * (top + outputs)].reshape(count, outputs)
        row = 0
        for i in range(rows):
            if layout == SEPARATE and a[i] != copy:
                continue
            for j in range(outputs):
                slope[row, j] = 0
            c = a[i] if layout == ACTION_OUTPUT else 0
            q_out[i] = q[row, c]
            slope[row, c] = _slope(q[row, c], target[i], weight[i], loss, delta, rows)
            row += 1
        _backward(params, grads, plan, copy, activation, inputs, acts, hats, inverse, deltas, spare)
    return -1

"""Passes through a network for one observation, compiled: values, and the gradient of one of them.

With a single observation there is nothing to batch, and of the time that a small network takes in a framework nearly
all is the framework's. Here one call gives the values of both states of a step, its target and the gradient; convolved
frames are known, too, and inputs of 0 are skipped. tests/test_learners_streaming.py holds it to autograd.

The network has one output per action. ``plan`` has one row per layer:

    0 kind · 1 inputs · 2 outputs · 3 weight at · 4 bias at · 5 scale at (−1: no normalisation, −2: one without scale
    and shift) · 6 shift at · and for convolutions 7 channels in · 8 height in · 9 width in · 10 channels out ·
    11 side of the kernel · 12 stride · 13 height out · 14 width out · and for all 15 where its block begins in ``acts``
    (what it gave), ``hats`` (normalised) and ``deltas`` (gradients).

Dense weights lie as ``[in, out]``, convolutional ones as ``[out, in, k, k]``. ``inverse`` holds 1/σ per layer; ``cols``
is room for the patches of one convolution.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from neuralq.jit import reassociating_kernel
from neuralq.q.kernels.batch import LAYER_NORM_EPS, through_activation, wide_inverse
from neuralq.types import Array

__all__ = ["CONV", "DENSE", "learn", "values_of"]

DENSE, CONV = 0, 1


@reassociating_kernel
def _dense(params: Array, row: Array, x: Array, y: Array) -> None:
    fan_in, fan_out = row[1], row[2]
    for j in range(fan_out):
        y[j] = params[row[4] + j]
    weight = params[row[3] : row[3] + fan_in * fan_out].reshape(fan_in, fan_out)
    for i in range(fan_in):
        xi = x[i]
        if xi != 0:
            for j in range(fan_out):
                y[j] += xi * weight[i, j]


@reassociating_kernel
def _patches(row: Array, x: Array, cols: Array) -> None:
    """What each weight of a kernel meets, one contiguous row of all positions after another."""
    side, stride, high, wide = row[11], row[12], row[13], row[14]
    at = 0
    for ci in range(row[7]):
        for ky in range(side):
            for kx in range(side):
                for oy in range(high):
                    there = (ci * row[8] + oy * stride + ky) * row[9] + kx
                    for ox in range(wide):
                        cols[at + ox] = x[there + ox * stride]
                    at += wide


@reassociating_kernel
def _conv(params: Array, row: Array, x: Array, y: Array, cols: Array) -> None:
    size = row[13] * row[14]
    _patches(row, x, cols)
    at = row[3]
    for co in range(row[10]):
        out = y[co * size : (co + 1) * size]
        for p in range(size):
            out[p] = params[row[4] + co]
        for k in range(row[7] * row[11] * row[11]):
            w = params[at]
            at += 1
            for p in range(size):
                out[p] += w * cols[k * size + p]


@reassociating_kernel
def _normalise(params: Array, row: Array, y: Array, hat: Array) -> Any:
    """Ba et al. (2016) over the whole layer; returns 1/σ."""
    size = y.size
    total = y[0] * 0
    for j in range(size):
        total += y[j]
    mean = total / y.dtype.type(size)
    spread = y[0] * 0
    for j in range(size):
        spread += (y[j] - mean) * (y[j] - mean)
    inv = y.dtype.type(1.0 / math.sqrt(spread / size + LAYER_NORM_EPS))
    if not spread < np.inf:
        inv = y.dtype.type(wide_inverse(y, mean))
    for j in range(size):
        h = (y[j] - mean) * inv
        hat[j] = h
        y[j] = h
    if row[5] >= 0:
        for j in range(size):
            y[j] = hat[j] * params[row[5] + j] + params[row[6] + j]
    return inv


@reassociating_kernel
def _activate(y: Array, activation: int) -> None:
    if activation == 0:
        for j in range(y.size):
            y[j] = y.dtype.type(0) if y[j] <= 0 else y[j]  # NaN stays
    elif activation == 1:
        for j in range(y.size):
            y[j] = math.tanh(y[j])
    elif activation == 3:
        for j in range(y.size):
            y[j] = 1 / (1 + math.exp(-y[j]))
    else:
        for j in range(y.size):
            y[j] = y[j] * y.dtype.type(0.01) if y[j] <= 0 else y[j]


@reassociating_kernel
def _forward(
    params: Array, plan: Array, activation: int, x: Array, acts: Array, hats: Array, inverse: Array, cols: Array
) -> Array:
    h = x
    for layer in range(plan.shape[0]):
        row = plan[layer]
        block, end = row[15], row[15] + row[2]
        y = acts[block:end]
        if row[0] == CONV:
            _conv(params, row, h, y, cols)
        else:
            _dense(params, row, h, y)
        if layer < plan.shape[0] - 1:
            if row[5] != -1:
                inverse[layer] = _normalise(params, row, y, hats[block:end])
            _activate(y, activation)
        h = y
    return h


@reassociating_kernel
def values_of(
    params: Array, plan: Array, activation: int, x: Array, acts: Array, hats: Array,
    inverse: Array, cols: Array, out: Array,
) -> None:  # fmt: skip
    """Action values of every row: ``x [B, d]`` into ``out [B, A]``."""
    for i in range(x.shape[0]):
        q = _forward(params, plan, activation, x[i], acts, hats, inverse, cols)
        for c in range(out.shape[1]):
            out[i, c] = q[c]


@reassociating_kernel
def _through_layer(
    params: Array, grads: Array, row: Array, d: Array, y: Array, hat: Array, inv: float, activation: int
) -> None:
    """From the gradient of a hidden layer's output to that of its sums, in place; scale and shift get theirs."""
    size = d.size
    through_activation(d, y, activation)
    if row[5] == -1:
        return
    if row[5] >= 0:
        for j in range(size):
            grads[row[6] + j] = d[j]
            grads[row[5] + j] = d[j] * hat[j]
            d[j] *= params[row[5] + j]
    mean, along = d[0] * 0, d[0] * 0
    for j in range(size):
        mean += d[j]
        along += d[j] * hat[j]
    mean /= d.dtype.type(size)
    along /= d.dtype.type(size)
    inv = d.dtype.type(inv)
    for j in range(size):
        d[j] = (d[j] - mean - hat[j] * along) * inv


@reassociating_kernel
def _dense_back(params: Array, grads: Array, row: Array, d: Array, x: Array, below: Array) -> None:
    fan_in, fan_out = row[1], row[2]
    for j in range(fan_out):
        grads[row[4] + j] = d[j]
    weight = params[row[3] : row[3] + fan_in * fan_out].reshape(fan_in, fan_out)
    grad = grads[row[3] : row[3] + fan_in * fan_out].reshape(fan_in, fan_out)
    for i in range(fan_in):
        xi = x[i]
        for j in range(fan_out):
            grad[i, j] = xi * d[j]
    for i in range(below.size):  # empty below the first layer
        total = d[0] * 0
        for j in range(fan_out):
            total += weight[i, j] * d[j]
        below[i] = total


@reassociating_kernel
def _conv_back(params: Array, grads: Array, row: Array, d: Array, x: Array, below: Array, cols: Array) -> None:
    side, stride, high, wide = row[11], row[12], row[13], row[14]
    size, fan_in = high * wide, row[7] * side * side
    _patches(row, x, cols)
    for co in range(row[10]):
        total = d[0] * 0
        for p in range(size):
            total += d[co * size + p]
        grads[row[4] + co] = total
        for k in range(fan_in):
            total = d[0] * 0
            for p in range(size):
                total += d[co * size + p] * cols[k * size + p]
            grads[row[3] + co * fan_in + k] = total
    if below.size == 0:  # the first layer
        return
    for i in range(below.size):
        below[i] = 0
    for k in range(fan_in):
        for p in range(size):
            cols[p] = 0
        for co in range(row[10]):
            w = params[row[3] + co * fan_in + k]
            for p in range(size):
                cols[p] += w * d[co * size + p]
        at = (k // (side * side) * row[8] + k // side % side) * row[9] + k % side
        for oy in range(high):
            for ox in range(wide):
                below[at + oy * stride * row[9] + ox * stride] += cols[oy * wide + ox]


@reassociating_kernel
def _backward(
    params: Array, grads: Array, plan: Array, activation: int, x: Array, acts: Array, hats: Array,
    inverse: Array, deltas: Array, cols: Array,
) -> None:  # fmt: skip
    """Gradient of the output weighted by the top block of ``deltas``, written over ``grads``."""
    top = plan.shape[0] - 1
    for layer in range(top, -1, -1):
        row = plan[layer]
        block, end = row[15], row[15] + row[2]
        d = deltas[block:end]
        if layer < top:
            _through_layer(params, grads, row, d, acts[block:end], hats[block:end], inverse[layer], activation)
        h = x
        below = deltas[0:0]
        if layer > 0:
            h = acts[plan[layer - 1, 15] : block]
            below = deltas[plan[layer - 1, 15] : block]
        if row[0] == CONV:
            _conv_back(params, grads, row, d, h, below, cols)
        else:
            _dense_back(params, grads, row, d, h, below)


@reassociating_kernel
def learn(
    params: Array, grads: Array, plan: Array, activation: int, x_tm1: Array, a_tm1: int, r_t: float,
    discount_t: float, x_t: Array, acts: Array, hats: Array, inverse: Array, cols: Array, deltas: Array,
) -> tuple[float, float, bool]:  # fmt: skip
    """Write ∇Q(s_tm1, a_tm1) over ``grads``; returns Q(s_tm1, a_tm1), the target and whether a_tm1 was greedy."""
    num_actions, top = plan[-1, 2], plan[-1, 15]
    best = acts[top]
    for side in range(2):  # one call in one place: every further one is inlined and compiled again
        q = _forward(params, plan, activation, x_t if side == 0 else x_tm1, acts, hats, inverse, cols)
        if side == 0:
            best = q[0]
            for c in range(1, num_actions):
                if not q[c] <= best:  # NaN wins, so that divergence is seen
                    best = q[c]
    target = params.dtype.type(r_t) + params.dtype.type(discount_t) * best
    value = acts[top + a_tm1]
    greedy = True
    for c in range(num_actions):
        deltas[top + c] = 0
        if acts[top + c] > value:
            greedy = False
    deltas[top + a_tm1] = 1
    _backward(params, grads, plan, activation, x_tm1, acts, hats, inverse, deltas, cols)
    return value, target, greedy

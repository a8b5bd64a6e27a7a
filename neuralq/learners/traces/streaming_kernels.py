"""The bounded step of a streaming learner, compiled: trace, bound and weights in two passes over the memory.

`neuralq.learners.traces.streaming` is the readable version that tests hold it to.
"""

from __future__ import annotations

import math

import numpy as np

from neuralq.jit import kernel, reassociating_kernel
from neuralq.types import Array

__all__ = ["ADAPTIVE", "INTENTIONAL", "OBGD", "advance", "is_finite"]


OBGD, ADAPTIVE, INTENTIONAL = 0, 1, 2
_EPSILON, _CLIP, _CLIP_DECAY = 1e-8, 20.0, 0.9998  # as in neuralq.rules.streaming


@kernel
def is_finite(v: Array) -> bool:
    """Whether no running square has overflowed: such a weight would stop for ever, without a word."""
    return bool(v.max() < np.inf)


@kernel
def _wide_norm(z: Array, v: Array, bound: int, correction: float) -> float:
    """The norm of the direction, where float32 cannot hold it."""
    norm = 0.0
    for i in range(z.size):
        norm += abs(np.float64(z[i])) / (1.0 if bound == OBGD else np.sqrt(v[i] * correction + _EPSILON))
    return norm


@reassociating_kernel
def _advance_bounded(
    values: Array, z: Array, v: Array, grad: Array, decay: float, delta: float, bound: int, step_size: float,
    kappa: float, beta2: float, num_updates: int,
) -> None:  # fmt: skip
    kind = values.dtype.type
    trace_decay, norm = kind(decay), z[0] * 0
    correction, epsilon = kind(1.0 / (1.0 - beta2**num_updates)), kind(_EPSILON)
    if bound == OBGD:
        for i in range(z.size):
            z[i] = trace_decay * z[i] + grad[i]
            norm += abs(z[i])
    else:
        old, new = kind(beta2), kind((1.0 - beta2) * delta * delta)
        for i in range(z.size):
            z[i] = trace_decay * z[i] + grad[i]
            v[i] = old * v[i] + new * z[i] * z[i]
            norm += abs(z[i]) / np.sqrt(v[i] * correction + epsilon)
    size = float(norm)
    if not size < np.inf:
        size = _wide_norm(z, v, bound, np.float64(correction))
    step = step_size / max(step_size * kappa * max(abs(delta), 1.0) * size, 1.0)
    scaled = kind(step * delta)
    if bound == OBGD:
        for i in range(z.size):
            values[i] += scaled * z[i]
    else:
        for i in range(z.size):
            values[i] += scaled * z[i] / np.sqrt(v[i] * correction + epsilon)


@reassociating_kernel
def _advance_intentional(
    values: Array, z: Array, v: Array, grad: Array, means: Array, decay: float, delta: float, rate: float,
    step_size: float, beta2: float, num_updates: int,
) -> None:  # fmt: skip
    kind = values.dtype.type
    trace_decay, old, new = kind(decay), kind(beta2), kind(1.0 - beta2)
    correction, epsilon = kind(1.0 / (1.0 - beta2**num_updates)), kind(_EPSILON)
    fresh, spread = z[0] * 0, z[0] * 0
    for i in range(z.size):
        z[i] = trace_decay * z[i] + grad[i]
        v[i] = old * v[i] + new * grad[i] * grad[i]
        scale = np.sqrt(v[i] * correction) + epsilon
        fresh += grad[i] * grad[i] / scale
        spread += z[i] * z[i] / scale
    means[0] = (1.0 - rate) * means[0] + rate * fresh
    means[1] = _CLIP_DECAY * means[1] + (1.0 - _CLIP_DECAY) * delta * delta
    limit = _CLIP * math.sqrt(means[1] / (1.0 - _CLIP_DECAY**num_updates))
    root = math.sqrt(means[0] / (1.0 - (1.0 - rate) ** num_updates) * spread)
    scaled = kind(step_size / max(root, _EPSILON) * min(max(delta, -limit), limit))
    for i in range(z.size):
        values[i] += scaled * z[i] / (np.sqrt(v[i] * correction) + epsilon)


@reassociating_kernel
def advance(
    values: Array, z: Array, v: Array, grad: Array, means: Array, decay: float, delta: float, bound: int,
    step_size: float, kappa: float, beta2: float, rate: float, num_updates: int,
) -> None:  # fmt: skip
    """Decay the trace, add the gradient, and move the weights as far as the bound allows.

    ``v`` is empty for OBGD. ``rate`` is 1 − γλ, of the running mean σ in ``means[0]``; ``means[1]`` is that of δ². At a
    rate of 0 there is no such mean: `neuralq.rules.intentional` has its limit.
    """
    if bound == INTENTIONAL:
        _advance_intentional(values, z, v, grad, means, decay, delta, rate, step_size, beta2, num_updates)
    else:
        _advance_bounded(values, z, v, grad, decay, delta, bound, step_size, kappa, beta2, num_updates)

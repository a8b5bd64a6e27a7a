"""Optimisers that act on one flat vector: plain SGD, Adam and RAdam, each one pass over the parameters.

They equal `torch.optim`'s of the same name step for step (tests/test_optim.py). On a CPU the pass is a compiled kernel,
on other devices a handful of tensor expressions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq.checks import check_choice, check_fraction, check_positive
from neuralq.jit import kernel, reassociating_kernel
from neuralq.types import Array

__all__ = ["FlatOptimiser", "Optimiser", "clip_norm_", "clip_norm_on_device_"]

_LEAST_NORM = 1e-15  # below, squares begin to vanish in float32


@dataclass(frozen=True)
class Optimiser:
    """Which optimiser, with its constants; the learning rate is given at each step.

    Args:
        kind: "sgd", "adam" (Kingma & Ba, 2015) or "radam" (Liu et al., 2020).
        beta1: decay of the first moment (Adam, RAdam).
        beta2: decay of the second moment (Adam, RAdam).
        eps: added to the root of the second moment (Adam, RAdam).
    """

    kind: str = "radam"
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-8

    def __post_init__(self) -> None:
        """Refuse unknown kinds and constants outside their range."""
        check_choice("optimiser", self.kind, ("sgd", "adam", "radam"))
        for name, beta in (("beta1", self.beta1), ("beta2", self.beta2)):
            check_fraction(name, beta)
            if beta == 1:
                raise ValueError(f"{name} must be below 1, got {beta!r}: a moment that never moves stays at 0")
        check_positive("eps", self.eps)


@kernel
def _moments_kernel(
    p: Array, g: Array, m: Array, v: Array, b1: float, b2: float, rate: float, root: float, eps: float, plain: bool
) -> None:
    c1, c2, step = p.dtype.type(b1), p.dtype.type(b2), p.dtype.type(rate)
    n1, n2 = p.dtype.type(1.0 - b1), p.dtype.type(1.0 - b2)  # in float32, 1 − 0.999 would be wrong by 1.3e-5 of itself
    scale, small = p.dtype.type(root), p.dtype.type(eps)
    if plain:
        for i in range(p.size):
            m[i] = c1 * m[i] + n1 * g[i]
            v[i] = c2 * v[i] + n2 * g[i] * g[i]
            p[i] -= step * m[i]
    else:
        for i in range(p.size):
            m[i] = c1 * m[i] + n1 * g[i]
            v[i] = c2 * v[i] + n2 * g[i] * g[i]
            moved = p[i] - step * m[i] / (np.sqrt(v[i]) * scale + small)
            p[i] = moved if v[i] < np.inf else p.dtype.type(np.nan)  # a square that overflows would stop it for ever


@reassociating_kernel
def _square_sum(g: Array) -> Any:
    total = g[0] * 0
    for i in range(g.size):
        total += g[i] * g[i]
    return total


@kernel
def _scale(g: Array, factor: float) -> None:
    f = g.dtype.type(factor)
    for i in range(g.size):
        g[i] *= f


def clip_norm_(grad: Tensor | Array, max_norm: float) -> None:
    """Scale ``grad``, a tensor or an array, in place so that its Euclidean norm is at most ``max_norm``.

    Squares that overflow or vanish are taken of the gradient over its largest entry; what is not finite becomes NaN.

    Example:
        >>> g = torch.tensor([3.0, 4.0])
        >>> clip_norm_(g, 1.0)
        >>> g.tolist()
        [0.6000000238418579, 0.800000011920929]
    """
    if not isinstance(grad, Tensor) or grad.device.type == "cpu":
        array = grad.numpy() if isinstance(grad, Tensor) else grad
        norm = math.sqrt(_square_sum(array))
        if not _LEAST_NORM < norm < math.inf:
            _clip_scaled_(array, max_norm)
        elif norm > max_norm:
            _scale(array, max_norm / norm)
        return
    clip_norm_on_device_(grad, max_norm)


def clip_norm_on_device_(grad: Tensor, max_norm: float) -> None:
    """As `clip_norm_`, by tensor expressions that wait for no device.

    Example:
        >>> g = torch.tensor([3e19, 4e19])
        >>> clip_norm_on_device_(g, 10.0)
        >>> g.tolist()
        [6.0, 8.0]
    """
    norm, largest = torch.linalg.vector_norm(grad), grad.abs().amax()
    usual = (norm > _LEAST_NORM) & torch.isfinite(norm)
    unit = torch.where(usual | (largest == 0), torch.ones_like(largest), largest)
    grad.div_(unit)  # by 1, but for the extremes
    norm = torch.where(usual, norm, torch.linalg.vector_norm(grad))
    grad.mul_(torch.minimum(max_norm / norm, unit))


def _clip_scaled_(g: Array, max_norm: float) -> None:
    """As `clip_norm_`, where the plain sum of squares is not to be trusted."""
    largest = float(np.abs(g).max())
    if largest == 0:
        return
    with np.errstate(invalid="ignore"):  # infinity over infinity
        wide = g.astype(np.float64) / largest
    norm = math.sqrt(float(np.sum(wide * wide)))
    if not norm < math.inf:
        g[:] = np.nan
    elif largest * norm > max_norm:
        g[:] = wide * (max_norm / norm)


class FlatOptimiser:
    """State of one optimiser over one flat vector.

    Args:
        optimiser: which, and its constants.
        values: the vector that `step` changes in place.

    Example:
        >>> w = torch.zeros(2)
        >>> FlatOptimiser(Optimiser("sgd"), w).step(torch.tensor([1.0, -1.0]), learning_rate=0.5)
        >>> w.tolist()
        [-0.5, 0.5]
    """

    def __init__(self, optimiser: Optimiser, values: Tensor) -> None:
        self.optimiser = optimiser
        self.values = values
        self.num_steps = 0
        moments = optimiser.kind != "sgd"
        self._m = torch.zeros_like(values) if moments else None
        self._v = torch.zeros_like(values) if moments else None
        self._arrays: tuple[Array, Array, Array] | None = None  # the same memory, on CPUs
        if self._m is not None and self._v is not None and values.device.type == "cpu":
            self._arrays = values.numpy(), self._m.numpy(), self._v.numpy()

    def step(self, grad: Tensor | Array, learning_rate: float) -> None:
        """One descent step along ``grad``; on a CPU it may be an array."""
        self.num_steps += 1
        if self._arrays is not None:
            p, m, v = self._arrays
            o, g = self.optimiser, grad.numpy() if isinstance(grad, Tensor) else grad
            _moments_kernel(p, g, m, v, o.beta1, o.beta2, *self._scales(learning_rate))
            return
        grad = grad if isinstance(grad, Tensor) else torch.from_numpy(grad)
        if self._m is None or self._v is None:
            self.values.add_(grad, alpha=-learning_rate)
            return
        rate, root, eps, plain = self._scales(learning_rate)
        o = self.optimiser
        self._m.lerp_(grad, 1 - o.beta1)
        self._v.mul_(o.beta2).addcmul_(grad, grad, value=1 - o.beta2)
        if plain:
            self.values.add_(self._m, alpha=-rate)
        else:
            spread = (self._v.sqrt() * root).add_(eps)
            spread = torch.where(spread == math.inf, math.nan, spread)  # as in the kernel
            self.values.addcdiv_(self._m, spread, value=-rate)

    def _scales(self, learning_rate: float) -> tuple[float, float, float, bool]:
        """Step, factor of √v, ε and whether √v is left out, so that p −= step·m/(factor·√v + ε)."""
        o, t = self.optimiser, self.num_steps
        first, second = 1 - o.beta1**t, 1 - o.beta2**t
        if o.kind == "adam":
            return learning_rate / first, 1 / math.sqrt(second), o.eps, False
        # RAdam, Liu et al. (2020), algorithm 2: the variance is used once its estimate has enough degrees of freedom.
        rho_end = 2 / (1 - o.beta2) - 1
        rho = rho_end - 2 * t * o.beta2**t / second
        if rho <= 5.0:
            return learning_rate / first, 1.0, o.eps, True
        rectify = math.sqrt((rho - 4) * (rho - 2) * rho_end / ((rho_end - 4) * (rho_end - 2) * rho))
        return learning_rate / first * rectify * math.sqrt(second), 1.0, o.eps, False

    def state_dict(self) -> dict[str, Any]:
        """Moments and step count."""
        return {"num_steps": self.num_steps, "m": self._m, "v": self._v}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self.num_steps = int(state["num_steps"])
        for mine, saved in ((self._m, state["m"]), (self._v, state["v"])):
            if (mine is None) != (saved is None):
                raise ValueError(f"the saved optimiser is not {self.optimiser.kind}; keep the run's configuration")
            if mine is not None:
                mine.copy_(saved)

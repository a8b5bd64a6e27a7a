"""Step bounds for learning from every step once: how far a trace may move the weights, decided anew at each step.

Without replay or batches a single large error can undo everything. These rules choose the step from the trace z and the
error δ so that the prediction just corrected is not overshot:

* *overshooting-bounded* (ObGD): ``M = α κ max(|δ|, 1) ‖z‖₁`` and ``Δθ = α / max(M, 1) · δ z``. For features within
  [−1, 1] the error shrinks by a fraction of at most 1/κ of itself, whatever α;
* *adaptive*: the same along ``u = z / √(v̂ + ε)``, where v is a running mean of (δz)²;
* *intentional*: Δθ = step · δ̄ z/D with D = √v̂ + ε and v a running mean of g². The step is chosen so that, on average, a
  fraction η of the error is removed: with λ = 0 the linear change of the prediction is exactly η δ.

Running means start at zero and are divided by 1 − βᵗ (bias correction). Weights and traces are vectors ``[d]``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuralq.rules.shapes import check_same_shape

__all__ = ["adaptive_obgd", "intentional", "obgd", "obgd_step_size"]

EPSILON = 1e-8
CLIP = 20.0
CLIP_DECAY = 0.9998


def obgd_step_size(trace_norm: Tensor, delta: Tensor, step_size: float, kappa: float) -> Tensor:
    """The largest step that ObGD takes: ``α / max(α κ max(|δ|, 1) ‖z‖₁, 1)``.

    Args:
        trace_norm: ‖z‖₁, ``[]``.
        delta: TD error, ``[]``.
        step_size: α > 0, where the bound is not felt.
        kappa: κ > 0; at most 1/κ of the error is removed.

    Returns:
        The step size, ``[]``.

    Source: Elsayed, Vasan & Mahmood 2024, algorithm 3.

    Example:
        >>> obgd_step_size(torch.tensor(4.0), torch.tensor(0.5), step_size=1.0, kappa=2.0)
        tensor(0.1250)
    """
    bound = step_size * kappa * delta.abs().clamp_min(1.0) * trace_norm
    return _unless_infinite(step_size / bound.clamp_min(1.0), bound)


def obgd(z: Tensor, delta: Tensor, step_size: float, kappa: float) -> Tensor:
    """Overshooting-bounded gradient descent: ``Δθ = α / max(α κ max(|δ|, 1) ‖z‖₁, 1) · δ z``.

    Args:
        z: trace that includes the present gradient, ``[d]``.
        delta: TD error, ``[]``.
        step_size: α > 0.
        kappa: κ > 0.

    Returns:
        What to add to the weights, ``[d]``.

    Source: Elsayed, Vasan & Mahmood 2024, algorithm 3.

    Example:
        >>> obgd(torch.tensor([1.0, -3.0]), torch.tensor(2.0), step_size=1.0, kappa=2.0)
        tensor([ 0.1250, -0.3750])
    """
    return obgd_step_size(z.abs().sum(-1), delta, step_size, kappa) * delta * z


def adaptive_obgd(
    z: Tensor, delta: Tensor, v: Tensor, num_updates: int, step_size: float, kappa: float, beta2: float
) -> tuple[Tensor, Tensor]:
    """ObGD along ``u = z / √(v̂ + 1e-8)`` with ``v ← β₂ v + (1 − β₂)(δz)²`` and v̂ = v / (1 − β₂ᵗ).

    Args:
        z: trace that includes the present gradient, ``[d]``.
        delta: TD error, ``[]``.
        v: running mean before this step, ``[d]``.
        num_updates: t ≥ 1, this update counted.
        step_size: α > 0.
        kappa: κ > 0.
        beta2: β₂ in (0, 1).

    Returns:
        What to add to the weights and the new v, each ``[d]``.

    Raises:
        ValueError: if ``v`` is not of z's shape.

    Source: Elsayed, Vasan & Mahmood 2024, algorithm 11, with the bias correction of the authors' program.

    Example:
        At the first step v̂ = (δz)², so u is the sign of z over |δ|.

        >>> z, v = torch.tensor([0.1, -4.0]), torch.zeros(2)
        >>> adaptive_obgd(z, torch.tensor(2.0), v, 1, step_size=1.0, kappa=2.0, beta2=0.999)[0]
        tensor([ 0.2500, -0.2500])
    """
    check_same_shape("v", v, "z", z)
    v = beta2 * v + (1.0 - beta2) * (delta * z) ** 2
    u = _unless_infinite(z / (v / (1.0 - beta2**num_updates) + EPSILON).sqrt(), v)
    return obgd(u, delta, step_size, kappa), v


def intentional(
    z: Tensor,
    grad: Tensor,
    delta: Tensor,
    v: Tensor,
    means: Tensor,
    num_updates: int,
    decay: float,
    step_size: float,
    beta2: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """A step meant to remove the fraction η of the error: ``Δθ = η / max(√(σ̂ Z), 1e-8) · δ̄ z/D``.

    ``v ← β₂ v + (1 − β₂) g²``, ``D = √v̂ + 1e-8``, ``n = Σ g²/D``, ``Z = Σ z²/D``; σ is the running mean of n at the
    rate 1 − γλ; δ̄ is δ clipped to ±20 √ê with e the running mean of δ² at the rate 0.0002, begun at 1 and divided by
    1 − 0.9998ᵗ, so that early errors are not clipped.

    Args:
        z: trace that includes the present gradient, ``[d]``.
        grad: g, the present gradient, ``[d]``.
        delta: TD error, ``[]``.
        v: running mean of g² before this step, ``[d]``.
        means: σ and e before this step, ``[2]``; (0, 1) at first.
        num_updates: t ≥ 1, this update counted.
        decay: γλ in [0, 1]; at 1 the running mean is the mean of all steps, which is its limit.
        step_size: η > 0, the fraction.
        beta2: β₂ in (0, 1).

    Returns:
        What to add to the weights ``[d]``, the new v ``[d]``, the new means ``[2]``.

    Raises:
        ValueError: if ``grad`` or ``v`` is not of z's shape.

    Source: Intentional Q(λ), 2026.

    Example:
        With λ = 0 the change of a linear prediction, gᵀΔθ, is η δ.

        >>> g = torch.tensor([3.0, 4.0])
        >>> step, _, _ = intentional(g, g, torch.tensor(2.0), 0 * g, torch.tensor([0.0, 1.0]), 1, 0.0, 0.25, 0.999)
        >>> float(g @ step)
        0.5
    """
    check_same_shape("grad", grad, "z", z)
    check_same_shape("v", v, "z", z)
    v = beta2 * v + (1.0 - beta2) * grad**2
    scale = (v / (1.0 - beta2**num_updates)).sqrt() + EPSILON
    fresh, spread = (grad**2 / scale).sum(-1), (z**2 / scale).sum(-1)
    rate, weight = (1.0 - decay, 1.0 - decay**num_updates) if decay < 1 else (1.0 / num_updates, 1.0)
    sigma = (1.0 - rate) * means[0] + rate * fresh
    squares = CLIP_DECAY * means[1] + (1.0 - CLIP_DECAY) * delta**2
    limit = CLIP * (squares / (1.0 - CLIP_DECAY**num_updates)).sqrt()
    clipped = torch.minimum(torch.maximum(delta.to(limit.dtype), -limit), limit)
    root = (sigma / weight * spread).sqrt()
    step = _unless_infinite(step_size / root.clamp_min(EPSILON) * clipped, root).to(z.dtype)
    return step * z / scale, v, torch.stack([sigma, squares]).to(means.dtype)


def _unless_infinite(step: Tensor, size: Tensor) -> Tensor:
    """``step``, and NaN where the size that divides it has overflowed: 0 would stop learning without a word."""
    return torch.where(torch.isinf(size), math.nan, step)

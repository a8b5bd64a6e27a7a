"""Eligibility traces: the backward view, in which every step corrects all that led to it.

A trace z is a fading sum of gradients; the weights move along it by each step's error δ_t. One step, in this order:

1. *cut*: if the action about to be credited, a_tm1, explored (Watkins' Q(λ)), ``z ← 0``: what came before did not lead
   to it by the greedy policy;
2. *decay and add*: ``z ← decay · z + ∇Q(s_tm1, a_tm1)`` with ``decay = λ · (the discount INTO s_tm1)``,
   which is the previous row's ``discount_t``. With a constant γ the discount out of the state is the same number, and
   the mistake of taking it shows only where discounts vary;
3. *learn* along δ_t z;
4. *drop*: if ``last_t``, ``z ← 0``.

With values held fixed, the sum of δ_t z over a stream equals the sum of (G_t - Q) ∇Q with `lambda_returns` exactly.

Shapes: a trace has the parameters on its last axis and any leading axes, ``[*n, d]``: ``[d]`` for one learner,
``[k, d]`` for k outputs, ``[B, d]`` for B streams. Decays, step sizes and flags are numbers or tensors that match z's
leading axes (``[k]`` against ``[k, d]``).
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.rules.shapes import align_leading, check_same_shape

__all__ = ["accumulate", "cut", "dutch", "replace", "true_online_increment"]


def accumulate(z: Tensor, grad: Tensor, decay: Tensor | float) -> Tensor:
    """The accumulating trace adds every visit: ``z' = decay · z + grad``.

    Args:
        z: trace, ``[*n, d]``.
        grad: gradient of the prediction, ``[*n, d]``.
        decay: λ times the discount *into* the state whose gradient is added; a number or ``[*n]``.

    Returns:
        The new trace, ``[*n, d]``.

    Raises:
        ValueError: if the shapes do not match.

    Source: Sutton 1988, eq. 4.

    Example:
        >>> accumulate(torch.tensor([1.0, 0.0]), torch.tensor([1.0, 1.0]), 0.5)
        tensor([1.5000, 1.0000])
    """
    check_same_shape("grad", grad, "z", z)
    return align_leading("decay", decay, "z", z) * z + grad


def replace(z: Tensor, grad: Tensor, decay: Tensor | float) -> Tensor:
    """The replacing trace forgets earlier visits of a feature: ``z'ᵢ = gradᵢ where gradᵢ ≠ 0, else decay · zᵢ``.

    Meant for tables and binary features, where a component is touched or not. A dense gradient touches every
    component, so the trace of a network would have no memory at all: use `accumulate` there.

    Args:
        z: trace, ``[*n, d]``.
        grad: gradient of the prediction, ``[*n, d]``.
        decay: λ times the discount *into* the state whose gradient enters; a number or ``[*n]``.

    Returns:
        The new trace, ``[*n, d]``.

    Raises:
        ValueError: if the shapes do not match.

    Source: Singh & Sutton 1996, eq. 3.

    Example:
        >>> replace(torch.tensor([1.0, 1.0]), torch.tensor([1.0, 0.0]), 0.5)
        tensor([1.0000, 0.5000])
    """
    check_same_shape("grad", grad, "z", z)
    return torch.where(grad != 0, grad, align_leading("decay", decay, "z", z) * z)


def dutch(z: Tensor, x: Tensor, decay: Tensor | float, step_size: Tensor | float) -> Tensor:
    """The dutch trace discounts what the weights already learned: ``z' = decay·z + (1 - step_size·decay·zᵀx)·x``.

    Args:
        z: trace, ``[*n, d]``.
        x: features (the gradient of a linear prediction), ``[*n, d]``.
        decay: λ times the discount *into* the state with features ``x``; a number or ``[*n]``.
        step_size: α of the learner; a number or ``[*n]``.

    Returns:
        The new trace, ``[*n, d]``. A step size of 0 gives `accumulate`; with x one-hot, a step size of 1 gives
        `replace`.

    Raises:
        ValueError: if the shapes do not match.

    Source: van Seijen & Sutton 2014; van Seijen et al. 2016, eq. 12.

    Example:
        >>> dutch(torch.tensor([1.0, 0.0]), torch.tensor([1.0, 1.0]), 0.5, 0.5)
        tensor([1.2500, 0.7500])
    """
    check_same_shape("x", x, "z", z)
    faded = align_leading("decay", decay, "z", z) * z
    overlap = (faded * x).sum(-1, keepdim=True)
    return faded + (1.0 - align_leading("step_size", step_size, "z", z) * overlap) * x


def cut(z: Tensor, where: Tensor) -> Tensor:
    """The trace with zeros where the flag is true: before adding the gradient at an exploring action, after the last.

    Args:
        z: trace, ``[*n, d]``.
        where: bool, ``[]`` or ``[*n]``.

    Returns:
        The new trace, ``[*n, d]``; a cut removes even a trace that has overflowed (multiplying by 0 would not).

    Raises:
        ValueError: if ``where`` is not bool or does not match the leading axes.

    Source: Watkins 1989 (the cut at exploring actions).

    Example:
        >>> cut(torch.ones(2, 2), torch.tensor([True, False]))
        tensor([[0., 0.],
                [1., 1.]])
    """
    if where.dtype != torch.bool:
        raise ValueError(f"where must be a bool tensor, got {where.dtype}; convert with where.bool()")
    flags = align_leading("where", where, "z", z)
    assert isinstance(flags, Tensor)
    return z.masked_fill(flags, 0.0)


def true_online_increment(
    z: Tensor, x: Tensor, delta: Tensor, v_tm1: Tensor, v_old: Tensor, step_size: Tensor | float
) -> Tensor:
    """With `dutch` traces this increment makes linear TD(λ) equal the online λ-return algorithm, step for step.

    ``Δw = step_size · [(δ + V - V_old) z - (V - V_old) x]``, where V is the value of s_tm1 under the present weights
    and V_old its value under the weights before the previous update (0 at the first step of an episode).

    Args:
        z: dutch trace that includes ``x``, ``[*n, d]``.
        x: features of s_tm1, ``[*n, d]``.
        delta: ``r_t + discount_t · V(s_t) - V(s_tm1)`` under the present weights, ``[*n]``.
        v_tm1: V(s_tm1) under the present weights, ``[*n]``.
        v_old: V(s_tm1) as it was computed (for s_t) in the previous step, ``[*n]``.
        step_size: α; a number or ``[*n]``.

    Returns:
        What to add to the weights, ``[*n, d]``.

    Raises:
        ValueError: if the shapes do not match.

    Source: van Seijen & Sutton 2014, algorithm 1.

    Example:
        At the first step the trace is the features themselves and the increment is that of TD(0).

        >>> x = torch.tensor([1.0, 0.0])
        >>> true_online_increment(x, x, torch.tensor(2.0), torch.tensor(1.0), torch.tensor(0.0), 0.5)
        tensor([1., 0.])
    """
    check_same_shape("x", x, "z", z)
    check_same_shape("v_tm1", v_tm1, "delta", delta)
    check_same_shape("v_old", v_old, "delta", delta)
    change = v_tm1 - v_old
    along_trace = align_leading("delta", delta + change, "z", z)
    along_features = align_leading("v_tm1", change, "z", z)
    return align_leading("step_size", step_size, "z", z) * (along_trace * z - along_features * x)

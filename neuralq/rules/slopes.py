"""Slopes in the loss: a network is told how a value changes with the state, and not only what it is.

A model that explains an observed return also says how it depends on where it began: with r_t = ρ(s_tm1) and
s_t = f(s_tm1), the chain rule along the states that were *observed* gives

    ∂G_t/∂s_tm1 = ρ'(s_tm1) + discount_t · f'(s_tm1)ᵀ · ∂G_{t+1}/∂s_t

(`return_slopes`). The network's own slope comes from `input_slopes`, and `squared_slopes` of the difference joins the
loss of the values (TangentProp). `lob_star` weighs each slope by how well the model predicted the value beside it, so
that a model which is wrong somewhere is not believed there: explanation-based neural networks (EBNN).

Source: Simard, Victorri, LeCun & Denker 1992; Mitchell & Thrun 1993; Mitchell 1997, section 12.4.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.checks import check_positive
from neuralq.rules.shapes import align_leading, check_same_shape

__all__ = ["input_slopes", "lob_star", "return_slopes", "squared_slopes"]


def input_slopes(v: Tensor, s: Tensor) -> Tensor:
    """The slope of each value in its own state, ``∂v/∂s``, with the graph that lets it be learned.

    Args:
        v: values, ``[*n]``, computed from ``s``, each from its own row alone (batch normalisation mixes rows).
        s: states, ``[*n, *obs]``, requiring a gradient.

    Returns:
        ``[*n, *obs]``.

    Raises:
        ValueError: if the leading axes differ, or ``v`` was not computed from ``s``.

    Example:
        >>> s = torch.tensor([[1.0, 2.0], [3.0, 4.0]], requires_grad=True)
        >>> input_slopes((s * s).sum(-1), s).tolist()
        [[2.0, 4.0], [6.0, 8.0]]
    """
    align_leading("v", v, "s", s)
    if not (s.requires_grad and v.requires_grad):
        raise ValueError("v must be computed from s, and s must require a gradient; call s.requires_grad_() before")
    (slope,) = torch.autograd.grad(v.sum(), s, create_graph=True)
    return slope


def squared_slopes(error: Tensor, weight: Tensor | None = None) -> Tensor:
    """The loss of a slope is ``weight · ½ |error|²``, beside which the loss of a value is `squared`.

    Args:
        error: what the slope should be less what it is, ``[*n, d]``.
        weight: μ, ``[*n]``, or None for 1.

    Returns:
        ``[*n]``.

    Raises:
        ValueError: if the shapes differ.

    Source: Simard, Victorri, LeCun & Denker 1992, eq. 2; Mitchell 1997, eq. 12.2.

    Example:
        >>> squared_slopes(torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.tensor([1.0, 0.5]))
        tensor([12.5000,  0.2500])
    """
    loss = 0.5 * (error * error).sum(-1)
    if weight is None:
        return loss
    check_same_shape("weight", weight, "a row of error", loss)
    return weight * loss


def lob_star(predicted: Tensor, observed: Tensor, largest: float) -> Tensor:
    """LOB*: how far an explanation is believed, 1 where it predicts the value, 0 from an error of ``largest`` on.

    Args:
        predicted: values by the model, ``[*n]``.
        observed: what they turned out to be, ``[*n]``.
        largest: error from which nothing is believed, in units of the value.

    Returns:
        ``1 − |predicted − observed| / largest``, at least 0, ``[*n]``.

    Raises:
        ValueError: if the shapes differ or ``largest`` is not a finite number above 0.

    Source: Mitchell & Thrun 1993; Mitchell 1997, section 12.4.2.

    Example:
        >>> lob_star(torch.tensor([1.0, 1.5, 4.0]), torch.ones(3), largest=2.0)
        tensor([1.0000, 0.7500, 0.0000])
    """
    check_positive("largest", largest)
    check_same_shape("predicted", predicted, "observed", observed)
    return (1.0 - (predicted - observed).abs() / largest).clamp(min=0.0)


def return_slopes(r_slope_t: Tensor, discount_t: Tensor, jacobian_t: Tensor, v_slope: Tensor) -> Tensor:
    """How the return from each row on changes with the state that the row left, by the chain rule over the rows after.

    Args:
        r_slope_t: ∂r_t/∂s_tm1, time-major ``[T, *n, d]``.
        discount_t: γ, or 0 where the world terminated, ``[T, *n]``.
        jacobian_t: ∂s_t/∂s_tm1, ``[T, *n, d, d]``: the numbers of s_t down, those of s_tm1 across.
        v_slope: ∂v/∂s of the value that the last row bootstraps from, ``[*n, d]``; zeros for none.

    Returns:
        ``[T, *n, d]``; with one row, the slope of a one-step target.

    Raises:
        ValueError: if the shapes do not go together, or T is 0.

    Source: Mitchell & Thrun 1993; Thrun 1996.

    Example:
        r_t = 2 s_tm1, s_t = 3 s_tm1, γ = ½: the last row's slope is 2, the first one's 2 + ½ · 3 · 2 = 5.

        >>> two = torch.full((2, 1), 2.0)
        >>> return_slopes(two, torch.full((2,), 0.5), torch.full((2, 1, 1), 3.0), torch.zeros(1)).flatten()
        tensor([5., 2.])
    """
    if r_slope_t.ndim < 2 or not len(r_slope_t):
        raise ValueError(f"r_slope_t must be [T, *n, d] with T of at least 1, got {list(r_slope_t.shape)}")
    check_same_shape("discount_t", discount_t, "a number of r_slope_t", r_slope_t[..., 0])
    check_same_shape("a row of jacobian_t", jacobian_t[..., 0, :], "r_slope_t", r_slope_t)
    check_same_shape("a column of jacobian_t", jacobian_t[..., 0], "r_slope_t", r_slope_t)
    check_same_shape("v_slope", v_slope, "a row of r_slope_t", r_slope_t[0])
    slopes, after = [], v_slope
    for r_slope, discount, jacobian in zip(r_slope_t.flip(0), discount_t.flip(0), jacobian_t.flip(0), strict=True):
        after = r_slope + discount[..., None] * (jacobian.mT @ after[..., None])[..., 0]
        slopes.append(after)
    return torch.stack(slopes[::-1])

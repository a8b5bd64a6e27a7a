"""Errors and losses: what is differentiated, and how hard a mistake is punished.

The Bellman error is ``δ = target - prediction`` for every method; semi-gradient and residual-gradient methods differ
only in what the gradient may flow through. This package detaches nothing inside a rule, so the learner prepares the
target and the two functions here *refuse the wrong preparation*: a target that still carries a gradient given to
`semi_gradient_error`, or a target without one given to `residual_gradient_error`, is an error and not another
algorithm.

Losses are elementwise ``[*n] -> [*n]``, with a factor ½ on the square so that the derivative is the error itself; the
mean over a batch is the learner's. Weights (importance, priorities) multiply the loss, never the error.
"""

from __future__ import annotations

from torch import Tensor

from neuralq.checks import check_positive
from neuralq.rules.shapes import check_same_shape

__all__ = ["huber", "residual_gradient_error", "semi_gradient_error", "squared"]


def squared(error: Tensor, weight: Tensor | None = None) -> Tensor:
    """The squared loss is ``weight · ½ error²``: its derivative is the weighted error.

    Args:
        error: ``[*n]``.
        weight: ``[*n]``, or None for 1.

    Returns:
        ``[*n]``.

    Raises:
        ValueError: if the shapes differ.

    Example:
        >>> import torch
        >>> squared(torch.tensor([1.0, -2.0]), torch.tensor([1.0, 0.5]))
        tensor([0.5000, 1.0000])
    """
    return _weighted(0.5 * error * error, weight)


def huber(error: Tensor, delta: float, weight: Tensor | None = None) -> Tensor:
    """The Huber loss is the squared loss up to ``delta`` and a line of slope ``delta`` beyond: outliers pull no harder.

    ``weight · ½ error²`` where |error| ≤ delta, else ``weight · delta (|error| - ½ delta)``.

    Args:
        error: ``[*n]``.
        delta: where the parabola becomes a line, above 0.
        weight: ``[*n]``, or None for 1.

    Returns:
        ``[*n]``.

    Raises:
        ValueError: if the shapes differ or ``delta`` is not a finite number above 0.

    Source: Huber 1964; Mnih et al. 2015 (delta = 1).

    Example:
        >>> import torch
        >>> huber(torch.tensor([0.5, -3.0]), 1.0)
        tensor([0.1250, 2.5000])
    """
    check_positive("delta", delta)
    size = error.abs()
    near = size.clamp(max=delta)  # one expression for both pieces: ½ near² + delta (size - near)
    return _weighted(0.5 * near * near + delta * (size - near), weight)


def semi_gradient_error(q_tm1: Tensor, target: Tensor) -> Tensor:
    """The TD error to be differentiated through the prediction alone: ``target - q_tm1`` with a constant target.

    The learner is responsible for the constant: compute the target under ``torch.no_grad()``, from a target network,
    or detach it. It is not done here, so that reading the learner shows what is differentiated.

    Args:
        q_tm1: prediction Q(s_tm1, a_tm1), ``[*n]``.
        target: from one of the rules, ``[*n]``, carrying no gradient.

    Returns:
        ``[*n]``; descending ``squared`` of it moves the prediction towards the target.

    Raises:
        ValueError: if the shapes differ or ``target`` requires a gradient.

    Source: Sutton 1988; Sutton & Barto 2018, section 9.3.

    Example:
        >>> import torch
        >>> q_tm1 = torch.tensor(2.0, requires_grad=True)
        >>> squared(semi_gradient_error(q_tm1, torch.tensor(5.0))).backward()
        >>> q_tm1.grad
        tensor(-3.)
    """
    check_same_shape("target", target, "q_tm1", q_tm1)
    if target.requires_grad:
        raise ValueError(
            "target must carry no gradient for a semi-gradient error, got one that requires it; compute it under "
            "torch.no_grad() or detach it in the learner (or use residual_gradient_error)"
        )
    return target - q_tm1


def residual_gradient_error(q_tm1: Tensor, target: Tensor) -> Tensor:
    """The Bellman residual to be differentiated through prediction and target both: ``target - q_tm1``.

    Gradient descent on its square is stable for every differentiable representation, at a price: where the world is
    random, one successor gives the square plus the variance of the target; an unbiased gradient needs two independent
    successors of the same pair.

    Args:
        q_tm1: prediction Q(s_tm1, a_tm1), ``[*n]``.
        target: from one of the rules, ``[*n]``, with its graph: computed from the same parameters, not detached.

    Returns:
        ``[*n]``.

    Raises:
        ValueError: if the shapes differ, or ``q_tm1`` requires a gradient and ``target`` does not.

    Source: Baird 1995, section 4.

    Example:
        >>> import torch
        >>> w = torch.tensor(1.0, requires_grad=True)
        >>> squared(residual_gradient_error(w, 3.0 + 0.5 * w)).backward()  # δ = 3 - ½w = 2.5, dδ/dw = -½
        >>> w.grad
        tensor(-1.2500)
    """
    check_same_shape("target", target, "q_tm1", q_tm1)
    if q_tm1.requires_grad and not target.requires_grad:
        raise ValueError(
            "target must carry the gradient of its bootstrap for a residual-gradient error, got one without; compute "
            "it from the same parameters without detaching (or use semi_gradient_error)"
        )
    return target - q_tm1


def _weighted(loss: Tensor, weight: Tensor | None) -> Tensor:
    """``loss``, times ``weight`` if there is one."""
    if weight is None:
        return loss
    check_same_shape("weight", weight, "error", loss)
    return weight * loss

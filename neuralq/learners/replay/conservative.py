"""Conservative Q-learning: values of actions that the data do not hold stay low.

The loss of a batch is the mean of ½(target − Q(s, a))² (or Huber's) plus the mean of

    α · (log Σₐ′ exp Q(s, a′) − Q(s, a))

where a is the action that was taken: CQL(H), eq. 4 of Kumar, Zhou, Tucker, Levine 2020, "Conservative Q-learning for
offline reinforcement learning", with a fixed α. Its gradient with respect to Q(s, ·) is α (softmax Q(s, ·) − 1ₐ). In a
table, where a is taken in s with frequency μ(a|s), the loss is least at

    Q(s, a) = target − α (softmax Q(s, ·)ₐ / μ(a|s) − 1).
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.q.engine import Engine

__all__ = ["conservative_gradient"]


def conservative_gradient(
    engine: Engine, s: Tensor, a: Tensor, targets: Tensor, weight: Tensor | None, alpha: float
) -> Tensor:
    """Errors before the step ``[B]``; the gradient of loss and penalty is left in ``flat.grad``.

    Args:
        engine: values and gradients, with the loss in it.
        s: states ``[B, *obs]``.
        a: actions taken there ``[B]``.
        targets: of their values ``[B]``.
        weight: by which the terms of each row are multiplied ``[B]``, or None.
        alpha: α, in units of scaled values.

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> engine = TorchEngine(TableQ(1, 2), Loss())
        >>> zero = torch.zeros(1, dtype=torch.int64)
        >>> _ = conservative_gradient(engine, zero, zero, torch.zeros(1), None, alpha=1.0)
        >>> engine.flat.grad.tolist()  # softmax is ½, ½
        [-0.5, 0.5]
    """
    q = engine.all(s)
    coefficients = torch.softmax(q, -1)
    coefficients.scatter_add_(-1, a[:, None], -torch.ones_like(q[:, :1]))
    scale = alpha / len(a) if weight is None else alpha / len(a) * weight[:, None].to(q.dtype)
    engine.sum_gradient(s, coefficients * scale)
    penalty = engine.flat.grad.clone()
    errors = engine.loss_gradient(s, a, targets, weight)
    engine.flat.grad.add_(penalty)
    return errors

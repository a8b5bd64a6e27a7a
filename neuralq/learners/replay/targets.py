"""One-step targets for a batch, compiled: what `rules.q_learning` gives, in one pass.

A learner that updates at every environment step asks for 64 targets each time; as tensor operations the rule takes a
tenth of the whole step. The rule stays the definition; tests/test_bootstrap.py holds this to it, bit for bit.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neuralq import rules
from neuralq.jit import kernel
from neuralq.types import Array

__all__ = ["q_learning_array_targets", "q_learning_targets"]


@kernel
def _targets(r_t: Array, discount_t: Array, q_t: Array, reward_scale: float, out: Array) -> None:
    scale = out.dtype.type(reward_scale)
    for i in range(out.size):
        best = q_t[i, 0]
        for a in range(1, q_t.shape[1]):
            # Written so that NaN wins, as in `Tensor.amax`: a diverged learner must show.
            if not best >= q_t[i, a] and best == best:
                best = q_t[i, a]
        if discount_t[i] == 0 and best == -np.inf:
            best = out.dtype.type(0)
        out[i] = r_t[i] * scale + discount_t[i] * best


def q_learning_targets(r_t: Tensor, discount_t: Tensor, q_t: Tensor, reward_scale: float = 1.0) -> Tensor:
    """``r_t · reward_scale + discount_t · maxₐ q_t[a]``, without gradient, in the precision of ``q_t``.

    Args:
        r_t: reward, ``[B]``.
        discount_t: γ, or 0 at termination, ``[B]``.
        q_t: action values of the successors, ``[B, A]``, −∞ for illegal actions.
        reward_scale: factor of the rewards.

    Raises:
        ValueError: if the leading axes differ.

    Example:
        >>> q_learning_targets(torch.tensor([1.0]), torch.tensor([0.5]), torch.tensor([[4.0, 8.0]])).tolist()
        [5.0]
    """
    r_t, discount_t = r_t.to(q_t.dtype), discount_t.to(q_t.dtype)
    if q_t.device.type != "cpu" or q_t.dim() != 2 or r_t.shape != q_t.shape[:1] or discount_t.shape != r_t.shape:
        return rules.q_learning(r_t * reward_scale, discount_t, q_t)
    return torch.from_numpy(q_learning_array_targets(r_t.numpy(), discount_t.numpy(), q_t.numpy(), reward_scale))


def q_learning_array_targets(r_t: Array, discount_t: Array, q_t: Array, reward_scale: float = 1.0) -> Array:
    """As `q_learning_targets` from arrays ``[B]``, ``[B]`` and ``[B, A]`` of one precision.

    Example:
        >>> q_learning_array_targets(np.array([1.0]), np.array([0.5]), np.array([[4.0, 8.0]])).tolist()
        [5.0]
    """
    out = np.empty(len(r_t), q_t.dtype)
    _targets(r_t, discount_t, q_t, reward_scale, out)
    return out

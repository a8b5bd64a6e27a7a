"""Legal actions as part of the state: an observation with its action mask in one vector."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from neuralq.types import QFunction

__all__ = ["MaskedQ"]


class MaskedQ(nn.Module):
    """A Q-function over observations that carry their action mask: illegal actions are worth −∞.

    The masked observation is one vector ``[d + A]``: the flattened observation, then 1 for each legal action and 0 for
    each illegal one. Every maximum, softmax and expectation of `neuralq.rules` copes with −∞, so nothing else needs to
    know that masks exist.

    Args:
        inner: Q-function over the observation alone.
        observation_shape: shape of that observation; ``()`` for a state index.

    Example:
        >>> from neuralq.q import TableQ
        >>> q = MaskedQ(TableQ(3, 2), observation_shape=())
        >>> q.all(torch.tensor([[2, 1, 0]]))
        tensor([[0., -inf]], dtype=torch.float64, grad_fn=<MaskedFillBackward0>)
    """

    def __init__(self, inner: QFunction, observation_shape: tuple[int, ...]) -> None:
        super().__init__()
        self.inner = inner
        self.num_actions = inner.num_actions
        self.observation_shape = tuple(observation_shape)
        self.width = math.prod(self.observation_shape)

    def observation(self, s: Tensor) -> Tensor:
        """The observation without its mask: ``[*n, d + A] -> [*n, *obs]``.

        Raises:
            ValueError: if the vector is not an observation and one entry per action.
        """
        if s.shape[-1:] != (self.width + self.num_actions,):
            raise ValueError(
                f"a masked observation has {self.width} entries and {self.num_actions} for the mask, got shape "
                f"{tuple(s.shape)}; observations without a mask go to the inner Q-function"
            )
        return s[..., : self.width].reshape((*s.shape[:-1], *self.observation_shape))

    def illegal(self, s: Tensor) -> Tensor:
        """Which actions are not legal: ``[*n, d + A] -> [*n, A]`` bool."""
        return s[..., self.width :] == 0

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values, −∞ where illegal: ``[*n, d + A] -> [*n, A]``."""
        return self.inner.all(self.observation(s)).masked_fill(self.illegal(s), -torch.inf)

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Values of the given actions, −∞ where illegal: ``([*n, d + A], [*n] int64) -> [*n]``."""
        q = self.inner.at(self.observation(s), a)
        return q.masked_fill(self.illegal(s).gather(-1, a[..., None])[..., 0], -torch.inf)

    def check_legal(self, s: Tensor, a: Tensor, weight: Tensor | None = None) -> None:
        """Experience holds no illegal action, whose value −∞ nothing can be learned from.

        Rows of weight 0 are no experience and may hold anything. Devices other than the CPU are not asked, for that
        would mean waiting for them: there an illegal action shows as parameters that are not finite.

        Args:
            s: observations with their masks, ``[*n, d + A]``.
            a: actions that exist, ``[*n]`` int64.
            weight: ``[*n]``, or None for 1.

        Raises:
            ValueError: naming the first such row.

        Example:
            >>> from neuralq.q import TableQ
            >>> MaskedQ(TableQ(3, 2), ()).check_legal(torch.tensor([2, 1, 0]), torch.tensor(1))
            Traceback (most recent call last):
            ValueError: action 1 is illegal in row 0 of 1 ...
        """
        if s.device.type != "cpu":
            return
        wrong = self.illegal(s).gather(-1, a[..., None])[..., 0].reshape(-1)
        if weight is not None:
            wrong = wrong & (weight.reshape(-1) != 0)
        if wrong.any():
            row = int(wrong.nonzero()[0, 0])
            raise ValueError(
                f"action {int(a.reshape(-1)[row])} is illegal in row {row} of {a.numel()} by the mask of its state; "
                "choose only actions that the mask allows, or let the environment's mask allow what it executes"
            )

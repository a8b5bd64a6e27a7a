"""The table and the linear function: the representations whose behaviour under an update can be computed exactly."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from neuralq.checks import check_whole

__all__ = ["LinearQ", "TableQ"]


class TableQ(nn.Module):
    """One entry per state and action: an update moves nothing but its own pair, so the chapter's theorems hold.

    Args:
        num_states: S; states are int64 indices below it.
        num_actions: A.
        dtype: of the entries, float64 by default. All entries start at 0.

    Example:
        >>> q = TableQ(num_states=3, num_actions=2)
        >>> q.all(torch.tensor([0, 2])).shape
        torch.Size([2, 2])
    """

    def __init__(self, num_states: int, num_actions: int, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        check_whole("num_states", num_states)
        check_whole("num_actions", num_actions)
        self.num_states = num_states
        self.num_actions = num_actions
        self.weight = nn.Parameter(torch.zeros(num_states, num_actions, dtype=dtype))

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n] int64 -> [*n, A]``."""
        return self.weight[s]

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n], [*n]) int64 -> [*n]``."""
        return self.weight[s, a]


class LinearQ(nn.Module):
    """A weight vector per action: Q(s, a) = x(s)·w_a (+ b_a), trained by LMS in Mitchell's terms.

    With one-hot features it equals `TableQ` update for update.

    Args:
        num_features: d, the length of x(s).
        num_actions: A.
        bias: whether each action has a constant b_a as well.
        features: module that makes x(s) from an observation; without one the observation, a vector, is x(s).
        dtype: of the weights, float64 by default. All weights start at 0.

    Example:
        >>> q = LinearQ(num_features=4, num_actions=2)
        >>> q.at(torch.ones(5, 4), torch.zeros(5, dtype=torch.int64)).shape
        torch.Size([5])
    """

    def __init__(
        self,
        num_features: int,
        num_actions: int,
        bias: bool = False,
        features: nn.Module | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        check_whole("num_features", num_features)
        check_whole("num_actions", num_actions)
        self.num_actions = num_actions
        self.features = features
        self.weight = nn.Parameter(torch.zeros(num_actions, num_features, dtype=dtype))
        self.bias = nn.Parameter(torch.zeros(num_actions, dtype=dtype)) if bias else None

    def _x(self, s: Tensor) -> Tensor:
        x = s if self.features is None else self.features(s)
        num_features = self.weight.shape[1]
        if x.shape[-1:] != (num_features,):
            raise ValueError(f"this function takes {num_features} features, got observations of shape {tuple(x.shape)}")
        return x.to(self.weight.dtype)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, d] -> [*n, A]``."""
        return nn.functional.linear(self._x(s), self.weight, self.bias)

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, d], [*n] int64) -> [*n]``."""
        q = (self._x(s) * self.weight[a]).sum(-1)
        return q if self.bias is None else q + self.bias[a]

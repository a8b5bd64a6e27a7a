"""Mitchell's three network layouts (1997, §13.6), each one batched computation over any body.

* `ActionInputQ`: the state and a one-hot action go in, one value comes out. Everything is shared between the actions.
* `SeparateQ`: a network for each action, nothing shared: the update of one action moves no other.
* `ActionOutputQ`: the state goes in, one value per action comes out. The hidden layers are shared.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_whole
from neuralq.q.bodies import MLP
from neuralq.q.custom import Body
from neuralq.q.inputs import shape_of

__all__ = ["ActionInputQ", "ActionOutputQ", "SeparateQ"]


class _Input(nn.Module):
    """Observation ``[*n, *obs]`` -> ``[copies, B, d]``: feature map, cast, flattening, stem."""

    def __init__(
        self,
        input_shape: tuple[int, ...] | int,
        body: Body,
        copies: int,
        features: nn.Module | None,
        rng: np.random.Generator,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        self.input_shape = shape_of(input_shape)
        self.copies = copies
        self.features = features
        self.dtype = dtype
        self.stem, self.num_features = body.stem(self.input_shape, copies, rng, dtype)

    def rows(self, s: Tensor) -> tuple[Tensor, torch.Size]:
        """Features of every observation as rows ``[B, *input]``, and the leading axes ``*n``."""
        x = (s if self.features is None else self.features(s)).to(self.dtype)
        rank = len(self.input_shape)
        leading = x.shape[: x.dim() - rank]
        if x.shape[x.dim() - rank :] != self.input_shape:
            raise ValueError(f"this network takes observations of shape {self.input_shape}, got {tuple(x.shape)}")
        # Not reshape(-1, ...): a batch of no observations has no size to infer.
        return x.reshape(math.prod(leading), *self.input_shape), leading

    def forward(self, rows: Tensor) -> Tensor:
        """``[B, *input] -> [copies, B, d]``."""
        if self.stem is not None:
            stemmed: Tensor = self.stem(rows)
            return stemmed
        return rows.reshape(rows.shape[0], self.num_features).expand(self.copies, -1, -1)


class ActionOutputQ(nn.Module):
    """State in, one output per action: the layout of DQN and of Mitchell's third network.

    Args:
        input_shape: shape of one observation (after ``features``, if given), or the length of a vector.
        num_actions: A.
        body: `MLP`, `Conv`, or a module of your own (`Custom`).
        features: module without parameters applied to the observation first (one-hot, pixel scaling).
        rng: generator, or its seed, for the initial weights.
        dtype: float32 by default.

    Example:
        >>> q = ActionOutputQ(4, num_actions=2, body=MLP(hidden=(8,)), rng=0)
        >>> q.all(torch.zeros(3, 4)).shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        input_shape: tuple[int, ...] | int,
        num_actions: int,
        body: Body | None = None,
        features: nn.Module | None = None,
        rng: np.random.Generator | int = 0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        input_shape = shape_of(input_shape)
        check_whole("num_actions", num_actions)
        body, rng = body or MLP(), np.random.default_rng(rng)
        self.num_actions = num_actions
        self.input = _Input(input_shape, body, 1, features, rng, dtype)
        self.trunk = body.trunk(self.input.num_features, num_actions, 1, rng, dtype)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, *obs] -> [*n, A]``."""
        rows, leading = self.input.rows(s)
        out: Tensor = self.trunk(self.input(rows))
        return out[0].reshape(*leading, self.num_actions)

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        return self.all(s).gather(-1, a[..., None])[..., 0]


class SeparateQ(nn.Module):
    """A separate network for each action, run together as one grouped product per layer.

    Arguments as for `ActionOutputQ`; ``body`` describes each of the A networks.

    Example:
        >>> q = SeparateQ((4,), num_actions=3, body=MLP(hidden=(8,)), rng=0)
        >>> q.all(torch.zeros(4)).shape
        torch.Size([3])
    """

    def __init__(
        self,
        input_shape: tuple[int, ...] | int,
        num_actions: int,
        body: Body | None = None,
        features: nn.Module | None = None,
        rng: np.random.Generator | int = 0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        input_shape = shape_of(input_shape)
        check_whole("num_actions", num_actions)
        body, rng = body or MLP(), np.random.default_rng(rng)
        self.num_actions = num_actions
        self.input = _Input(input_shape, body, num_actions, features, rng, dtype)
        self.trunk = body.trunk(self.input.num_features, 1, num_actions, rng, dtype)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, *obs] -> [*n, A]``."""
        rows, leading = self.input.rows(s)
        out: Tensor = self.trunk(self.input(rows))
        return out[..., 0].transpose(0, 1).reshape(*leading, self.num_actions)

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        return self.all(s).gather(-1, a[..., None])[..., 0]


class ActionInputQ(nn.Module):
    """State and one-hot action in, one value out: Mitchell's first layout.

    Arguments as for `ActionOutputQ`. With a `Conv` body the action joins after the convolutions, with a
    `Custom` one after the module, whose ``hidden`` must not be empty.

    Example:
        >>> q = ActionInputQ((4,), num_actions=2, body=MLP(hidden=(8,)), rng=0)
        >>> q.at(torch.zeros(3, 4), torch.tensor([0, 1, 1])).shape
        torch.Size([3])
    """

    def __init__(
        self,
        input_shape: tuple[int, ...] | int,
        num_actions: int,
        body: Body | None = None,
        features: nn.Module | None = None,
        rng: np.random.Generator | int = 0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        input_shape = shape_of(input_shape)
        check_whole("num_actions", num_actions)
        body, rng = body or MLP(), np.random.default_rng(rng)
        self.num_actions = num_actions
        self.input = _Input(input_shape, body, 1, features, rng, dtype)
        self.trunk = body.trunk(self.input.num_features + num_actions, 1, 1, rng, dtype)
        self.register_buffer("one_hot", torch.eye(num_actions, dtype=dtype), persistent=False)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, *obs] -> [*n, A]``, each state paired with every action at once."""
        rows, leading = self.input.rows(s)
        h = self.input(rows)[0]
        one_hot = self.get_buffer("one_hot")
        pairs = torch.cat([h.repeat_interleave(self.num_actions, 0), one_hot.repeat(h.shape[0], 1)], -1)
        out: Tensor = self.trunk(pairs[None])
        return out.reshape(*leading, self.num_actions)

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        rows, leading = self.input.rows(s)
        h = self.input(rows)[0]
        pairs = torch.cat([h, self.get_buffer("one_hot")[a.reshape(h.shape[0])]], -1)
        out: Tensor = self.trunk(pairs[None])
        return out.reshape(leading)

"""Dueling heads: how good the state is, and how much better each action is than the average one, learned apart.

Q(s, a) = V(s) + A(s, a) − mean over b of A(s, b) (Wang et al. 2016, eq. 9). Every transition updates V, whatever the
action, so states are valued before every action has been tried in them. Without the mean, V and A would be determined
only up to a constant.

Both streams have a last hidden layer of their own and share what is below it. That takes outputs for all actions from
one network: in the action-input layout an action's value comes from a pass of its own, separate networks share
nothing, and in a table or a linear function V would be redundant.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_whole
from neuralq.q.bodies import ACTIVATIONS, MLP, GroupedLayerNorm
from neuralq.q.custom import Body
from neuralq.q.inputs import shape_of
from neuralq.q.layouts import ActionOutputQ

__all__ = ["DuelingQ"]


class DuelingQ(nn.Module):
    """State in, one output per action, through a value stream and an advantage stream.

    The last hidden width of the body is that of each stream; the layers before it, and convolutions, are shared. The
    mean is over all actions, also those that a mask forbids in some state.

    Args:
        input_shape: shape of one observation (after ``features``, if given), or the length of a vector.
        num_actions: A.
        body: `MLP`, `Conv` or `Custom` with at least one hidden layer.
        features: module without parameters applied to the observation first.
        rng: generator, or its seed, for the initial weights.
        dtype: float32 by default.
        num_atoms: K > 1 gives A·K outputs, action by action, each atom with a V and an A of its own: what
            `neuralq.q.QuantileQ` and `neuralq.q.CategoricalQ` take.

    Raises:
        ValueError: if the body has no hidden layer.

    Source: Wang et al. 2016, eq. 9.

    Example:
        >>> q = DuelingQ((4,), num_actions=2, body=MLP(hidden=(8, 8)), rng=0)
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
        num_atoms: int = 1,
    ) -> None:
        super().__init__()
        input_shape = shape_of(input_shape)
        check_whole("num_actions", num_actions)
        check_whole("num_atoms", num_atoms)
        body, rng = body or MLP(), np.random.default_rng(rng)
        if not body.hidden:
            raise ValueError("dueling streams need a hidden layer, got hidden=(); give the body a width")
        *below, last = body.hidden
        self.num_actions = num_actions * num_atoms
        self._advantages = (num_actions, num_atoms)
        self.activation = body.activation
        # The shared part ends in a hidden layer, whose normalisation and activation a trunk leaves to its successor.
        shared = dataclasses.replace(body, hidden=tuple(below[:-1]))
        inner = ActionOutputQ(input_shape, below[-1] if below else 1, shared, features, rng, dtype)
        self.input = inner.input
        self.shared = inner.trunk if below else None
        norm = body.layer_norm and bool(below)
        self.norm = GroupedLayerNorm(1, (below[-1],), dtype, body.affine) if norm else None
        width = below[-1] if below else self.input.num_features
        stream = dataclasses.replace(body, hidden=(last,))
        self.value = stream.trunk(width, num_atoms, 1, rng, dtype)
        self.advantage = stream.trunk(width, self.num_actions, 1, rng, dtype)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, *obs] -> [*n, A]``, or ``[*n, A·K]``."""
        rows, leading = self.input.rows(s)
        x = self.input(rows)
        if self.shared is not None:
            x = self.shared(x)
            x = ACTIVATIONS[self.activation](x if self.norm is None else self.norm(x))
        value: Tensor = self.value(x)[0]
        advantage: Tensor = self.advantage(x)[0].reshape(value.shape[0], *self._advantages)
        q = value[:, None, :] + advantage - advantage.mean(1, keepdim=True)
        return q.reshape(*leading, self.num_actions)

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        return self.all(s).gather(-1, a[..., None])[..., 0]

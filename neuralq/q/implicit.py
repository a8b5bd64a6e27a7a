"""Quantiles at any level: a function of state, action and level τ, of which a distribution can be asked point by point.

The distribution of a return is given by its quantile function Z_τ(s, a), the value that the return stays below with
probability τ. A fixed number of quantiles is a vector of outputs; here τ goes in (Dabney, Ostrovski, Silver & Munos
2018, IQN). It goes in as n cosines, cos(π i τ) for i = 0 … n − 1:

* in a network they are embedded, φ_j(τ) = ReLU(Σ_i cos(π i τ) w_ij + b_j), and multiply the features ψ_j(s) of the
  state unit by unit: Z_τ = f(ψ(s) ∘ φ(τ)). ψ is what lies below the last hidden layer: the convolutions of a `Conv`
  body, the hidden layers but the last of an `MLP`, or its one hidden layer. One output per action is enough, so every
  layout can;
* a table or a linear function has no hidden features. There each pair holds the coefficients of a series,
  Z_τ(s, a) = Σ_i w_i(s, a) cos(π i τ), which is linear in its parameters; w_0 is the mean.

The action's value is the mean over K levels. Published are K levels drawn for every decision; here they are always the
midpoints (2k + 1)/(2K), so that what is done depends on the parameters and the state alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_whole
from neuralq.q.bodies import ACTIVATIONS, GroupedLinear
from neuralq.q.layouts import ActionInputQ, ActionOutputQ, SeparateQ
from neuralq.q.table_and_linear import LinearQ, TableQ
from neuralq.rules import quantile_levels
from neuralq.types import QFunction

__all__ = ["NUM_COSINES", "ImplicitQuantileQ"]

NUM_COSINES = 64
"""n, as published."""
_NUM_LEVELS = 32
"""K, as published."""


class ImplicitQuantileQ(nn.Module):
    """The quantile function of every action's return; the action's value is its mean over fixed levels.

    Args:
        inner: one of the three layouts with A actions, or a table or linear function with A·n outputs, the n
            coefficients of the first action first.
        rng: generator, or its seed, for the initial weights of a network's embedding.
        num_cosines: n.

    Raises:
        ValueError: if ``inner`` is none of these, its outputs do not divide evenly among n, or a network has no hidden
            layer.

    Source: Dabney, Ostrovski, Silver & Munos 2018, section 3 and eq. 4.

    Example:
        >>> from neuralq.q import MLP
        >>> q = ImplicitQuantileQ(ActionOutputQ((4,), num_actions=2, body=MLP(hidden=(8, 8)), rng=0), rng=1)
        >>> s, levels = torch.zeros(3, 4), torch.tensor([[0.1, 0.9]] * 3)
        >>> q.all(s).shape, q.outputs(s, levels).shape
        (torch.Size([3, 2]), torch.Size([3, 2, 2]))
    """

    fixed: Tensor
    angles: Tensor

    def __init__(self, inner: QFunction, rng: np.random.Generator | int = 0, num_cosines: int = NUM_COSINES) -> None:
        super().__init__()
        check_whole("num_cosines", num_cosines)
        self.inner = inner
        self.embedding: GroupedLinear | None = None
        if isinstance(inner, TableQ | LinearQ):
            if inner.num_actions % num_cosines:
                raise ValueError(
                    f"the function below has {inner.num_actions} outputs, which is no multiple of {num_cosines} per "
                    "action; make it with num_actions * num_cosines actions"
                )
            self.num_actions = inner.num_actions // num_cosines
        elif isinstance(inner, ActionOutputQ | SeparateQ | ActionInputQ):
            self.num_actions = inner.num_actions
            self.embedding = self._embedding_for(inner, np.random.default_rng(rng), num_cosines)
        else:
            raise ValueError(
                f"{type(inner).__name__} has no one place where levels could join; use ActionOutputQ, SeparateQ, "
                "ActionInputQ, LinearQ or TableQ"
            )
        # In double precision: single would lose the third digit of the fastest cosine's angle.
        self.register_buffer("angles", math.pi * torch.arange(num_cosines, dtype=torch.float64), persistent=False)
        self.register_buffer("fixed", self._cosines(quantile_levels(_NUM_LEVELS)), persistent=False)

    def _embedding_for(
        self, inner: ActionOutputQ | SeparateQ | ActionInputQ, rng: np.random.Generator, num_cosines: int
    ) -> GroupedLinear:
        """φ, as wide as the features that it multiplies; also finds the layer above them."""
        trunk: Any = inner.trunk
        num_hidden = len(trunk.layers) - 1
        if inner.input.stem is None and num_hidden == 0:
            raise ValueError("levels join hidden features, got a body with hidden=(); give it a width")
        self._joined_at = max(num_hidden - 1, 0 if inner.input.stem is not None else 1)
        weight = trunk.layers[self._joined_at].weight
        return GroupedLinear(weight.shape[0], num_cosines, weight.shape[1], rng, weight.dtype)

    def outputs(self, s: Tensor, levels: Tensor | None = None) -> Tensor:
        """Quantiles of every action: ``[*n, *obs] -> [*n, A, K]``.

        Args:
            s: observations.
            levels: τ in [0, 1], ``[*n, K]``, best in double precision; None for the fixed ones.
        """
        cosines = self.fixed if levels is None else self._cosines(levels)
        if self.embedding is None:
            flat = self.inner.all(s)
            coefficients = flat.reshape(*flat.shape[:-1], self.num_actions, cosines.shape[-1])
            return coefficients @ cosines.transpose(-1, -2).to(coefficients.dtype)
        inner: Any = self.inner
        rows, leading = inner.input.rows(s)
        joined = self._features(rows)[:, :, :, None] * self._embedded(cosines)[:, :, None]
        copies, num_rows, each, num_levels, width = joined.shape
        out = self._through(joined.reshape(copies, -1, width), self._joined_at, None)
        # Actions are copies of the network, rows of their own, or outputs: whichever they are, the others are one.
        out = out.reshape(copies, num_rows, each, num_levels, out.shape[-1]).permute(1, 0, 2, 4, 3)
        return out.reshape(*leading, self.num_actions, num_levels)

    def _cosines(self, levels: Tensor) -> Tensor:
        """``[*n, K] -> [*n, K, num_cosines]``."""
        return torch.cos(levels[..., None].double() * self.angles)

    def _embedded(self, cosines: Tensor) -> Tensor:
        """φ of every row's levels, or of those that all rows share: ``[copies, B or 1, K, width]``."""
        assert self.embedding is not None
        copies, num_cosines, width = self.embedding.weight.shape
        rows = cosines.reshape(-1, num_cosines).to(self.embedding.weight.dtype)
        phi = torch.relu(self.embedding(rows.expand(copies, -1, -1)))
        return phi.reshape(copies, -1, cosines.shape[-2], width)

    def _features(self, rows: Tensor) -> Tensor:
        """ψ of every row: ``[copies, B, 1, width]``, or with the action among the inputs ``[1, B, A, width]``."""
        inner: Any = self.inner
        x = inner.input(rows)
        each = 1
        if isinstance(inner, ActionInputQ):
            each = self.num_actions
            one_hot = inner.get_buffer("one_hot").repeat(x.shape[1], 1)
            x = torch.cat([x[0].repeat_interleave(each, 0), one_hot], -1)[None]
        x = self._through(x, 0, self._joined_at)
        return x.reshape(x.shape[0], -1, each, x.shape[-1])

    def _through(self, x: Tensor, start: int, end: int | None) -> Tensor:
        """The layers from ``start`` to ``end`` of the trunk, with what follows each hidden one."""
        trunk: Any = self.inner.trunk  # type: ignore[attr-defined]
        last = len(trunk.layers) - 1
        for i, layer in list(enumerate(trunk.layers))[start:end]:
            x = layer(x)
            if i < last:
                x = ACTIVATIONS[trunk.activation](trunk.norms[i](x) if len(trunk.norms) else x)
        return x

    def mean(self, outputs: Tensor) -> Tensor:
        """What is expected of an action with these quantiles, at evenly spread or drawn levels: ``[*n, K] -> [*n]``."""
        return outputs.mean(-1)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, *obs] -> [*n, A]``."""
        return self.mean(self.outputs(s))

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        return self.all(s).gather(-1, a[..., None])[..., 0]

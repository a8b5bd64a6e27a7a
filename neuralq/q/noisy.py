"""Noisy layers: weights with a mean and a learned spread, so that a network explores where it is unsure of itself.

A dense layer computes y = (μʷ + σʷ ⊙ εʷ) x + μᵇ + σᵇ ⊙ εᵇ. The noise is factorised: with standard normal vectors as
long as the layer's input and output and f(x) = sgn(x)√|x|, εʷ is the outer product of both f's and εᵇ the output's.
Both μ and σ are learned by gradient descent on what the noise makes of them; where being wrong costs, σ shrinks. Means
start uniform in ±1/√p for p inputs, and σ as 0.5/√p.

A layer has no noise until it is given some: without, it computes with its means, which is how a trained network plays.

Source: Fortunato et al. (2018), "Noisy networks for exploration", eq. 8 to 11 and section 3.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.q.bodies import Trunk
from neuralq.types import QFunction

__all__ = ["NoisyLinear", "draw_noise", "made_noisy", "noisy_layers", "remove_noise"]

_SIGMA = 0.5
"""σ₀ of factorised noise, as published."""


class NoisyLinear(nn.Module):
    """``copies`` noisy dense layers side by side: ``[copies, B, in] -> [copies, B, out]``.

    Args:
        copies: layers that share nothing, their noise neither.
        fan_in: p, inputs of each.
        fan_out: outputs of each.
        rng: draws the means.
        dtype: of the parameters.

    Source: Fortunato et al. 2018, eq. 9 to 11.

    Example:
        >>> layer = NoisyLinear(1, 4, 2, np.random.default_rng(0), torch.float64)
        >>> x = torch.ones(1, 3, 4, dtype=torch.float64)
        >>> plain = layer(x)
        >>> draw_noise([layer], np.random.default_rng(1))
        >>> bool((layer(x) != plain).all()), layer.weight_sigma[0, 0, 0].item()
        (True, 0.25)
    """

    def __init__(self, copies: int, fan_in: int, fan_out: int, rng: np.random.Generator, dtype: torch.dtype) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(fan_in)
        weight, bias = (copies, fan_in, fan_out), (copies, fan_out)
        self.weight = nn.Parameter(torch.from_numpy(rng.uniform(-bound, bound, weight)).to(dtype))
        self.bias = nn.Parameter(torch.from_numpy(rng.uniform(-bound, bound, bias)).to(dtype))
        self.weight_sigma = nn.Parameter(torch.full(weight, _SIGMA * bound, dtype=dtype))
        self.bias_sigma = nn.Parameter(torch.full(bias, _SIGMA * bound, dtype=dtype))
        self.noise: tuple[Tensor, Tensor] | None = None

    def forward(self, x: Tensor) -> Tensor:
        """Apply copy c to ``x[c]``, all rows with the same noise."""
        weight: Tensor = self.weight
        bias: Tensor = self.bias
        if self.noise is not None:
            below, above = self.noise
            weight = weight + self.weight_sigma * (below[:, :, None] * above[:, None, :])
            bias = bias + self.bias_sigma * above
        return torch.baddbmm(bias[:, None, :], x, weight)


def made_noisy(q: QFunction, rng: np.random.Generator) -> QFunction:
    """The same network with noisy layers in the place of its dense ones, with weights of their own; it is changed.

    Raises:
        ValueError: if it has no dense layers.

    Example:
        >>> from neuralq.q import MLP, ActionOutputQ
        >>> q = made_noisy(ActionOutputQ((4,), 2, MLP((8,)), rng=0), np.random.default_rng(0))
        >>> len(noisy_layers(q))
        2
    """
    trunks = [part for part in cast(nn.Module, q).modules() if isinstance(part, Trunk)]
    for trunk in trunks:
        for i, layer in enumerate(trunk.layers):
            copies, fan_in, fan_out = cast(Tensor, layer.weight).shape
            trunk.layers[i] = NoisyLinear(copies, fan_in, fan_out, rng, cast(Tensor, layer.weight).dtype)
    if not trunks:
        raise ValueError(f"noisy layers take the place of dense ones, and {type(q).__name__} has none; use a network")
    return q


def noisy_layers(q: Any) -> list[NoisyLinear]:
    """Every noisy layer of a representation, those under a mask or a distribution too."""
    return [part for part in q.modules() if isinstance(part, NoisyLinear)]


def draw_noise(layers: Sequence[NoisyLinear], rng: np.random.Generator) -> None:
    """New noise for every layer: f(ε) of its inputs and of its outputs, ``[copies, in]`` and ``[copies, out]``."""
    for layer in layers:
        below, above = (rng.standard_normal((layer.bias.shape[0], n)) for n in layer.weight.shape[1:])
        layer.noise = (_rooted(below, layer.weight), _rooted(above, layer.weight))


def remove_noise(layers: Sequence[NoisyLinear]) -> None:
    """Every layer computes with its means again."""
    for layer in layers:
        layer.noise = None


def _rooted(epsilon: Any, like: Tensor) -> Tensor:
    """sgn(ε)√|ε|."""
    return torch.from_numpy(np.sign(epsilon) * np.sqrt(np.abs(epsilon))).to(like)

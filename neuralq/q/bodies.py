"""Bodies of the network layouts: an MLP or a small convolutional net, with or without layer normalisation.

A body is described by a frozen dataclass (so that it can stand in a configuration) and built in two parts: a *stem*
that turns an observation into a vector (nothing for the MLP, convolutions for `Conv`), and a *trunk* of dense layers.
Both are built with a leading axis of ``copies`` networks that share nothing: `SeparateQ` asks for one copy per action
and still runs as one batched product per layer.

Weights start as U(±1/√fan_in), biases likewise, drawn from the caller's generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_choice, check_whole

__all__ = ["ACTIVATIONS", "MLP", "Conv", "GroupedConv", "GroupedLayerNorm", "GroupedLinear", "Trunk"]

ACTIVATIONS = {"relu": torch.relu, "tanh": torch.tanh, "leaky_relu": nn.functional.leaky_relu}


def _uniform(rng: np.random.Generator, shape: tuple[int, ...], fan_in: int, dtype: torch.dtype) -> nn.Parameter:
    bound = 1.0 / math.sqrt(fan_in)
    return nn.Parameter(torch.from_numpy(rng.uniform(-bound, bound, shape)).to(dtype))


class GroupedLinear(nn.Module):
    """``copies`` dense layers side by side: ``[copies, B, in] -> [copies, B, out]`` in one batched product."""

    def __init__(self, copies: int, fan_in: int, fan_out: int, rng: np.random.Generator, dtype: torch.dtype) -> None:
        super().__init__()
        self.weight = _uniform(rng, (copies, fan_in, fan_out), fan_in, dtype)
        self.bias = _uniform(rng, (copies, fan_out), fan_in, dtype)

    def forward(self, x: Tensor) -> Tensor:
        """Apply copy c to ``x[c]``."""
        return torch.baddbmm(self.bias[:, None, :], x, self.weight)


class GroupedLayerNorm(nn.Module):
    """``copies`` layer normalisations (Ba et al., 2016) side by side over the last axes, each with its own scale.

    Args:
        copies: number of independent networks.
        shape: normalised shape of one copy.
        dtype: of scale and shift.
    """

    def __init__(self, copies: int, shape: tuple[int, ...], dtype: torch.dtype) -> None:
        super().__init__()
        self.shape = shape
        self.weight = nn.Parameter(torch.ones(copies, *shape, dtype=dtype))
        self.bias = nn.Parameter(torch.zeros(copies, *shape, dtype=dtype))

    def forward(self, x: Tensor) -> Tensor:
        """``[copies, B, *shape] -> [copies, B, *shape]``."""
        return nn.functional.layer_norm(x, self.shape) * self.weight[:, None] + self.bias[:, None]


class Trunk(nn.Module):
    """Dense layers with an activation between them and none after the last: ``[copies, B, in] -> [copies, B, out]``."""

    def __init__(
        self,
        copies: int,
        sizes: tuple[int, ...],
        layer_norm: bool,
        activation: str,
        rng: np.random.Generator,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        self.copies = copies
        self.sizes = sizes
        self.layer_norm = layer_norm
        self.activation = activation
        layers: list[nn.Module] = []
        norms: list[nn.Module] = []
        for i, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            layers.append(GroupedLinear(copies, fan_in, fan_out, rng, dtype))
            if layer_norm and i < len(sizes) - 2:
                norms.append(GroupedLayerNorm(copies, (fan_out,), dtype))
        self.layers = nn.ModuleList(layers)
        self.norms = nn.ModuleList(norms)

    def forward(self, x: Tensor) -> Tensor:
        """Run every copy on its own slice of ``x``."""
        act = ACTIVATIONS[self.activation]
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if i < len(self.layers) - 1:
                x = act(self.norms[i](x) if self.layer_norm else x)
        return x


class GroupedConv(nn.Module):
    """``copies`` stacks of valid convolutions side by side, grouped: ``[B, C, H, W] -> [copies, B, d]``."""

    def __init__(
        self, copies: int, in_shape: tuple[int, ...], body: Conv, rng: np.random.Generator, dtype: torch.dtype
    ) -> None:
        super().__init__()
        self.copies = copies
        self.strides = body.strides
        self.activation = body.activation
        channels, height, width = in_shape
        weights: list[nn.Parameter] = []
        biases: list[nn.Parameter] = []
        norms: list[nn.Module] = []
        for fan_out, kernel, stride in zip(body.channels, body.kernel_sizes, body.strides, strict=True):
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
            if height < 1 or width < 1:
                raise ValueError(f"a kernel of {kernel} does not fit an observation of {in_shape}; use smaller kernels")
            fan_in = channels * kernel * kernel
            weights.append(_uniform(rng, (copies * fan_out, channels, kernel, kernel), fan_in, dtype))
            biases.append(_uniform(rng, (copies * fan_out,), fan_in, dtype))
            if body.layer_norm:
                norms.append(GroupedLayerNorm(copies, (fan_out, height, width), dtype))
            channels = fan_out
        self.weights = nn.ParameterList(weights)
        self.biases = nn.ParameterList(biases)
        self.norms = nn.ModuleList(norms)
        self.num_features = channels * height * width

    def forward(self, s: Tensor) -> Tensor:
        """Convolve every copy's own stack over the same images."""
        x = s
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            # The first layer's copies all see the same image, so there a plain convolution is the grouped one.
            groups = 1 if i == 0 else self.copies
            x = nn.functional.conv2d(x, weight, bias, stride=self.strides[i], groups=groups)
            if len(self.norms):
                num_channels = x.shape[1] // self.copies  # not −1: a batch of no observations has no size to infer
                split = x.reshape(x.shape[0], self.copies, num_channels, *x.shape[2:]).transpose(0, 1)
                x = self.norms[i](split).transpose(0, 1).reshape(x.shape)
            x = ACTIVATIONS[self.activation](x)
        return x.reshape(x.shape[0], self.copies, self.num_features).transpose(0, 1)


@dataclass(frozen=True)
class MLP:
    """Dense layers on the flattened observation.

    Args:
        hidden: widths of the hidden layers; empty for a linear function with a bias.
        layer_norm: layer normalisation before each activation, as in PQN (Gallici et al., 2024).
        activation: "relu", "tanh" or "leaky_relu" (slope 0.01).
    """

    hidden: tuple[int, ...] = (128, 128)
    layer_norm: bool = False
    activation: str = "relu"

    def __post_init__(self) -> None:
        """Refuse widths below 1 and activations that do not exist."""
        check_choice("activation", self.activation, ACTIVATIONS)
        for width in self.hidden:
            check_whole("hidden width", width)

    def stem(
        self, in_shape: tuple[int, ...], copies: int, rng: np.random.Generator, dtype: torch.dtype
    ) -> tuple[nn.Module | None, int]:
        """No stem: the flattened observation goes straight into the trunk."""
        return None, math.prod(in_shape)

    def trunk(self, fan_in: int, fan_out: int, copies: int, rng: np.random.Generator, dtype: torch.dtype) -> Trunk:
        """The dense layers of ``copies`` networks."""
        return Trunk(copies, (fan_in, *self.hidden, fan_out), self.layer_norm, self.activation, rng, dtype)


@dataclass(frozen=True)
class Conv:
    """Valid convolutions on ``[C, H, W]`` observations, then dense layers. The defaults are PQN's net for MinAtar.

    Args:
        channels: output channels of each convolution.
        kernel_sizes: side of each square kernel.
        strides: stride of each convolution.
        hidden: widths of the dense layers after them.
        layer_norm: layer normalisation before each activation.
        activation: as for `MLP`.
    """

    channels: tuple[int, ...] = (16,)
    kernel_sizes: tuple[int, ...] = (3,)
    strides: tuple[int, ...] = (1,)
    hidden: tuple[int, ...] = (128,)
    layer_norm: bool = True
    activation: str = "relu"

    def __post_init__(self) -> None:
        """Refuse lists of unequal length and values that make no network."""
        check_choice("activation", self.activation, ACTIVATIONS)
        if not len(self.channels) == len(self.kernel_sizes) == len(self.strides) >= 1:
            raise ValueError(
                "channels, kernel_sizes and strides need one entry per convolution, got "
                f"{len(self.channels)}, {len(self.kernel_sizes)} and {len(self.strides)}"
            )
        for width in (*self.channels, *self.kernel_sizes, *self.strides, *self.hidden):
            check_whole("channels, kernel sizes, strides and widths", width)

    def stem(
        self, in_shape: tuple[int, ...], copies: int, rng: np.random.Generator, dtype: torch.dtype
    ) -> tuple[nn.Module | None, int]:
        """The convolutions of ``copies`` networks, and the length of the vector each gives."""
        if len(in_shape) != 3:
            raise ValueError(f"a Conv body needs observations [channels, height, width], got shape {in_shape}")
        stem = GroupedConv(copies, in_shape, self, rng, dtype)
        return stem, stem.num_features

    def trunk(self, fan_in: int, fan_out: int, copies: int, rng: np.random.Generator, dtype: torch.dtype) -> Trunk:
        """The dense layers of ``copies`` networks."""
        return Trunk(copies, (fan_in, *self.hidden, fan_out), self.layer_norm, self.activation, rng, dtype)

"""Bodies of the network layouts: an MLP or a small convolutional net, with or without layer normalisation.

A body is described by a frozen dataclass (so that it can stand in a configuration) and built in two parts: a *stem*
that turns an observation into a vector (nothing for the MLP, convolutions for `Conv`), and a *trunk* of dense layers.
Both are built with a leading axis of ``copies`` networks that share nothing: `SeparateQ` asks for one copy per action
and still runs as one batched product per layer.

Weights start as U(±1/√fan_in), biases likewise, drawn from the caller's generator; with ``init="he"`` they start normal
with variance 2/fan_in below an activation and 1/fan_in in the last layer, biases at zero (He et al., 2015). With a
``sparsity`` that fraction of the inputs of every unit starts at zero and all biases do (Elsayed, Vasan & Mahmood 2024),
which keeps units apart where steps are large and there is no replay.

Frames come as ``[H, W, C]``, ``[C, H, W]`` or ``[H, W]``, or as a stack ``[K, …]`` of frames with three axes, and are
stored that way; `Conv` finds out, or is told, where the channels are, and turns them inside the network.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_choice, check_whole
from neuralq.q.frames import channels_first

__all__ = [
    "ACTIVATIONS",
    "MLP",
    "Conv",
    "GroupedConv",
    "GroupedLayerNorm",
    "GroupedLinear",
    "Trunk",
]

ACTIVATIONS = {"relu": torch.relu, "tanh": torch.tanh, "leaky_relu": nn.functional.leaky_relu, "sigmoid": torch.sigmoid}


_INITS = ("uniform", "he")
_SQUARABLE = 1e-15  # entries up to its inverse are squared and summed in float32 without a thought
_HE, _LAST = 2.0, 1.0  # times 1/fan_in: rectified units halve the variance, and above the last layer there are none


def _weight(
    rng: np.random.Generator, shape: tuple[int, ...], fan_in: int, dtype: torch.dtype, gain: float | None
) -> nn.Parameter:
    """Normal with variance gain / fan_in, or uniform where there is no gain."""
    bound = 1.0 / math.sqrt(fan_in)
    drawn = rng.uniform(-bound, bound, shape) if gain is None else rng.normal(0.0, math.sqrt(gain) * bound, shape)
    return nn.Parameter(torch.from_numpy(drawn).to(dtype))


def _weight_and_bias(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    last: int,
    bias_shape: tuple[int, ...],
    dtype: torch.dtype,
    sparsity: float,
    gain: float | None,
) -> tuple[nn.Parameter, nn.Parameter]:
    """Of a layer; axes 1 to ``last`` of the weight are a unit's inputs, ⌈sparsity · fan_in⌉ of which start at zero."""
    fan_in = math.prod(shape[1:last])
    weight = _weight(rng, shape, fan_in, dtype, gain)
    if sparsity > 0:  # drawn without replacement
        rows = weight.detach().numpy().reshape(shape[0], fan_in, *shape[last:])
        order = rng.random(rows.shape).argsort(axis=1)
        np.put_along_axis(rows, order.take(range(math.ceil(sparsity * fan_in)), axis=1), 0, axis=1)
    if sparsity > 0 or gain is not None:
        return weight, nn.Parameter(torch.zeros(bias_shape, dtype=dtype))
    return weight, _weight(rng, bias_shape, fan_in, dtype, None)


class GroupedLinear(nn.Module):
    """``copies`` dense layers side by side: ``[copies, B, in] -> [copies, B, out]`` in one batched product."""

    def __init__(
        self,
        copies: int,
        fan_in: int,
        fan_out: int,
        rng: np.random.Generator,
        dtype: torch.dtype,
        sparsity: float = 0.0,
        gain: float | None = None,
    ) -> None:
        super().__init__()
        shape, bias_shape = (copies, fan_in, fan_out), (copies, fan_out)
        self.weight, self.bias = _weight_and_bias(rng, shape, 2, bias_shape, dtype, sparsity, gain)

    def forward(self, x: Tensor) -> Tensor:
        """Apply copy c to ``x[c]``."""
        return torch.baddbmm(self.bias[:, None, :], x, self.weight)


class GroupedLayerNorm(nn.Module):
    """``copies`` layer normalisations (Ba et al., 2016) side by side over the last axes, each with its own scale.

    Args:
        copies: number of independent networks.
        shape: normalised shape of one copy.
        dtype: of scale and shift.
        affine: whether there are a scale and a shift to learn.
        first: whether what comes in is of any size. What float32 cannot square is scaled before: a variance that
            overflows would make a constant of it.
    """

    weight: nn.Parameter | None
    bias: nn.Parameter | None

    def __init__(
        self, copies: int, shape: tuple[int, ...], dtype: torch.dtype, affine: bool = True, *, first: bool = False
    ) -> None:
        super().__init__()
        self.shape, self.first = shape, first
        self.weight = nn.Parameter(torch.ones(copies, *shape, dtype=dtype)) if affine else None
        self.bias = nn.Parameter(torch.zeros(copies, *shape, dtype=dtype)) if affine else None

    def forward(self, x: Tensor) -> Tensor:
        """``[copies, B, *shape] -> [copies, B, *shape]``."""
        if self.first:  # the mean and spread of x / 1 are those of x, bit for bit
            axes = tuple(range(-len(self.shape), 0))
            x = x / (x.detach().abs().amax(axes, keepdim=True) * _SQUARABLE).clamp(min=1.0)
        hat = nn.functional.layer_norm(x, self.shape)
        return hat if self.weight is None or self.bias is None else hat * self.weight[:, None] + self.bias[:, None]


class Trunk(nn.Module):
    """Dense layers with an activation between them and none after the last: ``[copies, B, in] -> [copies, B, out]``."""

    def __init__(
        self, body: MLP | Conv, fan_in: int, fan_out: int, copies: int, rng: np.random.Generator, dtype: torch.dtype
    ) -> None:
        super().__init__()
        self.copies = copies
        self.sizes = sizes = (fan_in, *body.hidden, fan_out)
        self.layer_norm = body.layer_norm
        self.activation = body.activation
        layers: list[nn.Module] = []
        norms: list[nn.Module] = []
        for i, (below, above) in enumerate(pairwise(sizes)):
            gain = None if body.init == "uniform" else _HE if i < len(sizes) - 2 else _LAST
            layers.append(GroupedLinear(copies, below, above, rng, dtype, body.sparsity, gain))
            if body.layer_norm and i < len(sizes) - 2:
                norms.append(GroupedLayerNorm(copies, (above,), dtype, body.affine, first=i == 0))
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
    """``copies`` stacks of valid convolutions side by side, grouped: ``[B, *frame] -> [copies, B, d]``.

    The frame's axes are ``[C, H, W]``, ``[H, W, C]`` or ``[H, W]``, or a stack of the first two; ``in_shape`` is what
    the first convolution takes.
    """

    def __init__(
        self, copies: int, in_shape: tuple[int, ...], body: Conv, rng: np.random.Generator, dtype: torch.dtype
    ) -> None:
        super().__init__()
        self.copies = copies
        self.strides = body.strides
        self.activation = body.activation
        self.in_shape = channels_first(in_shape, body.channel_order)
        self.frame_shape = tuple(in_shape)
        # By the order given, not by the shape alone: all three sides may be equal.
        single = self.frame_shape[-3:]
        auto_last = len(single) == 3 and channels_first(single, body.channel_order) != single
        self.channels_last = body.channel_order == "last" or auto_last
        channels, height, width = self.in_shape
        gain = None if body.init == "uniform" else _HE
        weights: list[nn.Parameter] = []
        biases: list[nn.Parameter] = []
        norms: list[nn.Module] = []
        for fan_out, kernel, stride in zip(body.channels, body.kernel_sizes, body.strides, strict=True):
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
            if height < 1 or width < 1:
                raise ValueError(f"a kernel of {kernel} does not fit an observation of {in_shape}; use smaller kernels")
            shape = (copies * fan_out, channels, kernel, kernel)
            weight, bias = _weight_and_bias(rng, shape, 4, shape[:1], dtype, body.sparsity, gain)
            weights.append(weight)
            biases.append(bias)
            if body.layer_norm:
                norms.append(GroupedLayerNorm(copies, (fan_out, height, width), dtype, body.affine, first=not norms))
            channels = fan_out
        self.weights = nn.ParameterList(weights)
        self.biases = nn.ParameterList(biases)
        self.norms = nn.ModuleList(norms)
        self.num_features = channels * height * width

    def first(self, s: Tensor) -> Tensor:
        """Frames as the first convolution takes them, not copied but for stacks: ``[B, *frame] -> [B, C, H, W]``."""
        if len(self.frame_shape) == 2:
            return s[:, None]
        if len(self.frame_shape) == 4:
            return (s.permute(0, 1, 4, 2, 3) if self.channels_last else s).reshape(s.shape[0], *self.in_shape)
        return s.permute(0, 3, 1, 2) if self.channels_last else s

    def forward(self, s: Tensor) -> Tensor:
        """Convolve every copy's own stack over the same images."""
        x = self.first(s)
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


def _check_start(affine: bool, layer_norm: bool, sparsity: float) -> None:
    if not affine and not layer_norm:
        raise ValueError("affine=False says how layers are normalised, and layer_norm is False; leave affine out")
    if not 0 <= sparsity < 1:
        raise ValueError(f"sparsity must lie in [0, 1), got {sparsity}; 0.9 is usual for streaming learners")


@dataclass(frozen=True)
class MLP:
    """Dense layers on the flattened observation.

    Args:
        hidden: widths of the hidden layers; empty for a linear function with a bias.
        layer_norm: layer normalisation before each activation, as in PQN (Gallici et al., 2024).
        activation: "relu", "tanh", "leaky_relu" (slope 0.01) or "sigmoid".
        affine: whether layer normalisation learns a scale and a shift.
        sparsity: fraction of every unit's weights that start at zero, below 1.
        init: how the other weights start, "uniform" or "he".
    """

    hidden: tuple[int, ...] = (128, 128)
    layer_norm: bool = False
    activation: str = "relu"
    affine: bool = True
    sparsity: float = 0.0
    init: str = "uniform"

    def __post_init__(self) -> None:
        """Refuse widths below 1, activations that do not exist and layers without a weight."""
        check_choice("activation", self.activation, ACTIVATIONS)
        check_choice("init", self.init, _INITS)
        _check_start(self.affine, self.layer_norm, self.sparsity)
        for width in self.hidden:
            check_whole("hidden width", width)

    def stem(
        self, in_shape: tuple[int, ...], copies: int, rng: np.random.Generator, dtype: torch.dtype
    ) -> tuple[nn.Module | None, int]:
        """No stem: the flattened observation goes straight into the trunk."""
        return None, math.prod(in_shape)

    def trunk(self, fan_in: int, fan_out: int, copies: int, rng: np.random.Generator, dtype: torch.dtype) -> Trunk:
        """The dense layers of ``copies`` networks."""
        return Trunk(self, fan_in, fan_out, copies, rng, dtype)


@dataclass(frozen=True)
class Conv:
    """Valid convolutions on frames, then dense layers. The defaults have the sizes of PQN's net for MinAtar.

    Args:
        channels: output channels of each convolution.
        kernel_sizes: side of each square kernel.
        strides: stride of each convolution.
        hidden: widths of the dense layers after them.
        layer_norm: layer normalisation before each activation.
        activation: as for `MLP`.
        affine: as for `MLP`.
        sparsity: as for `MLP`.
        init: as for `MLP`.
        channel_order: whether frames are ``[C, H, W]`` ("first") or ``[H, W, C]`` ("last"); "auto" takes the smaller of
            the two end axes for the channels.
    """

    channels: tuple[int, ...] = (16,)
    kernel_sizes: tuple[int, ...] = (3,)
    strides: tuple[int, ...] = (1,)
    hidden: tuple[int, ...] = (128,)
    layer_norm: bool = True
    activation: str = "relu"
    affine: bool = True
    sparsity: float = 0.0
    init: str = "uniform"
    channel_order: str = "auto"

    def __post_init__(self) -> None:
        """Refuse lists of unequal length and values that make no network."""
        check_choice("activation", self.activation, ACTIVATIONS)
        check_choice("init", self.init, _INITS)
        check_choice("channel_order", self.channel_order, ("auto", "first", "last"))
        _check_start(self.affine, self.layer_norm, self.sparsity)
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
        stem = GroupedConv(copies, in_shape, self, rng, dtype)
        return stem, stem.num_features

    def trunk(self, fan_in: int, fan_out: int, copies: int, rng: np.random.Generator, dtype: torch.dtype) -> Trunk:
        """The dense layers of ``copies`` networks."""
        return Trunk(self, fan_in, fan_out, copies, rng, dtype)

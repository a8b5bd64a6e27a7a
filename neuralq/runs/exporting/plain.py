"""A representation as a chain of torch's own layers, which loads where there is no neuralq."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from neuralq.q import ActionInputQ, ActionOutputQ, LinearQ, MaskedQ, SeparateQ, TableQ
from neuralq.q.bodies import GroupedConv, Trunk
from neuralq.q.inputs import OneHot, Pixels
from neuralq.types import QFunction

__all__ = ["Plain", "plain_network"]

_ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh, "leaky_relu": nn.LeakyReLU, "sigmoid": nn.Sigmoid}


@dataclass(frozen=True)
class Plain:
    """Torch's own layers, and how they are made and asked in Python.

    Args:
        network: an `nn.Sequential`; where every action has a network of its own an `nn.ModuleList` of them.
        build: the expression that makes it.
        before: lines that turn observations ``x`` into what the network takes.
        values: the expression for the values of ``x``, ``[n, A]``.
    """

    network: nn.Module
    build: str
    before: tuple[str, ...]
    values: str


def plain_network(q: QFunction) -> Plain:
    """The same function in layers of torch.nn, with the same weights bit for bit; a mask is left to whoever asks.

    Raises:
        ValueError: for representations that are no chain of layers.

    Example:
        >>> from neuralq.q import MLP
        >>> plain_network(ActionOutputQ(4, 2, MLP((8,)))).build
        'nn.Sequential(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, 2))'
    """
    inner = q.inner if isinstance(q, MaskedQ) else q
    if isinstance(inner, TableQ):
        embedding = nn.Embedding(inner.num_states, inner.num_actions, dtype=inner.weight.dtype)
        _copy_into(embedding, inner.weight.detach(), None)
        return Plain(nn.Sequential(embedding), _build([embedding]), (), "network(x)")
    if isinstance(inner, LinearQ):
        flat = [one for one in _modules(inner.features) if isinstance(one, nn.Flatten)]
        layer = _linear(inner.weight.detach().T, None if inner.bias is None else inner.bias.detach())
        before = (*_features(inner.features), *(["x = x.flatten(1)"] if flat else []), "x = x.to(torch.float64)")
        return Plain(nn.Sequential(layer), _build([layer]), before, "network(x)")
    trunk = getattr(inner, "trunk", None)
    if not isinstance(inner, ActionOutputQ | SeparateQ | ActionInputQ) or not isinstance(trunk, Trunk):
        raise ValueError(
            f"{type(inner).__name__} is no chain of layers; --to onnx (to='onnx') takes it, and torch.export.export("
            "agent.q, ...)"
        )
    return _of_layout(inner, trunk)


def _of_layout(inner: ActionOutputQ | SeparateQ | ActionInputQ, trunk: Trunk) -> Plain:
    stem, rank, dtype = inner.input.stem, len(inner.input.input_shape), inner.input.dtype
    if stem is not None and not isinstance(stem, GroupedConv):
        raise ValueError("a network body of your own is code of yours already: its weights are agent.q.state_dict()")
    before = [*_features(inner.input.features), f"x = x.to({dtype})"]
    if isinstance(stem, GroupedConv):
        before += _frames_first(stem)
    chains = [[*_convolutions(stem, copy), *_dense(trunk, copy)] for copy in range(trunk.copies)]
    if stem is None and rank != 1:
        before.append("x = x.flatten(1)")
    if isinstance(inner, ActionInputQ):
        if stem is not None:
            raise ValueError("an action that joins after convolutions leaves no chain of layers; --to onnx takes it")
        many = inner.num_actions
        pairs = f"torch.cat([x.repeat_interleave({many}, 0), torch.eye({many}, dtype=x.dtype).repeat(len(x), 1)], 1)"
        values = f"network({pairs}).reshape(len(x), {many})"
        return Plain(nn.Sequential(*chains[0]), _build(chains[0]), tuple(before), values)
    if isinstance(inner, SeparateQ):
        networks = nn.ModuleList(nn.Sequential(*chain) for chain in chains)
        build = f"nn.ModuleList([{_build(chains[0])} for _ in range({len(chains)})])"
        return Plain(networks, build, tuple(before), "torch.cat([one(x) for one in network], 1)")
    return Plain(nn.Sequential(*chains[0]), _build(chains[0]), tuple(before), "network(x)")


def _modules(features: nn.Module | None) -> list[nn.Module]:
    return [] if features is None else list(features) if isinstance(features, nn.Sequential) else [features]


def _features(features: nn.Module | None) -> list[str]:
    """What is done to an observation before the first layer."""
    lines = []
    for one in _modules(features):
        if isinstance(one, OneHot):
            lines.append(f"x = nn.functional.one_hot(x, {one.num_categories}).to({one.dtype})")
        elif isinstance(one, Pixels):
            lines.append('x = (x.float() - torch.tensor(facts["pixel_origin"])) / torch.tensor(facts["pixel_divisor"])')
        elif not isinstance(one, nn.Flatten):
            raise ValueError(f"features of {type(one).__name__} are code of yours already; export to ONNX takes them")
    return lines


def _frames_first(stem: GroupedConv) -> list[str]:
    if len(stem.frame_shape) == 2:
        return ["x = x[:, None]"]
    if len(stem.frame_shape) == 4:
        turned = ".permute(0, 1, 4, 2, 3)" if stem.channels_last else ""
        return [f"x = x{turned}.reshape(len(x), *{stem.in_shape})"]
    return ["x = x.permute(0, 3, 1, 2)"] if stem.channels_last else []


def _convolutions(stem: GroupedConv | None, copy: int) -> list[nn.Module]:
    """The convolutions of one of the copies, flattened after the last."""
    layers: list[nn.Module] = []
    if stem is None:
        return layers
    for i, (weight, bias, stride) in enumerate(zip(stem.weights, stem.biases, stem.strides, strict=True)):
        fan_out = weight.shape[0] // stem.copies
        mine = slice(copy * fan_out, (copy + 1) * fan_out)
        layer = nn.Conv2d(weight.shape[1], fan_out, weight.shape[2], stride, dtype=weight.dtype)
        _copy_into(layer, weight.detach()[mine], bias.detach()[mine])
        layers += [layer, *([_norm(stem.norms[i], copy)] if len(stem.norms) else []), _ACTIVATIONS[stem.activation]()]
    return [*layers, nn.Flatten()]


def _dense(trunk: Trunk, copy: int) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for i, one in enumerate(trunk.layers):
        weights: Any = one
        layers.append(_linear(weights.weight.detach()[copy], weights.bias.detach()[copy]))
        if i < len(trunk.layers) - 1:
            layers += [_norm(trunk.norms[i], copy)] if len(trunk.norms) else []
            layers.append(_ACTIVATIONS[trunk.activation]())
    return layers


def _linear(weight: Tensor, bias: Tensor | None) -> nn.Linear:
    """A dense layer with weights ``[in, out]``, as ours lie."""
    fan_in, fan_out = weight.shape
    layer = nn.Linear(fan_in, fan_out, bias=bias is not None, dtype=weight.dtype)
    _copy_into(layer, weight.T, bias)
    return layer


def _norm(norm: Any, copy: int) -> nn.LayerNorm:
    layer = nn.LayerNorm(norm.shape, elementwise_affine=norm.weight is not None)
    if norm.weight is not None:
        layer = layer.to(norm.weight.dtype)
        _copy_into(layer, norm.weight.detach()[copy], norm.bias.detach()[copy])
    return layer


def _copy_into(layer: Any, weight: Tensor, bias: Tensor | None) -> None:
    layer.weight.data.copy_(weight)
    if bias is not None:
        layer.bias.data.copy_(bias)


def _build(layers: list[nn.Module]) -> str:
    return f"nn.Sequential({', '.join(map(_made, layers))})"


def _made(layer: Any) -> str:
    """The expression that makes a layer of this size."""
    name = f"nn.{type(layer).__name__}"
    weight = getattr(layer, "weight", None)
    kind = "" if weight is None or weight.dtype.itemsize == 4 else f", dtype={weight.dtype}"
    if isinstance(layer, nn.Linear):
        bias = ", bias=False" if getattr(layer, "bias", None) is None else ""
        return f"{name}({layer.in_features}, {layer.out_features}{bias}{kind})"
    if isinstance(layer, nn.Conv2d):
        size, stride = layer.kernel_size[0], layer.stride[0]
        return f"{name}({layer.in_channels}, {layer.out_channels}, {size}, {stride}{kind})"
    if isinstance(layer, nn.Embedding):
        return f"{name}({layer.num_embeddings}, {layer.embedding_dim}{kind})"
    if isinstance(layer, nn.LayerNorm):
        affine = "" if weight is not None else ", elementwise_affine=False"
        return f"{name}({tuple(layer.normalized_shape)}{affine}{kind})"
    return f"{name}()"

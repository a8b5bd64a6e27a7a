"""What is measured of a network by itself, beside fresh ones of its architecture: silent units, rank, one step."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.doctor.exam.case import CannotMeasure
from neuralq.q.bodies import ACTIVATIONS, GroupedConv, GroupedLinear, Trunk
from neuralq.types import Transition

__all__ = ["NUM_FRESH", "dormant_share", "fan_in_of", "fresh", "hidden", "lag_of", "moved", "rank_of"]

NUM_FRESH = 8
"""Fresh networks that a trained one is set beside."""
Outputs = Callable[[nn.Module, Tensor], Tensor]
"""The network and what it takes, to action values ``[N, A]``."""
_ACTIVATIONS = (nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU, nn.GELU, nn.SiLU, nn.Sigmoid, nn.Mish)


def fresh(network: nn.Module, rng: np.random.Generator) -> nn.Module:
    """A copy with weights as before training: each layer's uniform within ±1/√fan-in, PyTorch's default.

    Raises:
        CannotMeasure: a layer with weights of its own whose start is not known.
    """
    made = copy.deepcopy(network)
    with torch.no_grad():
        for layer in made.modules():
            own = dict(layer.named_parameters(recurse=False))
            if not own or isinstance(layer, nn.LayerNorm) or "LayerNorm" in type(layer).__name__:
                continue
            fan_in = fan_in_of(layer)
            if fan_in is None:
                raise CannotMeasure(f"what a fresh {type(layer).__name__} starts from is not known")
            for p in own.values():
                drawn = rng.uniform(-1, 1, tuple(p.shape)) / math.sqrt(fan_in)
                p.copy_(torch.as_tensor(drawn, dtype=p.dtype))
    return made


def fan_in_of(layer: nn.Module) -> int | None:
    """Inputs of each unit of a layer; None of a layer without weights, or of another kind."""
    weight = getattr(layer, "weight", None)
    if isinstance(layer, GroupedLinear):
        return int(layer.weight.shape[1])
    if isinstance(layer, nn.Linear | nn.Conv2d | nn.Conv1d | GroupedConv) and isinstance(weight, Tensor):
        return int(math.prod(weight.shape[1:]))
    return None


def hidden(network: nn.Module, outputs: Outputs, x: Tensor) -> list[Tensor]:
    """What each layer of hidden units gives, ``[N, units]``, the last one nearest to the output.

    Raises:
        CannotMeasure: the network has no activations that are modules.
    """
    found: list[Tensor] = []

    def keep(out: Tensor) -> None:
        out = out[0] if out.dim() == 3 and out.shape[0] == 1 else out
        if out.dim() == 4:  # a unit of a convolution is a channel
            out = out.detach().movedim(1, -1)
            out = out.reshape(len(x), -1, out.shape[-1]).abs().mean(1)
        found.append(out.detach().reshape(len(x), -1))

    def after(_: nn.Module, __: Any, out: Tensor) -> None:
        keep(out)

    handles = []
    for module in network.modules():
        if isinstance(module, _ACTIVATIONS):
            handles.append(module.register_forward_hook(after))
        elif isinstance(module, Trunk):
            handles += _hook_trunk(module, keep)
    if not handles:
        raise CannotMeasure("the network has no activations that are modules (nn.ReLU(), …)")
    try:
        with torch.no_grad():
            outputs(network, x)
    finally:
        for handle in handles:
            handle.remove()
    if not found:
        raise CannotMeasure("the network has no hidden units")
    return found


def _hook_trunk(trunk: Trunk, keep: Any) -> list[Any]:
    act = ACTIVATIONS[trunk.activation]
    before = trunk.norms if trunk.layer_norm else list(trunk.layers)[:-1]
    if trunk.copies > 1:
        return [m.register_forward_hook(lambda _, __, out: keep(act(out).movedim(0, 1).flatten(1))) for m in before]
    return [module.register_forward_hook(lambda _, __, out: keep(act(out))) for module in before]


def dormant_share(layers: Sequence[Tensor]) -> float:
    """The share of units with s_i = E|h_i| / mean_k E|h_k| ≤ 0.025, over all layers (Sokar et al. 2023).

    Args:
        layers: `hidden`'s, ``[N, units]`` each.

    Example:
        >>> dormant_share([torch.tensor([[1.0, 0.0, -2.0, 0.001]])])
        0.5
    """
    silent = total = 0
    for h in layers:
        activity = h.double().abs().mean(0)
        scores = activity / activity.mean().clamp(min=1e-30)
        silent += int((scores <= 0.025).sum())
        total += len(scores)
    return silent / total


def rank_of(h: Tensor) -> int:
    """srank, the number of singular values of ``h``, ``[N, units]``, that make 99 % of their sum (Kumar et al. 2021).

    Example:
        >>> rank_of(torch.tensor([[1.0, 2.0], [2.0, 4.0]])), rank_of(torch.eye(2))
        (1, 2)
    """
    sizes = torch.linalg.svdvals(h.double())
    share = torch.cumsum(sizes, 0) / sizes.sum().clamp(min=1e-300)
    return int((share < 0.99).sum()) + 1


def moved(network: nn.Module, outputs: Outputs, step: Transition, rate: float, x: Tensor) -> tuple[float, float]:
    """Churn: what one Adam step on the one-step errors of a batch does to other states (Schaul et al. 2022).

    Args:
        network: it stays as it is.
        outputs: the network and what it takes, to action values ``[N, A]``.
        step: the batch, ``[B]``.
        rate: Adam's step size.
        x: the other states, as the network takes them.

    Returns:
        The share whose greedy action changes, and the mean |ΔQ|.
    """
    learns = copy.deepcopy(network)
    with torch.no_grad():
        before = outputs(learns, x)
        target = step.r_t + step.discount_t * outputs(learns, step.s_t).amax(1)
    chosen = outputs(learns, step.s_tm1).gather(1, step.a_tm1[:, None])[:, 0]
    weights = [p for p in learns.parameters() if p.requires_grad]
    loss = nn.functional.mse_loss(chosen, target.to(chosen.dtype))
    with torch.no_grad():
        for p, g in zip(weights, torch.autograd.grad(loss, weights, allow_unused=True), strict=True):
            if g is not None:  # Adam's first step, written out: to make torch.optim.Adam takes a second
                p.sub_(rate * g / (g.abs() + 1e-8))
        after = outputs(learns, x)
    change = (before - after)[torch.isfinite(before)]  # illegal actions have no value
    return float((before.argmax(1) != after.argmax(1)).float().mean()), float(change.abs().mean())


def lag_of(q: Tensor, late: Tensor) -> float:
    """Mean |Q − Q⁻| over mean |Q|, of the online and the target network's values of the same states.

    Example:
        >>> lag_of(torch.tensor([[2.0, -4.0]]), torch.tensor([[1.0, -4.0]]))
        0.16666666666666666
    """
    known = torch.isfinite(q)
    a, b = q[known].double(), late[known].double()
    return float((a - b).abs().mean() / a.abs().mean().clamp(min=1e-12))

"""Networks rebuilt from the names and shapes of their weights: every key and every shape has to be used."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from neuralq.doctor.weights import CannotLoad

__all__ = ["ACTIVATIONS", "FromFrames", "fill", "stack", "under"]

ACTIVATIONS: dict[str, type[nn.Module]] = {
    kind.__name__: kind for kind in (nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU, nn.GELU, nn.SiLU, nn.Sigmoid, nn.Mish)
}
_STRIDES = {8: 4, 4: 2, 3: 1}  # of the three convolutions of Mnih et al. (2015), by the size of their kernels
_WAY_OUT = "name the class that was saved: --net your_module:YourNetwork"


class FromFrames(nn.Module):
    """Convolutions, dense layers over what they give, and a head; frames come as bytes and are divided by 255."""

    def __init__(self, frames: nn.Sequential, dense: nn.Sequential, head: nn.Sequential, divisor: float) -> None:
        super().__init__()
        self.frames, self.dense, self.head, self.divisor = frames, dense, head, divisor

    def forward(self, x: Tensor) -> Tensor:
        """``[N, C, H, W] -> [N, A]``."""
        out: Tensor = self.head(self.dense(self.frames(x / self.divisor).flatten(1)))
        return out


def under(state: Mapping[Any, Any], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with ``prefix``, without it.

    Example:
        >>> list(under({"q.0.weight": torch.zeros(1), "lr": 0.1}, "q."))
        ['0.weight']
    """
    return {
        key.removeprefix(prefix): value
        for key, value in state.items()
        if isinstance(key, str) and key.startswith(prefix) and isinstance(value, Tensor)
    }


def stack(state: Mapping[str, Tensor], what: str, activation: type[nn.Module] = nn.ReLU) -> nn.Sequential:
    """The `nn.Sequential` whose layers have these weights: ``0.weight``, ``0.bias``, ``2.weight``.

    A number without weights is an activation; the last one before dense layers that follow convolutions flattens.

    Args:
        state: its weights.
        what: how errors call it.
        activation: of the numbers without weights.

    Raises:
        CannotLoad: a key that belongs to no such layer, or a shape that does not follow from the layer before.

    Example:
        >>> stack({"0.weight": torch.zeros(3, 4), "0.bias": torch.zeros(3), "2.weight": torch.zeros(2, 3)}, "x")
        Sequential(
          (0): Linear(in_features=4, out_features=3, bias=True)
          (1): ReLU()
          (2): Linear(in_features=3, out_features=2, bias=False)
        )
    """
    numbers: dict[int, Tensor] = {}
    for key, value in state.items():
        match = re.fullmatch(r"(\d{1,3})\.(weight|bias)", key)
        if match is None:
            raise CannotLoad(
                f"{what} has a key {key!r}, which is no layer of a plain stack (0.weight, 0.bias, …); {_WAY_OUT}"
            )
        if match[2] == "weight":
            numbers[int(match[1])] = value
    if not numbers:
        raise CannotLoad(f"{what} has no layers (0.weight, 0.bias, …); {_WAY_OUT}")
    layers: list[nn.Module] = []
    before: Tensor | None = None
    for number in range(max(numbers) + 1):
        weight = numbers.get(number)
        if weight is None:
            layers.append(activation())
            continue
        if weight.dim() == 2 and before is not None and before.dim() == 4:
            layers[-1] = nn.Flatten()
        layers.append(_layer(weight, f"{number}.bias" in state, f"{what}: {number}.weight", before))
        before = weight if weight.dim() > 1 else before
    made: nn.Sequential = fill(nn.Sequential(*layers), state, what)
    return made


def _layer(weight: Tensor, bias: bool, what: str, before: Tensor | None) -> nn.Module:
    shape = tuple(weight.shape)
    if weight.dim() == 1 and before is not None and before.dim() == 2 and shape[0] == before.shape[0]:
        return nn.LayerNorm(shape[0], bias=bias)
    if before is not None and weight.dim() == 2 and before.dim() == 2 and shape[1] != before.shape[0]:
        raise CannotLoad(f"{what} takes {shape[1]} numbers, and the layer before gives {before.shape[0]}; {_WAY_OUT}")
    if weight.dim() == 2:
        return nn.Linear(shape[1], shape[0], bias=bias)
    if weight.dim() == 4 and shape[2] == shape[3] and shape[2] in _STRIDES:
        return nn.Conv2d(shape[1], shape[0], shape[2], _STRIDES[shape[2]], bias=bias)
    raise CannotLoad(f"{what} has the shape {list(shape)}, of which the layer cannot be told; {_WAY_OUT}")


def fill(module: nn.Module, state: Mapping[str, Tensor], what: str) -> Any:
    """The module with these weights in it.

    Raises:
        CannotLoad: a key or a shape that does not fit; it is named.
    """
    own = module.state_dict()
    for key in [*own, *state]:
        if key not in state:
            raise CannotLoad(f"{what} lacks the key {key!r} of {type(module).__name__}; {_WAY_OUT}")
        if key not in own:
            raise CannotLoad(f"{what} has the key {key!r}, which {type(module).__name__} lacks; {_WAY_OUT}")
        if state[key].shape != own[key].shape:
            got, wanted = list(state[key].shape), list(own[key].shape)
            raise CannotLoad(
                f"{what}: {key!r} has the shape {got}, and {type(module).__name__} has {wanted}; {_WAY_OUT}"
            )
    with torch.no_grad():
        module.load_state_dict({key: value.detach().clone() for key, value in state.items()})
    return module.eval()

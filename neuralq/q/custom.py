"""A network body of the user's own: any plain `torch.nn.Module` from observations to features, under every layout.

The module turns observations ``[B, *obs]`` (float32; pixels divided by 255, state indices one-hot) into ``[B, d]``.
What the layouts put after it are dense layers of theirs: one output for each action, or, after ``hidden`` layers, the
value of an action that joined the features. It is named by where it can be imported from, so that the configuration
can be stored and a run resumed, played and exported by another process.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_choice, check_whole
from neuralq.q.bodies import ACTIVATIONS, MLP, Conv, Trunk
from neuralq.q.recurrent import GRU

__all__ = ["BODIES", "Body", "Custom", "CustomStem", "Example"]


@dataclass(frozen=True)
class Custom:
    """A module of the user's own, and the dense layers after it.

    Args:
        module: "package.module:Class"; the class is called with the shape of an observation and ``settings``.
        settings: keyword arguments of the class; plain values, which a configuration can hold.
        hidden: widths of dense layers between the features and the values.
        layer_norm: layer normalisation in those layers.
        activation: of those layers: "relu", "tanh", "leaky_relu" or "sigmoid".

    Raises:
        ValueError: if ``module`` names no class, or is no name.

    Example:
        >>> from neuralq.q import ActionOutputQ
        >>> body = Custom("neuralq.q.custom:Example", {"width": 5}, hidden=(8,))
        >>> ActionOutputQ((4,), 2, body, rng=0).all(torch.zeros(3, 4)).shape
        torch.Size([3, 2])
    """

    module: str
    settings: dict[str, Any] = field(default_factory=dict)
    hidden: tuple[int, ...] = ()
    layer_norm: bool = False
    activation: str = "relu"

    def __post_init__(self) -> None:
        """Refuse what is no name and layers without a width."""
        place, _, name = self.module.partition(":")
        if not all(part.isidentifier() for part in (*place.split("."), *name.split("."))):
            raise ValueError(f"a body of your own is named 'package.module:Class', got {self.module!r}")
        check_choice("activation", self.activation, ACTIVATIONS)
        for width in self.hidden:
            check_whole("hidden width", width)
        if not isinstance(self.settings, Mapping):
            raise ValueError(f"settings of a body must be a mapping, got {self.settings!r}")

    @property
    def affine(self) -> bool:
        """Layer normalisation has a scale and a shift."""
        return True

    def stem(
        self, in_shape: tuple[int, ...], copies: int, rng: np.random.Generator, dtype: torch.dtype
    ) -> tuple[nn.Module | None, int]:
        """``copies`` modules that share nothing, and the length of the vector each gives."""
        stem = CustomStem(self, in_shape, copies, rng, dtype)
        return stem, stem.num_features

    def trunk(self, fan_in: int, fan_out: int, copies: int, rng: np.random.Generator, dtype: torch.dtype) -> Trunk:
        """The dense layers of ``copies`` networks."""
        return MLP(self.hidden, self.layer_norm, self.activation).trunk(fan_in, fan_out, copies, rng, dtype)


Body = MLP | Conv | Custom | GRU
BODIES: dict[str, Any] = {kind.__name__: kind for kind in get_args(Body)}
"""By the name that configurations give them; a body of another kind is a class and its place in `Body`."""


class CustomStem(nn.Module):
    """Copies of a user's module side by side: ``[B, *obs] -> [copies, B, d]``.

    Their weights are drawn under a seed from ``rng``; PyTorch's own stream of random numbers stays where it was.

    Args:
        body: names the module.
        in_shape: of one observation.
        copies: number of independent networks.
        rng: draws the seed.
        dtype: of the parameters.

    Raises:
        ValueError: if the module cannot be made, or what it makes of a batch is not one vector for each observation,
            the same at every call.
    """

    def __init__(
        self, body: Custom, in_shape: tuple[int, ...], copies: int, rng: np.random.Generator, dtype: torch.dtype
    ) -> None:
        super().__init__()
        kind = _imported(body.module)
        with torch.random.fork_rng(devices=[]):
            # Modules draw from the one generator that PyTorch has for them: lent for a moment, under a seed of ours.
            torch.random.set_rng_state(torch.Generator().manual_seed(int(rng.integers(2**63))).get_state())
            try:
                made = [kind(in_shape, **body.settings) for _ in range(copies)]
            except Exception as error:  # the user's own code ran
                raise ValueError(
                    f"cannot make {body.module}{(in_shape, body.settings)}: {type(error).__name__}: {error}; it is "
                    "called with the shape of an observation and the settings"
                ) from error
            self.copies = nn.ModuleList(module.to(dtype) for module in made)
            self.num_features = _num_features(body.module, made[0], in_shape, dtype)

    def forward(self, s: Tensor) -> Tensor:
        """Features of every copy."""
        return torch.stack([copy(s) for copy in self.copies])


def _imported(module: str) -> type[nn.Module]:
    place, _, name = module.partition(":")
    try:
        found: Any = importlib.import_module(place)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"cannot import the body {module!r}: {error}; it must lie in a module that Python finds; the commands "
            "look in the present folder, too"
        ) from error
    if not (isinstance(found, type) and issubclass(found, nn.Module)):
        raise ValueError(f"the body {module!r} must be a class of torch.nn.Module, got {found!r}")
    return found


def _num_features(name: str, module: nn.Module, in_shape: tuple[int, ...], dtype: torch.dtype) -> int:
    """Length of the features; two observations are enough to see what goes wrong."""
    before = [buffer.clone() for buffer in module.buffers()]
    probe = torch.linspace(0, 1, 2 * int(np.prod(in_shape)), dtype=dtype).reshape(2, *in_shape)
    with torch.no_grad():
        try:
            first, second = module(probe), module(probe)
        except Exception as error:
            raise ValueError(f"{name} fails on observations of shape {(2, *in_shape)}: {error}") from error
    if not isinstance(first, Tensor) or first.dim() != 2 or len(first) != 2 or first.dtype != dtype:
        got = f"{first.dtype} of shape {tuple(first.shape)}" if isinstance(first, Tensor) else type(first).__name__
        raise ValueError(
            f"{name} must make [B, d] {dtype} of [B, {', '.join(map(str, in_shape))}], got {got} for B = 2"
        )
    kept = all(torch.equal(old, new) for old, new in zip(before, module.buffers(), strict=True))
    if not kept or not torch.equal(first, second):
        raise ValueError(
            f"{name} makes something else of the same observations when called again (dropout, batch normalisation?); "
            "values must be a function of the observation and the parameters: use layer normalisation, or none"
        )
    return int(first.shape[1])


class Example(nn.Module):
    """What a body of one's own looks like: a layer of ReLU units over the flattened observation.

    Args:
        shape: of one observation.
        width: number of units.

    Example:
        >>> Example((2, 3), width=4)(torch.zeros(7, 2, 3)).shape
        torch.Size([7, 4])
    """

    def __init__(self, shape: tuple[int, ...], width: int = 64) -> None:
        super().__init__()
        self.layer = nn.Linear(int(np.prod(shape)), width)

    def forward(self, s: Tensor) -> Tensor:
        """``[B, *obs] -> [B, width]``."""
        return torch.relu(self.layer(s.flatten(1)))

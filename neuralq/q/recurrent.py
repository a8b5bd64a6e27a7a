"""A memory as part of the state: what a network made of the steps before, in one vector with the observation.

What cannot be seen has to be remembered. A body with a memory, `GRU`, makes h' of an observation and the memory h from
before it, and the layers after it see h' alone. `RecurrentQ` takes ``[d + M]``: the flattened observation, then h, 0 at
the start of an episode. So a replay buffer stores the memory with the observation it belongs to, and everything that
knows observations only needs to know nothing more. What memories do to each other over time is `RecurrentQ.recalled`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_choice, check_whole
from neuralq.q.bodies import ACTIVATIONS, MLP, GroupedLinear, Trunk
from neuralq.q.masked import MaskedQ
from neuralq.types import QFunction

__all__ = ["GRU", "GRUStem", "RecurrentQ", "recurrent_part"]


@dataclass(frozen=True)
class GRU:
    """Gated recurrent units between dense layers; observations are flattened.

    Args:
        units: numbers that are remembered, H; each of separate networks has as many.
        before: widths of dense layers between the observation and the units.
        hidden: widths of dense layers between the units and the values.
        layer_norm: layer normalisation in those layers.
        activation: of those layers: "relu", "tanh" or "leaky_relu".

    Source: Cho et al. 2014, with the reset gate after the product as in PyTorch's ``nn.GRUCell``.

    Example:
        >>> from neuralq.q import ActionOutputQ
        >>> q = RecurrentQ(ActionOutputQ(4 + 8, 2, GRU(units=8)), observation_shape=(4,))
        >>> q.all(torch.zeros(3, 4 + 8)).shape, q.next_memory(torch.zeros(3, 4 + 8)).shape
        (torch.Size([3, 2]), torch.Size([3, 8]))
    """

    units: int = 64
    before: tuple[int, ...] = ()
    hidden: tuple[int, ...] = (64,)
    layer_norm: bool = False
    activation: str = "relu"

    def __post_init__(self) -> None:
        """Refuse widths below 1 and activations that do not exist."""
        check_whole("units", self.units)
        check_choice("activation", self.activation, ACTIVATIONS)
        for width in (*self.before, *self.hidden):
            check_whole("widths", width)

    @property
    def affine(self) -> bool:
        """Layer normalisation has a scale and a shift."""
        return True

    def stem(
        self, in_shape: tuple[int, ...], copies: int, rng: np.random.Generator, dtype: torch.dtype
    ) -> tuple[nn.Module | None, int]:
        """The layers up to the units of ``copies`` networks, whose memories end the input, and H."""
        return GRUStem(self, in_shape, copies, rng, dtype), self.units

    def trunk(self, fan_in: int, fan_out: int, copies: int, rng: np.random.Generator, dtype: torch.dtype) -> Trunk:
        """The dense layers after the units of ``copies`` networks."""
        return MLP(self.hidden, self.layer_norm, self.activation).trunk(fan_in, fan_out, copies, rng, dtype)


class GRUStem(nn.Module):
    """Copies of gated recurrent units side by side: ``[B, d + copies·H] -> [copies, B, H]``, the next memories.

    Args:
        body: says how many units, and what is before them.
        in_shape: ``(d + copies·H,)``.
        copies: number of independent networks.
        rng: draws the weights.
        dtype: of the parameters.

    Raises:
        ValueError: if the input leaves nothing for the observation.
    """

    def __init__(
        self, body: GRU, in_shape: tuple[int, ...], copies: int, rng: np.random.Generator, dtype: torch.dtype
    ) -> None:
        super().__init__()
        self.copies, self.units = copies, body.units
        self.memory_size = copies * body.units
        self.width = math.prod(in_shape) - self.memory_size
        if self.width < 1 or len(in_shape) != 1:
            raise ValueError(
                f"a GRU body takes vectors of an observation and its memory of {self.memory_size}, got {in_shape}; add "
                "the memory's size to input_shape, and put RecurrentQ around the network"
            )
        *below, last = (self.width, *body.before)
        self.before = None
        if below:
            self.before = MLP(tuple(body.before[:-1]), body.layer_norm, body.activation).trunk(
                self.width, last, copies, rng, dtype
            )
        self.activation = body.activation
        self.input_gates = GroupedLinear(copies, last, 3 * body.units, rng, dtype)
        self.memory_gates = GroupedLinear(copies, body.units, 3 * body.units, rng, dtype)

    def driven(self, x: Tensor) -> Tensor:
        """What an observation alone says to the gates: ``[B, d] -> [copies, B, 3·H]``."""
        y = x.expand(self.copies, -1, -1)
        if self.before is not None:
            y = ACTIVATIONS[self.activation](self.before(y))
        driven: Tensor = self.input_gates(y)
        return driven

    def step(self, driven: Tensor, memory: Tensor) -> Tensor:
        """The next memory: ``[copies, B, 3·H], [copies, B, H] -> [copies, B, H]``."""
        recurrent = self.memory_gates(memory)
        h = self.units
        reset, update = torch.split(torch.sigmoid(driven[..., : 2 * h] + recurrent[..., : 2 * h]), h, -1)
        new = torch.tanh(torch.addcmul(driven[..., 2 * h :], reset, recurrent[..., 2 * h :]))
        return torch.lerp(new, memory, update)

    def split(self, memory: Tensor) -> Tensor:
        """``[B, copies·H] -> [copies, B, H]``."""
        return memory.reshape(memory.shape[0], self.copies, self.units).transpose(0, 1)

    def joined(self, memory: Tensor) -> Tensor:
        """``[copies, B, H] -> [B, copies·H]``."""
        return memory.transpose(0, 1).reshape(memory.shape[1], self.memory_size)

    def forward(self, rows: Tensor) -> Tensor:
        """One step of every copy."""
        return self.step(self.driven(rows[:, : self.width]), self.split(rows[:, self.width :]))


class RecurrentQ(nn.Module):
    """A Q-function over observations that carry the memory from before them.

    Args:
        inner: a network layout with a `GRU` body over vectors ``[f + M]``, f features and a memory of M numbers.
        observation_shape: shape of an observation; ``()`` for a state index.
        features: module without parameters that makes the f features of an observation (one-hot, pixel scaling).
        dtype: of observations where features ask for one; they come as the memory does.

    Raises:
        ValueError: if the network has no memory.

    Example:
        >>> from neuralq.q import ActionOutputQ
        >>> from neuralq.q.inputs import OneHot
        >>> q = RecurrentQ(ActionOutputQ(3 + 4, 2, GRU(units=4)), (), OneHot(3), torch.int64)
        >>> q.all(torch.tensor([[2.0, 0.0, 0.0, 0.0, 0.0]])).shape
        torch.Size([1, 2])
    """

    def __init__(
        self,
        inner: QFunction,
        observation_shape: tuple[int, ...],
        features: nn.Module | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        stem = getattr(getattr(inner, "input", None), "stem", None)
        if not isinstance(stem, GRUStem):
            raise ValueError(f"{type(inner).__name__} remembers nothing; give it the body GRU(units=...)")
        self.inner = inner
        self.num_actions = inner.num_actions
        self.observation_shape = tuple(observation_shape)
        self.width = math.prod(self.observation_shape)
        self.features, self.dtype = features, dtype
        self.memory_size = stem.memory_size

    @property
    def stem(self) -> GRUStem:
        """What makes the next memory of an observation and the one before."""
        stem: GRUStem = self.inner.input.stem  # type: ignore[attr-defined]
        return stem

    def _featured(self, s: Tensor) -> Tensor:
        """Features of the observations in ``[*n, d + M …]``: ``[*n, f]``."""
        x = s[..., : self.width].reshape((*s.shape[:-1], *self.observation_shape))
        x = x if self.dtype is None else x.to(self.dtype)
        x = x if self.features is None else self.features(x)
        return x.reshape((*s.shape[:-1], -1)).to(self.inner.input.dtype)  # type: ignore[attr-defined]

    def _memory(self, s: Tensor) -> Tensor:
        return s[..., self.width : self.width + self.memory_size].to(self.inner.input.dtype)  # type: ignore[attr-defined]

    def _vectors(self, s: Tensor) -> Tensor:
        if s.shape[-1:] != (self.width + self.memory_size,):
            raise ValueError(
                f"an observation with its memory has {self.width} entries and {self.memory_size} for the memory, got "
                f"shape {tuple(s.shape)}; an episode begins with a memory of zeros"
            )
        return torch.cat([self._featured(s), self._memory(s)], -1)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values: ``[*n, d + M] -> [*n, A]``."""
        return self.inner.all(self._vectors(s))

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Values of the given actions: ``([*n, d + M], [*n] int64) -> [*n]``."""
        return self.inner.at(self._vectors(s), a)

    def with_memory(self, s: Tensor, memory: Tensor) -> Tensor:
        """The observations with another memory, and what follows it: ``[*n, d + M …], [*n, M] -> [*n, d + M …]``."""
        end = self.width + self.memory_size
        return torch.cat([s[..., : self.width].to(memory.dtype), memory, s[..., end:].to(memory.dtype)], -1)

    def next_memory(self, s: Tensor) -> Tensor:
        """What is remembered after the observations: ``[B, d + M …] -> [B, M]``; what follows, a mask, is not read."""
        stem = self.stem
        return stem.joined(stem.step(stem.driven(self._featured(s)), stem.split(self._memory(s))))

    def recalled(self, s: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
        """A sequence with the memories that the present parameters have along it, as one differentiable function.

        The first row of every stream keeps the memory that it was stored with, and so does a row before which the
        stream broke: what was stored there is the memory of an episode's start.

        Args:
            s: observations with memories, and masks if any, ``[T, B, d + M …]``.
            last: where a stream breaks after a row, ``[T, B]`` bool.

        Returns:
            The same with other memories ``[T, B, d + M …]``, and the memories after each row ``[T, B, M]``.

        Source: Hausknecht & Stone 2015; stored states Kapturowski et al. 2019.
        """
        stem, stored = self.stem, self._memory(s)
        driven = stem.driven(self._featured(s).flatten(0, 1)).reshape(stem.copies, *s.shape[:2], -1)
        memory, before, after = stem.split(stored[0]), [], []
        for t in range(s.shape[0]):
            if t > 0:
                memory = torch.where(last[t - 1, :, None], stem.split(stored[t]), memory)
            before.append(memory)
            memory = stem.step(driven[:, t], memory)
            after.append(memory)
        rows, afterwards = (torch.stack([stem.joined(m) for m in some]) for some in (before, after))
        return self.with_memory(s, rows), afterwards


def recurrent_part(q: object) -> RecurrentQ | None:
    """The Q-function in ``q`` that has a memory, if one has.

    Example:
        >>> from neuralq.q import ActionOutputQ
        >>> recurrent_part(ActionOutputQ(4, 2)) is None
        True
    """
    inner = q.inner if isinstance(q, MaskedQ) else q
    return inner if isinstance(inner, RecurrentQ) else None

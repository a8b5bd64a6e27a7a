"""A trained agent as one torch module, from what the environment hands out to action values and a greedy action.

What `neuralq.runs.stream.encoding` does with arrays is done here with tensors, in operations that ONNX knows: an input
for each part of an observation, in the dtype of its space, and one for the action mask where there is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.q.recurrent import recurrent_part
from neuralq.runs.agent import Agent
from neuralq.runs.stream.encoding import Part
from neuralq.runs.stream.normalisation import CLIP
from neuralq.types import Array

__all__ = ["ExportedNetwork", "input_names", "output_names", "raw_inputs"]


def input_names(agent: Agent) -> list[str]:
    """Of the parts of an observation, and of the mask: "observation", or the keys by which a part is found.

    Example:
        >>> from gymnasium import spaces
        >>> from neuralq.runs.stream.encoding import encoder_for
        >>> space = spaces.Dict({"arm": spaces.Tuple([spaces.Box(-1, 1, (2,))]), "gear": spaces.Discrete(3)})
        >>> spec = type("Spec", (), {"masked": True, "memory_size": 0})
        >>> input_names(Agent(None, encoder_for(space), spec))
        ['arm.0', 'gear', 'action_mask']
    """
    names = [".".join(map(str, part.keys)) or "observation" for part in agent.encoder.parts]
    if agent.spec.masked:
        names.append("action_mask" if "action_mask" not in names else "legal_actions")
    if agent.spec.memory_size:
        names.append("memory" if "memory" not in names else "remembered")
    return names


def output_names(agent: Agent) -> list[str]:
    """Values and the greedy action, and what an agent with a memory remembers next."""
    return ["values", "action", *(["next_memory"] if agent.spec.memory_size else [])]


def raw_inputs(agent: Agent, observations: Sequence[Any], masks: Sequence[Any], memories: Array) -> list[Array]:
    """Observations as an environment gave them, one array ``[n, …]`` for each of `input_names`."""
    inputs = [
        np.stack([np.asarray(part.find(one) if part.keys else one) for one in observations]).astype(part.dtype)
        for part in agent.encoder.parts
    ]
    if agent.spec.masked:
        everything = np.ones(agent.spec.num_actions)
        inputs.append(np.stack([everything if one is None else np.asarray(one) for one in masks]) != 0)
    if agent.spec.memory_size:
        inputs.append(memories)
    return inputs


class ExportedNetwork(nn.Module):
    """Inputs as `raw_inputs` gives them to action values ``[n, A]`` in the environment's units, and greedy actions.

    One step of an agent with a memory, which is the last of the inputs and, as it is afterwards, of the outputs.
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.q = agent.q
        self.scale = agent.reward_scale
        self.first_action = agent.first_action
        self.encoder = agent.encoder
        self.dtype = torch.from_numpy(np.zeros((), agent.spec.dtype)).dtype
        self.masked, self.has_memory = agent.spec.masked, agent.spec.memory_size > 0
        scaling = None if agent.normalisation is None else agent.normalisation.scaling()
        self.is_normalised = scaling is not None
        if scaling is not None:
            mean, inverse = scaling
            self.register_buffer("mean", torch.as_tensor(mean))
            self.register_buffer("inverse", torch.as_tensor(inverse))

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Values and greedy actions of a batch, and the memories afterwards."""
        parts = self.encoder.parts
        s = self._encoded(inputs[: len(parts)])
        if self.is_normalised:
            flat = (s.flatten(1).double() - self.get_buffer("mean")) * self.get_buffer("inverse")
            s = flat.clamp(-CLIP, CLIP).float().reshape(s.shape)
        beside = [inputs[-1]] if self.has_memory else []
        beside += [inputs[len(parts)]] if self.masked else []
        if beside:
            s = torch.cat([one.reshape(one.shape[0], -1).to(self.dtype) for one in (s, *beside)], 1)
        values = self.q.all(s) / self.scale
        found = values, values.argmax(-1) + self.first_action
        recurrent = recurrent_part(self.q)
        return found if recurrent is None else (*found, recurrent.next_memory(s))

    def _encoded(self, inputs: Sequence[Tensor]) -> Tensor:
        layout, parts = self.encoder.layout, self.encoder.parts
        if layout == "image":
            return inputs[0]
        if layout == "array":
            return _numbers(parts[0], inputs[0], self.encoder.dtype)
        if layout == "index":
            return _index(parts, inputs)
        columns = [_columns(part, x, self.encoder.dtype) for part, x in zip(parts, inputs, strict=True)]
        return torch.cat(columns, 1)


def _as_tensor(x: Array, dtype: Any) -> Tensor:
    return torch.from_numpy(np.atleast_1d(np.asarray(x, dtype)))


def _numbers(part: Part, x: Tensor, dtype: Any) -> Tensor:
    """A Box, scaled: in float64, as arrays are."""
    if part.scaling is not None:
        origin, divisor = (_as_tensor(one, np.float64) for one in (part.scaling.origin, part.scaling.divisor))
        x = (x.double() - origin) / divisor
    return x.to(torch.float64 if dtype == np.float64 else torch.float32)


def _digits(part: Part, x: Tensor) -> Tensor:
    """Entries counted from 0: ``[n, …] -> [n, number of entries]``."""
    return x.reshape(x.shape[0], len(part.sizes or ())).long() - _as_tensor(part.starts, np.int64)


def _index(parts: Sequence[Part], inputs: Sequence[Tensor]) -> Tensor:
    index = torch.zeros_like(inputs[0].reshape(inputs[0].shape[0], -1)[:, 0], dtype=torch.int64)
    for part, x in zip(parts, inputs, strict=True):  # Horner's rule
        digits = _digits(part, x)
        for entry, size in enumerate(part.sizes or ()):
            index = index * size + digits[:, entry]
    return index


def _columns(part: Part, x: Tensor, dtype: Any) -> Tensor:
    """What a part fills of a flat vector: numbers, bits, or a one-hot block for each entry."""
    wanted = torch.float64 if dtype == np.float64 else torch.float32
    if part.sizes is None:
        return _numbers(part, x, dtype).reshape(x.shape[0], part.width)
    digits = _digits(part, x)
    if part.is_binary:
        return digits.to(wanted)
    entry = np.repeat(np.arange(len(part.sizes)), part.sizes)
    category = np.concatenate([np.arange(size) for size in part.sizes])
    return (digits[:, _as_tensor(entry, np.int64)] == _as_tensor(category, np.int64)).to(wanted)

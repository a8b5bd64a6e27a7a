"""A network with one output per action, seen as flat memory by the compiled passes for single observations."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq.q.bodies import ACTIVATIONS, GroupedConv, Trunk
from neuralq.q.compiled import layer_places
from neuralq.q.engine import Engine
from neuralq.q.flat import FlatParameters
from neuralq.q.kernels import single as kernels
from neuralq.q.layouts import ActionOutputQ
from neuralq.types import Transition

__all__ = ["SingleRowNetwork", "runs_single_row"]


def runs_single_row(q: Any) -> bool:
    """Whether `SingleRowNetwork` knows this module: `ActionOutputQ` with an MLP or Conv body, on a CPU.

    Example:
        >>> runs_single_row(ActionOutputQ((4,), 2)), runs_single_row(torch.nn.Linear(4, 2))
        (True, False)
    """
    if type(q) is not ActionOutputQ or type(q.trunk) is not Trunk or q.input.features is not None:
        return False
    if q.input.stem is not None and type(q.input.stem) is not GroupedConv:
        return False
    first: Tensor = next(q.parameters())
    return first.device.type == "cpu" and first.dtype in (torch.float32, torch.float64)


class SingleRowNetwork:
    """Compiled values, TD errors and gradients of one observation at a time.

    Args:
        engine: of a representation for which `runs_single_row` is true; its flat vectors are read and written.

    Example:
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> engine = TorchEngine(ActionOutputQ((4,), 2, rng=0), Loss())
        >>> bool(torch.allclose(SingleRowNetwork(engine).values(torch.ones(1, 4)), engine.all(torch.ones(1, 4))))
        True
    """

    def __init__(self, engine: Engine) -> None:
        q: Any = engine.q
        if not runs_single_row(q):
            raise ValueError(f"no single-row kernels for {type(q).__name__} as it is; use kind='torch'")
        self._num_actions: int = q.num_actions
        self._shape: tuple[int, ...] = q.input.input_shape
        self._width = int(np.prod(self._shape))
        self._stem: Any = q.input.stem
        self._dtype: torch.dtype = engine.flat.values.dtype
        plan = _plan_of(q, engine.flat)
        activation = list(ACTIVATIONS).index(q.trunk.activation)
        self._params, self._grads = engine.flat.values.numpy(), engine.flat.grad.numpy()
        self._network: Any = plan, activation
        # Of one convolution at a time: (fan_in of a channel) · (positions).
        patches = int((plan[:, 7] * plan[:, 11] ** 2 * plan[:, 13] * plan[:, 14]).max())
        units = int(plan[:, 2].sum())
        sizes = (units, units, len(plan), patches, units)
        *work, self._deltas = (torch.zeros(size, dtype=self._dtype).numpy() for size in sizes)
        self._work: Any = tuple(work)  # acts, hats, inverse, cols

    def _rows(self, s: Tensor) -> Any:
        if tuple(s.shape[1:]) != self._shape:
            raise ValueError(f"this network takes observations of shape {self._shape}, got {tuple(s.shape[1:])}")
        if s.dtype != self._dtype:
            s = s.to(self._dtype)
        if self._stem is not None:
            s = self._stem.first(s)
        return s.contiguous().numpy().reshape(-1, self._width)

    def values(self, s: Tensor) -> Tensor:
        """Action values ``[B, *obs] -> [B, A]``."""
        x = self._rows(s)
        out = np.empty((x.shape[0], self._num_actions), x.dtype)
        arguments: Any = (self._params, *self._network, x, *self._work, out)
        kernels.values_of(*arguments)
        return torch.from_numpy(out)

    def learn(self, step: Transition, r_t: float, discount_t: float) -> tuple[float, float, bool]:
        """Leave ∇Q(s, a) in the engine's gradient; returns Q(s, a), the one-step target and whether a was greedy.

        Raises:
            ValueError: if the action does not exist.
        """
        a = int(step.a_tm1.item())
        if not 0 <= a < self._num_actions:
            raise ValueError(f"actions must lie in 0..{self._num_actions - 1}, got {a}")
        rows = self._rows(step.s_tm1)[0], a, r_t, discount_t, self._rows(step.s_t)[0]
        arguments: Any = (self._params, self._grads, *self._network, *rows, *self._work, self._deltas)
        return kernels.learn(*arguments)


def _plan_of(q: Any, flat: FlatParameters) -> Any:
    """One row per layer; the columns are explained in `neuralq.q.kernels.single`."""
    plan = []
    stem, trunk = q.input.stem, q.trunk
    if stem is not None:
        channels, height, width = stem.in_shape
        for i, (weight, bias, stride) in enumerate(zip(stem.weights, stem.biases, stem.strides, strict=True)):
            c_out, side = weight.shape[0], weight.shape[2]
            high, wide = (height - side) // stride + 1, (width - side) // stride + 1
            sizes = (channels * height * width, c_out * high * wide)
            geometry = (channels, height, width, c_out, side, stride, high, wide)
            plan.append((kernels.CONV, *sizes, *layer_places(flat, weight, bias, stem.norms, i), *geometry))
            channels, height, width = c_out, high, wide
    for i, layer in enumerate(trunk.layers):
        places = layer_places(flat, layer.weight, layer.bias, trunk.norms, i)
        plan.append((kernels.DENSE, *layer.weight.shape[1:], *places, *(0,) * 8))
    table = np.array([(*row, 0) for row in plan], np.int64)
    table[1:, 15] = np.cumsum(table[:-1, 2])
    return table

"""What surrounds the replay buffer: its settings, the arrays of a sample, a scratch file in place of memory."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq.checks import check_fraction, check_positive
from neuralq.types import Array, Indices, Transition

__all__ = ["Batch", "Output", "Prioritised", "as_array", "scratch_file"]

PAIRED_ROW_BYTES = 1024
"""Observations above this size are handed out with their successor right behind them."""


@dataclass(frozen=True, slots=True)
class Prioritised:
    """Steps are drawn with probability p^α / Σ p^α, p = |δ| + ε, and weigh (N·P)^−β / max in the loss.

    Args:
        alpha: α in [0, 1]; 0 is uniform.
        beta: β in [0, 1]; 1 corrects the bias fully. `ReplayBuffer.sample` takes another value for annealing.
        epsilon: ε > 0, so that no step is forgotten for good.

    Defaults: Schaul et al. 2016, table 3 (proportional: α = 0.6, β from 0.4).
    """

    alpha: float = 0.6
    beta: float = 0.4
    epsilon: float = 1e-6

    def __post_init__(self) -> None:
        """Checks the ranges."""
        check_fraction("alpha", self.alpha)
        check_fraction("beta", self.beta)
        check_positive("epsilon", self.epsilon)


@dataclass(frozen=True, slots=True)
class Batch:
    """What `ReplayBuffer.sample` returns.

    Args:
        transition: ``[B]``; `last_t` and `discount_t` are those of the whole n-step window.
        weights: importance weights ``[B]`` in (0, 1], float32; ones when sampling is uniform.
        indices: where the steps are stored ``[B]``, for `ReplayBuffer.update_priorities`.
    """

    transition: Transition
    weights: Tensor
    indices: Indices


class Output:
    """Arrays that one kind of sample is written to, and the tensors over the same memory.

    Near and far observations lie one after the other where they are large: they do so in the buffer too, and one copy
    of both is up to a fifth quicker than two. Each observation is contiguous, the batch of them is then not.
    """

    __slots__ = ("arguments", "batch", "indices", "leading", "weights")

    def __init__(self, leading: tuple[int, ...], shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.leading, num = leading, leading[-1]
        row_bytes = math.prod(shape) * dtype.itemsize
        together = row_bytes > PAIRED_ROW_BYTES
        pairs = np.zeros((*leading, 2, *shape) if together else (2, *leading, *shape), dtype)
        s_tm1, s_t = (pairs[(*[slice(None)] * len(leading), i)] if together else pairs[i] for i in (0, 1))
        rest: list[Array] = [np.zeros(leading, t) for t in (np.int64, *[np.float32] * 3, np.bool_)]
        a_tm1, mu_tm1, r_t, discount_t, last_t = rest
        offset = row_bytes if together else row_bytes * math.prod(leading)
        self.arguments: tuple[Any, ...] = (pairs.reshape(-1).view(np.uint8), offset, *(x.reshape(-1) for x in rest))
        self.indices: Indices = np.zeros(num, np.int64)
        self.weights = np.ones(num, np.float32)
        transition = Transition(*map(torch.from_numpy, (s_tm1, a_tm1, mu_tm1, r_t, discount_t, s_t, last_t)))
        self.batch = Batch(transition, torch.from_numpy(self.weights), self.indices)


def as_array(value: Tensor | Array) -> Array:
    """The value's memory as an array; from another device, a copy."""
    if not isinstance(value, Tensor):
        return np.asarray(value)
    return value.numpy() if value.device.type == "cpu" and not value.requires_grad else value.detach().cpu().numpy()


def scratch_file(folder: Path, shape: tuple[int, ...]) -> Array:
    """An array over a nameless file in ``folder``: no clash with another run, nothing left behind."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        return np.memmap(file, np.uint8, "w+", shape=shape)

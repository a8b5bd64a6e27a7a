"""Quantiles at levels drawn anew for every update, from a function that has them all (IQN)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq.learners.kind import Representation
from neuralq.learners.replay.distributions.quantile import move_values, quantile_loss
from neuralq.learners.replay.distributions.record import Distribution
from neuralq.q.implicit import NUM_COSINES, ImplicitQuantileQ

__all__ = ["IQN"]


def _draw(num_rows: int, num_atoms: int, rng: np.random.Generator) -> Tensor:
    return torch.from_numpy(rng.random((num_rows, num_atoms)))


def _outputs(settings: Any, layout: str) -> int:
    """A table and a linear function hold a series for each action, networks have one output."""
    return NUM_COSINES if layout in ("table", "linear") else 1


def _check(settings: Any, representation: Representation) -> None:
    if representation.dueling:
        raise ValueError(
            "distribution='iqn' multiplies the hidden units of one network, and dueling has two streams of them; leave "
            "dueling out, or use distribution='quantile'"
        )


IQN = Distribution(
    name="iqn",
    title="quantiles at drawn levels, by a function of the level (IQN)",
    source="Dabney, Ostrovski, Silver & Munos 2018",
    losses=("huber",),
    q_class=ImplicitQuantileQ,
    move=move_values,
    loss=quantile_loss,
    levels=_draw,
    num_atoms=8,
    outputs=_outputs,
    represent=lambda q, settings, reward_scale, rng: ImplicitQuantileQ(q, rng),
    check=_check,
    place=4,
)

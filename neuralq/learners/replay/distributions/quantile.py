"""Equally likely values, regressed on those of the successor (QR-DQN)."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from neuralq import rules
from neuralq.learners.replay.distributions.record import Distribution, Moved
from neuralq.q import QuantileQ

__all__ = ["QUANTILE", "move_values", "quantile_loss"]


def move_values(q: Any, r_t: Tensor, discount_t: Tensor, outputs_t: Tensor, followed: rules.Followed) -> Moved:
    """Every value of the successor moves by itself."""
    return Moved(*rules.followed_values(r_t, discount_t, outputs_t, followed))


def quantile_loss(outputs_tm1: Tensor, moved: Moved, levels: Tensor | None) -> Tensor:
    """Quantile regression with Huber's parabola up to 1."""
    levels = None if levels is None else levels.to(outputs_tm1.dtype)
    return rules.quantile_huber(outputs_tm1, moved.values, 1.0, levels, moved.probabilities)


QUANTILE = Distribution(
    name="quantile",
    title="equally likely values (QR-DQN)",
    source="Dabney et al. 2018",
    losses=("huber",),
    q_class=QuantileQ,
    move=move_values,
    loss=quantile_loss,
    num_atoms=32,
    represent=lambda q, settings, reward_scale, rng: QuantileQ(q, settings.num_atoms),
    place=2,
)

"""Probabilities on a grid of values, with the moved and projected ones of the successor for labels (C51)."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from neuralq import rules
from neuralq.learners.replay.distributions.record import Distribution, Moved
from neuralq.q import CategoricalQ
from neuralq.types import QFunction

__all__ = ["CATEGORICAL"]


def _represent(q: QFunction, settings: Any, reward_scale: float, rng: np.random.Generator) -> QFunction:
    return CategoricalQ(
        q, settings.num_atoms, settings.value_min * reward_scale, settings.value_max * reward_scale
    )  # fmt: skip


def _move(q: CategoricalQ, r_t: Tensor, discount_t: Tensor, outputs_t: Tensor, followed: rules.Followed) -> Moved:
    return Moved(q.support, rules.followed_mass(r_t, discount_t, outputs_t, q.support, followed))


def _loss(outputs_tm1: Tensor, moved: Moved, levels: Tensor | None) -> Tensor:
    assert moved.probabilities is not None
    return rules.categorical_cross_entropy(outputs_tm1, moved.probabilities)


CATEGORICAL = Distribution(
    name="categorical",
    title="probabilities on a grid of values (C51)",
    source="Bellemare, Dabney & Munos 2017",
    losses=("cross_entropy",),
    q_class=CategoricalQ,
    move=_move,
    loss=_loss,
    num_atoms=51,
    least_atoms=2,
    bounded=True,
    represent=_represent,
    place=3,
)

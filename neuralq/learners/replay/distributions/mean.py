"""The mean of the return alone: Q-learning as it is."""

from __future__ import annotations

from neuralq.learners.replay.distributions.record import Distribution

__all__ = ["MEAN"]

MEAN = Distribution(
    name="none",
    title="the mean of the return",
    source="Mnih et al. 2015",
    losses=("huber", "squared"),
    check=lambda settings, representation: None,
    place=1,
)

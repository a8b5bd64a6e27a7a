"""What the settings of a replay run choose: the outputs that a representation has for every action, and the learner."""

from __future__ import annotations

import copy
from typing import cast

import torch
from torch import nn

from neuralq.learners import (
    DistributionalLearner,
    DQRCLearner,
    DQRCSettings,
    ReplayLearner,
    ReplaySettings,
    TwinHead,
)
from neuralq.q import CategoricalQ, QuantileQ
from neuralq.q.engine import Engine, TorchEngine
from neuralq.runs.recipe.config import NETWORKS, RunConfig
from neuralq.types import QFunction

__all__ = ["as_distribution", "num_atoms", "replay_learner"]


def num_atoms(config: RunConfig) -> int:
    """How many numbers are learned for every action: 1, or those of its distribution.

    Example:
        >>> num_atoms(RunConfig(learner="replay", replay=ReplaySettings(distribution="quantile", num_atoms=8)))
        8
    """
    return 1 if config.replay is None else config.replay.num_atoms or 1


def as_distribution(config: RunConfig, q: QFunction) -> QFunction:
    """The Q-function whose distribution ``q``, with `num_atoms` outputs per action, describes; else ``q`` itself."""
    settings = config.replay
    if settings is None or settings.distribution == "none":
        return q
    if settings.distribution == "quantile":
        return QuantileQ(q, num_atoms(config))
    low, high = settings.value_min, settings.value_max
    assert low is not None and high is not None
    return CategoricalQ(q, num_atoms(config), low * config.reward_scale, high * config.reward_scale)


def replay_learner(config: RunConfig, engine: Engine) -> ReplayLearner | DistributionalLearner | DQRCLearner:
    """The learner that the settings of a replay run ask for."""
    settings = config.replay
    assert settings is not None
    if settings.distribution != "none":
        assert isinstance(engine, TorchEngine)
        return DistributionalLearner(engine, settings, config.reward_scale)
    if settings.target_rule == "dqrc":
        head = TwinHead(engine.q) if config.layout in NETWORKS else _from_zero(engine.q)
        return DQRCLearner(engine, head, _dqrc_settings(settings), config.reward_scale)
    return ReplayLearner(engine, settings, config.reward_scale)


def _dqrc_settings(settings: ReplaySettings) -> DQRCSettings:
    beta, rate_h = settings.dqrc_beta, settings.dqrc_learning_rate
    assert beta is not None and rate_h is not None
    return DQRCSettings(settings.learning_rate, rate_h, beta, settings.optimiser, settings.max_grad_norm)


def _from_zero(q: QFunction) -> QFunction:
    """Another table or linear function of the same shape, all zero."""
    twin = copy.deepcopy(q)
    for p in cast(nn.Module, twin).parameters():
        p.data = torch.zeros_like(p)
        p.grad = None
    return twin

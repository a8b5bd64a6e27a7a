"""Runs from replay: which learner the settings ask for, and what it needs of the representation."""

from __future__ import annotations

import numpy as np

from neuralq.learners.kind import LearnerKind, Parts, Representation, Traits
from neuralq.learners.replay.distributional import DistributionalLearner
from neuralq.learners.replay.dqrc import DQRCLearner, DQRCSettings, TwinHead, has_hidden_units
from neuralq.learners.replay.learner import ReplayLearner
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.q import CategoricalQ, QuantileQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.types import QFunction

__all__ = ["REPLAY"]


def _build(parts: Parts) -> ReplayLearner | DistributionalLearner | DQRCLearner:
    settings: ReplaySettings = parts.settings
    if settings.distribution != "none":
        assert isinstance(parts.engine, TorchEngine)
        return DistributionalLearner(parts.engine, settings, parts.reward_scale)
    if settings.target_rule == "dqrc":
        head = TwinHead(parts.engine.q) if has_hidden_units(parts.engine.q) else parts.another()  # all 0, as it starts
        return DQRCLearner(parts.engine, head, _dqrc_settings(settings), parts.reward_scale)
    return ReplayLearner(parts.engine, settings, parts.reward_scale)


def _dqrc_settings(settings: ReplaySettings) -> DQRCSettings:
    beta, rate_h = settings.dqrc_beta, settings.dqrc_learning_rate
    assert beta is not None and rate_h is not None
    return DQRCSettings(settings.learning_rate, rate_h, beta, settings.optimiser, settings.max_grad_norm)


def _represent(q: QFunction, settings: ReplaySettings, reward_scale: float, rng: np.random.Generator) -> QFunction:
    """The Q-function whose distribution ``q`` describes; else ``q`` itself."""
    if settings.distribution == "none":
        return q
    assert settings.num_atoms is not None
    if settings.distribution == "quantile":
        return QuantileQ(q, settings.num_atoms)
    low, high = settings.value_min, settings.value_max
    assert low is not None and high is not None
    return CategoricalQ(q, settings.num_atoms, low * reward_scale, high * reward_scale)


def _check(settings: ReplaySettings, representation: Representation) -> None:
    distribution, layout = settings.distribution, representation.layout
    if distribution != "none" and layout in ("action-input", "separate"):
        raise ValueError(
            f"distribution={distribution!r} needs several outputs per action, and {layout} networks have one "
            "output each; use layout='action-output', 'linear' or 'table'"
        )
    if representation.dueling and settings.target_rule == "dqrc":
        raise ValueError(
            "dqrc puts its second function on the last hidden units of the network, and dueling has two such layers; "
            "leave dueling out"
        )
    if representation.engine == "compiled" and distribution != "none":
        raise ValueError("engine='compiled' has no kernels for dueling streams or distributions; use engine='auto'")


REPLAY = LearnerKind(
    name="replay",
    title="Q-learning from stored experience, with a target network (DQN)",
    source="Mnih et al. 2015",
    settings=ReplaySettings,
    build=_build,
    experience="replay",
    traits=lambda s: Traits(
        step_size=s.learning_rate,
        plain_steps=s.optimiser == "sgd",
        lambda_=0.0 if s.block_length == 1 else s.lambda_,
        target_period=s.target_period_updates,
        replay=True,
        double=s.target_rule == "double",
    ),
    loss=lambda s: Loss("huber" if s.loss == "huber" else "squared"),
    outputs=lambda s, layout: s.num_atoms or 1,
    represent=_represent,
    check=_check,
    place=2,
)

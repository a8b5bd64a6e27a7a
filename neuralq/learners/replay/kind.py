"""Runs from replay: which learner the settings ask for, and what it needs of the representation."""

from __future__ import annotations

from neuralq.learners.kind import LearnerKind, Parts, Representation, Traits
from neuralq.learners.replay.distributional import DistributionalLearner
from neuralq.learners.replay.distributions.record import MEAN
from neuralq.learners.replay.dqrc import DQRCLearner, TwinHead, has_hidden_units
from neuralq.learners.replay.learner import ReplayLearner
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.q.engine import Loss, TorchEngine
from neuralq.rules.one_step import DOUBLE

__all__ = ["REPLAY"]


def _build(parts: Parts) -> ReplayLearner | DistributionalLearner | DQRCLearner:
    settings: ReplaySettings = parts.settings
    if settings.returns is not MEAN:
        assert isinstance(parts.engine, TorchEngine)
        return DistributionalLearner(parts.engine, settings, parts.reward_scale, parts.rng)
    if settings.rule.correction:
        head = TwinHead(parts.engine.q) if has_hidden_units(parts.engine.q) else parts.another()  # all 0, as it starts
        return DQRCLearner(parts.engine, head, settings, parts.reward_scale)
    return ReplayLearner(parts.engine, settings, parts.reward_scale)


def _check(settings: ReplaySettings, representation: Representation) -> None:
    settings.returns.check(settings, representation)
    if representation.dueling and settings.rule.correction:
        raise ValueError(
            "dqrc puts its second function on the last hidden units of the network, and dueling has two such layers; "
            "leave dueling out"
        )
    if representation.engine == "compiled" and settings.returns is not MEAN:
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
        double=s.rule is DOUBLE,
    ),
    loss=lambda s: Loss("huber" if s.loss == "huber" else "squared"),
    outputs=lambda s, layout: s.returns.outputs(s, layout),
    represent=lambda q, s, reward_scale, rng: s.returns.represent(q, s, reward_scale, rng),
    check=_check,
    place=2,
    step_sizes=("learning_rate", "dqrc_learning_rate"),
)

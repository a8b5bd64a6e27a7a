"""Runs from replay: which learner the settings ask for, and what it needs of the representation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from neuralq.learners.kind import LearnerKind, Parts, Representation, Traits
from neuralq.learners.replay.distributional import DistributionalLearner
from neuralq.learners.replay.distributions.record import MEAN
from neuralq.learners.replay.dqrc import DQRCLearner, TwinHead, has_hidden_units
from neuralq.learners.replay.learner import ReplayLearner
from neuralq.learners.replay.noisy import NoisyLearner
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.noisy import made_noisy
from neuralq.rules.one_step import DOUBLE
from neuralq.rules.target_rule import target_rules
from neuralq.types import QFunction

__all__ = ["REPLAY"]


def _build(parts: Parts) -> ReplayLearner | DistributionalLearner | DQRCLearner | NoisyLearner:
    settings: ReplaySettings = parts.settings
    if settings.noisy:
        return NoisyLearner(_plain(parts), parts.rng)
    if settings.rule.correction:
        head = TwinHead(parts.engine.q) if has_hidden_units(parts.engine.q) else parts.another()  # all 0, as it starts
        return DQRCLearner(parts.engine, head, settings, parts.reward_scale)
    return _plain(parts)


def _plain(parts: Parts) -> ReplayLearner | DistributionalLearner:
    """Without a second function, and whatever the layers."""
    settings: ReplaySettings = parts.settings
    if settings.returns is MEAN:
        return ReplayLearner(parts.engine, settings, parts.reward_scale)
    assert isinstance(parts.engine, TorchEngine)
    return DistributionalLearner(parts.engine, settings, parts.reward_scale, parts.rng)


def _represented(q: QFunction, settings: ReplaySettings, reward_scale: float, rng: np.random.Generator) -> QFunction:
    q = made_noisy(q, rng) if settings.noisy else q
    return settings.returns.represent(q, settings, reward_scale, rng)


def _check_noisy(representation: Representation) -> None:
    if representation.layout in ("table", "linear"):
        raise ValueError(
            f"noisy layers take the place of dense ones, and layout={representation.layout!r} has none; use "
            "layout='action-output', or leave noisy out"
        )
    if representation.engine == "compiled":
        raise ValueError("engine='compiled' has no kernels for noisy layers; use engine='auto'")
    if getattr(getattr(representation, "body", None), "sparsity", 0.0):
        raise ValueError("noisy layers start as Fortunato et al. (2018) have them, not sparse; leave sparsity out")


def _check(settings: ReplaySettings, representation: Representation) -> None:
    settings.returns.check(settings, representation)
    if representation.dueling and settings.rule.correction:
        raise ValueError(
            "dqrc puts its second function on the last hidden units of the network, and dueling has two such layers; "
            "leave dueling out"
        )
    if settings.noisy:
        _check_noisy(representation)
    if representation.engine == "compiled" and settings.returns is not MEAN:
        raise ValueError("engine='compiled' has no kernels for dueling streams or distributions; use engine='auto'")


def _loss(settings: ReplaySettings) -> Loss:
    """Of a mean; distributions have losses of their own."""
    if settings.loss != "huber":
        return Loss("squared")
    return Loss("huber") if settings.huber_delta is None else Loss("huber", settings.huber_delta)


def _on_table(given: Mapping[str, Any]) -> dict[str, Any]:
    """Plain steps that bring an entry a twentieth nearer to each of its samples, all of them kept; an average plays.

    A step moves no other entry, so that targets need no frozen copy. An entry that all samples of a batch are of moves
    by 1.6 of the way at most, which still brings it nearer.
    """
    rule = target_rules().get(given.get("target_rule", ""))
    learns_means = given.get("distribution", MEAN.name) == MEAN.name and not (rule is not None and rule.correction)
    if not learns_means or given.get("optimiser", "sgd") != "sgd":
        return {}
    rows = given.get("batch_size", max(32, given.get("block_length", 1)))
    frozen = {} if given.get("target_period_updates") is not None else {"target_rate": 1.0}
    return frozen | {
        "optimiser": "sgd",
        "learning_rate": min(1.6, 0.05 * max(1, rows)),
        "loss": "squared",
        "max_grad_norm": None,
        "batch_size": rows,
        "train_period": 2,
        "capacity": 100_000,
        "average_updates": 5_000.0,
    }


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
        target_period=s.target_period_updates if s.target_rate is None else math.ceil(1 / s.target_rate),
        replay=True,
        double=s.rule is DOUBLE,
    ),
    loss=_loss,
    outputs=lambda s, layout: s.returns.outputs(s, layout),
    represent=_represented,
    check=_check,
    place=2,
    step_sizes=("learning_rate", "dqrc_learning_rate"),
    on_table=_on_table,
    space={
        "learning_rate": {"from": 1e-4, "to": 5e-3, "scale": "log"},
        "target_rule": ["q_learning", "double"],
        "num_steps": {"from": 1, "to": 10, "scale": "log"},
        "batch_size": [32, 64, 128, 256],
        "train_period": [1, 2, 4, 8],
        "target_rate": {"from": 0.002, "to": 0.05, "scale": "log", "or": None},
        "target_period_updates": {"from": 50, "to": 2_000, "scale": "log", "when": {"target_rate": None}},
        "average_updates": {"from": 100.0, "to": 10_000.0, "scale": "log", "or": None},
    },
    updates_per_step=lambda s: s.updates_per_period / s.train_period,
)

"""On an accelerator an update waits for nothing: every learner, rule and layout, where there is no data to wait for.

PyTorch's meta device stands for the accelerator. It knows shapes, types and places and holds no numbers, so whatever
would bring one back to the host (`item`, `nonzero`, a truth value, `.cpu()`) raises, and so does arithmetic between it
and a tensor that was left on the host. What the numbers come to there is for the tests marked ``gpu``.

Mutants that die here, each tried: importance weights left on the host (replay, its distributions, DQRC) · a trace cut
after asking whether the action was greedy or the stream has ended (online, streaming) · actions or the gradient's norm
looked at on any device · minibatches whose size depends on a target.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from neuralq.learners import Learner
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss
from neuralq.runs import RunConfig
from neuralq.runs.recipe import build
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.stream import ObservationSpec
from neuralq.runs.stream.experience import Sample

REPLAY = {"learning_starts": 8, "batch_size": 8, "capacity": 64, "target_period_updates": 1}
BLOCKS = {**REPLAY, "block_length": 4, "batch_size": 8}
BODY = {"class": "MLP", "hidden": [8, 8], "layer_norm": True}
ROLLOUT = {"num_envs": 2, "num_steps": 4, "num_epochs": 2, "num_minibatches": 2}
STREAMING = [
    {"bound": bound, "cut": cut}
    for bound in ("obgd", "adaptive-obgd", "intentional")
    for cut in ("watkins", "published")
]

BINS = {"distribution": "categorical", "value_min": 0.0, "value_max": 100.0}
DQRC = {**{k: v for k, v in REPLAY.items() if k != "target_period_updates"}, "target_rule": "dqrc"}
BLOCK_RULES = ("peng", "watkins", "retrace", "tree_backup", "harutyunyan")
CASES: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
    *(("rollout", {**ROLLOUT, **one}, {}) for one in (
        {}, {"returns": "watkins"}, {"target_period_updates": 1}, {"optimiser": "sgd"}, {"optimiser": "adam"},
        {"refresh_targets": True, "average_updates": 2.0, "anneal": True},
    )),
    *(("rollout", ROLLOUT, {"layout": layout}) for layout in ("action-input", "separate", "linear")),
    ("rollout", ROLLOUT, {"layout": "table", "env": "Taxi-v4"}),
    ("rollout", ROLLOUT, {"env": "Taxi-v4"}),  # with masks
    ("rollout", ROLLOUT, {"dueling": True}),
    *(("replay", {**REPLAY, **one}, {}) for one in (
        {}, {"target_rule": "double"}, {"target_rule": "munchausen"}, {"num_steps": 3}, {"prioritised": True},
        {"distribution": "quantile"}, {"distribution": "quantile", "prioritised": True},
        {"target_rule": "expected_sarsa"}, {"target_rule": "expected_sarsa", "distribution": "quantile"},
        {"distribution": "iqn"},
        BINS, {**BINS, "target_rule": "double", "prioritised": True}, {"loss": "squared"},
    )),
    ("replay", {**REPLAY, "distribution": "quantile"}, {"env": "Taxi-v4"}),
    *(("replay", {**DQRC, **one}, {}) for one in ({}, {"prioritised": True})),
    *(("replay", {**BLOCKS, "target_rule": rule}, {}) for rule in BLOCK_RULES),
    ("replay", REPLAY, {"layout": "table", "env": "Taxi-v4"}),
    ("online", {}, {}),
    ("online", {}, {"layout": "separate"}),
    *(("streaming", one, {}) for one in STREAMING),
    ("streaming", {}, {"env": "Taxi-v4"}),
    ("gradient", {}, {}),
    ("gradient", {}, {"env": "Taxi-v4"}),
    ("gradient", {"method": "gq"}, {"layout": "action-input"}),
]  # fmt: skip


def samples_of(config: RunConfig, num_samples: int = 2) -> tuple[ObservationSpec, list[Sample]]:
    """Experience that a host has collected, as the run's learner is handed it."""
    samples: list[Sample] = []
    with contextlib.closing(build.build_session(config)) as session:
        while len(samples) < num_samples:
            session.experience.add(session.stream.step(session.policy))
            for sample in session.experience.draw():  # each is valid until the next
                weight = None if sample.weight is None else sample.weight.clone()
                samples.append(Sample(sample.transition.map(torch.clone), weight, sample.indices))
        return session.stream.spec, samples


def learner_on(device: str, config: RunConfig, spec: ObservationSpec) -> Learner:
    q = build.build_q(config, spec, np.random.default_rng(0))
    assert isinstance(q, nn.Module)
    loss = "huber" if config.replay is not None and config.replay.loss == "huber" else "squared"
    engine = make_engine(q.to(device), Loss(loss), "torch")
    return build._learner(dataclasses.replace(config, device=device), engine, spec, np.random.default_rng(0))


def config_of(learner: str, settings: dict[str, Any], more: dict[str, Any]) -> RunConfig:
    body = {} if more.get("layout") in ("linear", "table") else {"body": BODY}
    chosen = {"env": "CartPole-v1", "engine": "torch", "learner": learner, "epsilon_start": 0.5, learner: settings}
    return config_from_dict({**chosen, **body, **more})


@pytest.mark.parametrize(("learner", "settings", "more"), CASES)
def test_an_update_brings_nothing_back_to_the_host(
    learner: str, settings: dict[str, Any], more: dict[str, Any]
) -> None:
    config = config_of(learner, settings, more)
    spec, samples = samples_of(config)
    there = learner_on("meta", config, spec)
    for sample in samples:
        seen = there.update(sample.transition.map(lambda x: x.to("meta")), sample.weight)
        assert seen.errors.device.type == seen.targets.device.type == "meta"
    assert there.num_updates == len(samples)


@pytest.mark.gpu
@pytest.mark.parametrize(("learner", "settings", "more"), CASES)
def test_an_accelerator_learns_the_same(learner: str, settings: dict[str, Any], more: dict[str, Any]) -> None:
    config = config_of(learner, settings, more)
    spec, samples = samples_of(config, num_samples=20)
    accelerator = torch.accelerator.current_accelerator()
    assert accelerator is not None
    here, there = learner_on("cpu", config, spec), learner_on(accelerator.type, config, spec)
    start = here.engine.flat.values.clone()
    for sample in samples:
        here.update(sample.transition, sample.weight)
        there.update(sample.transition.map(lambda x: x.to(accelerator)), sample.weight)
    torch.testing.assert_close(there.engine.flat.values.cpu(), here.engine.flat.values, rtol=1e-3, atol=1e-5)
    assert not torch.equal(here.engine.flat.values, start)


def test_what_would_wait_is_noticed() -> None:
    there = torch.ones(2, device="meta")
    for waits in (lambda: there.sum().item(), lambda: bool((there > 0).any()), there.nonzero, there.cpu):
        with pytest.raises((RuntimeError, NotImplementedError)):
            waits()
    with pytest.raises(RuntimeError, match="device"):
        there * torch.ones(2)

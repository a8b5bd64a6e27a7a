"""Every setting of every learner at every corner that it accepts (0, 1, None, each word) learns ten times, in numbers.

The corners are asked of the settings themselves: what they refuse is no corner. λ = 1 and γ = 1 hold throughout, for
where the two meet sums are longest; the slow lane has the other corners of both, and the smallest of worlds.

Mutants that die here: a running mean at the rate 1 − γλ = 0, divided by 1 − (γλ)ᵗ; a pass over no rows.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import re
from collections.abc import Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuralq import tabular
from neuralq.learners.gradient.residual import ResidualGradientLearner, ResidualGradientSettings
from neuralq.learners.kind import learner_kinds
from neuralq.mdp import FiniteMDP
from neuralq.q import MLP, TableQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.rules.streaming import intentional
from neuralq.runs import RunConfig
from neuralq.runs.folder.env_probe import Resumability
from neuralq.runs.recipe import build
from neuralq.runs.recipe.build import build_session
from neuralq.types import Transition

LEARNERS = learner_kinds()
BASE: dict[str, dict[str, Any]] = {
    "rollout": {"num_envs": 2, "num_steps": 4, "num_epochs": 2, "num_minibatches": 2},
    "replay": {"learning_starts": 12, "batch_size": 8, "capacity": 64, "target_period_updates": 4},
}
WIDER: dict[str, list[dict[str, Any]]] = {
    "replay": [
        {"target_rule": "peng", "block_length": 4, "batch_size": 8},
        {"target_rule": "retrace", "block_length": 2, "batch_size": 4},
        {"target_rule": "munchausen"},
        {"target_rule": "dqrc", "target_period_updates": None},
        {"distribution": "quantile", "num_atoms": 3},
        {"distribution": "categorical", "value_min": -5.0, "value_max": 5.0},
    ],
    "streaming": [{"bound": "intentional"}, {"bound": "adaptive-obgd"}],
    "gradient": [{"method": "gq"}],
    "rollout": [{"anneal": True}, {"average_updates": 2.0}],
}
SIZES = (0, 1, 0.0, 1.0, None, True, False)


class World(gym.Env[Any, Any]):
    """Numbers in, numbers out; episodes of ``length`` steps."""

    def __init__(self, num_actions: int = 2, length: int = 5) -> None:
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = spaces.Discrete(num_actions)
        self.length, self.t = length, 0

    def look(self) -> Any:
        return np.array([np.sin(self.t), np.cos(3 * self.t)], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self.look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        return self.look(), float(action) - 0.3 * self.t, self.t == self.length, False, {}


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    gym.register("World-v0", World)
    with pytest.MonkeyPatch.context() as patch:  # what these do is tested elsewhere, and takes most of the time here
        patch.setattr(build, "is_resumable", lambda *_: Resumability(False, "not asked"))
        yield
    del gym.registry["World-v0"]


def words(settings: Any, base: dict[str, Any], name: str) -> list[str]:
    """The words that a setting may be, from what it says to one that it may not."""
    try:
        settings(**{**base, name: "?"})
    except (ValueError, TypeError) as refusal:
        if str(refusal).startswith(f"{name} must be one of"):
            return re.findall("'([^']*)'", str(refusal).split(", got")[0])
    return []


def corners(kind: Any, base: dict[str, Any]) -> list[Any]:
    """The settings at each corner that they accept, each once."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(kind.settings):
        for value in (*SIZES, *words(kind.settings, base, field.name)):
            if isinstance(value, bool) != isinstance(field.default, bool) and not (
                field.default is None and "bool" in str(field.type)
            ):
                continue
            try:
                made = kind.settings(**{**base, field.name: value})
            except (ValueError, TypeError):
                continue
            found.setdefault(repr(made), made)
    return list(found.values())


def learns(learner: str, settings: Any, world: dict[str, Any], **more: Any) -> None:
    """Ten updates, or a refusal with its reason before the first."""
    options: dict[str, Any] = {"body": MLP((4,)), "gamma": 1.0, **more}
    try:
        config = RunConfig(
            env="World-v0", env_kwargs=world, learner=learner, evaluation_episodes=1, total_steps=200,
            **{learner: settings, **options},
        )  # fmt: skip
        session = build_session(config)
    except ValueError as refusal:
        assert len(str(refusal)) > 20, settings
        return
    try:
        for _ in range(400):
            session.experience.add(session.stream.step(session.policy))
            for sample in session.experience.draw():
                update = session.learner.update(sample.transition, sample.weight)
                assert bool(torch.isfinite(update.errors).all()), settings
            if session.learner.num_updates >= 10:
                break
        assert session.learner.num_updates >= 10, settings
        assert bool(torch.isfinite(session.learner.engine.flat.values).all()), settings
    except ValueError as reported:  # a step size of 1 may diverge, and says so
        assert "training diverged" in str(reported) and re.search("step_size(_h)?=1", repr(settings)), settings
    finally:
        session.close()


@pytest.mark.parametrize("learner", LEARNERS)
def test_ten_updates_at_every_corner_of_every_setting(learner: str) -> None:
    kind = LEARNERS[learner]
    longest = {"lambda_": 1.0} if "lambda_" in {field.name for field in dataclasses.fields(kind.settings)} else {}
    for wider in ({}, *(WIDER.get(learner, []) if learner != "replay" else [])):  # replay's rules are slow
        for settings in corners(kind, {**BASE.get(learner, {}), **longest, **wider}):
            learns(learner, settings, {})


WORLDS = [{"num_actions": 1}, {"length": 1}, {"num_actions": 1, "length": 1}]


@pytest.mark.slow
@pytest.mark.parametrize("world", [{}, *WORLDS])
@pytest.mark.parametrize("engine", ["auto", "torch"])
@pytest.mark.parametrize("gamma", [0.0, 1.0])
@pytest.mark.parametrize("learner", LEARNERS)
def test_ten_updates_at_the_other_corners(learner: str, gamma: float, engine: str, world: dict[str, Any]) -> None:
    for wider in ({}, *WIDER.get(learner, [])):
        for settings in corners(LEARNERS[learner], {**BASE.get(learner, {}), **wider}):
            learns(learner, settings, world, gamma=gamma, engine=engine)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("learner", LEARNERS)
def test_ten_updates_in_the_smallest_of_worlds(learner: str, world: dict[str, Any]) -> None:
    learns(learner, LEARNERS[learner].settings(**BASE.get(learner, {})), world, epsilon_end=0.0, epsilon_start=0.0)


def test_at_gamma_lambda_of_1_the_running_mean_is_the_mean_of_all_steps() -> None:
    # One weight, β₂ = ½, three steps of gradient 1, 2, 2, by hand. v̂ is the mean weighted by ½ᵗ over 1 − ½ᵗ; n = g²/√v̂;
    # σ̂ = (n₁ + … + n_t)/t; Z = z²/√v̂ with z = 1, 3, 5; Δθ = η / √(σ̂ Z) · δ z/√v̂ with η = ½ and δ = 1.
    v_hat = [1.0, (0.25 * 1 + 0.5 * 4) / 0.75, (0.125 * 1 + 0.25 * 4 + 0.5 * 4) / 0.875]
    n, expected = [], []
    for t, (g, z) in enumerate([(1.0, 1.0), (2.0, 3.0), (2.0, 5.0)]):
        root = v_hat[t] ** 0.5
        n.append(g * g / root)
        expected.append(0.5 / (sum(n) / len(n) * z * z / root) ** 0.5 * z / root)
    v, means, z_t = torch.zeros(1).double(), torch.tensor([0.0, 1.0]).double(), torch.zeros(1).double()
    for t, g in enumerate([1.0, 2.0, 2.0]):
        grad = torch.tensor([g]).double()
        z_t = z_t + grad
        step, v, means = intentional(z_t, grad, torch.tensor(1.0).double(), v, means, t + 1, 1.0, 0.5, 0.5)
        assert step.item() == pytest.approx(expected[t], rel=1e-6)


TABULAR = [
    tabular.q_learning, tabular.sarsa, tabular.expected_sarsa, tabular.double_q, tabular.q_lambda, tabular.sarsa_lambda,
    tabular.n_step, tabular.episodic_q_learning, tabular.dyna_q, tabular.prioritized_sweeping, tabular.queue_dyna,
]  # fmt: skip
NOT_NUMBERS = ("seed", "options")


@pytest.mark.parametrize("learn", TABULAR, ids=lambda learn: learn.__name__)
def test_ten_steps_at_every_corner_of_a_tabular_learner(learn: Any) -> None:
    one = FiniteMDP.from_arrays([[[0.0]]], [[5.0]], substochastic=True)  # one state, one action, one step
    ring = FiniteMDP.from_arrays([[[0.0, 1.0], [1.0, 0.0]]] * 2, [[1.0, -1.0], [0.5, 2.0]])  # which never ends
    ran = 0
    for name, parameter in inspect.signature(learn).parameters.items():
        if parameter.default is inspect.Parameter.empty or name in NOT_NUMBERS:
            continue
        numbers = (0, 1, 0.0, 1.0) if name == "step_size" or not isinstance(parameter.default, str) else ()
        for value in (*numbers, *words(partial(learn, one, 1, 0.5), {}, name)):
            for world, gamma in itertools.product((one, ring), (0.0, 1.0)):
                try:
                    learned = learn(world, 10, gamma, **{name: value})
                except ValueError as refusal:
                    assert len(str(refusal)) > 20 and "NaN" not in str(refusal), (name, value)
                    continue
                ran += 1
                assert np.isfinite(learned.q).all(), (name, value, gamma)
    assert ran >= 16


@pytest.mark.parametrize("phi", [0, 1, 0.0, 1.0, "adaptive"])
@pytest.mark.parametrize("trace_rate", [1, 1.0, 1e-9])
@pytest.mark.parametrize("discount", [0.0, 1.0])
def test_ten_updates_at_every_corner_of_the_residual_gradient(phi: Any, trace_rate: float, discount: float) -> None:
    settings = ResidualGradientSettings(phi=phi, step_size=0.1, trace_rate=trace_rate)
    learner = ResidualGradientLearner(TorchEngine(TableQ(2, 1), Loss()), settings)
    row = torch.tensor
    for t in range(10):
        s, s_t = row([t % 2]), row([(t + 1) % 2])
        learner.update(Transition(s, row([0]), row([1.0]), row([1.0]), row([discount]), s_t, row([False])))
    assert bool(torch.isfinite(learner.engine.flat.values).all())

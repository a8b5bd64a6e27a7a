"""Every layout with every learner on every kind of observation: it trains, or is refused in one line that says why.

Mutants that must die here: a refused combination let through · one that trains refused · a learner that leaves the
parameters as they were · frames or indices that reach a layout unprepared.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuralq.learners import OnlineSettings, ReplaySettings, RolloutSettings
from neuralq.learners.replay.distributions.record import distributions
from neuralq.q import MLP, Conv
from neuralq.runs import RunConfig
from neuralq.runs.folder.env_probe import Resumability
from neuralq.runs.recipe import build
from neuralq.runs.recipe.build import build_session
from neuralq.runs.recipe.config import LAYOUTS, LEARNERS, NETWORKS

NUM_STEPS = 120
ENVS = {"discrete": "FrozenLake-v1", "vector": "CartPole-v1", "flags": "Flicker-v0", "bytes": "Flicker-v0"}
SETTINGS: dict[str, Any] = {
    "rollout": {"rollout": RolloutSettings(num_envs=2, num_steps=20, num_epochs=2)},
    "replay": {"replay": ReplaySettings(learning_starts=50, batch_size=16, target_period_updates=50)},
    "online": {"online": OnlineSettings(step_size=1e-4)},
}
TABLES = ("vector", "flags", "bytes")


class Flicker(gym.Env[Any, Any]):
    """Random frames of 6 × 5 with two channels; the first pixel tells which action pays."""

    action_space = spaces.Discrete(2)

    def __init__(self, kind: str = "flags") -> None:
        dtype, high = (np.bool_, 1) if kind == "flags" else (np.uint8, 255)
        self.observation_space = spaces.Box(0, high, (6, 5, 2), dtype)  # type: ignore[arg-type]
        self.t = 0

    def look(self) -> Any:
        self.seen = self.observation_space.sample() if self.t == 0 else np.roll(self.seen, 1, 0)
        return self.seen

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.t = 0
        return self.look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = float(bool(self.seen[0, 0, 0]) == bool(action))
        self.t += 1
        return self.look(), reward, self.t == 12, False, {}


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    gym.register("Flicker-v0", Flicker)
    with pytest.MonkeyPatch.context() as patch:  # what it finds is tested elsewhere, and takes most of the time here
        patch.setattr(build, "is_resumable", lambda *_: Resumability(False, "not asked"))
        yield
    del gym.registry["Flicker-v0"]


def config_of(layout: str, learner: str, kind: str, **more: Any) -> RunConfig:
    kwargs = {"kind": kind} if kind in ("flags", "bytes") else {}
    small = {"body": (Conv((4,), hidden=(8,)) if kwargs else MLP((8,))) if layout in NETWORKS else None}
    return RunConfig(
        env=ENVS[kind], env_kwargs=kwargs, learner=learner, layout=layout, evaluation_episodes=1, epsilon_end=0.5,
        **{**small, **SETTINGS.get(learner, {}), **more},
    )  # fmt: skip


CELLS = [
    # One layout sees every kind of observation in the fast lane, the others vectors; the rest of the grid is slow.
    pytest.param(layout, learner, kind, marks=[] if kind == "vector" or layout == "action-output" else pytest.mark.slow)
    for layout in LAYOUTS
    for learner in LEARNERS
    for kind in ENVS
]


@pytest.mark.parametrize(("layout", "learner", "kind"), CELLS)
def test_it_trains_or_is_refused(layout: str, learner: str, kind: str) -> None:
    if learner == "tabular" and layout != "table":
        with pytest.raises(ValueError, match="the tabular learner learns a table, got layout="):
            config_of(layout, learner, kind)
        return
    if layout == "table" and kind in TABLES:
        other = "learner" if learner == "tabular" else "layout"
        with pytest.raises(
            ValueError, match=f"a table needs a finite observation space, got a Box.*; choose another {other}"
        ):
            build_session(config_of(layout, learner, kind))
        return
    session = build_session(config_of(layout, learner, kind))
    try:
        flat = session.learner.engine.flat.values
        before = flat.clone()
        while session.stream.num_steps < NUM_STEPS:
            session.experience.add(session.stream.step(session.policy))
            for sample in session.experience.draw():
                session.learner.update(sample.transition, sample.weight)
        assert bool(torch.isfinite(flat).all()) and session.learner.num_updates > 0
        # Frozen Lake may not have paid within so few steps; then a table that starts at 0 has nothing to learn.
        assert not torch.equal(before, flat) or (kind == "discrete" and layout in ("table", "linear"))
        session.evaluation_episodes, session.evaluation_max_steps = 1, 30
        assert len(session.play_greedily(0).returns) == 1
    finally:
        session.close()


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("distribution", [name for name in distributions() if name != "none"])
def test_distributions_go_with_layouts_of_as_many_outputs(layout: str, distribution: str, kind: str) -> None:
    span = {"value_min": 0.0, "value_max": 5.0} if distribution == "categorical" else {}
    chosen = ReplaySettings(learning_starts=20, batch_size=8, train_period=4, distribution=distribution, **span)  # type: ignore[arg-type]
    if layout in ("action-input", "separate") and distribution != "iqn":  # whose levels go in
        with pytest.raises(ValueError, match=f"needs several outputs per action, and {layout} networks have one"):
            config_of(layout, "replay", kind, replay=chosen)
        return
    if layout == "table" and kind in TABLES:
        return  # refused as above
    session = build_session(config_of(layout, "replay", kind, replay=chosen))
    try:
        while session.learner.num_updates < 3:
            session.experience.add(session.stream.step(session.policy))
            for sample in session.experience.draw():
                session.learner.update(sample.transition, sample.weight)
        assert bool(torch.isfinite(session.learner.engine.flat.values).all())
    finally:
        session.close()


@pytest.mark.parametrize(
    ("layout", "kind", "more", "said"),
    [
        ("table", "discrete", {"body": MLP((8,))}, "a table has no network body; leave body out or choose one of"),
        ("linear", "vector", {"body": Conv()}, "a linear function has no network body; leave body out or"),
        ("linear", "vector", {"dueling": True}, "in a linear function a value stream adds nothing"),
        ("action-input", "vector", {"dueling": True}, "an action-input network sees one action at a time"),
        ("separate", "vector", {"dueling": True}, "separate networks share nothing"),
        ("action-output", "vector", {"body": Conv()}, r"a Conv body needs frames .* got shape \(4,\); use an MLP body"),
        ("action-output", "discrete", {"body": Conv()}, r"a Conv body needs frames .* got shape \(16,\); use an MLP"),
        ("action-output", "flags", {"body": Conv(kernel_sizes=(7,))}, "a kernel of 7 does not fit an observation of"),
        ("action-output", "flags", {"engine": "compiled", "body": Conv()}, "kernels for MLP networks only"),
        ("table", "discrete", {"engine": "compiled"}, "kernels for MLP networks only"),
        ("action-output", "vector", {"online": OnlineSettings(trace="dutch")}, "tables and linear features only"),
    ],
)  # fmt: skip
def test_nonsense_is_refused_with_the_reason(layout: str, kind: str, more: dict[str, Any], said: str) -> None:
    learner = next((name for name in LEARNERS if name in more), "rollout")
    with pytest.raises(ValueError, match=said) as refused:
        build_session(config_of(layout, learner, kind, **more))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("learner", [name for name in LEARNERS if name != "tabular"])
def test_an_mlp_reads_frames_flattened(learner: str) -> None:
    session = build_session(config_of("action-output", learner, "bytes", body=MLP((8,))))
    try:
        assert session.learner.engine.all(
            torch.zeros(3, 6, 5, 2, dtype=torch.uint8 if learner != "streaming" else torch.float32)
        ).shape == (3, 2)
    finally:
        session.close()

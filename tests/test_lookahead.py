"""Runs that cannot learn, or not in this memory or this life, say so before they cost anything."""

from __future__ import annotations

import logging
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from neuralq import checks
from neuralq.apps.cli import main
from neuralq.learners import ReplaySettings, RolloutSettings
from neuralq.runs import RunConfig, train
from neuralq.runs.recipe.lookahead import num_updates, require_room, warnings_ahead
from neuralq.runs.recipe.presets import PRESETS, with_preset
from neuralq.runs.stream import Interaction, ObservationSpec, make_vector_env

Capture = pytest.CaptureFixture[str]


class Plain(gym.Env[Any, Any]):
    """Episodes of five steps, each worth ``reward``; a mask may stand in the observation, and one in info."""

    def __init__(self, actions: int = 2, name: str = "x", told: bool = False, reward: float = 1.0) -> None:
        self.action_space = spaces.Discrete(actions)
        self.observation_space = spaces.Dict({name: spaces.MultiBinary(actions), "z": spaces.Box(-1, 1, (2,))})
        self.name, self.told, self.reward = name, told, reward

    def look(self) -> tuple[Any, dict[str, Any]]:
        ones = np.ones(int(self.action_space.n), np.int8)
        return {self.name: ones, "z": np.zeros(2, np.float32)}, {"action_mask": ones} if self.told else {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self.look()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        seen, info = self.look()
        return seen, self.reward, self.t == 5, False, info


gym.register("ahead/Plain-v0", Plain)


class Numbered(Plain):
    """Many states."""

    def __init__(self, states: int) -> None:
        super().__init__()
        self.observation_space = spaces.Discrete(states)  # type: ignore[assignment]

    def look(self) -> tuple[Any, dict[str, Any]]:
        return 0, {}


def ahead(config: RunConfig, **kwargs: Any) -> list[str]:
    return warnings_ahead(config, Interaction(make_vector_env(lambda: Plain(**kwargs), 1), 0.9, 0))


def replay(total_steps: int, **given: Any) -> RunConfig:
    return RunConfig(learner="replay", total_steps=total_steps, epsilon_decay_steps=1, replay=ReplaySettings(**given))


ROLLOUT = RolloutSettings(num_envs=2, num_steps=8, target_period_updates=100)
ANNEALED = RolloutSettings(anneal=True, anneal_env_steps=400)


@pytest.mark.parametrize(
    ("config", "wanted"),
    [
        (replay(999), "nothing will be learned: the first update comes after 1,000 steps"),
        (replay(1_499), "they are copied every 500 updates (--replay.target-period-updates), and there will be 500"),
        (replay(20_000, train_period=100), "every 500 updates (--replay.target-period-updates), and there will be 191"),
        (RunConfig(total_steps=1_000, epsilon_decay_steps=1, rollout=ROLLOUT), "and there will be 63"),
        (RunConfig(total_steps=1_000), "ε is still 0.95 when the run ends, not 0.05"),
        (RunConfig(total_steps=1_000, epsilon_decay_steps=1, rollout=ANNEALED), "learning rate is 0 from step 400 on"),
    ],
)  # fmt: skip
def test_a_run_that_cannot_learn_by_its_settings_says_so(config: RunConfig, wanted: str) -> None:
    found = ahead(config)
    if wanted.endswith("will be 500"):  # 1,000 to 1,499: the 500th update is the copy
        assert num_updates(config) == 500 and found == []
    else:
        assert len(found) == 1 and wanted in found[0]


def test_a_run_that_can_learn_says_nothing() -> None:
    assert ahead(RunConfig()) == ahead(RunConfig(learner="replay")) == ahead(RunConfig(learner="streaming")) == []
    for env, learner in PRESETS:
        assert ahead(with_preset({"env": env, "learner": learner})) == []


def test_the_number_of_updates_is_counted() -> None:
    def counted(config: RunConfig) -> int:
        added, due, updates, settings = 0, config.replay.learning_starts, 0, config.replay  # type: ignore[union-attr]
        for _ in range(config.total_steps):
            added += 1
            while added >= due:
                due += settings.train_period  # type: ignore[union-attr]
                updates += settings.updates_per_period  # type: ignore[union-attr]
        return updates

    for given in ({"learning_starts": 7}, {"learning_starts": 50, "train_period": 3}, {"updates_per_period": 2}):
        for steps in (49, 50, 52, 1200):
            assert num_updates(replay(steps, **given)) == counted(replay(steps, **given))


@pytest.mark.parametrize("name", ["action_mask", "legal_moves", "Available"])
def test_masks_that_are_only_seen_are_named(name: str) -> None:
    assert [f"observation['{name}'] looks like a mask" in line for line in ahead(RunConfig(), name=name)] == [True]
    assert ahead(RunConfig(), name=name, told=True) == []
    assert ahead(RunConfig(), name="speed") == []


def test_one_action_leaves_nothing_to_choose() -> None:
    assert "nothing to choose" in ahead(RunConfig(), actions=1)[0]


@pytest.mark.parametrize(("reward", "wanted"), [(3.0, "12.29"), (2.0, None)])
def test_a_categorical_range_narrower_than_the_returns_is_told_from_the_first_episodes(
    reward: float, wanted: str | None, tmp_path: Any, capsys: Capture
) -> None:
    words = [
        "train",
        "ahead/Plain-v0",
        "--env-kwargs",
        f"{{reward: {reward}}}",
        "--learner",
        "replay",
        "--gamma",
        "0.9",
    ]
    words += ["--replay.distribution", "categorical", "--replay.value-min", "0", "--replay.value-max", "10"]
    words += ["--replay.learning-starts", "20", "--replay.target-period-updates", "5", "--total-steps", "60"]
    assert main([*words, "--evaluation-episodes", "1", "--run-dir", str(tmp_path / "run")]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "lies outside of 0..10" in line]
    # Five rewards of 3 at γ = 0.9: 3·(1 − 0.9⁵)/0.1 = 12.2853; of 2: 8.19, which fits.
    assert len(said) == (wanted is not None) and (wanted is None or wanted in said[0])


def test_programs_read_warnings_in_the_log(tmp_path: Any, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "neuralq"):
        train(
            RunConfig(learner="replay", total_steps=30, epsilon_decay_steps=1, evaluation_episodes=1), tmp_path / "run"
        )
    assert [record.message[:26] for record in caplog.records] == ["nothing will be learned: t"]


def spec_of(states: int | None, actions: int) -> ObservationSpec:
    return ObservationSpec((), np.dtype(np.int64), (), states, False, actions)


@pytest.mark.parametrize(
    ("layout", "states", "actions", "weights", "way_out"),
    [
        ("action-output", 10**6, 2, 10**6 * 128 + 128 * 128 + 128 * 2, "give each state a few numbers of its own"),
        ("action-output", 4, 10**6, 4 * 128 + 128 * 128 + 128 * 10**6, "take narrower layers"),
        ("separate", 4, 10**4, 10**4 * (4 * 128 + 128 * 128 + 128), "take narrower layers"),
        ("table", 10**6, 100, 10**8, "merge states"),
        ("linear", 10**6, 100, 10**8, "give each state"),
    ],
)
def test_weights_that_do_not_fit_are_refused_before_they_are_made(
    layout: str, states: int, actions: int, weights: int, way_out: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, spec = RunConfig(layout=layout), spec_of(states, actions)
    monkeypatch.setattr(checks, "available_bytes", lambda: 28 * weights - 1)
    with pytest.raises(MemoryError, match=f"{weights:,} weights.*GiB.*{way_out}"):
        require_room(config, spec)


def test_very_many_actions_one_at_a_time_are_refused_or_their_time_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    config = RunConfig(layout="action-input", total_steps=100_000)
    found = ahead(config, actions=10_000)
    # 10,000 passes of 10,002 + 10,000 inputs, 128 and 128 units (2,576,768 weights), a multiplication and an addition
    # each, once to act and three times for each of four passes to learn: 10⁴ · 2 · 2.58e6 · 13 = 6.7e11.
    assert len(found) == 1 and "about 68 s per step" in found[0] and "--layout action-output" in found[0]
    assert ahead(config, actions=18) == []
    monkeypatch.setattr(checks, "available_bytes", lambda: 2**32)
    with pytest.raises(MemoryError, match=r"what is computed of 1,024 observations at once.*--layout action-output"):
        require_room(config, spec_of(4, 10_000))


def test_very_many_states_as_one_hot_vectors_are_told_to_be_slow_and_large(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Interaction(make_vector_env(lambda: Numbered(10**6), 1), 0.9, 0)
    for layout in ("action-output", "linear"):
        assert "s per step" in warnings_ahead(RunConfig(layout=layout), stream)[0]
    assert warnings_ahead(RunConfig(layout="table"), stream) == []
    monkeypatch.setattr(checks, "available_bytes", lambda: 10**10)
    with pytest.raises(MemoryError, match="give each state a few numbers of its own"):  # 1,024 rows of 3 · 4 MB
        require_room(RunConfig(layout="linear"), stream.spec)


def test_a_network_that_does_not_fit_is_one_line_at_the_command(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(checks, "available_bytes", lambda: 10**5)
    assert main(["train", "CartPole-v1", "--preset", "false", "--run-dir", str(tmp_path / "run")]) == 1
    said = capsys.readouterr().err.splitlines()
    # 4 · 128 + 128 · 128 + 128 · 2 weights
    assert said[-1].startswith(
        "neuralq: error: the action-output representation of observations and 2 actions (17,152 w"
    )

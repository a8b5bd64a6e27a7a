"""Configurations refuse contradictions and survive being stored; recipes build what they say.

Mutants that must die here: a value of the wrong kind let through · a list not turned back into a tuple · settings of
the wrong learner ignored · an environment of one's own not imported · a missing engine left to the environment's
constructor · a preset's value winning over a given one.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuralq.learners import OnlineSettings, ReplaySettings, RolloutSettings
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, LinearQ, SeparateQ, TableQ
from neuralq.runs import RunConfig, preset_for, train, with_preset
from neuralq.runs.recipe.build import build_q, build_session, plan_of
from neuralq.runs.recipe.config import config_from_dict, config_to_dict
from neuralq.runs.recipe.environments import make_envs
from neuralq.runs.recipe.presets import PRESETS

CONFIGS = [
    RunConfig(),
    RunConfig(env="FrozenLake-v1", env_kwargs={"is_slippery": False}, layout="table", seed=4, stop_at_return=0.5),
    RunConfig(learner="replay", replay=ReplaySettings(prioritised=True, num_steps=3), body=MLP((8, 4), True, "tanh")),
    RunConfig(learner="online", layout="linear", online=OnlineSettings(lambda_=0.25, trace="dutch")),
    RunConfig(layout="separate", body=Conv((4, 8), (3, 2), (1, 1), (16,)), rollout=RolloutSettings(max_grad_norm=None)),
]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{c.learner} {c.layout}")
def test_a_configuration_comes_back_from_json_as_it_was(config: RunConfig) -> None:
    stored = json.loads(json.dumps(config_to_dict(config), allow_nan=False))
    assert config_from_dict(stored) == config
    assert set(stored) & {"rollout", "replay", "online"} == {config.learner}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"total_stepz": 5}, "unknown keys total_stepz"),
        ({"total_steps": "many"}, "total_steps must be a whole number, got 'many'"),
        ({"total_steps": 1.5}, "total_steps must be a whole number, got 1.5"),
        ({"total_steps": True}, "total_steps must be a whole number, got True"),
        ({"seed": None}, "seed must be a whole number, got None"),
        ({"gamma": "0.9"}, "gamma must be a number, got '0.9'"),
        ({"stop_at_return": "high"}, "stop_at_return must be a number, got 'high'"),
        ({"env": 5}, "env must be text, got 5"),
        ({"env_kwargs": [1]}, "env_kwargs must be a mapping, got"),
        ({"rollout": {"num_envs": "x"}}, "rollout.num_envs must be a whole number, got 'x'"),
        ({"rollout": [4]}, "rollout must be a mapping, got"),
        ({"rollout": {"lamda": 1}}, "rollout has unknown keys lamda; known are"),
        ({"body": {"hidden": [8]}}, "class of the body must be one of 'MLP', 'Conv', 'Custom', 'GRU', got None"),
        ({"body": {"class": "RNN"}}, "class of the body must be one of"),
        ({"body": {"class": "MLP", "depth": 2}}, "body has unknown keys depth"),
        ({"body": "MLP"}, "body must be a mapping with a class"),
        ({"body": {"class": "MLP", "layer_norm": "yes"}}, "body.layer_norm must be true or false, got 'yes'"),
        ({"learner": "replay", "rollout": {}}, "settings for the rollout learner would be ignored"),
        ({"layout": "linear", "body": {"class": "MLP"}}, "a linear function has no network body"),
        ({"layout": "table", "engine": "compiled"}, "kernels for MLP networks only"),
    ],
)
def test_a_stored_configuration_with_a_mistake_is_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError) as refused:
        config_from_dict(given)
    assert said in str(refused.value)


@pytest.mark.parametrize(
    "given",
    [
        {"gamma": 1.01}, {"epsilon_start": -0.1}, {"reward_scale": 0.0}, {"reward_scale": float("nan")},
        {"total_steps": 0}, {"seed": -1}, {"evaluation_episodes": 0}, {"threads": 0}, {"layout": "Table"},
        {"rollout": {"num_envs": 2}}, {"body": {"class": "MLP"}}, {"total_steps": "many"},
    ],
    ids=str,
)  # fmt: skip
def test_the_dataclass_refuses_by_itself(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(given))):
        RunConfig(**given)


def test_whole_numbers_may_be_written_as_floats_and_numbers_of_numpy_are_numbers() -> None:
    config = RunConfig(total_steps=1e5, seed=np.int64(3), gamma=1)  # type: ignore[arg-type]
    assert (config.total_steps, config.seed, config.gamma) == (100_000, 3, 1.0)
    assert type(config.total_steps) is int and type(config.seed) is int and type(config.gamma) is float
    json.dumps(config_to_dict(config))


@pytest.mark.parametrize(("env", "learner"), PRESETS)
def test_every_preset_is_a_configuration_and_gives_way(env: str, learner: str) -> None:
    config = with_preset({"env": env, "learner": learner, "seed": 8, "reward_scale": 0.77})
    assert (config.env, config.learner, config.seed, config.reward_scale) == (env, learner, 8, 0.77)
    assert preset_for(env, learner)


def test_a_plan_is_the_configurations() -> None:
    plan = plan_of(
        RunConfig(total_steps=7, stop_at_return=1.5, evaluate_every=3, checkpoint_every=4, log_every=2, seed=5)
    )
    assert (plan.budget, plan.stop_at_return, plan.evaluate_every) == (7, 1.5, 3)
    assert (plan.checkpoint_every, plan.log_every, plan.seed) == (4, 2, 5)


@pytest.mark.parametrize(
    ("layout", "kind"),
    [("linear", LinearQ), ("action-input", ActionInputQ), ("separate", SeparateQ), ("action-output", ActionOutputQ)],
)
def test_the_layout_decides_the_representation(layout: str, kind: type) -> None:
    body = None if layout == "linear" else MLP((4,))
    session = build_session(RunConfig(layout=layout, body=body, evaluation_episodes=1))
    assert (session.evaluation_episodes, session.evaluation_max_steps, session.seed) == (1, 10_000, 0)
    try:
        assert type(session.learner.engine.q) is kind
        q = build_q(RunConfig(layout=layout, body=body), session.stream.spec, np.random.default_rng(0))
        assert type(q) is kind and q.num_actions == 2
    finally:
        session.close()


def test_a_table_has_one_row_per_state_and_refuses_the_uncountable() -> None:
    session = build_session(RunConfig(env="FrozenLake-v1", layout="table", evaluation_episodes=1))
    q = session.learner.engine.q
    session.close()
    assert isinstance(q, TableQ) and session.learner.engine.flat.values.numel() == 16 * 4
    with pytest.raises(ValueError, match="a table needs a finite observation space"):
        build_session(RunConfig(layout="table"))


def test_a_single_environment_is_no_batch_of_the_vectorised_kind() -> None:
    for num_envs in (1, 3):
        envs = make_envs(RunConfig(), num_envs)
        assert envs.num_envs == num_envs
        envs.close()


MODULE = """
import gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv
gym.register("OwnGame-v0", CartPoleEnv, max_episode_steps=30)
"""


def test_an_environment_of_ones_own_is_imported_by_its_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_games.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    small = RolloutSettings(num_envs=2, num_steps=8)
    config = RunConfig(env="own_games:OwnGame-v0", total_steps=64, evaluation_episodes=2, rollout=small, body=MLP((8,)))
    run = train(config, tmp_path / "run")
    assert run.env_steps >= 64 and run.greedy_return is not None and 8 <= run.greedy_return <= 30


def test_an_environment_that_raises_when_it_is_made_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sad_games.py").write_text("raise RuntimeError('no display')\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="'sad_games:Game-v0': RuntimeError: no display"):
        make_envs(RunConfig(env="sad_games:Game-v0"), 2)


@pytest.mark.parametrize("env", ["LunarLander-v3", "BipedalWalker-v3"])
def test_a_missing_engine_is_one_clear_line(env: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "Box2D", None)
    with pytest.raises(ValueError, match=rf"{env} needs the extra 'box2d' .*: pip install 'neuralq\[box2d\]'$"):
        make_envs(RunConfig(env=env), 1)
    make_envs(RunConfig(env="CartPole-v1"), 1).close()


def test_the_lander_trains_with_its_preset(tmp_path: Path) -> None:
    pytest.importorskip("Box2D", reason="needs the extra box2d")
    config = with_preset({"env": "LunarLander-v3", "total_steps": 64, "evaluation_episodes": 1})
    assert config.total_steps == 64 and config.learner == "rollout"
    run = train(config, tmp_path / "run")
    assert run.env_steps >= 64 and run.greedy_return is not None


def test_a_device_that_is_not_there_is_refused_before_anything_is_built() -> None:
    with pytest.raises(ValueError, match="cannot compute on device 'cuda:63'"):
        build_session(RunConfig(device="cuda:63"))


def test_an_environment_without_a_preset_gets_the_replay_learners_general_one() -> None:
    general = with_preset({"env": "Unknown-v0", "learner": "replay"})
    assert general.replay is not None and general.replay.num_steps > 1
    assert general.replay == with_preset("Other-v3", learner="replay").replay
    for other in ({"layout": "linear"}, {"env": "ALE/Pong-v5"}):  # other rates than a small network's
        plain = {"env": "Unknown-v0", "learner": "replay", **other}
        assert with_preset(plain) == config_from_dict(plain)
    for given in ({"target_rate": 0.5}, {"target_period_updates": 7}, {"target_rule": "retrace", "block_length": 4}):
        chosen = with_preset({"env": "Unknown-v0", "learner": "replay", "replay": given}).replay
        assert {name: getattr(chosen, name) for name in given} == given


def test_rainbow_is_all_six_parts_on_any_environment() -> None:
    config = with_preset("CartPole-v1", preset="rainbow")
    settings = config.replay
    assert settings is not None and config.dueling and settings.noisy and settings.prioritised
    assert (settings.target_rule, settings.num_steps, settings.distribution) == ("double", 3, "categorical")
    assert config.epsilon_start == config.epsilon_end == 0.0
    with pytest.raises(ValueError, match="name the smallest and the largest return"):
        with_preset("Unknown-v0", preset="rainbow")
    assert with_preset("Unknown-v0", preset="rainbow", value_min=0.0, value_max=5.0).replay.value_max == 5.0  # type: ignore[union-attr]
    atari = with_preset("ALE/Pong-v5", preset="rainbow")
    assert atari.clip_rewards and atari.replay is not None and atari.replay.value_max == 10.0
    with pytest.raises(ValueError, match="rainbow is for the replay learner, got rollout"):
        with_preset("CartPole-v1", preset="rainbow", learner="rollout")
    with pytest.raises(ValueError, match="preset must be one of 'rainbow', got 'rainbows'"):
        with_preset("CartPole-v1", preset="rainbows")

"""Training from Python by whatever names an environment and whatever its settings are called.

Mutants that must die here: settings that land in the other place than they were meant for · the preset left out, or put
under a whole configuration · the object itself trained on · a changed object taken for its id · a folder that claims a
name nobody can follow.
"""

from __future__ import annotations

import functools
import json
import logging
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import neuralq
from neuralq.learners import ReplaySettings
from neuralq.q import MLP
from neuralq.runs import RunConfig, with_preset
from neuralq.runs.api import _asked
from neuralq.runs.recipe import keywords
from neuralq.runs.recipe.handed import handed_over

SHORT: dict[str, Any] = {
    "total_steps": 64, "evaluation_episodes": 1, "num_envs": 2, "num_steps": 16, "hidden": (8,), "resume_probe": False
}  # fmt: skip


class Coin(gym.Env[Any, Any]):
    """One step; action 1 earns ``prize``."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, prize: float = 1.0) -> None:
        self.prize, self.num_steps = prize, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.num_steps += 1
        return np.zeros(2, np.float32), self.prize * float(action), True, False, {}


def config_of(env: Any, preset: bool = True, **settings: Any) -> RunConfig:
    return _asked(env, settings, preset)[0]


def test_keyword_arguments_are_fields_and_the_settings_of_the_learner() -> None:
    given = {"learner": "replay", "lambda_": 0.0, "total_steps": 1e5, "gamma": 0.9, "batch_size": 8, "hidden": [4]}
    config = config_of("Unknown-v0", False, **given)
    assert (config.learner, config.total_steps, config.gamma, config.body) == ("replay", 100_000, 0.9, MLP((4,)))
    assert config.replay == ReplaySettings(lambda_=0.0, batch_size=8)
    nested = {"env": "Unknown-v0", "learner": "replay", "replay": {"batch_size": 8}}
    same = config_of(nested, False, lambda_=0.0, gamma=0.9)
    assert same.replay == config.replay
    whole = config_of(config, seed=3, batch_size=9)
    assert whole.seed == 3 and whole.replay == ReplaySettings(lambda_=0.0, batch_size=9) and whole.body == config.body
    assert config_of(config, learner="online").online is not None  # settings of another learner go with it
    parts = config_of("X-v0", body=MLP((3,)), learner="replay", replay=ReplaySettings(batch_size=7))
    assert parts.body == MLP((3,)) and parts.settings.batch_size == 7


def test_a_preset_is_the_default_as_from_the_shell_and_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    preset = with_preset("CartPole-v1")
    assert config_of("CartPole-v1") == preset == with_preset({"env": "CartPole-v1"}) != RunConfig()
    assert config_of("CartPole-v1", preset=False) == RunConfig()
    assert config_of({"env": "CartPole-v1"}) == preset and config_of(RunConfig()) == RunConfig()
    assert with_preset("CartPole-v1", learner="replay", lambda_=0.0).replay.num_steps == 3  # type: ignore[union-attr]
    wider = with_preset("CartPole-v1", hidden=(9,)).body
    assert isinstance(wider, MLP) and wider.hidden == (9,) and wider.layer_norm  # the rest of the preset's body stays
    with caplog.at_level(logging.INFO, "neuralq"):
        neuralq.train("CartPole-v1", tmp_path / "run", **SHORT)
    assert "preset for CartPole-v1, rollout learner" in caplog.text


REFUSED = {
    "called otherwise": ({"total_timesteps": 5}, "no setting total_timesteps; it is called total_steps here"),
    "another learner's": ({"batch_size": 5}, r"belongs to the replay learner.*add learner='replay'"),
    "misspelt": ({"totl_steps": 5}, "did you mean total_steps"),
    "the environment's": ({"is_slippery": False}, r"goes into env_kwargs=\{'is_slippery': False\}"),
    "twice": ({"lambda_": 0.5, "rollout": {"lambda_": 0.6}}, "lambda_ is given twice"),
    "no learner": ({"learner": "dqn"}, "learner must be one of 'rollout', 'replay'"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_setting_is_answered_with_the_nearest(case: str) -> None:
    settings, told = REFUSED[case]
    with pytest.raises(ValueError, match=told):
        neuralq.train("CartPole-v1", **settings)
    with pytest.raises(ValueError, match=told):
        with_preset("CartPole-v1", **settings)


def test_names_of_a_learner_and_of_the_run_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import make_dataclass, replace

    torn = replace(keywords.LEARNERS["online"], settings=make_dataclass("Torn", [("gamma", float, 0.5)]))
    monkeypatch.setattr(keywords, "LEARNERS", {**keywords.LEARNERS, "online": torn})
    with pytest.raises(ValueError, match=r"gamma is a setting of the run and one of the online learner; write online="):
        keywords.nested({}, {"learner": "online", "gamma": 0.5})


@pytest.mark.parametrize("kind", ["object", "class", "function", "partial", "id"])
def test_an_environment_is_handed_over_as_people_have_it(kind: str, tmp_path: Path) -> None:
    gym.register("test/Coin-v0", Coin) if "test/Coin-v0" not in gym.registry else None
    local = type("Local", (Coin,), {"__module__": "__main__"})
    given = {
        "object": local(2.0), "class": Coin, "function": lambda: local(2.0),
        "partial": functools.partial(Coin, prize=2.0), "id": "test/Coin-v0",
    }[kind]  # fmt: skip
    run = neuralq.train(given, tmp_path / "run", **SHORT)
    stored = json.loads((tmp_path / "run" / "config.json").read_text())
    named = {"object": "<Local>", "function": "<Local>", "id": "test/Coin-v0"}
    assert stored["env"] == named.get(kind, f"{__name__}:Coin")
    assert stored["env_kwargs"] == ({"prize": 2.0} if kind == "partial" else {})
    assert run.greedy_return in (0.0, 1.0 if kind in ("class", "id") else 2.0)
    assert neuralq.load(run).predict(np.zeros(2, np.float32)) in (0, 1)
    if kind == "object":
        assert given.num_steps == 0  # copies were trained on


def test_a_run_without_a_name_takes_its_environment_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from neuralq.apps.cli import main
    from neuralq.runs import api

    def make() -> Coin:
        return Coin()

    run = neuralq.train(lambda: Coin(), tmp_path / "run", **SHORT)
    assert neuralq.resume(run, 128).env_steps == 128  # in this process it is known
    monkeypatch.setattr(api, "_makers", {})  # another process
    for use in (neuralq.load, neuralq.resume):
        with pytest.raises(ValueError, match=r"no name leads to, Coin of a Python program.*neuralq\.load\(run, env="):
            use(run.run_dir)
    assert neuralq.load(run.run_dir, env=make).predict(np.zeros(2, np.float32)) in (0, 1)
    assert neuralq.resume(run.run_dir, 192, env=Coin()).env_steps == 192
    assert main(["evaluate", str(run.run_dir)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("neuralq: error: this run was trained on an environment that no name leads to")


def test_objects_are_named_only_where_the_name_makes_them_again() -> None:
    assert handed_over(gym.make("FrozenLake-v1", is_slippery=False)).env_kwargs == {"is_slippery": False}
    assert handed_over(gym.make("CartPole-v1", max_episode_steps=30)).env_kwargs == {"max_episode_steps": 30}
    pole = gym.make("CartPole-v1")
    assert handed_over(pole).env == "CartPole-v1"
    pole.unwrapped.length = 3.0  # type: ignore[attr-defined]
    changed = handed_over(pole)
    assert changed.env == "<CartPoleEnv>" and changed.make is not None
    assert changed.make().unwrapped.length == 3.0 and changed.make() is not changed.make()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (3, "must be a Gymnasium id"),
        (lambda: 3, "must make a gymnasium.Env, and made 3"),
        (Coin().step, "functools.partial or a lambda"),
        (gym.make_vec("CartPole-v1", 2), "num_envs of the learner"),
    ],
)
def test_what_is_no_environment_is_told_what_is(given: Any, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        neuralq.train(given)


def test_env_kwargs_do_not_go_to_what_is_made_already(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="give it its arguments there"):
        neuralq.train(lambda: Coin(), tmp_path / "run", env_kwargs={"prize": 2.0})
    limited = neuralq.train(Coin, tmp_path / "run", env_kwargs={"max_episode_steps": 3, "prize": 2.0}, **SHORT)
    assert limited.greedy_return in (0.0, 2.0)


def test_solve_takes_names_environments_and_models() -> None:
    by_name = neuralq.solve("FrozenLake-v1", 0.9, is_slippery=False)
    assert by_name.v[0] == pytest.approx(0.9**5)  # six steps to the goal, which pays 1 at the last
    lake = gym.make("FrozenLake-v1", is_slippery=False)
    model = neuralq.FiniteMDP.from_gymnasium(lake)
    for answer in (neuralq.solve(lake, 0.9), neuralq.exact.solve(lake, 0.9), neuralq.solve(model, 0.9)):
        assert np.array_equal(answer.v, by_name.v)
    with pytest.raises(ValueError, match="takes names"):
        neuralq.exact.solve("FrozenLake-v1", 0.9)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="made already"):
        neuralq.solve(lambda: lake, 0.9, is_slippery=True)


def test_a_model_can_be_trained_on(tmp_path: Path) -> None:
    model = neuralq.FiniteMDP.from_arrays([[[0.0]], [[0.0]]], [[1.0, 3.0]], substochastic=True)
    run = neuralq.train(model, tmp_path / "run", layout="table", learner="online", step_size=0.5, total_steps=200)
    assert neuralq.load(run).values(0) == pytest.approx([1.0, 3.0], abs=1e-3)


@pytest.mark.parametrize("layout", [neuralq.ActionOutputQ, neuralq.SeparateQ, neuralq.ActionInputQ, neuralq.q.DuelingQ])
def test_a_vector_is_given_by_its_length(layout: Any) -> None:
    short, long = layout(4, 2), layout((4,), 2)
    assert all((a == b).all() for a, b in zip(short.parameters(), long.parameters(), strict=True))
    with pytest.raises(ValueError, match=r"Box has it as its shape"):
        layout(spaces.Box(-1, 1, (4,)), 2)
    with pytest.raises(ValueError, match="num_actions must be a whole number"):
        layout(4, spaces.Discrete(2))

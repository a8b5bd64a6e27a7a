"""Runs of the streaming learner: configured, resumed bit for bit, loaded, and learning CartPole in several seeds.

Mutants that must die here: trace, running means or statistics of the stream left out of the checkpoint · an evaluation
that teaches the statistics, or sees raw observations · an agent loaded without them · a step against the error.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuralq.apps.cli import main
from neuralq.learners import StreamingLearner, StreamingSettings
from neuralq.learners.traces import streaming_kernels as kernels
from neuralq.q import MLP
from neuralq.runs import RunConfig, evaluate_run, load, resume, train, with_preset
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.run_folder import read_config, read_metrics
from neuralq.runs.recipe.build import build_session, normalisation_for
from neuralq.runs.recipe.config import config_from_dict, config_to_dict

CLOCKS = ("cpu_seconds", "wall_seconds", "steps_per_second")
BODY = MLP((8,), layer_norm=True, affine=False, activation="leaky_relu", sparsity=0.5)
PERIODS = {"evaluate_every": 200, "evaluation_episodes": 2, "checkpoint_every": 150, "log_every": 50}


class Stopped(BaseException):
    """Ends a run in the middle as a kill would: nothing of the library catches it."""


def stop(row: Mapping[str, Any]) -> None:
    if row["kind"] == "train" and row["env_steps"] >= 400:
        raise Stopped


def clockless(path: Path) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in read_metrics(path)]


def configured(**given: Any) -> RunConfig:
    settings = StreamingSettings(**given.pop("streaming", {}))
    return RunConfig(
        **{"env": "CartPole-v1", "learner": "streaming", "total_steps": 600, "body": BODY, **PERIODS, **given},
        streaming=settings,
    )


CASES: dict[str, dict[str, Any]] = {
    "obgd": {},
    "obgd, torch, published": {"engine": "torch", "streaming": {"cut": "published"}},
    "adaptive": {"streaming": {"bound": "adaptive-obgd"}},
    "intentional": {"streaming": {"bound": "intentional"}},
    "separate": {"layout": "separate"},
    "linear, raw": {"layout": "linear", "body": None, "streaming": {"normalise_observations": False}},
    "table": {"layout": "table", "body": None, "env": "FrozenLake-v1"},
    "one-hot": {"env": "FrozenLake-v1", "streaming": {"scale_rewards": False}},
    "vectorised twin": {"env": "MountainCar-v0"},
}


QUICK = ("obgd", "intentional", "table", "vectorised twin")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in CASES]
)
def test_a_run_stopped_anywhere_ends_as_if_it_had_not_been(name: str, tmp_path: Path) -> None:
    config = configured(**CASES[name])
    whole = train(config, tmp_path / "whole")
    with pytest.raises(Stopped):
        train(config, tmp_path / "parts", [stop])
    saved = checkpoint.load_newest(tmp_path / "parts" / "checkpoints").step
    assert 0 < saved < read_metrics(tmp_path / "parts")[-1]["env_steps"]  # something is really done again
    parts = resume(tmp_path / "parts")
    assert (parts.parameters_sha256, parts.greedy_return) == (whole.parameters_sha256, whole.greedy_return)
    assert clockless(tmp_path / "parts") == clockless(tmp_path / "whole")
    ends = [checkpoint.load_newest(tmp_path / run / "checkpoints").state["stream"] for run in ("whole", "parts")]
    for statistic, value in (ends[0]["normalisation"] or {}).items():
        np.testing.assert_array_equal(value, ends[1]["normalisation"][statistic])
    assert (ends[0]["normalisation"] is None) == (name == "one-hot")


class Stateful(gym.Env[Any, Any]):
    """Its state hides in a generator object, which cannot be saved."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.walk = (float(x) for x in self.np_random.normal(100, 1, 20))
        return np.array([next(self.walk)], np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        x = next(self.walk, None)
        return np.array([x or 100.0], np.float32), float(action), x is None, False, {}


def test_the_statistics_survive_where_the_environment_starts_anew(tmp_path: Path) -> None:
    gym.register("Stateful-v0", Stateful)
    try:
        config = configured(env="Stateful-v0", total_steps=300)
        train(config, tmp_path / "run")
        resume(tmp_path / "run", total_steps=310)
        seen = checkpoint.load_newest(tmp_path / "run" / "checkpoints").state["stream"]["normalisation"]
        assert seen["observation_count"][0] > 310 and abs(seen["observation_mean"][0] - 100) < 1
    finally:
        del gym.registry["Stateful-v0"]


def test_evaluations_see_what_the_learner_sees_and_teach_nothing() -> None:
    session = build_session(configured())
    try:
        for _ in range(50):
            session.experience.add(session.stream.step(session.policy))
            for sample in session.experience.draw():
                session.learner.update(sample.transition)
        before = {name: value.copy() for name, value in session.stream.normalisation.state_dict().items()}
        session.evaluation_episodes, session.evaluation_max_steps = 2, 100
        session.play_greedily(3)
        for name, value in session.stream.normalisation.state_dict().items():
            np.testing.assert_array_equal(value, before[name])
        session.evaluation_stream.restart(7)
        raw = session.evaluation_stream.envs.reset(seed=7)[0]
        var = before["observation_squares"] / (before["observation_count"] - 1)
        expected = (raw - before["observation_mean"]) / np.sqrt(var + 1e-8)
        np.testing.assert_allclose(session.evaluation_stream.state_dict()["s"], expected, rtol=1e-4, atol=1e-5)
    finally:
        session.close()


def test_an_agent_sees_through_the_runs_statistics_and_speaks_in_the_environments_units(tmp_path: Path) -> None:
    config = configured(total_steps=400)
    train(config, tmp_path / "run")
    agent = load(tmp_path / "run")
    state = checkpoint.load_newest(tmp_path / "run" / "checkpoints").state["stream"]["normalisation"]
    s = np.array([0.01, -0.02, 0.03, 0.04], np.float32)
    mean, var = state["observation_mean"], state["observation_squares"] / (state["observation_count"] - 1)
    seen = torch.from_numpy(((s - mean) / np.sqrt(var + 1e-8)).astype(np.float32))
    spread = np.sqrt(state["return_squares"][0] / (state["return_count"][0] - 1) + 1e-8)
    np.testing.assert_allclose(agent.values(s), agent.q.all(seen).detach().numpy() * spread, rtol=1e-4)
    assert 0.5 < spread < 100
    last = [row for row in read_metrics(tmp_path / "run") if row["kind"] == "evaluation"][-1]
    assert evaluate_run(tmp_path / "run", 4).mean < 500 and last["greedy_return"] > 0


def test_a_configuration_of_the_streaming_learner_comes_back_from_json() -> None:
    config = configured(streaming={"bound": "adaptive-obgd", "normalise_observations": False})
    assert config_from_dict(json.loads(json.dumps(config_to_dict(config)))) == config
    preset = with_preset({"env": "CartPole-v1", "learner": "streaming"})
    assert (preset.epsilon_decay_steps, preset.total_steps, preset.body) == (
        25_000,
        500_000,
        MLP((32, 32), layer_norm=True, activation="leaky_relu", affine=False, sparsity=0.9),
    )


def test_indices_are_not_normalised() -> None:
    envs = gym.make_vec("FrozenLake-v1", num_envs=1)
    config = configured(env="FrozenLake-v1", streaming={"normalise_observations": True})
    with pytest.raises(ValueError, match="state indices have no mean"):
        normalisation_for(config, envs)
    envs.close()


def test_the_command_line_trains_with_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = str(tmp_path / "run")
    argv = ["train", "CartPole-v1", "--learner", "streaming", "--streaming.lambda", "0.7", "--total-steps", "300"]
    assert main([*argv, "--streaming.cut", "published", "--run-dir", run]) == 0
    stored = read_config(run)
    assert stored["streaming"]["lambda_"] == 0.7 and stored["streaming"]["cut"] == "published"
    assert stored["body"]["sparsity"] == 0.9


# Learning.


def learned(seed: int, num_steps: int, **settings: Any) -> float:
    """Mean return of twenty greedy episodes after ``num_steps`` of the preset's run, ε having come down by half."""
    config = with_preset({
        "env": "CartPole-v1", "learner": "streaming", "seed": seed, "epsilon_decay_steps": num_steps // 2,
        "streaming": settings,
    })  # fmt: skip
    session = build_session(config)
    try:
        assert isinstance(session.learner, StreamingLearner)
        while session.stream.num_steps < num_steps:
            session.experience.add(session.stream.step(session.policy))
            for sample in session.experience.draw():
                session.learner.update(sample.transition, sample.weight)
        session.evaluation_episodes, session.evaluation_max_steps = 20, 500
        return session.play_greedily(1).mean
    finally:
        session.close()


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"cut": "published"}, {"bound": "intentional"}], ids=str)
def test_it_learns_cartpole(settings: dict[str, Any]) -> None:
    """Chance is 9 for one action held and 22 for actions drawn uniformly."""
    returns = [learned(seed, 40_000, **settings) for seed in range(5)]
    assert np.median(returns) > 150 and sum(value > 60 for value in returns) >= 4, returns


@pytest.mark.slow
def test_a_step_against_the_error_does_not_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    forwards = kernels.advance

    def backwards(values: Any, z: Any, v: Any, grad: Any, means: Any, decay: float, delta: float, *rest: Any) -> None:
        forwards(values, z, v, grad, means, decay, -delta, *rest)

    monkeypatch.setattr(kernels, "advance", backwards)
    returns = []
    for seed in range(3):
        try:
            returns.append(learned(seed, 10_000))
        except ValueError:  # the values have left the numbers
            returns.append(0.0)
    assert max(returns) < 60, returns

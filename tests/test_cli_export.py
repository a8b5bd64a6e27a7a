"""ONNX files: run by onnxruntime beside the run itself, for each layout and kind of observation.

Mutants that must die here: values in the learner's units · greedy actions without the offset of the action space · a
batch size baked in · statistics of observations forgotten · a mask ignored · a file kept that is wrong · a difference
that is not looked at.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from given_spaces import GivenSpace
from gymnasium import spaces

from neuralq.apps.cli import main
from neuralq.runs import RunConfig, load
from neuralq.runs.agent import Agent
from neuralq.runs.exporting import export as export_module
from neuralq.runs.exporting import onnx_file
from neuralq.runs.exporting.played import played
from neuralq.runs.recipe.build import build_q
from neuralq.runs.recipe.environments import make_envs
from neuralq.runs.stream import Interaction, Normalisation
from neuralq.runs.stream.encoding import encoder_for
from neuralq.runs.sweep import create_sweep

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

Capture = pytest.CaptureFixture[str]
SMALL = ["--preset", "false", "--total-steps", "64", "--rollout.num-envs", "2", "--rollout.num-steps", "16"]
SMALL += ["--evaluation-episodes", "1", "--evaluation-max-steps", "50"]


class Offset(gym.Env[Any, Any]):
    """Pictures of bytes, and actions that are numbered from 5."""

    observation_space = spaces.Box(0, 255, (2, 12, 12), np.uint8)
    action_space = spaces.Discrete(3, start=5)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample() * 0 + self.np_random.integers(256, dtype=np.uint8), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        picture = self.np_random.integers(256, size=(2, 12, 12), dtype=np.uint8)
        return picture, float(action == 6), bool(self.np_random.random() < 0.2), False, {}


gym.register("test/Offset-v0", Offset)


def trained(path: Path, env: str, *words: str) -> str:
    body = [] if {"table", "linear"} & set(words) else ["--hidden", "8"]
    assert main(["train", env, *SMALL, *(body if env == "CartPole-v1" else []), *words, "--run-dir", str(path)]) == 0
    return str(path)


@pytest.mark.parametrize(
    ("env", "words", "shape"),
    [
        ("CartPole-v1", ["--layout", "action-output", "--layer-norm", "true", "--reward-scale", "0.01"], [4]),
        ("CartPole-v1", ["--layout", "action-input"], [4]),
        pytest.param("CartPole-v1", ["--layout", "separate"], [4], marks=pytest.mark.slow),
        pytest.param("CartPole-v1", ["--layout", "linear"], [4], marks=pytest.mark.slow),
        ("neuralq/MitchellGrid-v0", ["--layout", "table"], []),  # a state, and 4 legal moves beside it
        pytest.param("FrozenLake-v1", ["--layout", "action-output"], [], marks=pytest.mark.slow),
        ("test/Offset-v0", [], [2, 12, 12]),
    ],
)
def test_the_file_gives_the_runs_values(
    env: str, words: list[str], shape: list[int], tmp_path: Path, capsys: Capture
) -> None:
    run, file = trained(tmp_path / "run", env, *words), tmp_path / "policy.onnx"
    capsys.readouterr()
    assert main(["export", run, "--onnx", str(file), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["max_abs_difference"] <= result["allowed"] and result["num_observations"] == 256
    agent, session = load(run), onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    facts = session.get_modelmeta().custom_metadata_map
    assert facts["env"] == env and json.loads(facts["first_action"]) == agent.first_action
    played = gym.make(env)
    observation, info = played.reset(seed=1)
    mask = info.get("action_mask")
    given = {"observation": np.stack([observation] * 5)}
    if mask is not None:
        given["action_mask"] = np.array([mask != 0] * 5)
    assert [(one["name"], one["dtype"]) for one in result["inputs"]] == [(k, str(x.dtype)) for k, x in given.items()]
    assert result["inputs"][0]["shape"] == ["n", *shape]
    values, action = session.run(None, given)
    expected = agent.values(observation, mask)
    assert values.shape == (5, len(expected)) and played.action_space.contains(np.int64(action[0]))
    np.testing.assert_allclose(values[3], expected, rtol=1e-5, atol=1e-5)
    assert expected[action[3] - agent.first_action] == pytest.approx(expected.max(), abs=1e-5)
    if mask is not None:
        assert np.array_equal(np.isfinite(values[0]), np.asarray(mask) != 0)


QUANTILES = ["--replay.distribution", "quantile", "--replay.num-atoms", "5", "--dueling", "true"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "agent",
    [
        ["--preset", "false", "--learner", "replay", *QUANTILES],
        ["--preset", "false", "--learner", "replay", "--replay.noisy", "true"],
        ["--preset", "rainbow"],
    ],
    ids=["dueling quantiles", "noisy", "rainbow"],
)
def test_dueling_streams_of_a_distribution_and_noisy_layers(agent: list[str], tmp_path: Path, capsys: Capture) -> None:
    """Both parts of the former are reshaped and may not remember a traced batch; the latter play by their means."""
    words = ["--total-steps", "40", "--replay.learning-starts", "20", "--hidden", "8", "--evaluation-episodes", "1"]
    assert main(["train", "CartPole-v1", *agent, *words, "--run-dir", str(tmp_path / "run")]) == 0
    capsys.readouterr()
    assert main(["export", str(tmp_path / "run"), "--onnx", str(tmp_path / "policy.onnx"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["max_abs_difference"] <= result["allowed"]


def test_a_file_that_differs_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run, file = trained(tmp_path / "run", "CartPole-v1"), tmp_path / "policy.onnx"

    def shifted(*given: Any) -> Any:
        found = played(*given)
        found.values[200, 1] += 1e-3
        return found

    monkeypatch.setattr(export_module, "played", shifted)
    assert main(["export", run, "--onnx", str(file)]) == 1
    assert "differs from the run's by 0.001" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run"]


def test_greedy_actions_are_compared_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run = trained(tmp_path / "run", "test/Offset-v0")

    forward = onnx_file.ExportedNetwork.forward

    def worst(self: Any, *inputs: Any) -> Any:
        values, _ = forward(self, *inputs)
        return values, values.argmin(-1) + self.first_action

    monkeypatch.setattr(onnx_file.ExportedNetwork, "forward", worst)
    assert main(["export", run, "--onnx", str(tmp_path / "policy.onnx")]) == 1
    assert "differs from the run's by inf" in capsys.readouterr().err


@pytest.mark.slow
def test_statistics_of_observations_are_part_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    run = trained(tmp_path / "run", "CartPole-v1")
    agent = load(run)
    seen = Normalisation((4,), 0.99, num_envs=3)
    for row in np.random.default_rng(0).normal([0.0, 1.0, -2.0, 50.0], [1.0, 0.1, 3.0, 0.01], (40, 3, 4)):
        seen.observe(row)
    agent.normalisation = seen.frozen()
    monkeypatch.setattr(export_module, "load", lambda *_: agent)
    capsys.readouterr()
    assert main(["export", run, "--onnx", str(tmp_path / "policy.onnx"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    # The fourth observation is 50 ± 0.01 where ±1 is seen: as far away as anything is seen.
    assert result["max_abs_difference"] <= result["allowed"]
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    s = np.array([0.5, 1.05, -1.0, 50.005], np.float32)
    (values,), _ = session.run(None, {"observation": s[None]})
    np.testing.assert_allclose(values, agent.values(s), rtol=1e-5, atol=1e-5)


def test_what_cannot_be_exported_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run = trained(tmp_path / "run", "CartPole-v1")
    assert main(["export", run, "--onnx", str(tmp_path / "no" / "x.onnx")]) == 1
    assert "there is no folder" in capsys.readouterr().err
    create_sweep(tmp_path / "sweep", {"total_steps": 1}, [4])
    assert main(["export", str(tmp_path / "sweep"), "--onnx", "x.onnx"]) == 2
    assert f"name one of them, e.g. {tmp_path}/sweep/seed-4" in capsys.readouterr().err
    for name in ("onnxruntime", "onnx"):
        monkeypatch.setitem(sys.modules, name, None)
        assert main(["export", run, "--onnx", str(tmp_path / "x.onnx")]) == 1
        assert 'pip install "neuralq[onnx]"' in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run", "sweep"]


SPACES: dict[str, gym.Space[Any]] = {
    "start": spaces.Discrete(4, start=-2),
    "late": spaces.Discrete(4, start=7),
    "bits": spaces.MultiBinary((2, 3)),
    "digits": spaces.MultiDiscrete([[2, 3], [4, 1]], start=[[1, 0], [-1, 5]]),
    "bytes": spaces.Box(0, 255, (5,), np.uint8),
    "planes": spaces.Box(0, 1, (6, 6, 2), np.uint8),
    "wide": spaces.Box(np.array([1e9, -np.inf]), np.array([1e9 + 100, np.inf]), dtype=np.float64),
    "scalar": spaces.Box(-1, 1, ()),
    "dict": spaces.Dict(
        speed=spaces.Box(-100, 100, (2,)), gear=spaces.Discrete(3, start=1),
        arm=spaces.Tuple([spaces.MultiDiscrete([2, 3]), spaces.Box(0, 255, (2, 2), np.uint8)]),
    ),
}  # fmt: skip


def strange(which: str, masked: bool = False) -> GivenSpace:
    return GivenSpace(SPACES[which], masked)


gym.register("test/Strange-v0", strange)


def untrained(which: str, masked: bool, layout: str, normalised: bool) -> tuple[RunConfig, Agent]:
    kwargs = {"which": which, "masked": masked}
    config = RunConfig(env="test/Strange-v0", env_kwargs=kwargs, layout=layout, reward_scale=0.1)
    envs = make_envs(config, 1)
    space = envs.single_observation_space
    seen = Normalisation(encoder_for(space, wide=True).shape, 0.9, 1, rewards=False) if normalised else None
    stream = Interaction(envs, 0.9, 0, layout == "table", seen)
    for _ in range(9):
        stream.step(choose_legal)
    q = build_q(config, stream.spec, np.random.default_rng(0))
    return config, Agent(q, stream.encoder, stream.spec, -1, 0.1, None if seen is None else seen.frozen())


def choose_legal(s: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.ones(len(s), dtype=torch.int64), torch.ones(len(s))


CASES = [(which, "action-output", which == "wide") for which in SPACES]
CASES += [("start", "table", False), ("digits", "table", False), ("dict", "linear", False), ("dict", "linear", True)]


@pytest.mark.parametrize(
    ("which", "layout", "normalised", "masked"),
    [  # each case once in the fast lane, every second one masked
        pytest.param(*case, masked, marks=[] if masked == bool(number % 2) else pytest.mark.slow)
        for number, case in enumerate(CASES)
        for masked in (False, True)
    ],
)
def test_the_file_takes_what_the_environment_gives(
    which: str, layout: str, normalised: bool, masked: bool, tmp_path: Path
) -> None:
    config, agent = untrained(which, masked, layout, normalised)
    onnx_file.write_onnx(agent, config, tmp_path / "policy.onnx", played(config, agent))
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    names = ["speed", "gear", "arm.0", "arm.1"] if which == "dict" else ["observation"]
    assert [one.name for one in session.get_inputs()] == [*names, *(["action_mask"] if masked else [])]
    env = gym.make("test/Strange-v0", which=which, masked=masked)
    for seed in range(20):
        x, info = env.reset(seed=seed)
        parts = [x["speed"], x["gear"], *x["arm"]] if which == "dict" else [x]
        given = {name: np.asarray(value)[None] for name, value in zip(names, parts, strict=True)}
        mask = info.get("action_mask")
        if masked:
            given["action_mask"] = mask[None] != 0
        values, action = session.run(None, given)
        np.testing.assert_allclose(values[0], agent.values(x, mask), rtol=1e-5, atol=1e-5)
        assert action[0] == agent.predict(x, mask)


def test_the_inputs_of_the_file_are_said(tmp_path: Path, capsys: Capture) -> None:
    kwargs = ["--env-kwargs", json.dumps({"which": "dict", "masked": True})]
    run = trained(tmp_path / "run", "test/Strange-v0", *kwargs)
    capsys.readouterr()
    assert main(["export", run, "--onnx", str(tmp_path / "policy.onnx")]) == 0
    wanted = "speed float32 [n, 2], gear int64 [n], arm.0 int64 [n, 2], arm.1 uint8 [n, 2, 2], action_mask bool [n, 3]"
    assert wanted in capsys.readouterr().out

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
from gymnasium import spaces

from neuralq.apps.cli import export as export_module
from neuralq.apps.cli import main
from neuralq.runs import load
from neuralq.runs.stream import Normalisation
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
        ("CartPole-v1", ["--layout", "separate"], [4]),
        ("CartPole-v1", ["--layout", "linear"], [4]),
        ("neuralq/MitchellGrid-v0", ["--layout", "table"], [5]),  # a state and 4 legal moves
        ("FrozenLake-v1", ["--layout", "action-output"], []),
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
    encoded = np.asarray(agent.encoder.encode_single(observation))
    if mask is not None:
        encoded = np.concatenate([encoded.reshape(-1), mask])
    assert result["input"]["shape"] == ["n", *encoded.shape] and (not shape or list(encoded.shape) == shape)
    values, action = session.run(None, {"observation": np.stack([encoded] * 5).astype(result["input"]["dtype"])})
    expected = agent.values(observation, mask)
    assert values.shape == (5, len(expected)) and played.action_space.contains(np.int64(action[0]))
    np.testing.assert_allclose(values[3], expected, rtol=1e-5, atol=1e-5)
    assert expected[action[3] - agent.first_action] == pytest.approx(expected.max(), abs=1e-5)
    if mask is not None:
        assert np.array_equal(np.isfinite(values[0]), np.asarray(mask) != 0)


def test_dueling_streams_of_a_distribution(tmp_path: Path, capsys: Capture) -> None:
    """They are reshaped twice, and neither may remember the batch that was traced."""
    words = ["--preset", "false", "--total-steps", "40", "--learner", "replay", "--replay.learning-starts", "20"]
    words += ["--replay.distribution", "quantile", "--replay.num-atoms", "5", "--dueling", "true", "--hidden", "8"]
    words += ["--evaluation-episodes", "1", "--run-dir", str(tmp_path / "run")]
    assert main(["train", "CartPole-v1", *words]) == 0
    capsys.readouterr()
    assert main(["export", str(tmp_path / "run"), "--onnx", str(tmp_path / "policy.onnx"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["max_abs_difference"] <= result["allowed"]


def test_a_file_that_differs_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run, file = trained(tmp_path / "run", "CartPole-v1"), tmp_path / "policy.onnx"
    played = export_module._played

    def shifted(*given: Any) -> Any:
        observations, values = played(*given)
        values[200, 1] += 1e-3
        return observations, values

    monkeypatch.setattr(export_module, "_played", shifted)
    assert main(["export", run, "--onnx", str(file)]) == 1
    assert "differs from the run's by 0.001" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run"]


def test_greedy_actions_are_compared_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run = trained(tmp_path / "run", "test/Offset-v0")

    def forward(self: Any, s: Any) -> Any:
        values = self.q.all(s) / self.scale
        return values, values.argmin(-1) + self.first_action

    monkeypatch.setattr(export_module._Exported, "forward", forward)
    assert main(["export", run, "--onnx", str(tmp_path / "policy.onnx")]) == 1
    assert "differs from the run's by inf" in capsys.readouterr().err


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
    # The fourth observation is 50 where ±1 is seen, thousands of deviations away: values are large, and the bound too.
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

"""A plain `nn.Sequential` of a run: the printed lines load it where there is no neuralq and give the agent's values.

Mutants that must die here: weights not transposed · another copy's weights · values in the learner's units · scales,
statistics or the start of a space forgotten · a normalisation without its scale · a difference that is not looked at ·
a file that stays although it is wrong · random numbers of the user's drawn.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from given_spaces import GivenSpace
from gymnasium import spaces
from safetensors import safe_open
from safetensors.torch import load_file

import neuralq
from neuralq.apps.cli import main
from neuralq.learners import ReplaySettings
from neuralq.q import MLP, Conv, Rule
from neuralq.q.custom import Custom
from neuralq.runs import RunConfig
from neuralq.runs.agent import Agent
from neuralq.runs.exporting import torch_file
from neuralq.runs.exporting.played import played
from neuralq.runs.exporting.torch_file import write_torch
from neuralq.runs.folder import checkpoint
from neuralq.runs.recipe.build import build_q
from neuralq.runs.recipe.environments import make_envs
from neuralq.runs.stream import Interaction, Normalisation
from neuralq.runs.stream.encoding import encoder_for

SPACES: dict[str, gym.Space[Any]] = {
    "vector": spaces.Box(-1, 1, (4,)),
    "scaled": spaces.Box(np.array([-500.0, 0.0]), np.array([100.0, 1000.0]), dtype=np.float64),
    "matrix": spaces.Box(-1, 1, (3, 2)),
    "start": spaces.Discrete(4, start=-2),
    "planes": spaces.Box(0, 255, (8, 8, 3), np.uint8),
    "stack": spaces.Box(0, 255, (2, 8, 8, 3), np.uint8),
    "flags": spaces.Box(0, 1, (6, 6), np.bool_),
    "dict": spaces.Dict(speed=spaces.Box(-100, 100, (2,)), gear=spaces.Discrete(3, start=1)),
}


def odd(which: str, masked: bool = False) -> GivenSpace:
    return GivenSpace(SPACES[which], masked)


gym.register("test/Odd-v0", odd)
NORMED = {"body": MLP((7, 5), layer_norm=True, activation="tanh")}
NOISY = {"learner": "replay", "replay": ReplaySettings(noisy=True), **NORMED}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "plain": ("vector", {"body": MLP((8, 8))}),
    "normalised layers": ("vector", NORMED),
    "without a scale": ("vector", {"body": MLP((8,), layer_norm=True, affine=False, activation="leaky_relu")}),
    "separate": ("matrix", {"layout": "separate", **NORMED}),
    "action-input": ("scaled", {"layout": "action-input", **NORMED}),
    "linear": ("matrix", {"layout": "linear"}),
    "linear states": ("start", {"layout": "linear"}),
    "table": ("start", {"layout": "table"}),
    "one-hot": ("start", NORMED),
    "frames": ("planes", {"body": Conv((3, 4), (3, 2), (1, 2), (5,))}),
    "separate frames": ("planes", {"layout": "separate", "body": Conv((3, 4), (3, 2), (1, 2), (5,))}),
    "stacked frames": ("stack", {"body": Conv((3,), (3,), (1,), (5,), layer_norm=False)}),
    "flags": ("flags", {"body": Conv((3,), (3,), (1,), (5,))}),
    "composed": ("dict", NORMED),
    "noisy": ("vector", NOISY),
    "noisy and separate": ("start", {"layout": "separate", **NOISY}),
    "advised": ("vector", {"body": MLP((8,), activation="sigmoid"), "rules": (Rule({0: True, 3: False}, 1),)}),
}


def untrained(which: str, masked: bool = False, normalised: bool = False, **settings: Any) -> tuple[RunConfig, Agent]:
    """An agent with drawn weights, also where they start at 0."""
    config = RunConfig(env="test/Odd-v0", env_kwargs={"which": which, "masked": masked}, reward_scale=0.1, **settings)
    envs = make_envs(config, 1)
    wide = encoder_for(envs.single_observation_space, wide=True) if normalised else None
    seen = None if wide is None else Normalisation(wide.shape, 0.9, 1, rewards=False)
    stream = Interaction(envs, 0.9, 0, config.layout == "table", seen)
    for _ in range(9):
        stream.step(lambda s: (torch.ones(len(s), dtype=torch.int64), torch.ones(len(s))))
    q = build_q(config, stream.spec, np.random.default_rng(0))
    for parameter in q.parameters():  # type: ignore[attr-defined]
        parameter.data += 0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
    envs.close()
    return config, Agent(q, stream.encoder, stream.spec, -1, 0.1, None if seen is None else seen.frozen())


@pytest.mark.parametrize(
    ("case", "masked"),
    [  # each case once in the fast lane, every second one masked
        pytest.param(case, masked, marks=[] if masked == bool(number % 2) else pytest.mark.slow)
        for number, case in enumerate(CASES)
        for masked in (False, True)
    ],
)
def test_the_lines_give_the_agents_values(case: str, masked: bool, tmp_path: Path) -> None:
    which, settings = CASES[case]
    config, agent = untrained(which, masked, **settings)
    before = torch.random.get_rng_state()
    seen = played(config, agent)
    lines, difference = write_torch(agent, config, tmp_path / "q.safetensors", seen)
    assert torch.equal(torch.random.get_rng_state(), before) and "neuralq" not in lines
    names: dict[str, Any] = {}
    exec(lines, names)
    given = torch_file._given(agent, seen)
    found = names["values"](given).numpy()
    legal = np.isfinite(seen.values)
    np.testing.assert_allclose(
        found[legal], seen.values[legal], rtol=1e-5, atol=1e-5 * np.abs(seen.values[legal]).max()
    )
    assert difference == pytest.approx(np.abs(found - seen.values)[legal].max(), abs=1e-4)
    names["values"](given[:1])  # in batches of any size


def test_statistics_of_observations_are_part_of_it(tmp_path: Path) -> None:
    config, agent = untrained("scaled", normalised=True, body=MLP((8,)))
    write_torch(agent, config, tmp_path / "q.safetensors", played(config, agent))


def test_it_loads_where_there_is_no_neuralq(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = neuralq.train(
        "CartPole-v1", tmp_path / "run", total_steps=64, evaluation_episodes=1, num_envs=2, num_steps=16, hidden=(8,),
        num_minibatches=1, resume_probe=False,
    )  # fmt: skip
    file = tmp_path / "cart.safetensors"
    capsys.readouterr()
    assert main(["export", str(run.run_dir), "--to", "torch", "--out", str(file)]) == 0
    told, lines = capsys.readouterr().out.split("\n\n", 1)
    assert "in double precision and rounded none, bit for bit" in told
    program = f"import sys\nsys.modules['neuralq'] = None\n{lines}\nprint(values([[.1, .2, -.1, .3]]).tolist())"
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path)
    expected = neuralq.load(run).values(np.array([0.1, 0.2, -0.1, 0.3], np.float32))
    np.testing.assert_allclose(json.loads(out.stdout)[0], expected, rtol=1e-5)
    with safe_open(str(file), "pt") as opened:
        header = opened.metadata()
    assert header["python"].splitlines() == [f"FILE = {file.name!r}", *lines.splitlines()[1:-1]]
    # Weights are the checkpoint's bit for bit, by the names that both have for them.
    saved = checkpoint.load_newest(run.run_dir / "checkpoints").state
    start, shape = saved["layers"]["trunk.layers.0.weight"]
    mine = saved["learner"]["average"]["values"][start : start + 32].view(shape)[0].T
    assert torch.equal(load_file(str(file))["0.weight"], mine)


def test_what_is_no_chain_of_layers_is_refused_with_a_way_out(tmp_path: Path) -> None:
    config, agent = untrained("vector", dueling=True, body=MLP((8, 8)))
    seen = played(config, agent)
    with pytest.raises(ValueError, match=r"DuelingQ is no chain of layers; --to onnx"):
        write_torch(agent, config, tmp_path / "q.safetensors", seen)
    config, agent = untrained("vector", body=Custom("neuralq.q.custom:Example"))
    with pytest.raises(ValueError, match=r"agent\.q\.state_dict\(\)"):
        write_torch(agent, config, tmp_path / "q.safetensors", played(config, agent))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("wrong", ["value", "tensor"])
def test_a_file_that_differs_is_not_kept(wrong: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, agent = untrained("vector", body=MLP((8, 8)))
    seen = played(config, agent)
    if wrong == "value":
        seen.values[100, 1] += 1e-3
    else:
        stored = torch_file.save_file
        monkeypatch.setattr(
            torch_file, "save_file",
            lambda tensors, *rest, **more: stored({**tensors, "0.bias": tensors["0.bias"] + 1e-7}, *rest, **more),
        )  # fmt: skip
    told = "differs from the run's by 0.00" if wrong == "value" else "the tensor 0.bias came out different"
    with pytest.raises(ValueError, match=f"{told}.*; nothing was written"):
        write_torch(agent, config, tmp_path / "q.safetensors", seen)
    assert not list(tmp_path.iterdir())


def test_names_of_files_say_what_is_meant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="no folder"):
        neuralq.export(tmp_path, tmp_path / "no" / "q.safetensors")
    with pytest.raises(ValueError, match="to must be one of 'torch', 'onnx'"):
        neuralq.export(tmp_path, tmp_path / "q", to="tflite")
    with pytest.raises(ValueError, match="a run is named by its folder"):
        neuralq.export(3, tmp_path / "q")
    assert main(["export", str(tmp_path), "--onnx", "x.onnx", "--to", "torch"]) == 2
    assert "--onnx names the file and its format" in capsys.readouterr().err

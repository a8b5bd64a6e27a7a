"""Bodies of the user's own: every layout, its own gradients, stored, resumed, loaded in another process, and refused.

Mutants that must die here: copies of separate networks that share weights · weights drawn from the global generator, or
moving it · the action joined before the module · a module that is not a function let through · settings not stored.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from neuralq.apps.cli import main
from neuralq.learners import ReplaySettings, RolloutSettings
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Custom, DuelingQ, SeparateQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss, TorchEngine
from neuralq.runs import RunConfig, evaluate_run, load, resume, train
from neuralq.runs.recipe.config import config_from_dict, config_to_dict

SOURCE = """
import torch
from torch import nn

class Tower(nn.Module):
    def __init__(self, shape, width=6):
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(torch.Size(shape).numel(), width), nn.SiLU())
    def forward(self, s):
        return self.layers(s)

class Forgetful(nn.Module):
    def __init__(self, shape):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(4, 3), nn.Dropout(0.5))
    def forward(self, s):
        return self.layers(s)

class Counting(nn.Module):
    def __init__(self, shape):
        super().__init__()
        self.norm = nn.BatchNorm1d(4)
    def forward(self, s):
        return self.norm(s)

class Flat(nn.Module):
    def __init__(self, shape):
        super().__init__()
        self.layer = nn.Linear(4, 3)
    def forward(self, s):
        return self.layer(s)[0]

class Rigid(nn.Module):
    def __init__(self, shape):
        super().__init__()
        self.layer = nn.Linear(7, 3)
    def forward(self, s):
        return self.layer(s)

def function(shape):
    return nn.Linear(4, 3)
"""
TOWER = Custom("own_nets:Tower", {"width": 5})


@pytest.fixture(autouse=True)
def own_nets(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path_factory.mktemp("own")
    (folder / "own_nets.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "own_nets", raising=False)


@pytest.mark.parametrize("kind", [ActionOutputQ, SeparateQ, ActionInputQ])
def test_a_layout_is_its_dense_layers_after_the_module(kind: Any) -> None:
    q = kind((4,), 3, Custom("own_nets:Tower", {"width": 5}, hidden=(7,)), rng=3)
    s = torch.randn(2, 6, 4, generator=torch.Generator().manual_seed(0))
    values = q.all(s)
    assert values.shape == (2, 6, 3)
    a = torch.arange(12).reshape(2, 6) % 3
    torch.testing.assert_close(q.at(s, a), values.gather(-1, a[..., None])[..., 0])
    towers = list(q.input.stem.copies)
    assert len(towers) == (3 if kind is SeparateQ else 1)
    for action in range(3):  # the same by hand
        h = towers[action if kind is SeparateQ else 0](s[0])
        if kind is ActionInputQ:
            h = torch.cat([h, torch.eye(3)[action].expand(6, 3)], -1)
        (first, last), copy = q.trunk.layers, action if kind is SeparateQ else 0
        x = torch.relu(h @ first.weight[copy] + first.bias[copy])
        out = x @ last.weight[copy] + last.bias[copy]
        torch.testing.assert_close(values[0, :, action], out[:, action if kind is ActionOutputQ else 0])
    if kind is SeparateQ:
        assert not torch.equal(towers[0].layers[1].weight, towers[1].layers[1].weight)


def test_weights_come_from_the_generator_and_leave_pytorchs_alone() -> None:
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    one, same, other = (ActionOutputQ((4,), 2, TOWER, rng=seed) for seed in (1, 1, 2))
    assert torch.equal(before, torch.random.get_rng_state())
    s = torch.ones(1, 4)
    assert torch.equal(one.all(s), same.all(s)) and not torch.equal(one.all(s), other.all(s))


def test_the_gradient_reaches_the_module_and_the_engine_is_torch() -> None:
    engine = make_engine(ActionOutputQ((4,), 2, TOWER, rng=0), Loss(), "auto")
    assert isinstance(engine, TorchEngine)
    engine.loss_gradient(torch.ones(3, 4), torch.tensor([0, 1, 1]), torch.ones(3))
    assert all(p.grad is not None and bool((p.grad != 0).any()) for p in engine.q.parameters())  # type: ignore[attr-defined]
    dueling = DuelingQ((4,), 2, Custom("own_nets:Tower", hidden=(8, 8)), rng=0)
    assert dueling.all(torch.ones(3, 4)).shape == (3, 2)


def test_a_configuration_holds_it() -> None:
    config = RunConfig(body=Custom("own_nets:Tower", {"width": 9}, hidden=(4,), layer_norm=True))
    stored = json.loads(json.dumps(config_to_dict(config)))
    assert stored["body"]["class"] == "Custom" and config_from_dict(stored) == config
    assert config_from_dict({"body": "own_nets:Tower"}).body == Custom("own_nets:Tower")


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("own_nets:Forgetful", "something else of the same observations when called again"),
        ("own_nets:Counting", "something else of the same observations when called again"),
        ("own_nets:Flat", r"must make \[B, d\] torch.float32 of \[B, 4\], got torch.float32 of shape \(3,\)"),
        ("own_nets:Rigid", r"fails on observations of shape \(2, 4\)"),
        ("own_nets:Nobody", "cannot import the body 'own_nets:Nobody': .*no attribute"),
        ("nowhere_at_all:Tower", "cannot import the body .*No module named"),
        ("own_nets:function", "must be a class of torch.nn.Module"),
        ("Tower", "named 'package.module:Class', got 'Tower'"),
        ("own nets:Tower", "named 'package.module:Class'"),
    ],
)
def test_what_is_no_body_is_refused_with_the_reason(module: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ActionOutputQ((4,), 2, Custom(module), rng=0)


def test_other_refusals() -> None:
    with pytest.raises(ValueError, match=r"cannot make own_nets:Tower.*unexpected keyword argument 'breadth'"):
        ActionOutputQ((4,), 2, Custom("own_nets:Tower", {"breadth": 3}), rng=0)
    with pytest.raises(ValueError, match="one action be best everywhere; give the body hidden"):
        RunConfig(layout="action-input", body=TOWER)
    with pytest.raises(ValueError, match="kernels for MLP networks only"):
        RunConfig(engine="compiled", body=TOWER)
    with pytest.raises(ValueError, match="dueling streams need a hidden layer"):
        RunConfig(learner="replay", dueling=True, body=TOWER)
    with pytest.raises(ValueError, match="or 'module:Class' of your own, got 'Tower'"):
        config_from_dict({"body": "Tower"})


def test_a_run_with_it_is_resumed_bit_for_bit_and_loaded(tmp_path: Path) -> None:
    small = RolloutSettings(num_envs=2, num_steps=16, num_epochs=1)
    config = RunConfig(
        body=TOWER, total_steps=320, evaluate_every=160, evaluation_episodes=1, checkpoint_every=64, rollout=small
    )
    whole = train(config, tmp_path / "whole")
    part = train(RunConfig(**{**vars_of(config), "total_steps": 160}), tmp_path / "parts")
    assert 160 <= part.env_steps < 320
    assert resume(tmp_path / "parts", 320).parameters_sha256 == whole.parameters_sha256
    agent = load(tmp_path / "whole")
    assert np.isfinite(agent.values(np.zeros(4, np.float32))).all()
    assert len(evaluate_run(tmp_path / "whole", 2).returns) == 2


def vars_of(config: RunConfig) -> dict[str, Any]:
    return {name: getattr(config, name) for name in config.__dataclass_fields__}


def test_from_the_command_line_in_the_folder_where_it_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other_nets.py").write_text(SOURCE)
    (tmp_path / "other_game.py").write_text(
        "import gymnasium as gym\nfrom gymnasium.envs.classic_control import CartPoleEnv\n"
        "gym.register('OtherGame-v0', CartPoleEnv, max_episode_steps=20)\n"
    )
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    words = ["--rollout.num-envs", "2", "--rollout.num-steps", "16", "--total-steps", "32"]
    words += ["--evaluation-episodes", "1", "--run-dir", "run"]
    assert main(["train", "other_game:OtherGame-v0", *words, "--body", "other_nets:Tower", "--hidden", "8"]) == 0
    assert sys.path == before
    stored = json.loads((tmp_path / "run" / "config.json").read_text())
    assert stored["body"] == {
        "class": "Custom", "module": "other_nets:Tower", "settings": {}, "hidden": [8], "layer_norm": False,
        "activation": "relu",
    }  # fmt: skip


@pytest.mark.slow
def test_replay_and_pictures_take_it_too(tmp_path: Path) -> None:
    settings = ReplaySettings(learning_starts=20, batch_size=8, train_period=8)
    config = RunConfig(env="FrozenLake-v1", learner="replay", replay=settings, body=TOWER, total_steps=64)
    assert train(config, tmp_path / "lake").env_steps == 64
    q = ActionOutputQ((2, 5, 5), 2, Custom("own_nets:Tower"), features=nn.Identity(), rng=0)
    assert q.all(torch.zeros(3, 2, 5, 5)).shape == (3, 2)
    assert isinstance(RunConfig(body=MLP((8,))).body, MLP)

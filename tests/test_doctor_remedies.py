"""What the doctor prints is done: the commands that should mend a subject do, and its custom worlds are told apart."""

from __future__ import annotations

import io
import json
import shlex
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import TransformObservation, TransformReward
from torch import nn

import neuralq
from neuralq.apps.cli import main
from neuralq.doctor import Report, examination, examine


def saved(value: Any) -> bytes:
    out = io.BytesIO()
    torch.save(value, out)
    return out.getvalue()


def file_of_stable_baselines(path: Path) -> Path:
    """What Stable-Baselines3's DQN saves after 50,000 steps with its own defaults, but for the weights."""
    net = nn.Sequential(nn.Linear(4, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 2))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in net.parameters():
            p.copy_(torch.randn(p.shape, generator=generator) * 0.3)
    state = {f"{n}.q_net.{k}": v for n in ("q_net", "q_net_target") for k, v in net.state_dict().items()}
    told = {
        "observation_space": {":type:": "Box", "dtype": "float32", "_shape": [4]},
        "action_space": {":type:": "Discrete", "n": "2", "start": "0"}, "policy_kwargs": {},
        "gamma": 0.99, "tau": 1.0, "n_steps": 1, "batch_size": 32, "buffer_size": 1_000_000, "learning_starts": 100,
        "gradient_steps": 1, "target_update_interval": 10_000, "num_timesteps": 50_000, "_n_updates": 12_475,
        "learning_rate": 1e-4, "exploration_fraction": 0.1, "exploration_initial_eps": 1.0,
        "exploration_final_eps": 0.05,
    }  # fmt: skip
    groups = {"state": {}, "param_groups": [{"lr": 1e-4, "params": [0]}]}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps(told))
        archive.writestr("policy.pth", saved(OrderedDict(state)))
        archive.writestr("policy.optimizer.pth", saved(groups))
        archive.writestr("_stable_baselines3_version", "2.9.2")
    return path


@pytest.fixture(scope="module")
def confirms(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The two lines that would confirm reach: of Stable-Baselines3, and of neuralq with the same settings."""
    path = file_of_stable_baselines(tmp_path_factory.mktemp("sb3") / "agent.zip")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(examination, "_MEASUREMENTS", {"V5": examination._MEASUREMENTS["V5"]})
        patch.setattr("neuralq.doctor.exam.case.NUM_GREEDY", 10)
        report = examine(path, "CartPole-v1", budget_s=3)
    reach = next(one for one in report.findings if one.id == "V5")
    return reach.confirm.splitlines()


def test_the_lines_that_confirm_reach_name_the_same_settings_but_three(confirms: list[str]) -> None:
    """4 · 299 / 10 = 120 copies, so that of 12,475 updates there are 103 between two: 413 environment steps."""
    sb3, ours = confirms
    assert sb3.startswith("DQN('MlpPolicy', env, n_steps=10, target_update_interval=413, learning_rate=0.001)")
    words = shlex.split(ours)
    given = dict(zip(words[3::2], words[4::2], strict=True))
    assert words[:3] == ["neuralq", "train", "CartPole-v1"] and given == {
        "--preset": "false", "--learner": "replay", "--total-steps": "50000", "--gamma": "0.99", "--hidden": "64,64",
        "--epsilon-start": "1.0", "--epsilon-end": "0.05", "--epsilon-decay-steps": "5000",
        "--replay.batch-size": "32", "--replay.capacity": "50000", "--replay.learning-starts": "100",
        "--replay.train-period": "4",
        "--replay.num-steps": "10", "--replay.target-period-updates": "103", "--replay.learning-rate": "0.001",
    }  # fmt: skip


@pytest.mark.slow
def test_the_command_that_confirms_reach_mends_the_return(
    confirms: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three seeds with the settings as they were, and with the three that it changes."""
    ours = shlex.split(confirms[1])[1:]
    was = {"--replay.num-steps": "1", "--replay.target-period-updates": "2495", "--replay.learning-rate": "0.0001"}
    before = list(ours)
    for name, value in was.items():
        before[before.index(name) + 1] = value

    def returned(words: list[str], run: str, seed: int) -> float:
        main([*words, "--seed", str(seed), "--run-dir", str(tmp_path / run), "--resume-probe", "false", "--json"])
        return float(json.loads(capsys.readouterr().out.splitlines()[-1])["greedy_return"])

    old = [returned(before, f"before{seed}", seed) for seed in range(3)]
    new = [returned(ours, f"after{seed}", seed) for seed in range(3)]
    assert max(old) < 250 and min(new) > 400, (old, new)


@pytest.mark.slow
def test_defaults_of_stable_baselines_are_named_reach_and_the_line_that_is_printed_mends_them(
    confirms: list[str], tmp_path: Path
) -> None:
    """DQN as it comes, 50,000 steps on CartPole-v1: what the file says is what `confirms` was made of."""
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.evaluation import evaluate_policy

    env, path = gym.make("CartPole-v1"), tmp_path / "agent.zip"
    as_it_comes = stable_baselines3.DQN("MlpPolicy", env, seed=0).learn(50_000)
    as_it_comes.save(path)
    report = examine(path, "CartPole-v1", budget_s=50)
    first = report.findings[0]
    assert (first.id, first.grade, report.cause) == ("V5", "B", "algorithm") and report.seconds < 60
    assert first.confirm.splitlines() == confirms
    called = {"DQN": lambda *given, **named: stable_baselines3.DQN(*given, seed=0, **named), "env": env}
    mended = eval(first.confirm.splitlines()[0], called)  # the line as it is printed
    before, after = (
        float(evaluate_policy(model, gym.make("CartPole-v1"), 20)[0]) for model in (as_it_comes, mended)
    )  # fmt: skip
    assert before < 250 and after > 300


# Environments that are at fault, each with a network that was trained in it.


class EndsAtLimit(gym.Wrapper[Any, Any, Any, Any]):
    """Reports its own limit of 100 steps as termination."""

    def reset(self, **given: Any) -> Any:
        self.t = 0
        return self.env.reset(**given)

    def step(self, action: Any) -> Any:
        self.t += 1
        s, r, terminated, truncated, told = self.env.step(action)
        return s, r, terminated or self.t >= 100, truncated, told


def ends_at_its_limit() -> gym.Env[Any, Any]:
    return EndsAtLimit(gym.make("CartPole-v1", max_episode_steps=-1))


def hides_its_velocities() -> gym.Env[Any, Any]:
    space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    return TransformObservation(gym.make("CartPole-v1", max_episode_steps=100), lambda s: s[[0, 2]], space)


def pays_a_thousand() -> gym.Env[Any, Any]:
    return TransformReward(gym.make("CartPole-v1", max_episode_steps=100), lambda r: 1000.0 * float(r))


FAULTY = {"E3": ends_at_its_limit, "E6": hides_its_velocities, "E5": pays_a_thousand}


def trained(make: Any, folder: Path, **settings: Any) -> Report:
    given = {"preset": False, "learner": "replay", "total_steps": 10_000, "epsilon_decay_steps": 5_000, **settings}
    run = neuralq.train(make, folder, seed=0, resume_probe=False, evaluation_episodes=1, **given)
    return examine(run, make, gamma=0.99)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTY)
def test_faults_of_an_environment_are_named_before_what_they_do_to_values(name: str, tmp_path: Path) -> None:
    report = trained(FAULTY[name], tmp_path / "run")
    assert (report.cause, report.findings[0].id) == ("environment", name) and report.seconds < 60

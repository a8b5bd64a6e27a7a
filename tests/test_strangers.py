"""What people from Gymnasium, Stable-Baselines3, CleanRL and Tianshou type first works, or says what to type instead.

What is said to be typed instead is typed here, too.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import neuralq
from neuralq.apps.cli import main

TINY = "total_steps=64, evaluation_episodes=1, num_envs=2, num_steps=16, hidden=(8,), resume_probe=False"
WORKS = {
    "train by id": f'neuralq.train("CartPole-v1", {TINY})',
    "train on an environment, with a rate": f'neuralq.train(gymnasium.make("CartPole-v1"), learning_rate=1e-3, {TINY})',
    "train on a function": f'neuralq.train(lambda: gymnasium.make("CartPole-v1"), {TINY})',
    "train by the keyword env": f'neuralq.train(env="CartPole-v1", {TINY})',
    "numbers as they are": 'neuralq.train("CartPole-v1", total_steps=1e2, learner="replay", learning_starts=200, '
    "evaluation_episodes=1, resume_probe=False)",
    "load": "neuralq.load(run.run_dir)",
    "load a run": "neuralq.load(run)",
    "predict": "env.step(agent.predict(obs))",
    "predict many": "agent.predict(np.stack([obs, obs]))[1]",
    "call an agent": "agent(obs)",
    "call the network": "agent.q(torch.as_tensor(obs)[None])",
    "evaluate an agent": "neuralq.evaluate(agent, 3).mean",
    "evaluate a run": "neuralq.evaluate(run, num_episodes=3)",
    "export": 'neuralq.export(run, "q.safetensors")',
    "a buffer": "neuralq.ReplayBuffer(1000, (4,), np.float32)",
    "a network": "neuralq.ActionOutputQ(4, 2)(torch.zeros(3, 4))",
    "solve": 'neuralq.solve("FrozenLake-v1", 0.9)',
    "resume": "neuralq.resume(run, total_steps=96)",
}
ANSWERED = {
    "the class of SB3": ('neuralq.DQN("MlpPolicy", "CartPole-v1")', 'neuralq.train("CartPole-v1", learner="replay")'),
    "PPO": ('neuralq.PPO("MlpPolicy", env)', 'neuralq.train("CartPole-v1", learner="replay")'),
    "make": ('neuralq.make("CartPole-v1")', 'gymnasium.make("CartPole-v1")'),
    "vectors": ('neuralq.make_vec_env("CartPole-v1", 8)', 'neuralq.train("CartPole-v1", num_envs=8)'),
    "Tianshou's buffer": ("neuralq.VectorReplayBuffer(20000, 10)", "neuralq.ReplayBuffer(1000, (4,), np.float32)"),
    "CleanRL's network": ("neuralq.QNetwork(env)", "neuralq.ActionOutputQ(4, 2)"),
    "learn": ("agent.learn(10_000)", "neuralq.resume(run, total_steps=...)"),
    "save": ('agent.save("dqn_cartpole")', "neuralq.export(run, 'q.safetensors')"),
    "deterministic": ("agent.predict(obs, deterministic=True)", "action = agent.predict(observation)"),
    "two results": ("action, _ = agent.predict(obs)", "action = agent.predict(observation)"),
    "evaluate_policy": ("neuralq.evaluate_policy(agent, env)", "neuralq.evaluate(agent)"),
    "evaluate in an environment": ("neuralq.evaluate(agent, env)", "neuralq.evaluate(run)"),
    "timesteps": ('neuralq.train("CartPole-v1", timesteps=1e5)', "total_steps"),
    "total_timesteps": ('neuralq.train("CartPole-v1", total_timesteps=1e5)', "total_steps"),
    "buffer_size": ('neuralq.train("CartPole-v1", buffer_size=1000)', "capacity"),
    "policy": ('neuralq.train("CartPole-v1", policy="MlpPolicy")', "layout"),
    "net_arch": ('neuralq.train("CartPole-v1", net_arch=[64])', "hidden"),
    "what the environment takes": (
        'neuralq.train("FrozenLake-v1", is_slippery=False)', "env_kwargs={'is_slippery': False}"
    ),
    "a learner by its paper": ('neuralq.train("CartPole-v1", learner="dqn")', "'replay'"),
    "a vector environment": ('neuralq.train(gymnasium.make_vec("CartPole-v1", 2))', "num_envs"),
    "spaces as sizes": ("neuralq.ActionOutputQ(env.observation_space, env.action_space)", "its shape"),
    "a seed for all": ("neuralq.set_random_seed(1)", 'neuralq.train("CartPole-v1", seed=1)'),
    "record": ("neuralq.record(run)", 'neuralq.record(run, gif="run.gif")'),
}  # fmt: skip
INSTEAD = {
    'neuralq.train("CartPole-v1", learner="replay")': 'neuralq.train("CartPole-v1", learner="replay", total_steps=40, '
    "learning_starts=10, evaluation_episodes=1)",
    'neuralq.train("CartPole-v1", num_envs=8)': f'neuralq.train("CartPole-v1", {TINY})',
    'neuralq.train("CartPole-v1", seed=1)': f'neuralq.train("CartPole-v1", seed=1, {TINY})',
    "neuralq.resume(run, total_steps=...)": "neuralq.resume(run, total_steps=128)",
    "neuralq.evaluate(agent)": "neuralq.evaluate(agent, 2)",
    "neuralq.evaluate(run)": "neuralq.evaluate(run, 2)",
    "total_steps": f'neuralq.train("CartPole-v1", {TINY})',
    "capacity": 'neuralq.train("CartPole-v1", learner="replay", capacity=1000, total_steps=40, learning_starts=10, '
    "evaluation_episodes=1)",
    "layout": f'neuralq.train("CartPole-v1", layout="separate", {TINY})',
    "hidden": f'neuralq.train("CartPole-v1", {TINY})',
    "env_kwargs={'is_slippery': False}": 'neuralq.train("FrozenLake-v1", env_kwargs={"is_slippery": False}, '
    "total_steps=64, evaluation_episodes=1, evaluation_max_steps=20, resume_probe=False)",
    "'replay'": 'neuralq.with_preset("CartPole-v1", learner="replay")',
    "num_envs": f'neuralq.train("CartPole-v1", {TINY})',
    "its shape": "neuralq.ActionOutputQ(env.observation_space.shape, env.action_space.n)",
    "action = agent.predict(observation)": "env.step(agent.predict(obs))",
}
"""What is typed for an answer that does not stand there as it can be typed, or would take long."""


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    env = gym.make("CartPole-v1")
    known: dict[str, Any] = {"neuralq": neuralq, "gymnasium": gym, "np": np, "torch": torch, "env": env}
    folder = tmp_path_factory.mktemp("runs")
    known["run"] = eval(f'neuralq.train("CartPole-v1", {str(folder / "run")!r}, {TINY})', known)
    known["agent"], known["obs"] = neuralq.load(known["run"]), env.reset(seed=0)[0]
    return known


@pytest.mark.parametrize("case", WORKS)
def test_it_works(case: str, names: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert eval(WORKS[case], names) is not None


@pytest.mark.parametrize("case", ANSWERED)
def test_it_is_answered_with_what_to_type(
    case: str, names: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed, instead = ANSWERED[case]
    monkeypatch.chdir(tmp_path)
    with pytest.raises((AttributeError, TypeError, ValueError)) as told:
        exec(typed, dict(names))
    assert instead in str(told.value) and "\n" not in str(told.value)
    if case != "record":  # films are tested where their packages are
        exec(INSTEAD.get(instead, instead), dict(names))


SHELL = {
    "CleanRL's options": (
        ["train", "--env-id", "CartPole-v1", "--total-timesteps", "1e5"],
        "--env-id is called --env here, --total-timesteps is called --total-steps here",
    ),
    "an environment as the command": (["CartPole-v1"], "neuralq train CartPole-v1"),
    "an algorithm as the learner": (["train", "CartPole-v1", "--learner", "dqn"], "'replay'"),
}


@pytest.mark.parametrize("case", SHELL)
def test_the_shell_answers_too(case: str, capsys: pytest.CaptureFixture[str]) -> None:
    argv, told = SHELL[case]
    assert main(argv) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    again = ["train", "--env", "CartPole-v1", "--total-steps", "1e5", "--learner", "replay", "--print_config"]
    assert main(again) == 0


@pytest.mark.whole
def test_scripts_of_algorithms_are_options() -> None:
    found = subprocess.run([sys.executable, "-m", "neuralq.dqn"], capture_output=True, text=True, check=False)
    assert found.returncode == 1
    told = "neuralq: algorithms are options: python -m neuralq train CartPole-v1 --learner replay"
    assert found.stderr.strip() == told
    assert main([*told.split("neuralq ")[1].split(), "--print_config"]) == 0

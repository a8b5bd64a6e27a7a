"""Agents that are ill in a known way, and healthy ones, for judging the doctor (doctor_study.py).

    python scripts/doctor_subjects.py 7 --seed 0 --out agents   # trains one and examines it

Subjects are trained by Stable-Baselines3 (extra bench) where it can express the disease, else by the plain DQN below,
so that the doctor is not judged on neuralq's own learner alone. Diseases are planted in CartPole with a limit of 100
steps, γ = 0.9 and 35 copies of the target network, with which the same learner without a disease (0 and 0p) has right
values: with γ = 0.99 and as many copies as that takes, DQN overestimates by itself. Where the disease is about γ it has
its own. Healthy runs are neuralq's presets on four environments, and Stable-Baselines3 on FrozenLake.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation, TransformReward
from torch import nn

from neuralq.doctor import Settings, examine
from neuralq.doctor.subject import Subject, of_network

GAMMA, LIMIT, STEPS = 0.9, 100, 4_000
Maker = Callable[[], gym.Env[Any, Any]]


@dataclass(frozen=True)
class Plan:
    """How the plain DQN learns, its mistakes included. There are 3 / (1 − γ) copies and more."""

    steps: int = STEPS
    lr: float = 1e-3
    gamma: float = GAMMA
    hidden: tuple[int, ...] = (64, 64)
    batch: int = 64
    buffer: int = 100_000
    starts: int = 400
    every: int = 8
    updates: int = 3
    copy_every_updates: int = 40
    epsilon: tuple[float, float] = (1.0, 0.05)
    sign: float = 1.0
    mask: bool = True
    truncation_ends: bool = False


def dqn(make: Maker, plan: Plan, seed: int) -> tuple[nn.Module, nn.Module, Settings, dict[str, Any]]:
    """DQN (Mnih et al. 2015) in a page: the network, its target, how it was trained, and its buffer."""
    rng, env = np.random.default_rng(seed), make()
    width, num_actions = int(np.prod(env.observation_space.shape or ())), int(env.action_space.n)  # type: ignore[attr-defined]
    net, late = (_mlp(width, plan.hidden, num_actions, seed) for _ in range(2))
    late.load_state_dict(net.state_dict())
    optimiser = torch.optim.Adam(net.parameters(), lr=plan.lr)
    size = min(plan.buffer, plan.steps)
    rows: dict[str, Any] = {
        "obs": np.zeros((size, width), np.float32), "next_obs": np.zeros((size, width), np.float32),
        "action": np.zeros(size, np.int64), "reward": np.zeros(size, np.float32),
        "terminated": np.zeros(size, bool), "truncated": np.zeros(size, bool),
    }  # fmt: skip
    s, _ = env.reset(seed=seed)
    num_updates = 0
    for t in range(plan.steps):
        share = min(t / (0.3 * plan.steps), 1.0)
        epsilon = plan.epsilon[0] + share * (plan.epsilon[1] - plan.epsilon[0])
        with torch.no_grad():
            q = net(torch.as_tensor(s, dtype=torch.float32))
        a = int(rng.integers(num_actions)) if rng.random() < epsilon else int(q.argmax())
        s_t, r, terminated, truncated, _ = env.step(a)
        i = t % size
        rows["obs"][i], rows["next_obs"][i], rows["action"][i] = s, s_t, a
        rows["reward"][i] = plan.sign * float(r)
        rows["terminated"][i], rows["truncated"][i] = terminated or (plan.truncation_ends and truncated), truncated
        s = env.reset()[0] if terminated or truncated else s_t
        if t >= plan.starts and t % plan.every == 0:
            for _ in range(plan.updates):
                _update(net, late, optimiser, rows, rng.integers(min(t + 1, size), size=plan.batch), plan)
                num_updates += 1
                if num_updates % plan.copy_every_updates == 0:
                    late.load_state_dict(net.state_dict())
    env.close()
    known = Settings(
        learning_rate=plan.lr, target_period_updates=plan.copy_every_updates, updates=num_updates,
        env_steps=plan.steps, batch_size=plan.batch, capacity=plan.buffer, num_steps=1, lambda_=0,
        epsilon_start=plan.epsilon[0], epsilon_end=plan.epsilon[1],
    )  # fmt: skip
    return net, late, known, {name: column[: min(plan.steps, size)] for name, column in rows.items()}


def _mlp(width: int, hidden: tuple[int, ...], num_actions: int, seed: int) -> nn.Module:
    layers: list[nn.Module] = []
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for below, above in zip((width, *hidden), hidden, strict=False):
            layers += [nn.Linear(below, above), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(hidden[-1], num_actions))


def _update(net: nn.Module, late: nn.Module, optimiser: Any, rows: Mapping[str, Any], pick: Any, plan: Plan) -> None:
    s, a, r, s_t, ended = (
        torch.as_tensor(rows[name][pick]) for name in ("obs", "action", "reward", "next_obs", "terminated")
    )
    with torch.no_grad():
        goes_on = 1.0 - ended.float() if plan.mask else torch.ones(len(pick))
        target = r + plan.gamma * goes_on * late(s_t).amax(1)
    q = net(s).gather(1, a[:, None])[:, 0]
    loss = nn.functional.smooth_l1_loss(q, target)
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(net.parameters(), 10.0)
    optimiser.step()


class EndsAtLimit(gym.Wrapper[Any, Any, Any, Any]):
    """Reports its own limit of steps as termination."""

    def __init__(self, env: gym.Env[Any, Any], limit: int) -> None:
        super().__init__(env)
        self.limit = limit

    def reset(self, **given: Any) -> Any:
        self.t = 0
        return self.env.reset(**given)

    def step(self, action: Any) -> Any:
        self.t += 1
        s, r, terminated, truncated, told = self.env.step(action)
        return s, r, terminated or self.t >= self.limit, truncated, told


def cartpole() -> gym.Env[Any, Any]:
    return gym.make("CartPole-v1", max_episode_steps=LIMIT)


def _observing(change: Callable[[Any], Any], width: int) -> Maker:
    space = gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
    return lambda: TransformObservation(cartpole(), lambda s: np.asarray(change(s), np.float32), space)


@dataclass(frozen=True)
class Disease:
    """One planted mistake.

    Args:
        name: in a few words.
        causes: any of which is right.
        ids: of the findings that are meant.
        make: the environment, as it is examined.
        learns_in: the environment as the learner sees it, where the mistake lies between them.
        sb3: arguments of Stable-Baselines3's DQN that express it; None where it cannot.
        plan: of the plain DQN, where it cannot.
        gamma: as it is declared.
        gives_data: whether the buffer is handed to the doctor.
    """

    name: str
    causes: tuple[str | None, ...]
    ids: str
    make: Maker = cartpole
    learns_in: Maker | None = None
    sb3: Mapping[str, Any] | None = None
    plan: Plan | None = None
    gamma: float = GAMMA
    gives_data: bool = False


def _noisy() -> gym.Env[Any, Any]:
    rng = np.random.default_rng(0)
    return TransformReward(cartpole(), lambda r: float(r) + 5.0 * float(rng.standard_normal()))


_ALG, _ENV, _REP, _DATA = ("algorithm",), ("environment",), ("representation",), ("data",)
DISEASES: dict[str, Disease] = {
    "0": Disease("none (Stable-Baselines3)", (None,), "", sb3={}),
    "0p": Disease("none (plain DQN)", (None,), "", plan=Plan()),
    "1": Disease("sign of rewards flipped in the learner", _ALG, "V3",
                 learns_in=lambda: TransformReward(cartpole(), lambda r: -float(r)), sb3={}),
    "2": Disease("γ = 0.9 learned, 0.99 declared", _ALG, "V3", sb3={"target_update_interval": 8}, gamma=0.99),
    "3a": Disease("truncation as termination, with the buffer", _DATA, "D1",
                  sb3={"replay_buffer_kwargs": {"handle_timeout_termination": False}}, gives_data=True),
    "3b": Disease("truncation as termination, no data", _ALG, "V3", gamma=0.95,
                  make=lambda: gym.make("CartPole-v1", max_episode_steps=30), sb3={
        "replay_buffer_kwargs": {"handle_timeout_termination": False}, "target_update_interval": 56, "gamma": 0.95,
    }),
    "4": Disease("environment reports its limit as termination", _ENV, "E3",
                 make=lambda: EndsAtLimit(gym.make("CartPole-v1", max_episode_steps=-1), LIMIT), sb3={}),
    "5": Disease("no terminal mask", _ALG, "V3 V4", plan=Plan(mask=False)),
    "6": Disease("target copied every update", _ALG, "V4 R3", sb3={
        "target_update_interval": 1, "gradient_steps": 1, "num_envs": 2, "gamma": 0.99
    }, gamma=0.99),
    "7": Disease("target copied 3 times in all", _ALG, "V5", sb3={"target_update_interval": 2000}),
    "8": Disease("step size 0.05", _ALG, "R1", sb3={"learning_rate": 0.05}),
    "9": Disease("step size 1e-6", _ALG, "R6a", sb3={"learning_rate": 1e-6}),
    "10": Disease("observations × 10,000", _REP, "E4", make=_observing(lambda s: 1e4 * s, 4), sb3={}),
    "11": Disease("rewards × 1,000 and Huber", _ENV, "E5",
                  make=lambda: TransformReward(cartpole(), lambda r: 1000.0 * float(r)),
                  sb3={"gamma": 0.95, "target_update_interval": 56}, gamma=0.95),
    "12": Disease("velocities hidden", _ENV, "E6", make=_observing(lambda s: s[[0, 2]], 2), sb3={}),
    "13": Disease("body of one unit", _REP, "R7", sb3={"policy_kwargs": {"net_arch": [1]}}),
    "14": Disease("ε = 0 always", _DATA, "D4 D4a", sb3={"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}),
    "15": Disease("buffer of 100", _DATA, "D3 D3a", sb3={"buffer_size": 100, "learning_starts": 100}),
    "16": Disease("reward noise σ = 5", _ALG, "V2", learns_in=_noisy, sb3={}),
    "17": Disease("Baird's star", _ALG, "V7a R3", make=lambda: gym.make("neuralq/BairdStar-v0", max_episode_steps=100),
                  plan=Plan()),
}  # fmt: skip
BASE: dict[str, Any] = {
    "gamma": GAMMA, "learning_rate": 1e-3, "batch_size": 64, "buffer_size": 100_000, "learning_starts": 400,
    "train_freq": 1, "gradient_steps": 3, "target_update_interval": 104, "exploration_fraction": 0.3,
    "exploration_final_eps": 0.05, "policy_kwargs": {"net_arch": [64, 64]},
}  # fmt: skip
"""Of Stable-Baselines3, with 8 environments, where the disease says nothing else; as the plain DQN's."""


@dataclass(frozen=True)
class Control:
    """A healthy run: which environment, who trains it and how, and the greedy return from which on it is one."""

    env: str
    trainer: str
    at_least: float
    given: Mapping[str, Any] = field(default_factory=dict)
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    steps: int = STEPS

    def make(self) -> gym.Env[Any, Any]:
        return gym.make(self.env, **self.env_kwargs)


_DRY = {"is_slippery": False}
HEALTHY = (
    Control("CartPole-v1", "neuralq", 475, {"stop_at_return": 475}),
    Control("Acrobot-v1", "neuralq", -100, {"total_steps": 60_000}),
    Control("MountainCar-v0", "neuralq", -120),
    Control("FrozenLake-v1", "neuralq", 0.99, env_kwargs=_DRY),
    Control("FrozenLake-v1", "Stable-Baselines3", 0.99, {"exploration_final_eps": 0.2}, _DRY),
)


class Star(nn.Module):
    """Baird's star for Q-learning: values linear in its features, of states as one-hot rows."""

    def __init__(self, features: Any, weights: Any) -> None:
        super().__init__()
        self.features = torch.as_tensor(features, dtype=torch.float32)
        self.weights = nn.Parameter(torch.as_tensor(weights, dtype=torch.float32))

    def forward(self, states: torch.Tensor) -> torch.Tensor:
        """``[N, S] -> [N, A]``."""
        return states @ (self.features @ self.weights)


def star(seed: int, updates: int = 4_000) -> Subject:
    """Q-learning on the star from the weights that Sutton & Barto (2018, figure 11.2) start from, sampled as there."""
    from neuralq_envs.counterexamples.baird import star_control

    problem, rng, step_size = star_control(), np.random.default_rng(seed), 0.05
    features, w, n = np.asarray(problem.features), np.array(problem.initial_weights), problem.mdp.num_states
    for _ in range(updates):
        s, solid = int(rng.integers(n)), int(rng.random() < 1 / n)
        s_t = n - 1 if solid else int(rng.integers(n - 1))
        error = GAMMA * (features[s_t] @ w).max() - features[s, solid] @ w
        w += step_size * error * features[s, solid]
    known = Settings(learning_rate=step_size, target_period_updates=1, updates=updates, env_steps=updates)
    one_hot = torch.eye(n)
    return of_network(Star(features, w), "linear Q-learning", settings=known, encode=lambda s: one_hot[np.asarray(s)])


def _sb3(make: Maker, given: Mapping[str, Any], seed: int, steps: int, file: Path) -> dict[str, Any]:
    """Trains, saves, and gives the buffer back by columns."""
    from stable_baselines3 import DQN
    from stable_baselines3.common.vec_env import DummyVecEnv

    given = {**BASE, **given}
    model = DQN("MlpPolicy", DummyVecEnv([make] * given.pop("num_envs", 8)), seed=seed, **given)
    model.learn(steps)
    model.save(file)
    buffer = model.replay_buffer
    n = buffer.size() if buffer.full else buffer.pos
    ends, cut = buffer.dones[:n] > 0, buffer.timeouts[:n] > 0
    columns = {
        "obs": buffer.observations[:n], "next_obs": buffer.next_observations[:n], "action": buffer.actions[:n],
        "reward": buffer.rewards[:n], "terminated": ends & ~cut, "truncated": cut,
    }  # fmt: skip
    return {name: np.concatenate(np.swapaxes(column, 0, 1)) for name, column in columns.items()}  # one by one


def ill(number: str, seed: int, folder: Path) -> tuple[Any, dict[str, Any]]:
    """A subject with a disease, and its buffer by columns."""
    disease = DISEASES[number]
    if number == "17":
        return star(seed), {}
    if disease.plan is not None:
        net, late, known, rows = dqn(disease.make, disease.plan, seed)
        return of_network(net, "plain DQN", target=late, settings=known), rows
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"disease_{number}_seed_{seed}.zip"
    return file, _sb3(disease.learns_in or disease.make, disease.sb3 or {}, seed, STEPS, file)


def well(control: Control, seed: int, folder: Path) -> Path:
    """The run folder or file of a healthy agent."""
    import neuralq

    path = folder / "agent.zip"
    if control.trainer == "neuralq":
        around: dict[str, Any] = {"env_kwargs": control.env_kwargs} if control.env_kwargs else {}
        neuralq.train(control.env, path, seed=seed, resume_probe=False, **control.given, **around)
    else:
        _sb3(control.make, control.given, seed, control.steps, path)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("disease", choices=DISEASES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("agents"), help="folder of what Stable-Baselines3 saves")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    disease = DISEASES[options.disease]
    subject, rows = ill(options.disease, options.seed, options.out)
    data = rows if disease.gives_data else None
    print(examine(subject, disease.make, gamma=disease.gamma, data=data, seed=options.seed).explain())


if __name__ == "__main__":
    main()

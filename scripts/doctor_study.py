"""How far the doctor can be trusted: every planted disease and healthy runs, and what it named first.

    python scripts/doctor_study.py --seeds 5 --out doctor_study.json
    python scripts/doctor_study.py --only 1 7 healthy --seeds 1

Subjects are trained by Stable-Baselines3 where it is installed and can express the disease (extra bench), else by the
plain DQN below, so that the doctor is not judged on neuralq's own learner. Each row is printed as it is known: disease,
seed, what was named first, whether that is the expected cause. Thresholds are read on even seeds and reported on odd
ones with --split.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
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
from neuralq.doctor.subject import of_network

GAMMA, LIMIT = 0.99, 100
Maker = Callable[[], gym.Env[Any, Any]]


@dataclass(frozen=True)
class Plan:
    """How the plain DQN learns, its mistakes included; the defaults are those of rl-zoo for CartPole."""

    steps: int = 30_000
    lr: float = 2.3e-3
    gamma: float = GAMMA
    hidden: tuple[int, ...] = (64, 64)
    batch: int = 64
    buffer: int = 100_000
    starts: int = 1000
    every: int = 256
    updates: int = 128
    copy_every_updates: int = 32
    epsilon: tuple[float, float] = (1.0, 0.04)
    sign: float = 1.0
    mask: bool = True
    truncation_ends: bool = False
    noise: float = 0.0
    huber: bool = False


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
        share = min(t / (0.16 * plan.steps), 1.0)
        epsilon = plan.epsilon[0] + share * (plan.epsilon[1] - plan.epsilon[0])
        with torch.no_grad():
            q = net(torch.as_tensor(s, dtype=torch.float32))
        a = int(rng.integers(num_actions)) if rng.random() < epsilon else int(q.argmax())
        s_t, r, terminated, truncated, _ = env.step(a)
        i = t % size
        rows["obs"][i], rows["next_obs"][i], rows["action"][i] = s, s_t, a
        rows["reward"][i] = plan.sign * (float(r) + plan.noise * rng.standard_normal())
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
        gamma=GAMMA, learning_rate=plan.lr, target_period_updates=plan.copy_every_updates, updates=num_updates,
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
    loss = nn.functional.smooth_l1_loss(q, target) if plan.huber else nn.functional.mse_loss(q, target)
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
        ids: of the findings that are meant, for the table.
        make: the environment.
        plan: how it is learned.
        sb3: arguments of Stable-Baselines3's DQN that express it; None where it cannot.
        gives_data: whether the buffer is handed to the doctor.
    """

    name: str
    causes: tuple[str, ...]
    ids: str
    make: Maker = cartpole
    plan: Plan = field(default_factory=Plan)
    sb3: Mapping[str, Any] | None = None
    gives_data: bool = False


DISEASES: dict[str, Disease] = {
    "1": Disease("reward sign flipped in the learner", ("algorithm",), "V3", plan=Plan(sign=-1.0)),
    "2": Disease("γ = 0.9 learned, 0.99 declared", ("algorithm",), "V3", plan=Plan(gamma=0.9)),
    "3a": Disease("truncation stored as termination", ("data",), "D1", plan=Plan(truncation_ends=True),
    gives_data=True),
    "3b": Disease("truncation as termination, no data", ("algorithm",), "V3", plan=Plan(truncation_ends=True)),
    "4": Disease("environment ends at its limit", ("environment",), "E3",
                 make=lambda: EndsAtLimit(gym.make("CartPole-v1", max_episode_steps=-1), LIMIT), sb3={}),
    "5": Disease("no terminal mask", ("algorithm",), "V4 V3", plan=Plan(mask=False)),
    "6": Disease("target copied every update", ("algorithm",), "V4 R3", plan=Plan(copy_every_updates=1, every=4,
    updates=4)),
    "7": Disease("target interval of 10,000", ("algorithm",), "V5", plan=Plan(copy_every_updates=5000),
                 sb3={"target_update_interval": 10_000}),
    "8": Disease("step size 0.05", ("algorithm",), "R1", plan=Plan(lr=0.05), sb3={"learning_rate": 0.05}),
    "9": Disease("step size 1e-6", ("algorithm",), "R6a V1", plan=Plan(lr=1e-6), sb3={"learning_rate": 1e-6}),
    "10": Disease("observations × 10,000", ("representation",), "E4 X2", make=_observing(lambda s: 1e4 * s, 4), sb3={}),
    "11": Disease("rewards × 1,000 and Huber", ("environment",), "E5",
                  make=lambda: TransformReward(cartpole(), lambda r: 1000.0 * float(r)), plan=Plan(huber=True), sb3={}),
    "12": Disease("velocities hidden", ("environment",), "E6", make=_observing(lambda s: s[[0, 2]], 2), sb3={}),
    "13": Disease("body of one unit", ("representation",), "X2", plan=Plan(hidden=(1,)),
                  sb3={"policy_kwargs": {"net_arch": [1]}}),
    "14": Disease("ε = 0 always", ("data",), "D4", plan=Plan(epsilon=(0.0, 0.0)),
                  sb3={"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}),
    "15": Disease("buffer of 100", ("data",), "D3", plan=Plan(buffer=100, starts=100), sb3={"buffer_size": 100}),
    "16": Disease("reward noise σ = 5", ("algorithm",), "V2", plan=Plan(noise=5.0)),
}  # fmt: skip
HEALTHY: dict[str, dict[str, Any]] = {
    "CartPole-v1": {"stop_at_return": 475},
    "Acrobot-v1": {},
    "MountainCar-v0": {},
    "FrozenLake-v1": {"env_kwargs": {"is_slippery": False}},
}
ZOO = {
    "learning_rate": 2.3e-3, "batch_size": 64, "buffer_size": 100_000, "learning_starts": 1000, "train_freq": 256,
    "gradient_steps": 128, "target_update_interval": 10, "exploration_fraction": 0.16, "exploration_final_eps": 0.04,
}  # fmt: skip


def _sb3(disease: Disease, seed: int, folder: Path, steps: int) -> Path | None:
    try:
        from stable_baselines3 import DQN
    except ImportError:
        return None
    if disease.sb3 is None:
        return None
    given = {"policy_kwargs": {"net_arch": [64, 64]}, **ZOO, **disease.sb3}
    model = DQN("MlpPolicy", disease.make(), seed=seed, gamma=GAMMA, **given)
    model.learn(steps)
    model.save(folder / "agent.zip")
    return folder / "agent.zip"


def diagnose(number: str, seed: int, steps: int, budget_s: float) -> dict[str, Any]:
    """Train one subject with a disease and say what the doctor named."""
    disease = DISEASES[number]
    began, data = time.perf_counter(), None
    with tempfile.TemporaryDirectory() as folder:
        subject: Any = _sb3(disease, seed, Path(folder), steps)
        trainer = "Stable-Baselines3" if subject is not None else "plain DQN"
        if subject is None:
            plan = Plan(**{**vars(disease.plan), "steps": steps})
            net, late, known, rows = dqn(disease.make, plan, seed)
            subject = of_network(net, "plain DQN", target=late, settings=known)
            data = rows if disease.gives_data else None
        trained = time.perf_counter() - began
        report = examine(subject, disease.make, gamma=GAMMA, data=data, budget_s=budget_s, seed=seed)
    named = [one.id for one in report.findings if one.grade in "AB"]
    score = next((one.value for one in report.measured if one.id == "V1"), None)
    return {
        "disease": number, "name": disease.name, "seed": seed, "trainer": trainer, "expected": list(disease.causes),
        "meant": disease.ids, "cause": report.cause, "named": named, "right": report.cause in disease.causes,
        "finding_right": bool(named) and named[0] in disease.ids.split(), "return": score,
        "train_s": round(trained, 1), "exam_s": round(report.seconds, 1),
        "measured": {one.id: [one.value, one.flagged] for one in report.measured},
    }  # fmt: skip


def healthy(env: str, seed: int, budget_s: float) -> dict[str, Any]:
    """Train one healthy agent by neuralq's presets and say whether the doctor finds anything."""
    import neuralq

    with tempfile.TemporaryDirectory() as folder:
        run = neuralq.train(env, Path(folder) / "run", seed=seed, resume_probe=False, **HEALTHY[env])
        report = examine(run.run_dir, budget_s=budget_s, seed=seed)
    named = [one.id for one in report.findings if one.grade in "AB"]
    return {
        "disease": "healthy", "name": env, "seed": seed, "trainer": "neuralq", "expected": [None],
        "cause": report.cause,
        "named": named, "right": report.cause is None, "return": run.greedy_return,
        "measured": {one.id: [one.value, one.flagged] for one in report.measured},
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[*DISEASES, "healthy"], help="diseases by number, or healthy")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=30_000, help="environment steps of each subject")
    parser.add_argument("--budget", type=float, default=60.0, help="seconds of each examination")
    parser.add_argument("--split", action="store_true", help="confusion of odd seeds alone")
    parser.add_argument("--out", type=Path, help="rows as JSON")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    rows = []
    for number in options.only:
        for seed in range(options.seeds):
            if number == "healthy":
                found = [healthy(env, seed, options.budget) for env in HEALTHY] if seed < 3 else []
            else:
                found = [diagnose(number, seed, options.steps, options.budget)]
            for row in found:
                rows.append(row)
                print(_line(row), flush=True)
                if options.out is not None:
                    options.out.write_text(json.dumps(rows, default=float), encoding="utf-8")
    print(_table([row for row in rows if not options.split or row["seed"] % 2]))


def _line(row: Mapping[str, Any]) -> str:
    verdict = "right" if row["right"] else "MISSED"
    named = " ".join(row["named"]) or "nothing"
    return f"{row['disease']:>8} {row['name']:<36} seed {row['seed']} {verdict:<6} {row['cause']}: {named}"


def _table(rows: list[dict[str, Any]]) -> str:
    """The confusion matrix: per disease, how often each cause came first."""
    causes = ["environment", "algorithm", "representation", "data", "luck", None]
    lines = ["| disease | " + " | ".join(str(c or "nothing") for c in causes) + " | right |", "|---" * 8 + "|"]
    for name in dict.fromkeys(row["name"] for row in rows):
        mine = [row for row in rows if row["name"] == name]
        counts = [str(sum(row["cause"] == cause for row in mine)) for cause in causes]
        lines.append(f"| {name} | {' | '.join(counts)} | {sum(row['right'] for row in mine)} of {len(mine)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

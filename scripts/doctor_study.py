"""How far the doctor can be trusted: every planted disease and healthy runs, and what it named first.

    python scripts/doctor_study.py --out doctor_study
    python scripts/doctor_study.py --only 1 7 healthy --seeds 1 --out doctor_study
    python scripts/doctor_study.py --out doctor_study --decide-again
    python scripts/doctor_study.py --network-verdict 300

Subjects are trained by Stable-Baselines3 (extra bench) where it can express the disease, else by the plain DQN below, so
that the doctor is not judged on neuralq's own learner alone. The disease 0 is none: the same learner and settings with
nothing planted. Healthy runs are neuralq's presets on four environments, and Stable-Baselines3.

Every row goes to rows.jsonl in the folder as soon as it is known: what was measured, whole, and what was named. Rows that
are there are not run again, so that it may be stopped at any time; --decide-again puts what was measured through the
present decision tree without training or measuring anything. At the end: the confusion matrix, every miss, times, and for
each threshold that is our own the range that even seeds allow and what it does on odd ones.
With --network-verdict the lab's verdict before training is held against what training did, on random
finite problems: area under the ROC curve and a table of predicted growth against the share that diverged.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation, TransformReward
from torch import nn

from neuralq.doctor import Settings, examine
from neuralq.doctor.estimates import area_under_curve
from neuralq.doctor.findings import Finding
from neuralq.doctor.report import Report
from neuralq.doctor.subject import Subject, of_network
from neuralq.doctor.tree import decide

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
    "3b": Disease("truncation as termination, no data", _ALG, "V3", sb3={
        "replay_buffer_kwargs": {"handle_timeout_termination": False}, "target_update_interval": 16, "gamma": 0.98,
        "learning_rate": 5e-4,
    }, gamma=0.98),
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
    "14": Disease("ε = 0 always", _DATA, "D4", sb3={"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}),
    "15": Disease("buffer of 100", _DATA, "D3", sb3={"buffer_size": 100, "learning_starts": 100}),
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


_DRY = {"is_slippery": False}
HEALTHY = (
    Control("CartPole-v1", "neuralq", 475, {"stop_at_return": 475}),
    Control("Acrobot-v1", "neuralq", -100, {"total_steps": 60_000}),
    Control("MountainCar-v0", "neuralq", -120),
    Control("FrozenLake-v1", "neuralq", 0.99, env_kwargs=_DRY),
    Control("FrozenLake-v1", "Stable-Baselines3", 0.99, {"exploration_final_eps": 0.2}, _DRY),
    Control("CliffWalking-v1", "Stable-Baselines3", -20, {"exploration_final_eps": 0.2}),
    Control("Acrobot-v1", "Stable-Baselines3", -120, steps=20_000),
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


def diagnose(number: str, seed: int, budget_s: float) -> dict[str, Any]:
    """Train one subject with a disease and say what the doctor named."""
    disease = DISEASES[number]
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        subject: Any = Path(folder) / "agent.zip"
        if number == "17":
            subject, rows = star(seed), {}
        elif disease.plan is not None:
            net, late, known, rows = dqn(disease.make, disease.plan, seed)
            subject = of_network(net, "plain DQN", target=late, settings=known)
        else:
            rows = _sb3(disease.learns_in or disease.make, disease.sb3 or {}, seed, STEPS, subject)
        trained = time.process_time() - began
        data = rows if disease.gives_data else None
        report = examine(subject, disease.make, gamma=disease.gamma, data=data, budget_s=budget_s, seed=seed)
    trainer = "plain" if disease.plan is not None else "Stable-Baselines3"
    return {"disease": number, "name": disease.name, "seed": seed, "trainer": trainer, **_found(report, trained)}


def healthy(control: Control, seed: int, budget_s: float) -> dict[str, Any]:
    """Train one healthy agent and say whether the doctor finds anything."""
    import neuralq

    def make() -> gym.Env[Any, Any]:
        return gym.make(control.env, **control.env_kwargs)

    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        path, env = Path(folder) / "agent.zip", None if control.trainer == "neuralq" else make
        if control.trainer == "neuralq":
            settings = {**control.given, **({"env_kwargs": control.env_kwargs} if control.env_kwargs else {})}
            neuralq.train(control.env, path, seed=seed, resume_probe=False, **settings)
        else:
            _sb3(make, control.given, seed, control.steps, path)
        trained = time.process_time() - began
        report = examine(path, env, budget_s=budget_s, seed=seed)
    row = {"disease": "healthy", "name": f"{control.env}, {control.trainer}", "seed": seed, "trainer": control.trainer}
    return {**row, **_found(report, trained), "at_least": control.at_least}


def _found(report: Report, trained: float) -> dict[str, Any]:
    return {
        **_named(report.findings, report.cause), "measured": [one.plain() for one in report.measured],
        "not_measured": dict(report.not_measured), "train_cpu_s": round(trained, 1), "exam_s": round(report.seconds, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }  # fmt: skip


def _named(findings: Sequence[Finding], cause: str | None) -> dict[str, Any]:
    return {"cause": cause, "named": [one.id for one in findings if one.grade in "AB"]}


def decided_again(row: Mapping[str, Any]) -> dict[str, Any]:
    """The row as the present decision tree would have it."""
    found = [
        Finding(**{
            **one, "value": float("nan") if one["value"] is None else one["value"],
            "interval": one["interval"] and tuple(float("nan") if b is None else b for b in one["interval"]),
        })
        for one in row["measured"]
    ]  # fmt: skip
    findings, headline = decide(found)
    report = Report("", "", GAMMA, headline, findings, tuple(found), {}, 0.0)
    return {**row, **_named(findings, report.cause)}


def network_verdict(num_problems: int, seed: int = 0) -> dict[str, Any]:
    """The lab's verdict at the start against training, on random finite problems and three layouts."""
    from neuralq.lab.networks.diagnosis import diagnose_network
    from neuralq.lab.networks.expected import expected_backup, expected_td_step
    from neuralq.lab.networks.tangent_kernel import observations_of
    from neuralq.lab.problems import Problem
    from neuralq.mdp import FiniteMDP
    from neuralq.q import MLP, ActionInputQ, ActionOutputQ, SeparateQ

    rng, rows = np.random.default_rng(seed), []
    for i in range(num_problems):
        model = FiniteMDP.garnet(8, 2, 3, seed=seed + i)
        features = rng.standard_normal((8, 3))
        problem = Problem.from_mdp(model, features, gamma=float(rng.choice([0.9, 0.99])))
        for layout in (ActionOutputQ, SeparateQ, ActionInputQ):
            q = layout((3,), 2, body=MLP(hidden=(16,)), rng=i, dtype=torch.float64)
            seen = observations_of(problem)
            found = diagnose_network(q, problem, 0.05, observations=seen, curvature=False)
            backup = expected_backup(problem, seen, state_values=False)
            before = found.largest_error
            for _ in range(500):
                expected_td_step(q, backup, 0.05)
            after = diagnose_network(q, problem, 0.05, observations=seen, curvature=False).largest_error
            rows.append((found.kernel_growth, bool(not np.isfinite(after) or after > 2 * before), layout.__name__))
    growth, diverged = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    both = 0 < diverged.sum() < len(diverged)
    return {
        "problems": num_problems, "rows": len(rows), "diverged": int(diverged.sum()),
        "auc": area_under_curve(growth, diverged) if both else None,
        "missed": int((diverged & (growth <= 1)).sum()), "false alarms": int((~diverged & (growth > 1)).sum()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[*DISEASES, "healthy"], help="diseases by number, or healthy")
    parser.add_argument("--seeds", type=int, default=5, help="of each disease; healthy runs have up to 3")
    parser.add_argument("--budget", type=float, default=60.0, help="seconds of each examination")
    parser.add_argument("--out", type=Path, default=Path("doctor_study"), help="folder of rows.jsonl")
    parser.add_argument("--decide-again", action="store_true", help="only decide again from what was measured")
    parser.add_argument("--network-verdict", type=int, metavar="N", help="instead: N random problems for the lab")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    if options.network_verdict is not None:
        print(json.dumps(network_verdict(options.network_verdict)))
        return
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "rows.jsonl"
    rows = [json.loads(line) for line in file.read_text("utf-8").splitlines()] if file.exists() else []
    if options.decide_again:
        rows = [decided_again(row) for row in rows]
    else:
        _run(options.only, options.seeds, options.budget, rows, file)
    print(summary(rows))


def _run(only: Sequence[str], seeds: int, budget_s: float, rows: list[dict[str, Any]], file: Path) -> None:
    """What is missing among the rows, seed by seed, so that what comes first says something of everything."""
    known = {(row["disease"], row["name"], row["seed"]) for row in rows}
    for seed in range(seeds):
        wanted: list[tuple[tuple[str, str, int], Callable[[], dict[str, Any]]]] = [
            ((number, DISEASES[number].name, seed), partial(diagnose, number, seed, budget_s))
            for number in only if number != "healthy"
        ]  # fmt: skip
        if "healthy" in only and seed < 3:
            wanted += [
                (("healthy", f"{one.env}, {one.trainer}", seed), partial(healthy, one, seed, budget_s))
                for one in HEALTHY
            ]
        for key, make in wanted:
            if key not in known:
                row = json.loads(json.dumps(make(), default=float))
                rows.append(row)
                with file.open("a", encoding="utf-8") as out:
                    out.write(json.dumps(row) + "\n")
                print(_line(row), flush=True)


def _value(row: Mapping[str, Any], name: str) -> dict[str, Any] | None:
    return next((one for one in row["measured"] if one["id"] == name), None)


def _is_healthy(row: Mapping[str, Any]) -> bool:
    """Whether a row without a planted disease is one by its return, of which the doctor knows nothing."""
    learned = _value(row, "V1")
    at_least = row.get("at_least", 99.0)
    return row["disease"] in ("healthy", "0", "0p") and learned is not None and learned["value"] >= at_least


def _is_right(row: Mapping[str, Any]) -> bool:
    if row["disease"] in ("healthy", "0", "0p"):
        return not row["named"]
    return row["cause"] in DISEASES[row["disease"]].causes


def _line(row: Mapping[str, Any]) -> str:
    learned = _value(row, "V1")
    score = "?" if learned is None or learned["value"] is None else f"{learned['value']:.4g}"
    return (
        f"{row['disease']:>8} {row['name']:<46} seed {row['seed']} {'right ' if _is_right(row) else 'MISSED'} "
        f"{row['cause']}: {' '.join(row['named']) or 'nothing'}; return {score}, trained in {row['train_cpu_s']} CPU-s, "
        f"examined in {row['exam_s']} s"
    )


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """The confusion matrix, whole and of odd seeds, the misses, thresholds, and times."""
    unfit = [row for row in rows if row["disease"] in ("healthy", "0", "0p") and not _is_healthy(row)]
    kept = [row for row in rows if row not in unfit]
    missed = [row for row in kept if not _is_right(row)]
    seconds, peak = [row["exam_s"] for row in rows], max(row["peak_mb"] for row in rows)
    return "\n".join([
        "All seeds", _table(kept), "", "Odd seeds, on which no threshold was set",
        _table([row for row in kept if row["seed"] % 2]), "", "Missed", *map(_line, missed), "",
        "Left out: nothing was planted, and the return is below what is called healthy", *map(_line, unfit), "",
        "Thresholds of our own", _thresholds(kept), "",
        f"Examinations took {statistics.median(seconds)} s in the median and {max(seconds)} s at most; the process, with "
        f"training, {peak} MB at most",
    ])  # fmt: skip


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The confusion matrix: per disease, how often each cause came first."""
    causes = ["environment", "algorithm", "representation", "data", "luck", None]
    head = "| planted | " + " | ".join(str(c or "none") for c in causes) + " | first finding | right |"
    lines = [head, "|---" * 9 + "|"]
    for name in dict.fromkeys(row["name"] for row in rows):
        mine = [row for row in rows if row["name"] == name]
        counts = [str(sum(row["cause"] == cause for row in mine) or "") for cause in causes]
        firsts = Counter(row["named"][0] if row["named"] else "none" for row in mine)
        first = ", ".join(f"{k} × {n}" for k, n in firsts.most_common())
        lines.append(f"| {name} | {' | '.join(counts)} | {first} | {sum(map(_is_right, mine))} of {len(mine)} |")
    return "\n".join(lines)


Statistic = Callable[[dict[str, Any]], float]
OWN: dict[str, tuple[float, bool, Statistic]] = {
    "E3": (0.0, False, lambda one: one["value"] - one["threshold"]),
    "E4": (100.0, True, lambda one: one["value"]),
    "E5": (1e4, True, lambda one: one["value"]),
    "E6": (0.10, True, lambda one: one["interval"][0]),
    "V2": (0.10, True, lambda one: max(one["interval"][0], -one["interval"][1])),
    "V3": (0.80, False, lambda one: one["value"]),
    "V5": (0.90, False, lambda one: one["value"]),
    "V7a": (1.0, True, lambda one: one["value"]),
    "R1": (0.5, True, lambda one: one["interval"][0]),
    "R6a": (1.5, False, lambda one: 1.5 * one["value"] / one["threshold"]),
    "R7": (0.10, True, lambda one: one["interval"][0]),
    "D3": (3.0, False, lambda one: one["value"]),
}
"""Thresholds of our own: as they are in the doctor, whether more is worse, and what is held against them."""


def _thresholds(rows: Sequence[Mapping[str, Any]]) -> str:
    """Per threshold: what even seeds allow, and how odd seeds fare with the one that the doctor has."""
    lines = ["| id | in use | healthy, even seeds | diseased, even seeds | odd seeds found | odd seeds healthy flagged |",
             "|---" * 6 + "|"]  # fmt: skip
    for name, (threshold, more, statistic) in OWN.items():
        found: dict[tuple[bool, int], list[float]] = {(ill, odd): [] for ill in (True, False) for odd in (0, 1)}
        for row in rows:
            one, is_ill = (
                _value(row, name),
                name in DISEASES[row["disease"]].ids.split() if row["disease"] in DISEASES else False,
            )
            if one is None or one["value"] is None or not (is_ill or _is_healthy(row)):
                continue
            found[is_ill, row["seed"] % 2].append(statistic(one))
        worst = (max if more else min)(found[False, 0], default=float("nan"))
        mildest = (min if more else max)(found[True, 0], default=float("nan"))
        beyond = [[(v > threshold) == more for v in found[ill, 1]] for ill in (True, False)]
        shares = " | ".join(f"{sum(b)} of {len(b)}" for b in beyond)
        lines.append(
            f"| {name} | {threshold:g} | {'≤' if more else '≥'} {worst:.3g} | {'≥' if more else '≤'} {mildest:.3g} | {shares} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()

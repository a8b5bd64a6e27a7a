"""DQN side by side with Stable-Baselines3 at equal steps: our defaults, our presets, and theirs as tuned by the RL zoo.

"before" is what our defaults were up to 0.3.1, plain DQN, for environments that had no preset then.

    pip install "neuralq[bench,box2d]"
    python scripts/bench_dqn.py [CartPole-v1 ...] [--learners default preset sb3 before] [--seeds 5] [--out FILE]

Every case trains for the zoo's number of steps on one thread. The final return is the mean of 100 greedy episodes of
the agent that is there at the end; a row gives the interquartile mean over seeds with its stratified bootstrap
interval (Agarwal et al. 2021). "share" is the return between that of uniformly random actions (0) and the environment's
threshold (1), and the last rows average it over environments, so that one number says how far the defaults, which know
nothing of the environment, are from settings searched for it. Ours were chosen on seeds below the first one here.

    environment       learner      steps      final      interval 95 %   share    CPU-s
    CartPole-v1       default     50,000      ...

``--out`` appends every case to a file of JSON lines and leaves out those that stand in it, so that a benchmark that was
stopped goes on. ``--json`` prints one JSON object as the last line, with the same numbers.
"""

from __future__ import annotations

import argparse
import importlib
import json
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

import neuralq
from neuralq.runs import RunConfig, evaluate_run, with_preset
from neuralq.runs.recipe.budget import cut_to_budget
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.recipe.presets import PRESETS
from neuralq.runs.recipe.replay_presets import ANY
from neuralq.runs.sweep.statistics import bootstrap_interval, estimate, interquartile_mean

_WIDE = {"policy_kwargs": {"net_arch": [256, 256]}}
_ACROBOT = {
    "learning_rate": 6.3e-4, "batch_size": 128, "buffer_size": 50_000, "learning_starts": 0, "gamma": 0.99,
    "target_update_interval": 250, "train_freq": 4, "gradient_steps": -1, "exploration_fraction": 0.12,
    "exploration_final_eps": 0.1, **_WIDE,
}  # fmt: skip
ZOO: dict[str, tuple[int, dict[str, Any]]] = {
    # Steps and settings of DQN as tuned in DLR-RM/rl-baselines3-zoo, hyperparams/dqn.yml at commit ce95481; there
    # LunarLander is v2, whose dynamics v3 only mends.
    "CartPole-v1": (50_000, {
        "learning_rate": 2.3e-3, "batch_size": 64, "buffer_size": 100_000, "learning_starts": 1_000, "gamma": 0.99,
        "target_update_interval": 10, "train_freq": 256, "gradient_steps": 128, "exploration_fraction": 0.16,
        "exploration_final_eps": 0.04, **_WIDE,
    }),
    "MountainCar-v0": (120_000, {
        "learning_rate": 4e-3, "batch_size": 128, "buffer_size": 10_000, "learning_starts": 1_000, "gamma": 0.98,
        "target_update_interval": 600, "train_freq": 16, "gradient_steps": 8, "exploration_fraction": 0.2,
        "exploration_final_eps": 0.07, **_WIDE,
    }),
    "Acrobot-v1": (100_000, _ACROBOT),
    "LunarLander-v3": (100_000, _ACROBOT),
}  # fmt: skip
OURS: dict[str, tuple[int, dict[str, Any]]] = {
    # An environment of our own, with its arguments: without a time limit an untrained agent never comes back.
    "neuralq/WindyGridworld-v0": (20_000, {"max_episode_steps": 200}),
}
BEFORE: dict[str, Any] = {
    "gamma": 0.99, "reward_scale": 1.0, "body": {"class": "MLP", "hidden": [128, 128], "layer_norm": False},
    "replay": {
        "target_rule": "q_learning", "num_steps": 1, "num_envs": 1, "capacity": 50_000, "batch_size": 64,
        "learning_starts": 1_000, "train_period": 1, "updates_per_period": 1, "target_period_updates": 500,
        "learning_rate": 5e-4, "optimiser": "adam", "loss": "huber", "max_grad_norm": 10.0,
    },
}  # fmt: skip
SCALE = {  # uniformly random actions over 1,000 episodes, and the return at which Gymnasium calls it solved
    "CartPole-v1": (22.0, 475.0),
    "MountainCar-v0": (-200.0, -110.0),
    "Acrobot-v1": (-499.0, -100.0),
    "LunarLander-v3": (-183.0, 200.0),
    "neuralq/WindyGridworld-v0": (-200.0, -15.0),  # the optimum
}
DEFAULT = ("CartPole-v1", "MountainCar-v0", "Acrobot-v1")  # those that need no extra
LEARNERS = ("default", "preset", "sb3")
STEPS = {env: steps for env, (steps, _) in (ZOO | OURS).items()}


def learn(env: str, learner: str, seed: int, total_steps: int, num_episodes: int) -> dict[str, Any]:
    """Train one case and play with what it leaves behind."""
    train = _train_sb3 if learner == "sb3" else _train_ours
    final, cpu_seconds = train(env, learner, seed, total_steps, num_episodes)
    return {
        "env": env, "learner": learner, "seed": seed, "env_steps": total_steps, "final_return": final,
        "cpu_seconds": cpu_seconds,
    }  # fmt: skip


def _train_ours(env: str, learner: str, seed: int, total_steps: int, num_episodes: int) -> tuple[float, float]:
    given = {"env": env, "learner": "replay", "seed": seed, "total_steps": total_steps, "resume_probe": False}
    given |= {"evaluate_every": total_steps, "checkpoint_every": 10**9}
    if env in OURS:
        given["env_kwargs"] = OURS[env][1]
    with tempfile.TemporaryDirectory() as folder:
        run = neuralq.train(configured(learner, given), folder)
        return evaluate_run(folder, num_episodes).mean, run.cpu_seconds


def configured(learner: str, given: dict[str, Any]) -> RunConfig:
    """With the environment's preset, or what an environment without one gets, now or before."""
    if learner == "preset":
        return with_preset(given)
    settings = BEFORE if learner == "before" else PRESETS[ANY, "replay"]
    return config_from_dict({**cut_to_budget(settings, given)[0], **given})


def _train_sb3(env: str, learner: str, seed: int, total_steps: int, num_episodes: int) -> tuple[float, float]:
    dqn = importlib.import_module("stable_baselines3").DQN
    began = time.process_time()
    model = dqn("MlpPolicy", env, seed=seed, device="cpu", **ZOO[env][1]).learn(total_steps)
    cpu_seconds = time.process_time() - began
    game, returns = gymnasium.make(env), []
    for episode in range(num_episodes):
        s, _ = game.reset(seed=10**6 + episode)
        total, ended = 0.0, False
        while not ended:
            action, _ = model.predict(s, deterministic=True)
            s, reward, terminated, truncated, _ = game.step(int(action))
            total, ended = total + float(reward), terminated or truncated
        returns.append(total)
    game.close()
    return float(np.mean(returns)), cpu_seconds


def share(env: str, value: float) -> float:
    """A return between random actions (0) and the threshold (1).

    Example:
        >>> share("MountainCar-v0", -155.0)
        0.5
    """
    low, high = SCALE[env]
    return (value - low) / (high - low)


def summary_of(env: str, learner: str, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The row of an environment and a learner."""
    final = estimate([result["final_return"] for result in results])
    return {
        "env": env, "learner": learner, "env_steps": results[0]["env_steps"], "iqm": final.iqm, "low": final.low,
        "high": final.high, "share": share(env, final.iqm), "seeds": list(results),
        "median_cpu_seconds": statistics.median(result["cpu_seconds"] for result in results),
    }  # fmt: skip


def average_of(learner: str, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Shares over all environments: interquartile mean and mean; the bootstrap draws each environment's runs apart."""
    envs = sorted({result["env"] for result in results})
    table = np.array([[share(env, r["final_return"]) for r in results if r["env"] == env] for env in envs]).T
    low, high = bootstrap_interval(table, np.random.default_rng(0)) if len(table) > 1 else (None, None)
    bounds = {"low": None if low is None else float(low), "high": None if high is None else float(high)}
    return {
        "learner": learner,
        "envs": envs,
        "iqm": float(interquartile_mean(table.ravel())),
        "mean": float(table.mean()),
        **bounds,
    }


def cases_of(options: argparse.Namespace, known: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Every case's result, from the file where it stands there."""
    for env in options.envs or DEFAULT:
        total_steps = options.total_steps or STEPS[env]
        for learner in options.learners:
            for seed in range(options.first_seed, options.first_seed + options.seeds):
                names = {"env": env, "learner": learner, "seed": seed, "env_steps": total_steps}
                found = [one for one in known if names.items() <= one.items()]
                result = found[0] if found else learn(env, learner, seed, total_steps, options.episodes)
                if not found and options.out is not None:
                    with options.out.open("a") as file:
                        file.write(json.dumps(result) + "\n")
                yield result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("envs", nargs="*", help=f"of {', '.join(STEPS)} (default {' '.join(DEFAULT)})")
    which = (*LEARNERS, "before")
    parser.add_argument("--learners", nargs="+", choices=which, default=LEARNERS, help="which (default all but before)")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds (default 5)")
    parser.add_argument("--first-seed", type=int, default=2000, help="settings were chosen on seeds below it")
    parser.add_argument("--total-steps", type=int, help="environment steps in place of the zoo's")
    parser.add_argument("--episodes", type=int, default=100, help="of the final evaluation (default 100)")
    parser.add_argument("--out", type=Path, help="a file of JSON lines that takes every case, and gives those it has")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    if unknown := [env for env in options.envs if env not in (ZOO if "sb3" in options.learners else STEPS)]:
        parser.error(f"the zoo's settings for {', '.join(unknown)} are not written down; choose from {', '.join(ZOO)}")
    torch.set_num_threads(1)
    has_file = options.out is not None and options.out.exists()
    known = [json.loads(line) for line in options.out.read_text().splitlines()] if has_file else []
    results = []
    for one in cases_of(options, known):
        results.append(one)
        print(
            f"{one['env']} {one['learner']} seed {one['seed']}: "
            f"{one['final_return']:.1f}, {one['cpu_seconds']:.1f} CPU-s",
            flush=True,
        )
    report(results, options.json)


def report(results: Sequence[dict[str, Any]], as_json: bool) -> None:
    """The table, and all of it as JSON if asked."""
    print(
        f"{'environment':<16} {'learner':<9} {'steps':>8} {'final':>9} {'interval 95 %':>18} {'share':>7} {'CPU-s':>8}"
    )
    pairs = list(dict.fromkeys((one["env"], one["learner"]) for one in results))
    rows = [summary_of(*pair, [one for one in results if (one["env"], one["learner"]) == pair]) for pair in pairs]
    for row in rows:
        interval = "-" if row["low"] is None else f"{row['low']:.1f} .. {row['high']:.1f}"
        print(
            f"{row['env']:<16} {row['learner']:<9} {row['env_steps']:>8,} {row['iqm']:>9.1f} {interval:>18} "
            f"{row['share']:>7.2f} {row['median_cpu_seconds']:>8.1f}"
        )
    learners = list(dict.fromkeys(learner for _, learner in pairs))
    averages = [average_of(learner, [one for one in results if one["learner"] == learner]) for learner in learners]
    for average in averages:
        interval = "-" if average["low"] is None else f"{average['low']:.2f} .. {average['high']:.2f}"
        print(
            f"{'all':<16} {average['learner']:<9} {'':>8} {average['iqm']:>9.2f} {interval:>18} {average['mean']:>7.2f}"
        )
    if as_json:
        print(json.dumps({"rows": rows, "averages": averages}))


if __name__ == "__main__":
    main()

"""Tabular learning beside plain Python: the compiled loop on a model, and a run that steps an environment.

    python scripts/bench_tabular.py [--updates 20000000] [--python-updates 50000] [--steps 100000] [--rounds 3] [--json]

First Q-learning updates per CPU-second on FrozenLake 8x8.

Both apply rule 13.10 with α = 1 / (1 + visits) and ε-greedy actions (ε = .1, random ties) with restarts and a time
limit of 200 steps. The Python side is the loop one would write: lists for the table, `gymnasium.step` for the world.
Medians over rounds that alternate. Two more rows tell what compiling costs: the first call in a process whose cache
folder is empty, and the first call in a process that finds the cache.

Then the CPU time of Taxi-v4 through Gymnasium, without its model: ``neuralq train Taxi-v4 --learner tabular
--tabular.simulate false`` (what the run calls training: not its evaluations) beside the NumPy loop that one would
write, ε-greedy with α = .1. For example:

    compiled, from the model        44,264,580 updates/CPU-s (target 20,000,000)
    plain Python, gymnasium            108,524 updates/CPU-s
    ratio                                  408x (target 100x)
    first call, empty cache                2.2 s (target 10 s)
    first call, cached                    0.53 s (target 1 s)
    Taxi, a run through Gymnasium         1.01 s for 100,000 steps
    Taxi, plain NumPy                     0.96 s
    ratio                                 1.05x (target at most 1.5x)

``--json`` prints one JSON object as the last line.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time

import gymnasium
import numpy as np

import neuralq
from neuralq.mdp import FiniteMDP
from neuralq.tabular import EpsilonGreedy, Model, RunOptions, compile_model, q_learning

ENV, GAMMA, EPSILON, LIMIT = "FrozenLake8x8-v1", 0.99, 0.1, 200
TAXI = "Taxi-v4"

FIRST_CALL = """
import time, numpy
from neuralq.mdp import FiniteMDP
from neuralq.tabular import q_learning
mdp = FiniteMDP.garnet(4, 2, 2, seed=0)
began = time.perf_counter()
q_learning(mdp, 1, 0.9)
print(time.perf_counter() - began)
"""


def compiled(model: Model, num_updates: int, seed: int) -> float:
    options = RunOptions(max_episode_steps=LIMIT)
    learned = q_learning(model, num_updates, GAMMA, policy=EpsilonGreedy(EPSILON), seed=seed, options=options)
    return num_updates / learned.cpu_seconds


def plain_python(num_updates: int, seed: int) -> float:
    env = gymnasium.make(ENV, max_episode_steps=LIMIT)
    rng = random.Random(seed)
    num_states, num_actions = int(env.observation_space.n), int(env.action_space.n)  # type: ignore[attr-defined]
    q = [[0.0] * num_actions for _ in range(num_states)]
    visits = [[0] * num_actions for _ in range(num_states)]
    s, _ = env.reset(seed=seed)
    began = time.process_time()
    for _ in range(num_updates):
        row = q[s]
        if rng.random() < EPSILON:
            a = int(rng.random() * num_actions)
        else:
            top = max(row)
            a = rng.choice([b for b in range(num_actions) if row[b] == top])
        s_t, r_t, terminated, truncated, _ = env.step(a)
        visits[s][a] += 1
        alpha = 1 / (1 + visits[s][a])
        target = r_t if terminated else r_t + GAMMA * max(q[s_t])
        row[a] += alpha * (target - row[a])
        s = env.reset()[0] if terminated or truncated else s_t
    return num_updates / (time.process_time() - began)


def run_of_taxi(num_steps: int, seed: int) -> float:
    """CPU-seconds of training, every step of which is one of the environment."""
    with tempfile.TemporaryDirectory() as folder:
        run = neuralq.train(
            neuralq.with_preset(
                {
                    "env": TAXI, "learner": "tabular", "tabular": {"simulate": False}, "seed": seed, "exact": False,
                    "total_steps": num_steps, "evaluate_every": num_steps, "evaluation_episodes": 1,
                }
            ),
            f"{folder}/run",
        )  # fmt: skip
    return run.cpu_seconds


def plain_numpy(num_steps: int, seed: int) -> float:
    """CPU-seconds of the loop that one would write."""
    env = gymnasium.make(TAXI)
    rng = np.random.default_rng(seed)
    q = np.zeros((int(env.observation_space.n), int(env.action_space.n)))  # type: ignore[attr-defined]
    s, _ = env.reset(seed=seed)
    began = time.process_time()
    for _ in range(num_steps):
        a = int(rng.integers(q.shape[1])) if rng.random() < EPSILON else int(np.argmax(q[s]))
        s_t, r_t, terminated, truncated, _ = env.step(a)
        target = r_t if terminated else r_t + GAMMA * q[s_t].max()
        q[s, a] += 0.1 * (target - q[s, a])
        s = env.reset()[0] if terminated or truncated else s_t
    return time.process_time() - began


def first_calls() -> tuple[float, float]:
    """Seconds of the first call with an empty and with a filled cache, each in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-c", FIRST_CALL]
        seconds = [
            float(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
            for _ in range(2)
        ]
    return seconds[0], seconds[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=20_000_000, help="of the compiled loop (default 20,000,000)")
    parser.add_argument("--python-updates", type=int, default=50_000, help="of the Python loop (default 50,000)")
    parser.add_argument("--steps", type=int, default=100_000, help="of Taxi (default 100,000)")
    parser.add_argument("--rounds", type=int, default=3, help="how often each is measured (default 3)")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    model = compile_model(FiniteMDP.from_gymnasium(gymnasium.make(ENV)))
    rates = [
        (compiled(model, options.updates, seed), plain_python(options.python_updates, seed))
        for seed in range(options.rounds)
    ]
    fast = statistics.median(rate for rate, _ in rates)
    slow = statistics.median(rate for _, rate in rates)
    cold, warm = first_calls()
    print(f"{'compiled, from the model':<26} {fast:>15,.0f} updates/CPU-s (target 20,000,000)")
    print(f"{'plain Python, gymnasium':<26} {slow:>15,.0f} updates/CPU-s")
    print(f"{'ratio':<26} {fast / slow:>15,.0f}x (target 100x)")
    print(f"{'first call, empty cache':<26} {cold:>15.1f} s (target 10 s)")
    print(f"{'first call, cached':<26} {warm:>15.2f} s (target 1 s)")
    run_of_taxi(1000, 0)  # compiles
    pairs = [(run_of_taxi(options.steps, seed), plain_numpy(options.steps, seed)) for seed in range(options.rounds)]
    stepped, numpy = (statistics.median(column) for column in zip(*pairs, strict=True))
    print(f"{'Taxi, a run through Gymnasium':<30} {stepped:>11.2f} s for {options.steps:,} steps")
    print(f"{'Taxi, plain NumPy':<30} {numpy:>11.2f} s")
    print(f"{'ratio':<30} {stepped / numpy:>11.2f}x (target at most 1.5x)")
    if options.json:
        print(json.dumps({"compiled": fast, "python": slow, "ratio": fast / slow, "first_call_seconds": cold,
                          "cached_call_seconds": warm, "taxi_seconds": stepped, "taxi_numpy_seconds": numpy,
                          "taxi_ratio": stepped / numpy}))  # fmt: skip


if __name__ == "__main__":
    main()

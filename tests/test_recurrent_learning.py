"""What networks with a memory must reach where state is hidden, and those without one must not; ten fresh seeds."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import neuralq
from neuralq.exact import solve
from neuralq_envs.aliased import mccallum

SEEDS = range(200, 210)
PLAIN: dict[str, Any] = {"class": "MLP", "hidden": [64, 64], "layer_norm": True}
CARTPOLE: dict[str, Any] = {
    "env": "CartPole-v1", "wrappers": [{"neuralq_envs.hidden:Shown": {"entries": [0, 2]}}], "total_steps": 100_000,
    "rollout": {
        "normalise_observations": True, "learning_rate": 1e-3, "anneal_env_steps": 100_000, "num_epochs": 8,
        "num_minibatches": 4,
    },
}  # fmt: skip
MAZE: dict[str, Any] = {
    "env": "neuralq/McCallumMaze-v0", "gamma": 0.9, "total_steps": 50_000, "epsilon_end": 0.15,
    "evaluate_every": 10_000,
    "rollout": {
        "lambda_": 0.9, "returns": "watkins", "refresh_targets": True, "num_envs": 8, "num_steps": 32,
        "num_epochs": 6, "num_minibatches": 2, "learning_rate": 2e-3, "average_updates": 10.0,
    },
}  # fmt: skip
TASKS = {"CartPole without velocities": (CARTPOLE, 64, 0.95 * 500), "McCallum's maze": (MAZE, 32, None)}


def trained(task: dict[str, Any], body: dict[str, Any], seed: int, folder: str) -> float:
    config = {**task, "learner": "rollout", "body": body, "seed": seed, "resume_probe": False, "monitor": False}
    run = neuralq.train(neuralq.with_preset(config), folder)
    return neuralq.evaluate(run, num_episodes=100, seed=1).mean


def full_state_return() -> float:
    """Mean undiscounted return of the shortest ways from all ten starts."""
    mdp = mccallum().mdp
    v = solve(mdp, 1.0).v
    return float(v @ mdp.start_distribution)


def test_the_full_state_of_the_maze_is_worth_what_shortest_ways_are() -> None:
    assert full_state_return() == pytest.approx(5 - 0.1 * (3.9 - 1))  # 3.9 steps in the mean, the last pays 5


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_a_memory_reaches_what_the_full_state_does_and_no_memory_does_not(task: str, tmp_path: Path) -> None:
    """95 % of the full state's return in at least 8 of 10 seeds; of the plain body in none."""
    config, units, bound = TASKS[task]
    bound = 0.95 * full_state_return() if bound is None else bound
    remembers = {"class": "GRU", "units": units, "hidden": [units]}
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = {
            name: [pool.submit(trained, config, body, seed, str(tmp_path / f"{name}-{seed}")) for seed in SEEDS]
            for name, body in (("gru", remembers), ("plain", PLAIN))
        }
        found = {name: [future.result() for future in some] for name, some in futures.items()}
    print(task, bound, found)
    assert sum(value >= bound for value in found["gru"]) >= 8
    assert sum(value >= bound for value in found["plain"]) == 0

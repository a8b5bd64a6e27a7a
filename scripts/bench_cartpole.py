"""CartPole-v1 by TD(λ): CPU-seconds and environment steps until it is solved, over seeds, and whether it stays solved.

    python scripts/bench_cartpole.py [--seeds 10] [--json]

Every seed trains with the preset on one thread, and is evaluated greedily (20 episodes) every 4,096 steps. It counts as
solved at its first evaluation that averages at least 475; training goes on, and "stays" says whether the next three
evaluations average that too. CPU-seconds are those of training: evaluating and compiling are not counted. Example:

    seed     steps   CPU-s   next three
       0    13,048    0.66   378 362 499  falls below
       1    17,144    0.86   500 500 500  stays
       …
    10 of 10 seeds within 100,000 steps; median 15,098 steps, 0.75 CPU-seconds; 3 of 10 stay above 475

``--json`` prints one JSON object as the last line, with the same numbers.
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import statistics
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import neuralq
from neuralq.runs import with_preset
from neuralq.runs.folder.run_folder import read_metrics

TARGET = 475
NUM_AFTER = 3


def solve(seed: int, budget: int, evaluate_every: int) -> dict[str, Any]:
    total_steps = budget + (NUM_AFTER + 1) * evaluate_every
    config = with_preset(
        {
            "env": "CartPole-v1",
            "seed": seed,
            "total_steps": total_steps,
            "evaluate_every": evaluate_every,
            "evaluation_episodes": 20,
            "checkpoint_every": 2 * total_steps,
        }
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run")
        neuralq.train(config, path)
        rows = [row for row in read_metrics(path) if row["kind"] == "evaluation"]
    hit = next((i for i, row in enumerate(rows) if row["greedy_return"] >= TARGET), None)
    if hit is None or rows[hit]["env_steps"] > budget:
        return {"seed": seed, "env_steps": None, "cpu_seconds": None, "next_returns": [], "stays": False}
    following = [row["greedy_return"] for row in rows[hit + 1 : hit + 1 + NUM_AFTER]]
    return {
        "seed": seed,
        "env_steps": rows[hit]["env_steps"],
        "cpu_seconds": rows[hit]["cpu_seconds"],
        "next_returns": following,
        "stays": len(following) == NUM_AFTER and min(following) >= TARGET,
    }


def in_processes(seeds: range, one: Callable[[int], dict[str, Any]], processes: int) -> Iterator[dict[str, Any]]:
    if processes == 1:
        yield from map(one, seeds)
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(one, seeds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="seeds 0, 1, … (default 10)")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=100_000, help="environment steps to be solved within")
    parser.add_argument("--evaluate-every", type=int, default=4096, help="environment steps (default 4,096)")
    parser.add_argument("--processes", type=int, default=2, help="seeds at a time (default 2)")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()

    one = functools.partial(solve, budget=options.budget, evaluate_every=options.evaluate_every)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    results = []
    print("seed     steps   CPU-s   next three", flush=True)
    for result in in_processes(seeds, one, options.processes):
        results.append(result)
        if result["env_steps"] is None:
            print(f"{result['seed']:>4} {'-':>9} {'-':>7}   not within {options.budget:,} steps", flush=True)
            continue
        returns = " ".join(f"{value:.0f}" for value in result["next_returns"])
        verdict = "stays" if result["stays"] else "falls below"
        steps, cpu_seconds = result["env_steps"], result["cpu_seconds"]
        print(f"{result['seed']:>4} {steps:>9,} {cpu_seconds:>7.2f}   {returns}  {verdict}", flush=True)

    solved = [result for result in results if result["env_steps"] is not None]
    num_stay = sum(result["stays"] for result in results)
    median_steps = statistics.median(r["env_steps"] for r in solved) if solved else None
    median_cpu = statistics.median(r["cpu_seconds"] for r in solved) if solved else None
    line = f"{len(solved)} of {len(results)} seeds within {options.budget:,} steps"
    if solved:
        line += f"; median {median_steps:,.0f} steps, {median_cpu:.2f} CPU-seconds; "
        line += f"{num_stay} of {len(results)} stay above {TARGET}"
    print(line)
    if options.json:
        summary = {
            "num_seeds": len(results),
            "num_solved": len(solved),
            "num_stay": num_stay,
            "median_env_steps": median_steps,
            "median_cpu_seconds": median_cpu,
            "seeds": results,
        }
        print(json.dumps(summary))


if __name__ == "__main__":
    main()

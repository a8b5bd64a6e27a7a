"""What the rollout learner comes to with its presets: final greedy return over seeds, one row per environment.

    python scripts/bench_learning.py [CartPole-v1 ...] [--seeds 10] [--first-seed 1100] [--runs FOLDER] [--json]

LunarLander-v3, which needs the extra box2d, and the games of MinAtar, which need the extra minatar, are measured when
they are named. Every seed trains with the preset and its budget of steps on one thread. The final return is the mean
of 100 greedy episodes, none of them seen before, of the agent that the run leaves behind; the row gives the
interquartile mean over seeds with its stratified bootstrap interval. A seed is solved at its first evaluation (20
greedy episodes) that averages at least the threshold, and stays if the next three do as well; in MinAtar the threshold
is where DQN's published curve ends, and Seaquest has none, for its curve is from before a mistake in the game was
mended. CPU-seconds are those of training. Example:

    CartPole-v1, 100,000 steps
    seed     final   solved at   CPU-s   next three
    1000     500.0       8,583    0.45   500 500 500  stays
       …
    environment                  steps      final      interval 95 %     solved   stay   until solved        in all
    CartPole-v1                100,000      500.0     500.0 .. 500.0      10/10   9/10     0.45 CPU-s     4.1 CPU-s

``--json`` prints one JSON object as the last line, with the same numbers; ``--runs`` keeps the runs, for their curves.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import multiprocessing
import statistics
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import neuralq
from neuralq.runs import evaluate_run, with_preset
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.sweep.statistics import estimate

THRESHOLDS: dict[str, float | None] = {
    "CartPole-v1": 475.0,
    "Acrobot-v1": -100.0,
    "MountainCar-v0": -110.0,
    "LunarLander-v3": 200.0,
    # DQN after 5,000,000 frames, read off the curves of the games' authors (Young & Tian 2019, README; 30 seeds).
    "MinAtar/Asterix-v1": 17.0,
    "MinAtar/Breakout-v1": 10.0,
    "MinAtar/Freeway-v1": 50.0,
    "MinAtar/Seaquest-v1": None,
    "MinAtar/SpaceInvaders-v1": 44.0,
}
DEFAULT = ("CartPole-v1", "Acrobot-v1", "MountainCar-v0")  # those that need no extra
NUM_AFTER = 3


def learn(case: tuple[str, int], total_steps: int | None, num_episodes: int, runs: Path | None) -> dict[str, Any]:
    env, seed = case
    given = {} if total_steps is None else {"total_steps": total_steps}
    config = with_preset({"env": env, "seed": seed, "checkpoint_every": 10**9, **given})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(runs or folder, f"{env.replace('/', '-')}-{seed}")
        run = neuralq.train(config, path)
        final = evaluate_run(path, num_episodes).mean
        rows = [row for row in read_metrics(path) if row["kind"] == "evaluation"]
    outcome = {"seed": seed, "final_return": final, "env_steps": run.env_steps, "cpu_seconds": run.cpu_seconds}
    return outcome | first_hit(rows, THRESHOLDS[env])


def first_hit(rows: Sequence[dict[str, Any]], threshold: float | None) -> dict[str, Any]:
    """Where the evaluations ``rows`` first reach the threshold, and whether the next three do too."""
    goal = math.inf if threshold is None else threshold
    hit = next((i for i, row in enumerate(rows) if row["greedy_return"] >= goal), None)
    if hit is None:
        return {"solved_at": None, "solved_cpu_seconds": None, "next_returns": [], "stays": False}
    following = [row["greedy_return"] for row in rows[hit + 1 : hit + 1 + NUM_AFTER]]
    return {
        "solved_at": rows[hit]["env_steps"],
        "solved_cpu_seconds": rows[hit]["cpu_seconds"],
        "next_returns": following,
        "stays": len(following) == NUM_AFTER and min(following) >= goal,
    }


def in_processes(
    cases: Sequence[tuple[str, int]], one: Callable[[tuple[str, int]], dict[str, Any]], processes: int
) -> Iterator[dict[str, Any]]:
    if processes == 1:
        yield from map(one, cases)
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(one, cases)


def seed_row(result: dict[str, Any]) -> str:
    line = f"{result['seed']:>4} {result['final_return']:>9.1f} "
    if result["solved_at"] is None:
        return line + f"{'-':>11} {'-':>7}   not at a threshold"
    returns = " ".join(f"{value:.0f}" for value in result["next_returns"])
    verdict = "stays" if result["stays"] else "falls below" if len(result["next_returns"]) == NUM_AFTER else "ends"
    return line + f"{result['solved_at']:>11,} {result['solved_cpu_seconds']:>7.2f}   {returns}  {verdict}"


def summary_of(env: str, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    final = estimate([result["final_return"] for result in results])
    solved = [result["solved_cpu_seconds"] for result in results if result["solved_at"] is not None]
    return {
        "env": env,
        "env_steps": max(result["env_steps"] for result in results),
        "iqm": final.iqm,
        "low": final.low,
        "high": final.high,
        "threshold": THRESHOLDS[env],
        "num_seeds": len(results),
        "num_solved": len(solved),
        "num_stay": sum(result["stays"] for result in results),
        "median_solved_cpu_seconds": statistics.median(solved) if solved else None,
        "median_cpu_seconds": statistics.median(result["cpu_seconds"] for result in results),
        "seeds": list(results),
    }


def summary_row(row: dict[str, Any]) -> str:
    interval = "-" if row["low"] is None else f"{row['low']:.1f} .. {row['high']:.1f}"
    until = "-" if row["median_solved_cpu_seconds"] is None else f"{row['median_solved_cpu_seconds']:.2f} CPU-s"
    solved, stay = (f"{row[name]}/{row['num_seeds']}" for name in ("num_solved", "num_stay"))
    return (
        f"{row['env']:<24} {row['env_steps']:>9,} {row['iqm']:>10.1f} {interval:>18} "
        f"{solved:>10} {stay:>6} {until:>14} {row['median_cpu_seconds']:>7.1f} CPU-s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("envs", nargs="*", help=f"of {', '.join(THRESHOLDS)} (default {' '.join(DEFAULT)})")
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds (default 10)")
    parser.add_argument("--first-seed", type=int, default=1000, help="the presets were chosen on seeds below it")
    parser.add_argument("--total-steps", type=int, help="environment steps in place of the preset's")
    parser.add_argument("--episodes", type=int, default=100, help="of the final evaluation (default 100)")
    parser.add_argument("--processes", type=int, default=2, help="seeds at a time (default 2)")
    parser.add_argument("--runs", type=Path, help="a folder for the runs, which else are not kept")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    if unknown := [env for env in options.envs if env not in THRESHOLDS]:
        parser.error(f"no threshold for {', '.join(unknown)}; choose from {', '.join(THRESHOLDS)}")

    one = functools.partial(learn, total_steps=options.total_steps, num_episodes=options.episodes, runs=options.runs)
    summaries = []
    for env in options.envs or DEFAULT:
        cases = [(env, options.first_seed + i) for i in range(options.seeds)]
        results = []
        print(f"{env}\nseed     final   solved at   CPU-s   next three", flush=True)
        for result in in_processes(cases, one, options.processes):
            results.append(result)
            print(seed_row(result), flush=True)
        summaries.append(summary_of(env, results))
    header = ("environment", "steps", "final", "interval 95 %", "solved", "stay", "until solved", "in all")
    print("{:<24} {:>9} {:>10} {:>18} {:>10} {:>6} {:>14} {:>13}".format(*header))
    for summary in summaries:
        print(summary_row(summary))
    if options.json:
        print(json.dumps(summaries))


if __name__ == "__main__":
    main()

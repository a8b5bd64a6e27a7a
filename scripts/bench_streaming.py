"""Streaming learners on classic control: final greedy return by bound of the step and by cut of the trace.

    python scripts/bench_streaming.py [CartPole-v1 ...] [--variants obgd obgd/published ...] [--steps N] [--seeds 10]
                                      [--first-seed 1100] [--workers N] [--json]

A variant is a bound (obgd: Stream Q(λ), adaptive-obgd, intentional), by itself with the exact cut of Watkins' trace, or
followed by ``/published`` with that of Stream Q(λ)'s program; ``rollout`` is the rollout learner with its own preset.
Everything else is the preset's. The seeds of a row are the processes of one sweep. The final return is the mean of 100
greedy episodes, none of them seen before, of the agent that a run leaves behind; the mean of a run's evaluations says
how it got there. Both are interquartile means over seeds with stratified bootstrap intervals; CPU-seconds are the
median of training a seed. Columns:

    environment     variant                     steps seeds   final     interval 95 %    mean     interval 95 %  CPU-s

``--json`` prints one JSON object per row as the last line, with the seeds' own numbers.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuralq.apps.cli.sweeps import sweep_bar
from neuralq.runs import RunConfig, evaluate_run, with_preset
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.recipe.config import config_to_dict
from neuralq.runs.sweep import LocalProcesses, create_sweep, num_cores, run_sweep
from neuralq.runs.sweep.statistics import estimate

ENVS = ("CartPole-v1", "Acrobot-v1", "MountainCar-v0")
BOUNDS = ("obgd", "adaptive-obgd", "intentional")
VARIANTS = (*BOUNDS, *(f"{bound}/published" for bound in BOUNDS), "rollout")


def config_of(env: str, variant: str, num_steps: int | None) -> RunConfig:
    """The preset of the variant's learner, with its bound and cut, and the number of steps if it is given."""
    given: dict[str, Any] = {"env": env, "learner": "rollout" if variant == "rollout" else "streaming"}
    if variant != "rollout":
        bound, _, cut = variant.partition("/")
        given["streaming"] = {"bound": bound, "cut": cut or "watkins"}
    if num_steps is not None:
        given["total_steps"] = num_steps
    return with_preset({**given, "checkpoint_every": 10**9})


def measure(env: str, variant: str, seeds: Sequence[int], options: argparse.Namespace) -> dict[str, Any]:
    config = config_of(env, variant, options.steps)
    with tempfile.TemporaryDirectory() as folder:
        sweep = create_sweep(Path(folder, "sweep"), config_to_dict(config), seeds)
        with sweep_bar(sweep) as bar:
            result = run_sweep(sweep, LocalProcesses(min(options.workers, len(seeds)), sweep.config), bar)
        missing = [run for run in result.runs if run.state != "finished"]
        if missing:
            why = missing[0].reason or f"ended by {result.interrupted_by}"
            raise SystemExit(f"{env} {variant}: seed {missing[0].seed} did not finish: {why}")
        outcomes = [seed_of(run.run_dir, run.seed, options.episodes) for run in result.runs]
    return row_of(env, variant, outcomes)


def seed_of(run_dir: Path, seed: int, num_episodes: int) -> dict[str, Any]:
    """What one seed came to."""
    found = [row for row in read_metrics(run_dir) if row["kind"] == "evaluation"]
    return {
        "seed": seed,
        "env_steps": found[-1]["env_steps"],
        "cpu_seconds": found[-1]["cpu_seconds"],
        "final_return": evaluate_run(run_dir, num_episodes).mean,
        "mean_return": statistics.fmean(row["greedy_return"] for row in found),
    }


def row_of(env: str, variant: str, outcomes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    final, along = (estimate([outcome[name] for outcome in outcomes]) for name in ("final_return", "mean_return"))
    return {
        "env": env,
        "variant": variant,
        "env_steps": max(outcome["env_steps"] for outcome in outcomes),
        "num_seeds": len(outcomes),
        **{"iqm": final.iqm, "low": final.low, "high": final.high},
        **{"along_iqm": along.iqm, "along_low": along.low, "along_high": along.high},
        "median_cpu_seconds": statistics.median(outcome["cpu_seconds"] for outcome in outcomes),
        "seeds": list(outcomes),
    }


def line_of(row: dict[str, Any]) -> str:
    def interval(low: float | None, high: float | None) -> str:
        return "-" if low is None or high is None else f"{low:.1f} .. {high:.1f}"

    final, along = interval(row["low"], row["high"]), interval(row["along_low"], row["along_high"])
    return (
        f"{row['env']:<15} {row['variant']:<24} {row['env_steps']:>8,} {row['num_seeds']:>5} {row['iqm']:>7.1f} "
        f"{final:>17} {row['along_iqm']:>7.1f} {along:>17} {row['median_cpu_seconds']:>6.1f}"
    )


HEADER = "{:<15} {:<24} {:>8} {:>5} {:>7} {:>17} {:>7} {:>17} {:>6}".format(
    "environment", "variant", "steps", "seeds", "final", "interval 95 %", "mean", "interval 95 %", "CPU-s"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("envs", nargs="*", help=f"environments (default {' '.join(ENVS)})")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=VARIANTS, metavar="V", help="default all")
    parser.add_argument("--steps", type=int, help="environment steps in place of the presets'")
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds (default 10)")
    parser.add_argument("--first-seed", type=int, default=1100, help="the first of them (default 1100)")
    parser.add_argument("--episodes", type=int, default=100, help="of the final evaluation (default 100)")
    parser.add_argument("--workers", type=int, default=num_cores(), help="seeds at a time (default: one per core)")
    parser.add_argument("--json", action="store_true", help="one JSON object per row as the last line")
    options = parser.parse_args()
    if unknown := [env for env in options.envs if env not in ENVS]:
        parser.error(f"no streaming preset for {', '.join(unknown)}; choose from {', '.join(ENVS)}")
    if min(options.seeds, options.episodes, options.workers) < 1 or options.first_seed < 0:
        parser.error("--seeds, --episodes and --workers must be at least 1, --first-seed at least 0")

    print(HEADER, flush=True)
    rows = []
    for env in options.envs or ENVS:
        for variant in options.variants:
            seeds = range(options.first_seed, options.first_seed + options.seeds)
            rows.append(measure(env, variant, seeds, options))
            print(line_of(rows[-1]), flush=True)
    if options.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()

"""Greedy return by environment steps for many runs: a panel for each environment, a line for each seed.

    python scripts/learning_curves.py RUN [RUN ...] [--level ENV=RETURN ...] [--csv F] [--svg F]

A row for each evaluation: environment, seed, steps, CPU-seconds of training and greedy return. The thick line is the
mean over the seeds that have come that far. ``--level`` draws a dashed line into the panel of an environment;
``--draw F`` takes the rows from a CSV in place of runs. Example:

    python scripts/bench_learning.py MinAtar/Breakout-v1 --seeds 3 --runs runs/minatar
    python scripts/learning_curves.py runs/minatar/* --level MinAtar/Breakout-v1=10 --svg curves.svg
"""

from __future__ import annotations

import argparse
import csv
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuralq.figures import COLOURS, draw_svg, steps_axis
from neuralq.runs.folder.run_folder import read_config, read_metrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = ("env", "seed", "env_steps", "cpu_seconds", "greedy_return")

Row = dict[str, Any]


def rows_of(run: Path) -> list[Row]:
    """The evaluations of a run."""
    config = read_config(run)
    return [
        {
            "env": config["env"],
            "seed": config["seed"],
            "env_steps": row["env_steps"],
            "cpu_seconds": round(row["cpu_seconds"], 1),
            "greedy_return": round(row["greedy_return"], 3),
        }
        for row in read_metrics(run)
        if row["kind"] == "evaluation"
    ]


def read(path: Path) -> list[Row]:
    with open(path, newline="", encoding="utf-8") as file:
        return [{k: v if k == "env" else float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def write(path: Path, rows: Sequence[Row]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def mean_curve(rows: Sequence[Row]) -> tuple[list[float], list[float]]:
    """Steps at which there is an evaluation, and the mean of those that were made there."""
    steps = sorted({row["env_steps"] for row in rows})
    return steps, [statistics.fmean(row["greedy_return"] for row in rows if row["env_steps"] == at) for at in steps]


def paint(figure: Figure, rows: Sequence[Row], levels: Mapping[str, float]) -> None:
    envs = sorted({row["env"] for row in rows})
    for axes, env in zip(figure.subplots(1, len(envs), squeeze=False)[0], envs, strict=True):
        here = [row for row in rows if row["env"] == env]
        for seed in sorted({row["seed"] for row in here}):
            mine = [row for row in here if row["seed"] == seed]
            steps, returns = [row["env_steps"] for row in mine], [row["greedy_return"] for row in mine]
            axes.plot(steps, returns, color=COLOURS[0], linewidth=0.8, alpha=0.5)
        axes.plot(*mean_curve(here), color=COLOURS[0], linewidth=2)
        if env in levels:
            axes.axhline(levels[env], color=COLOURS[1], linestyle="--", linewidth=1.2)
        axes.set(title=env.rpartition("/")[2], ylim=(min(0, axes.get_ylim()[0]), None))
        axes.set_xlim(left=0)
        steps_axis(axes, "environment steps")
    figure.axes[0].set_ylabel("greedy return")


def level_of(text: str) -> tuple[str, float]:
    env, _, value = text.partition("=")
    return env, float(value)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python scripts/learning_curves.py runs/a --svg curves.svg"
    )
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="folders of runs")
    parser.add_argument("--draw", type=Path, metavar="CSV", help="takes the rows from this file")
    parser.add_argument(
        "--level", type=level_of, action="append", default=[], metavar="ENV=RETURN", help="a dashed line"
    )
    parser.add_argument("--csv", type=Path, help="writes every evaluation")
    parser.add_argument("--svg", type=Path, help="draws the curves")
    options = parser.parse_args()
    if bool(options.runs) == (options.draw is not None):
        parser.error("give folders of runs, or --draw CSV")
    rows = [row for run in options.runs for row in rows_of(run)] if options.draw is None else read(options.draw)
    if not rows:
        parser.error("there is no evaluation yet; give runs that have been evaluated")
    if options.csv is not None:
        write(options.csv, rows)
    if options.svg is not None:
        about = "Greedy return by environment steps, a thin line for each seed and a thick one for their mean."
        size = (3.2 * len({row["env"] for row in rows}), 3.2)
        levels = dict(options.level)
        drawn = draw_svg("learning-curves", "Learning curves", about, size, lambda figure: paint(figure, rows, levels))
        options.svg.write_text(drawn + "\n", encoding="utf-8")
    for env in sorted({row["env"] for row in rows}):
        steps, means = mean_curve([row for row in rows if row["env"] == env])
        print(f"{env:<24} {steps[-1]:>11,.0f} steps  mean greedy return {means[-1]:.1f}")


if __name__ == "__main__":
    main()

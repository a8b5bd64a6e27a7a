"""One environment, Mitchell's three network layouts, several seeds: one figure and one table.

    python scripts/three_layouts.py --env CartPole-v1 --seeds 5 --figure layouts.svg
    python scripts/three_layouts.py --env neuralq/MitchellGrid-v0 --layouts table linear action-output

Every layout learns by TD(λ) at the environment's preset. The figure (SVG, PNG or PDF by its name; it needs matplotlib)
shows the median over seeds of the greedy return with its interquartile range. The table, for example:

    layout          final median   quartiles       best   CPU-s
    action-input           500.0   498.2 .. 500.0  500.0     5.1
    separate               500.0   471.0 .. 500.0  500.0     4.0
    action-output          500.0   500.0 .. 500.0  500.0     2.3
    wrote layouts.svg
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import neuralq
from neuralq.runs import with_preset
from neuralq.runs.folder.run_folder import read_metrics


def learn(case: tuple[str, str, int, int]) -> dict[str, Any]:
    env, layout, seed, total_steps = case
    config = with_preset(
        {
            "env": env,
            "layout": layout,
            "seed": seed,
            "total_steps": total_steps,
            "evaluate_every": max(1, total_steps // 20),
            "checkpoint_every": 2 * total_steps,
        }
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run")
        run = neuralq.train(config, path)
        rows = [row for row in read_metrics(path) if row["kind"] == "evaluation"]
    steps, returns = ([row[name] for row in rows] for name in ("env_steps", "greedy_return"))
    return {"layout": layout, "seed": seed, "steps": steps, "returns": returns, "cpu_seconds": run.cpu_seconds}


def bands(curves: list[dict[str, Any]], num_points: int = 100) -> tuple[Any, Any]:
    """Steps ``[n]`` and the quartiles ``[3, n]`` of the seeds' returns there, read between evaluations linearly."""
    first = max(curve["steps"][0] for curve in curves)
    steps = np.linspace(first, min(curve["steps"][-1] for curve in curves), num_points)
    returns = [np.interp(steps, curve["steps"], curve["returns"]) for curve in curves]
    return steps, np.percentile(returns, [25, 50, 75], axis=0)


def draw(by_layout: dict[str, list[dict[str, Any]]], env: str, path: str) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise SystemExit("--figure needs matplotlib: pip install 'neuralq[plot]'") from error
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    for layout, curves in by_layout.items():
        steps, (low, middle, high) = bands(curves)
        line = axes.plot(steps, middle, label=layout)[0]
        axes.fill_between(steps, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    num_seeds = len(next(iter(by_layout.values())))
    axes.set(xlabel="environment steps", ylabel="greedy return", title=f"{env}: quartiles of {num_seeds} seeds")
    axes.legend()
    figure.savefig(path)


def in_processes(cases: Iterable[tuple[str, str, int, int]], processes: int) -> Iterator[dict[str, Any]]:
    if processes == 1:
        yield from map(learn, cases)
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(learn, cases)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="CartPole-v1", help="Gymnasium id (default CartPole-v1)")
    parser.add_argument("--layouts", nargs="+", default=["action-input", "separate", "action-output"])
    parser.add_argument("--seeds", type=int, default=5, help="seeds 0, 1, … (default 5)")
    parser.add_argument("--total-steps", type=int, default=80_000, help="environment steps of each (default 80,000)")
    parser.add_argument("--processes", type=int, default=2, help="runs at a time (default 2)")
    parser.add_argument("--figure", metavar="PATH", help="where to draw, for example layouts.svg")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()

    cases = itertools.product([options.env], options.layouts, range(options.seeds), [options.total_steps])
    by_layout: dict[str, list[dict[str, Any]]] = {layout: [] for layout in options.layouts}
    for curve in in_processes(cases, options.processes):
        by_layout[curve["layout"]].append(curve)

    print(f"{'layout':<14} {'final median':>13}   {'quartiles':<18} {'best':>7} {'CPU-s':>7}")
    for layout, curves in by_layout.items():
        low, middle, high = np.percentile([curve["returns"][-1] for curve in curves], [25, 50, 75])
        best = max(max(curve["returns"]) for curve in curves)
        cpu_seconds = np.median([curve["cpu_seconds"] for curve in curves])
        print(f"{layout:<14} {middle:>13.1f}   {f'{low:.1f} .. {high:.1f}':<18} {best:>7.1f} {cpu_seconds:>7.1f}")
    if options.figure is not None:
        draw(by_layout, options.env, options.figure)
        print(f"wrote {options.figure}")
    if options.json:
        print(json.dumps({"env": options.env, "layouts": by_layout}))


if __name__ == "__main__":
    main()

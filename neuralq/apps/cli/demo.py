"""``neuralq demo`` and ``neuralq baird``: a network that learns, and a divergence predicted before it happens."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.progress import training_bar
from neuralq.apps.pages.star import write_demo_report
from neuralq.lab import BairdPrediction, BairdResult, predict_baird, run_baird
from neuralq.runs import Run, RunConfig, preset_for, train
from neuralq.runs.control import CONTROL
from neuralq.runs.folder.run_folder import is_run_folder, read_metrics
from neuralq.runs.recipe.config import config_from_dict

__all__ = ["baird", "demo", "plain_star", "show_star"]

TARGET = 475.0


def demo(argv: list[str]) -> int:
    """Learn CartPole, run Baird's star, write one page about both."""
    parser = command_parser(
        "demo",
        "Learn CartPole-v1 by TD(λ), predict and measure divergence on Baird's star, write a page on both.",
        "neuralq demo --seed 1",
    )
    parser.add_argument("--folder", default="runs/demo", help="where the results go (default: runs/demo)")
    parser.add_argument("--seed", type=int, default=0, help="of the training run (default: 0)")
    options = parser.parse_args(argv)
    folder = Path(options.folder)
    began = time.perf_counter()
    console = Console(file=sys.stderr)
    run = _cartpole(folder / "cartpole", options.seed, console)
    predictions, results = show_star(console, num_steps=5000, gamma=0.99, step_size=0.01, num_upper=6)
    facts = {
        "environment": "CartPole-v1",
        "environment steps": run.env_steps,
        "CPU-seconds of training": round(run.cpu_seconds, 2),
        "greedy return": run.greedy_return,
        "target": TARGET,
    }
    path = write_demo_report(folder / "report.html", read_metrics(run.run_dir), facts, results, target=TARGET)
    seconds = time.perf_counter() - began
    plain = {**run.plain(), "report": str(path), "seconds": seconds, "baird": plain_star(predictions, results)}
    print_result(plain, options.json, [f"report: {path} ({seconds:.0f} s in all)"])
    if not run.reached:
        raise Failure(f"CartPole-v1 did not reach {TARGET:g} with seed {options.seed}; try another seed")
    return 0


def _cartpole(path: Path, seed: int, console: Console) -> Run:
    console.print(
        "[bold]1. CartPole-v1 by TD(λ)[/bold]: one output per action, λ-returns over 32 parallel environments"
    )
    console.print("   preparing (the first run on a machine compiles kernels, about half a minute)")
    if is_run_folder(path):
        shutil.rmtree(path)
    values = {"env": "CartPole-v1", "seed": seed, "stop_at_return": TARGET, **preset_for("CartPole-v1", "rollout")}
    config: RunConfig = config_from_dict(values)
    with training_bar(CONTROL, config) as bar:
        run = train(config, path, [bar])
    console.print(
        f"   greedy return {run.greedy_return:.1f} over 20 episodes after {run.env_steps:,} steps: "
        f"{run.cpu_seconds:.2f} CPU-seconds of training, {run.wall_seconds:.1f} s with evaluation",
        highlight=False,
        soft_wrap=True,
    )
    return run


def baird(argv: list[str]) -> int:
    """Predict growth on Baird's star, then measure it."""
    parser = command_parser(
        "baird",
        "Baird's star: what each representation will do under the same update, and what it does.",
        "neuralq baird --gamma 0.85",
    )
    parser.add_argument("--gamma", type=float, default=0.99, help="discount (default: 0.99; the threshold is 15/17)")
    parser.add_argument("--step-size", type=float, default=0.01, help="α (default: 0.01)")
    parser.add_argument("--num-upper", type=int, default=6, help="upper states of the star (default: 6)")
    parser.add_argument("--num-steps", type=int, default=5000, help="sweeps (default: 5000)")
    options = parser.parse_args(argv)
    predictions, results = show_star(
        Console(file=sys.stderr), options.num_steps, options.gamma, options.step_size, options.num_upper
    )
    print_result({"baird": plain_star(predictions, results)}, options.json, [])
    return 0


def show_star(
    console: Console, num_steps: int, gamma: float, step_size: float, num_upper: int
) -> tuple[list[BairdPrediction], list[BairdResult]]:
    """Print what is predicted of each representation of the star, then what is measured; both are returned."""
    console.print(
        f"[bold]Baird's star[/bold], γ={gamma:g}, α={step_size:g}: the prediction, before anything is trained",
        soft_wrap=True,
    )
    predictions = predict_baird(gamma, step_size, num_upper)
    for p in predictions:
        console.print(
            f"   {p.representation:<14} ×{p.growth:.7f} per sweep: {p.verdict} ({p.scope})",
            highlight=False,
            soft_wrap=True,
        )
    with console.status(f"running {num_steps:,} sweeps of each representation"):
        results = run_baird(num_steps, gamma, step_size, num_upper)
    table = Table("representation", "predicted", "measured", "largest |V|", "exact V", title="measured")
    for r in results:
        largest = f"{abs(r.values).max():.4g}" + (" (stopped)" if r.stopped_on_cap else "")
        exact = f"{abs(r.exact_values).max():g}"
        table.add_row(r.representation, f"{r.predicted_growth:.7f}", f"{r.measured_growth:.7f}", largest, exact)
    console.print(table)
    return predictions, results


def plain_star(predictions: Sequence[BairdPrediction], results: Sequence[BairdResult]) -> list[dict[str, Any]]:
    """Predictions and results as JSON takes them."""
    return [
        {
            "representation": r.representation,
            "predicted_growth": p.growth,
            "prediction_scope": p.scope,
            "verdict": p.verdict,
            "measured_growth": r.measured_growth,
            "stopped_on_cap": r.stopped_on_cap,
        }
        for p, r in zip(predictions, results, strict=True)
    ]

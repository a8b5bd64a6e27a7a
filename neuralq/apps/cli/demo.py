"""``neuralq demo`` and ``neuralq baird``: a network that learns, and a divergence predicted before it happens."""

from __future__ import annotations

import shutil
import sys
import time
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.progress import training_bar
from neuralq.apps.pages.star import divergence_svg, write_demo_report
from neuralq.lab import Problem, RepresentationResult, predict_representations, run_representations
from neuralq.runs import Run, RunConfig, preset_for, train
from neuralq.runs.control import CONTROL
from neuralq.runs.evaluation import shown
from neuralq.runs.folder.run_folder import is_run_folder, read_metrics
from neuralq.runs.recipe.config import config_from_dict
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.baird import critical_gamma

__all__ = ["add_star", "baird", "demo", "show_star", "star_console", "star_of"]

TARGET = 475.0


def demo(argv: list[str]) -> int:
    """Learn CartPole, run Baird's star, write one page about both."""
    parser = command_parser(
        "demo",
        "Learn CartPole-v1 by TD(λ), predict and measure divergence on Baird's star, write a page on both.",
        "neuralq demo --seed 1",
    )
    parser.add_argument(
        "--run-dir", default="runs/demo", metavar="FOLDER", help="where the results go (default: runs/demo)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the training run (default: 0)")
    options = parser.parse_args(argv)
    folder = Path(options.run_dir)
    began = time.perf_counter()
    console = Console(file=sys.stderr)
    run = _cartpole(folder / "cartpole", options.seed, console)
    results = show_star(console, star(), num_steps=5000)
    facts = {
        "environment": "CartPole-v1",
        "environment steps": run.env_steps,
        "CPU-seconds of training": round(run.cpu_seconds, 2),
        "greedy return": run.agent_return,
        "target": TARGET,
    }
    path = write_demo_report(folder / "report.html", read_metrics(run.run_dir), facts, results, target=TARGET)
    seconds = time.perf_counter() - began
    plain = {**run.plain(), "report": str(path), "seconds": seconds, "baird": [one.plain() for one in results]}
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
        f"   greedy return {shown(run.agent_return or 0.0)} over 20 episodes after {run.env_steps:,} steps: "
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
        "neuralq baird --svg star.svg",
    )
    add_star(parser)
    parser.add_argument("--svg", metavar="FILE", help="also draw the errors (extra: plot)")
    options = parser.parse_args(argv)
    results = show_star(star_console(options), star_of(options), options.num_steps, options.seed)
    if options.svg is not None:
        Path(options.svg).write_text(divergence_svg(results), encoding="utf-8")
    print_result({"baird": [one.plain() for one in results]}, options.json, [])
    return 0


def add_star(parser: ArgumentParser) -> None:
    """The arguments that say which star is meant, and how long it is run."""
    parser.add_argument("--gamma", type=float, default=0.99, help="discount (default: 0.99; the threshold is 15/17)")
    parser.add_argument("--step-size", type=float, default=0.01, help="α (default: 0.01)")
    parser.add_argument("--num-upper", type=int, default=6, help="upper states of the star (default: 6)")
    parser.add_argument("--num-steps", type=int, default=5000, help="sweeps of each representation (default: 5000)")
    parser.add_argument("--seed", type=int, default=0, help="of the networks' initial weights (default: 0)")


def star_of(options: Namespace) -> Problem:
    """The star that the arguments of `add_star` name."""
    return replace(star(options.num_upper, options.gamma), step_size=options.step_size)


def star_console(options: Namespace) -> Console:
    """Where tables go; with ``--json`` they are progress."""
    return Console(file=sys.stderr if options.json else sys.stdout)


def show_star(console: Console, problem: Problem, num_steps: int, seed: int = 0) -> list[RepresentationResult]:
    """Print what is predicted of each representation of a star, then what is measured."""
    edge = critical_gamma(problem.mdp.num_states - 1)
    console.print(
        f"[bold]Baird's star[/bold], γ={problem.gamma:g}, α={problem.step_size:g}: the prediction, before anything is "
        f"trained; expected TD diverges for {f'γ > {edge:.4f}' if edge < 1 else 'no γ'}",
        soft_wrap=True,
    )
    for p in predict_representations(problem, seed=seed):
        where = "everywhere" if p.scope == "global" else "at the initial weights"
        console.print(
            f"   {p.representation:<14} ×{p.growth:.7f} per sweep: {p.verdict} {where}", highlight=False, soft_wrap=True
        )
    with console.status(f"running {num_steps:,} sweeps of each representation"):
        results = run_representations(problem, num_steps, seed=seed)
    table = Table("representation", "predicted", "measured", "sweeps", "largest |V|", "exact V", title="measured")
    for r in results:
        largest = f"{abs(r.values).max():.4g}" + (" (stopped)" if r.stopped_on_cap else "")
        exact = f"{abs(r.exact_values).max():g}"
        growths = f"{r.predicted_growth:.7f}", f"{r.measured_growth:.7f}"
        table.add_row(r.representation, *growths, f"{r.steps:,}", largest, exact)
    console.print(table)
    return results

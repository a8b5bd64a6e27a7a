"""``neuralq train | resume | evaluate | report``."""

from __future__ import annotations

import contextlib
import signal
import sys
from datetime import datetime
from pathlib import Path

import numpy as np

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.options import parse_train
from neuralq.apps.cli.sweeps import is_td_gammon_run, resume_seeds, single_run, started_from, train_seeds
from neuralq.checks import MissingExtra
from neuralq.rules import Linear
from neuralq.runs import Run, RunConfig, evaluate_run
from neuralq.runs import resume as resume_run
from neuralq.runs import train as train_run
from neuralq.runs.folder.best import load_best
from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.run_folder import default_run_path, read_config, refuse_old_run
from neuralq.runs.hooks import ProgressBar, TensorBoard, WeightsAndBiases, own_hook
from neuralq.runs.loop import Hook
from neuralq.runs.recipe.config import config_from_dict, config_to_dict
from neuralq.runs.report import write_report
from neuralq.runs.sweep import is_sweep_folder

__all__ = ["evaluate", "report", "resume", "train"]


def train(argv: list[str]) -> int:
    """Train as the options say; exit status 0 only if the target was reached, where one was set."""
    if argv[:1] == ["td-gammon"]:
        from neuralq.apps.cli.backgammon import train_td_gammon

        return train_td_gammon(argv[1:])
    parsed = parse_train(argv)
    if parsed is None:
        return 0
    config, options = parsed
    if options.seeds is not None:
        return train_seeds(config, options)
    path = Path(options.run_dir or default_run_path(config.env, config.layout, config.seed, datetime.now()))
    refuse_old_run(path)  # also by train_run, but preparing takes seconds
    origin = started_from(config, options)
    _say(f"run folder {path}{origin}; preparing (the first run on a machine compiles kernels)")
    with contextlib.ExitStack() as stack:
        hooks: list[Hook] = []
        if options.tensorboard:
            hooks.append(stack.enter_context(contextlib.closing(TensorBoard(path / "tensorboard"))))
        if options.wandb:
            hooks.append(stack.enter_context(contextlib.closing(WeightsAndBiases(path, config_to_dict(config)))))
        hooks += _own(options.hook, stack)
        hooks.append(stack.enter_context(_bar(config, config.total_steps)))
        run = train_run(config, path, hooks)
    return _conclude(run, options.json, config.stop_at_return, config.engine != "auto")


def resume(argv: list[str]) -> int:
    """Go on with a run."""
    parser = command_parser(
        "resume",
        "Go on with a run from its newest intact checkpoint, or with a sweep of seeds where each of them stands.",
        "neuralq resume runs/demo/cartpole",
    )
    parser.add_argument("run", help="run folder, or sweep folder")
    parser.add_argument("--total-steps", type=int, help="a new budget; lets a finished run go on")
    parser.add_argument("--games", type=int, metavar="N", help="of a TD-Gammon run: a new budget")
    parser.add_argument("--workers", type=int, metavar="N", help="of a sweep: how many seeds at a time")
    parser.add_argument("--hook", metavar="module:name", help="of a single run: as for neuralq train")
    options = parser.parse_args(argv)
    if is_td_gammon_run(options.run):
        from neuralq.apps.cli.backgammon import resume_td_gammon

        return resume_td_gammon(options)
    if options.games is not None:
        raise Failure(f"--games is for a TD-Gammon run, and there is none in {options.run}; leave it out", 2)
    if is_sweep_folder(options.run):
        if options.hook is not None:
            raise Failure("a sweep goes on with the hook that it was begun with; leave --hook out", 2)
        return resume_seeds(options.run, options.total_steps, options.workers, options.json)
    if options.workers is not None:
        raise Failure(f"--workers is for a sweep, and {options.run} is none; leave it out", 2)
    config = config_from_dict(read_config(options.run))
    board = Path(options.run) / "tensorboard"
    with contextlib.ExitStack() as stack:
        hooks: list[Hook] = []
        if board.is_dir():  # the run was started with --tensorboard
            hooks.append(stack.enter_context(contextlib.closing(TensorBoard(board))))
        if (Path(options.run) / "wandb").is_dir():  # with --wandb
            tracker = WeightsAndBiases(options.run, config_to_dict(config))
            hooks.append(stack.enter_context(contextlib.closing(tracker)))
        hooks += _own(options.hook, stack)
        hooks.append(stack.enter_context(_bar(config, options.total_steps or config.total_steps)))
        run = resume_run(options.run, options.total_steps, hooks)
    return _conclude(run, options.json, config.stop_at_return, config.engine != "auto")


def _bar(config: RunConfig, total_steps: int) -> ProgressBar:
    epsilon = Linear(config.epsilon_start, config.epsilon_end, config.epsilon_decay_steps)
    return ProgressBar(total_steps, config.stop_at_return, epsilon=epsilon.value)


def _own(name: str | None, stack: contextlib.ExitStack) -> list[Hook]:
    """The user's own hook, if there is one, closed at the end if it can be."""
    if name is None:
        return []
    hook = own_hook(name)
    close = getattr(hook, "close", None)
    if callable(close):
        stack.callback(close)
    return [hook]


def evaluate(argv: list[str]) -> int:
    """Play greedy episodes with a run's newest checkpoint, or its best; or a match of backgammon."""
    if any(map(_is_about_backgammon, argv)):
        from neuralq.apps.cli.backgammon_match import evaluate_backgammon

        return evaluate_backgammon(argv)
    parser = command_parser(
        "evaluate",
        "Play greedy episodes with a trained run. One of TD-Gammon plays a match: neuralq evaluate --against --help.",
        "neuralq evaluate RUN --episodes 100",
        "neuralq evaluate RUN --against gnubg --games 5000",
    )
    parser.add_argument("run", help="run folder")
    parser.add_argument("--episodes", type=int, default=100, help="how many (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes (default: 0)")
    parser.add_argument("--best", action="store_true", help="play with the best parameters of the run, not the last")
    options = parser.parse_args(argv)
    result = evaluate_run(single_run(options.run), options.episodes, options.seed, options.best)
    returns = np.array(result.returns)
    error = float(returns.std(ddof=1) / np.sqrt(len(returns))) if len(returns) > 1 else None
    quartiles = np.percentile(returns, [0, 25, 50, 75, 100])
    plain = {
        "greedy_return": result.mean,
        "standard_error": error,
        "returns": list(result.returns),
        "lengths": list(result.lengths),
        "num_cut": result.num_cut,
        "run_dir": str(options.run),
        "parameters": "best" if options.best else "newest",
    }
    lines = [
        f"mean return {result.mean:.2f}" + ("" if error is None else f" ± {error:.2f} (standard error)")
        + f" over {len(returns)} episodes",
        "lowest {:.1f}, quartiles {:.1f} {:.1f} {:.1f}, highest {:.1f}".format(*quartiles),
    ]  # fmt: skip
    if result.num_cut:
        lines.append(f"{result.num_cut} episodes were cut off: the environment did not end them")
    print_result(plain, options.json, lines)
    return 0


def report(argv: list[str]) -> int:
    """Write a run's report."""
    parser = command_parser("report", "Write a run's report.html (extra plot).", "neuralq report RUN")
    parser.add_argument("run", help="run folder")
    options = parser.parse_args(argv)
    path = write_report(single_run(options.run))
    print_result({"report": str(path)}, options.json, [str(path)])
    return 0


def _is_about_backgammon(argument: str) -> bool:
    """Whether it names a player of backgammon, or asks what only such a player can do."""
    only_there = argument.startswith(("--against", "--error-rate")) or argument.endswith(".safetensors")
    return only_there or is_td_gammon_run(argument)


def _say(line: str) -> None:
    print(f"neuralq: {line}", file=sys.stderr, flush=True)


def _conclude(run: Run, as_json: bool, target: float | None, forced: bool) -> int:
    try:
        report_path = str(write_report(run.run_dir))
    except MissingExtra as error:
        report_path = None
        _say(f"no report: {error}")
    if run.interrupted_by is not None:
        _say(f"{run.interrupted_by}: saved at {run.env_steps:,} steps; go on with: neuralq resume {run.run_dir}")
    _say(run.resumability)
    if run.engine != "compiled" and not forced:
        _say(f"values and gradients were computed by {run.engine}: there are no kernels for all of this representation")
    best = _best_return(run)
    summary = {**run.plain(), "best_return": best, "report": report_path}
    score = "not evaluated" if run.greedy_return is None else f"greedy return {run.greedy_return:.1f}"
    lines = [
        f"{run.env_steps:,} environment steps, {run.cpu_seconds:.2f} CPU-seconds of training, "
        f"{run.wall_seconds:.2f} seconds in all; {score}",
        f"run folder {run.run_dir}" + ("" if report_path is None else f", report {report_path}"),
    ]
    if best is not None and run.greedy_return is not None and best > run.greedy_return:
        lines.append(f"the best evaluation scored {best:.1f}: neuralq evaluate {run.run_dir} --best")
    print_result(summary, as_json, lines)
    if run.interrupted_by is not None:
        return 128 + signal.Signals[run.interrupted_by].value
    if run.reached is False:
        raise Failure(f"the target of {target:g} was not reached within the budget of {run.env_steps:,} steps", 1)
    return 0


def _best_return(run: Run) -> float | None:
    try:
        return load_best(run.run_dir).greedy_return
    except CheckpointError:  # not evaluated yet
        return None

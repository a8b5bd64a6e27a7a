"""``neuralq train --seeds N``, and ``neuralq resume`` for the sweep that it leaves."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO

from neuralq.apps.cli import Failure, main, print_result
from neuralq.apps.cli.kinds import say
from neuralq.apps.cli.option_table import TrainOptions
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.runs import RunConfig
from neuralq.runs.children import python_command
from neuralq.runs.control import CONTROL
from neuralq.runs.evaluation import shown
from neuralq.runs.folder.origin import flat_names
from neuralq.runs.folder.run_folder import RunFolderError, claimed, default_run_path, is_run_folder, read_config
from neuralq.runs.hooks import own_hook
from neuralq.runs.kinds import kind_in, kind_named
from neuralq.runs.play_off import told_of
from neuralq.runs.recipe.config import config_from_dict, config_to_dict
from neuralq.runs.sweep import (
    Status,
    Sweep,
    SweepResult,
    create_sweep,
    is_sweep_folder,
    num_cores,
    open_sweep,
    run_sweep,
    stop_with_parent,
)
from neuralq.runs.sweep.statistics import interquartile_mean
from neuralq.runs.trust import refuse_strangers

__all__ = [
    "add_trust",
    "child",
    "refuse_other_kinds",
    "resume_seeds",
    "single_run",
    "started_from",
    "sweep_bar",
    "train_seeds",
]

_CHILD = "from neuralq.apps.cli.sweeps import child; child()"


def train_seeds(config: RunConfig, options: TrainOptions) -> int:
    """Run seeds side by side; exit status 0 only if each finished and, where a target was set, reached it."""
    assert options.seeds is not None
    flags = [f"--{name}" for name in ("tensorboard", "wandb") if getattr(options, name)]
    for hook in options.hooks:
        own_hook(hook, config)  # a name that is wrong is one error, not one for each seed
        flags += ["--hook", hook]
    seeds = range(config.seed, config.seed + options.seeds)
    with claimed(options.run_dir, lambda: _default_path(config)) as path:
        sweep = create_sweep(path, config_to_dict(config), seeds, flags)
    return _run(sweep, options.workers, options.json, started_from(config, options))


def _default_path(config: RunConfig) -> Path:
    single = default_run_path(config.env, config.layout, config.seed, datetime.now())
    return single.with_name(f"sweep-{single.name}")


def started_from(config: RunConfig, options: TrainOptions) -> str:
    """Where the settings come from that nobody gave, for the first line of a run."""
    preset = f"; {options.preset} (see neuralq presets)" if options.preset else ""
    if not options.notes:
        return preset
    return f"{preset}; within {config.total_steps:,} steps {', '.join(options.notes)}"


def resume_seeds(
    path: str | Path,
    total_steps: int | None,
    num_workers: int | None,
    as_json: bool,
    changes: Mapping[str, Any] = MappingProxyType({}),
    trust: str = "true",
) -> int:
    """Go on with a sweep: seeds that have not finished, and those that failed."""
    if trust == "false":
        sweep = open_sweep(path)
        runs = [run for run in map(sweep.run_path, sweep.seeds) if is_run_folder(run)]
        for config in (sweep.config, *map(read_config, runs)):
            refuse_strangers(config, *(name for name in sweep.options if ":" in name))
    plain = config_to_dict(CONTROL.changed(config_from_dict(open_sweep(path).config), None, changes))
    parts = {name.partition(".")[0]: plain[name.partition(".")[0]] for name in changes}
    return _run(open_sweep(path, total_steps, parts), num_workers, as_json, "")


def add_which(parser: argparse.ArgumentParser) -> None:
    """Which of a run's two agents is meant: ``best`` is None where it is left to the run."""
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--best", action="store_true", default=None,
        help="take the parameters whose evaluation scored highest; default: the agent of the run, which its end names",
    )  # fmt: skip
    which.add_argument("--final", action="store_false", dest="best", help="take the last parameters")


def add_trust(parser: argparse.ArgumentParser) -> None:
    """The option that keeps modules of strangers from being imported."""
    parser.add_argument(
        "--trust", choices=("true", "false"), default="true", metavar="{true,false}",
        help="whether to import the modules that the run names (environment, body) where they are no installed "
        "packages; a run of somebody else's may bring code along (default: true)",
    )  # fmt: skip


def single_run(path: str, trust: str = "true") -> Path:
    """The folder of one run on an environment.

    Raises:
        Failure: if a sweep is there, whose seeds are runs, or a run of another kind.
        ValueError: without trust, if the run names modules that are no installed packages.
    """
    if is_sweep_folder(path):
        seed = open_sweep(path).seeds[0]
        raise Failure(f"{path} is a sweep of several runs; name one of them, e.g. {Path(path) / f'seed-{seed}'}", 2)
    refuse_other_kinds(path)
    if trust == "false" and is_run_folder(path):
        refuse_strangers(read_config(path))
    return Path(path)


def refuse_other_kinds(path: str | Path) -> None:
    """Nothing where there is a run on an environment, or none.

    Raises:
        Failure: if there is a run of another kind, with what to do instead.
    """
    name = kind_in(path)
    if name is not None and (command := kind_named(name).command) is not None:
        raise Failure(f"{path} is {kind_named(name).title}, which is {command.instead.format(run=path)}", 2)


def child() -> None:
    """One seed: the command line in a process that stops with its parent."""
    stop_with_parent()
    sys.exit(main(sys.argv[1:]))


def _command(sweep: Sweep, seed: int) -> list[str]:
    begin = python_command(_CHILD)
    path = str(sweep.run_path(seed))
    if is_run_folder(path):
        options = list(sweep.options)
        hooks = options[options.index("--hook") :] if "--hook" in options else []
        told = [f"--set={name}={'none' if value is None else value}" for name, value in _moved(sweep, path).items()]
        return [*begin, "resume", path, "--total-steps", str(sweep.total_steps), *told, *hooks]
    config = ["--config", str(sweep.path / "config.json"), "--preset", "false"]
    return [*begin, "train", *config, "--seed", str(seed), "--run-dir", path, *sweep.options]


def _moved(sweep: Sweep, run: str) -> dict[str, Any]:
    """What a seed may go on with otherwise than it began, and the sweep by now has otherwise."""
    try:
        began = read_config(run)
    except RunFolderError:  # its process will say so
        return {}
    wanted, began = flat_names(sweep.config), flat_names(began)
    names = [name for name in sorted(CONTROL.may_change() - {CONTROL.budget}) if name in wanted and name in began]
    return {name: wanted[name] for name in names if wanted[name] != began[name]}


def _run(sweep: Sweep, num_workers: int | None, as_json: bool, origin: str) -> int:
    workers = min(num_workers or num_cores(), len(sweep.seeds))
    say(f"sweep folder {sweep.path}{origin}; {len(sweep.seeds)} seeds, {workers} at a time")
    with sweep_bar(sweep) as bar:
        result = run_sweep(sweep, _command, num_workers, bar)
    target = sweep.config.get("stop_at_return")
    plain = {**result.plain(), "sweep_dir": str(sweep.path)}
    print_result(plain, as_json, _lines(sweep, result))
    if result.interrupted_by is not None:
        say(f"{result.interrupted_by}: go on with: neuralq resume {sweep.path}")
        return 128 + signal.Signals[result.interrupted_by].value
    failed = [run.seed for run in result.runs if run.state == "failed"]
    if failed:
        named = f"seed {failed[0]}" if len(failed) == 1 else f"seeds {', '.join(map(str, failed))}"
        raise Failure(f"{named} failed, try again with: neuralq resume {sweep.path}")
    missed = [str(run.seed) for run in result.runs if run.summary.get("reached") is False]
    if missed:
        raise Failure(f"the target of {target:g} was not reached by {len(missed)} seeds: {', '.join(missed)}")
    return 0


def _lines(sweep: Sweep, result: SweepResult) -> list[str]:
    lines = []
    for run in result.runs:
        if run.state == "finished":
            seconds = run.summary.get("cpu_seconds") or 0.0
            spent = f"{run.summary['env_steps']:,} steps, {seconds:.1f} CPU-seconds"
            lines.append(f"seed {run.seed}: {told_of(run.summary)}, {spent}")
        else:
            log = f" (see {sweep.log_path(run.seed)})" if run.reason else ""
            lines.append(f"seed {run.seed}: {run.state}{': ' * bool(run.reason)}{run.reason}{log}")
    found = result.estimate
    if found is not None:
        text = f"greedy return, interquartile mean over {found.num_runs} seeds: {shown(found.iqm, 2)}"
        if found.low is not None and found.high is not None:
            text += f", 95 % interval {shown(found.low, 2)} to {shown(found.high, 2)} (stratified bootstrap)"
        lines.append(text)
    return [*lines, f"sweep folder {sweep.path}"]


def sweep_bar(
    sweep: Sweep, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
) -> ProgressBar[Status]:
    """Progress over all seeds: steps, rate, and the interquartile mean of those that have finished.

    Example:
        >>> import io
        >>> out = io.StringIO()
        >>> with sweep_bar(Sweep(Path(), {"total_steps": 100}, (0, 1)), out) as bar:
        ...     bar(Status(50, 200, (1,), 1, (), (31.0,)))
        >>> out.getvalue().strip()
        '1 of 2 seeds · 50 of 200 steps · IQM 31.0'
    """
    began: list[tuple[float, int]] = []

    def tell(status: Status) -> Told:
        now = clock()
        began[1:] = [(now, status.env_steps)]  # the first stays
        seconds, steps = now - began[0][0], status.env_steps - began[0][1]
        parts = [f"{status.num_finished} of {len(sweep.seeds)} seeds"]
        if status.failed:
            parts.append(f"failed: {', '.join(map(str, status.failed))}")
        parts.append(f"{status.env_steps:,} of {status.total_steps:,} steps")
        if seconds > 0:
            parts.append(f"{steps / seconds:,.0f} steps/s")
        if status.returns:
            parts.append(f"IQM {shown(float(interquartile_mean(status.returns)))}")
        return Told(status.env_steps, parts, event=status.num_finished + len(status.failed))

    return ProgressBar(sweep.total_steps * len(sweep.seeds), tell, stream, clock)

"""``neuralq train --seeds N``, and ``neuralq resume`` for the sweep that it leaves."""

from __future__ import annotations

import argparse
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO

from rich.markup import escape
from rich.table import Table

from neuralq.apps.cli import Failure, print_result
from neuralq.apps.cli.kinds import say
from neuralq.apps.cli.option_table import TrainOptions
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.runs import RunConfig
from neuralq.runs.control import CONTROL
from neuralq.runs.evaluation import shown
from neuralq.runs.folder.run_folder import claimed, default_run_path, is_run_folder, read_config
from neuralq.runs.hooks import own_hook
from neuralq.runs.kinds import kind_in, kind_named
from neuralq.runs.play_off import told_of
from neuralq.runs.recipe.config import config_from_dict, config_to_dict
from neuralq.runs.report.page import format_value
from neuralq.runs.sweep import (
    Engine,
    LocalProcesses,
    Member,
    RunResult,
    Status,
    Sweep,
    SweepResult,
    create_sweep,
    is_sweep_folder,
    open_sweep,
    run_sweep,
    share_of,
)
from neuralq.runs.sweep.ray_cluster import RayCluster
from neuralq.runs.sweep.scripts import REQUEUE
from neuralq.runs.sweep.statistics import Estimate, interquartile_mean
from neuralq.runs.trust import refuse_strangers

__all__ = [
    "a_configuration",
    "add_trust",
    "add_which",
    "engine_of",
    "make_runs",
    "refuse_other_kinds",
    "resume_seeds",
    "run_to_the_end",
    "single_run",
    "started_from",
    "sweep_bar",
    "train_seeds",
]

_MOST_LINES = 50
"""Of runs, and of combinations of values, that are told at the end."""
_MOST_ROWS = 12
"""Of combinations of values, in the table that is drawn while a sweep runs."""


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
    engine = LocalProcesses(options.workers, sweep.config)
    return run_to_the_end(sweep, engine, options.json, started_from(config, options))


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
    sweep = open_sweep(path)
    members = list(sweep.members())
    if trust == "false":
        runs = [run for run in (sweep.path / member.name for member in members) if is_run_folder(run)]
        for config in (*map(sweep.configuration, members), *map(read_config, runs)):
            refuse_strangers(config, *(name for name in sweep.options if ":" in name))
    first = config_from_dict(sweep.configuration(members[0]))
    plain = config_to_dict(CONTROL.changed(first, None, changes))
    if sweep.axes is None:
        parts = {name.partition(".")[0]: plain[name.partition(".")[0]] for name in changes}
    else:  # its options are keywords, and settings of a learner stand flat among them
        parts = {CONTROL.full_name(first, name).rpartition(".")[2]: value for name, value in changes.items()}
    sweep = open_sweep(path, total_steps, parts)
    return run_to_the_end(sweep, LocalProcesses(num_workers, sweep.configuration(members[0])), as_json)


def a_configuration(path: str | Path) -> dict[str, Any]:
    """The configuration of the first run of a sweep."""
    sweep = open_sweep(path)
    return sweep.configuration(next(sweep.members()))


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


def make_runs(sweep: Sweep, options: argparse.Namespace) -> int:
    """What ``neuralq sweep`` was asked for beside telling how far a sweep is: its runs, or a share of them."""
    of = len(sweep) if options.of is None else options.of
    members = None if options.index is None else share_of(sweep, options.index, of)
    again = options.retry_failed
    status = run_to_the_end(sweep, engine_of(sweep, options), options.json, members=members, retry_failed=again)
    return REQUEUE if members is not None and status > 128 else status


def engine_of(sweep: Sweep, options: argparse.Namespace) -> Engine:
    """What makes the runs, as the options of ``neuralq sweep`` say."""
    if options.ray is not None:
        if options.workers is not None:
            raise Failure("--workers is for processes of this machine; on a cluster --cpus says what a run takes", 2)
        return RayCluster(options.ray, sweep.path, options.cpus, options.gpus, options.storage)
    return LocalProcesses(options.workers, sweep.configuration(next(sweep.members())))


def run_to_the_end(
    sweep: Sweep,
    engine: Engine,
    as_json: bool,
    origin: str = "",
    members: Sequence[Member] | None = None,
    retry_failed: bool = True,
) -> int:
    """Make the runs of a sweep and tell what they came to.

    Args:
        sweep: which.
        engine: what makes the runs.
        as_json: whether to print the result as JSON.
        origin: where settings come from that nobody gave, for the first line.
        members: some of its runs; all by default.
        retry_failed: whether runs that failed before are begun again.

    Returns:
        The exit status: 0 only if each run finished and, where a target was set, reached it; that of the signal that
        ended it.
    """
    number, again = len(sweep) if members is None else len(members), _again(sweep)
    share = "" if members is None else f" of {len(sweep):,}"
    say(f"sweep folder {sweep.path}{origin}; {number:,}{share} {_things(sweep)}, {engine.title}")
    with sweep_bar(sweep, number=number) as bar:
        result = run_sweep(sweep, engine, bar, retry_failed, members)
    print_result({**result.plain(), "sweep_dir": str(sweep.path)}, as_json, _lines(sweep, result))
    if result.interrupted_by is not None:
        say(f"{result.interrupted_by}: go on with: {again}")
        return 128 + signal.Signals[result.interrupted_by].value
    failed = [run for run in result.runs if run.state == "failed"]
    if failed and sweep.axes is None:
        seeds = ", ".join(str(run.seed) for run in failed)
        raise Failure(f"seed{'s' * (len(failed) > 1)} {seeds} failed, try again with: {again}")
    if failed:
        raise Failure(f"{len(failed):,} of {number:,} runs failed, try again with: {again} --retry-failed")
    missed = [str(run.seed) for run in result.runs if run.summary.get("reached") is False]
    if missed and sweep.axes is None:
        target = sweep.config.get("stop_at_return")
        raise Failure(f"the target of {target:g} was not reached by {len(missed)} seeds: {', '.join(missed)}")
    if missed:
        raise Failure(f"the target was not reached by {len(missed):,} of {number:,} runs")
    return 0


def _again(sweep: Sweep) -> str:
    return f"neuralq {'resume' if sweep.axes is None else 'sweep'} {sweep.path}"


def _things(sweep: Sweep) -> str:
    return "seeds" if sweep.axes is None else "runs"


def _lines(sweep: Sweep, result: SweepResult) -> list[str]:
    runs = result.runs if sweep.axes is None else [run for run in result.runs if run.state != "finished"]
    lines = [_line(sweep, run) for run in runs[:_MOST_LINES]]
    if len(runs) > _MOST_LINES:
        lines.append(f"and {len(runs) - _MOST_LINES:,} more (neuralq sweep {sweep.path} --status --json has them all)")
    if sweep.axes is None:
        found = result.estimate
        how = "" if found is None or found.low is None else " (stratified bootstrap)"
        told = [] if found is None else [f"greedy return, interquartile mean over {_counted(found)}{how}"]
    else:
        told = _combinations(result)
        if sweep.axes:
            told.append(f"side by side: neuralq compare {sweep.path} --by {next(iter(sweep.axes)).rstrip('_')}")
    return [*lines, *told, f"sweep folder {sweep.path}"]


def _line(sweep: Sweep, run: RunResult) -> str:
    name = run.run_dir.relative_to(sweep.path).as_posix().replace("seed-", "seed ")
    if run.state != "finished":
        log = f" (see {run.run_dir}.log)" if run.reason else ""
        return f"{name}: {run.state}{': ' * bool(run.reason)}{run.reason}{log}"
    seconds = run.summary.get("cpu_seconds") or 0.0
    return f"{name}: {told_of(run.summary)}, {run.summary['env_steps']:,} steps, {seconds:.1f} CPU-seconds"


def _combinations(result: SweepResult) -> list[str]:
    """What each combination of values came to, the best first."""
    found: dict[str, list[RunResult]] = {}
    for run in result.runs:
        words = ", ".join(f"{name.rstrip('_')} {format_value(value)}" for name, value in run.options.items()) or "all"
        found.setdefault(words, []).append(run)
    estimates = {words: SweepResult(tuple(runs)).estimate for words, runs in found.items()}
    ordered = sorted((e.iqm, words, _counted(e)) for words, e in estimates.items() if e is not None)[::-1]
    lines = [f"{words}: interquartile mean over {counted}" for _, words, counted in ordered[:_MOST_LINES]]
    return [*lines, *([f"and {len(ordered) - _MOST_LINES:,} more combinations"] if len(ordered) > _MOST_LINES else [])]


def _counted(found: Estimate) -> str:
    text = f"{found.num_runs} seed{'s' * (found.num_runs > 1)}: {shown(found.iqm, 2)}"
    if found.low is None or found.high is None:
        return text
    return f"{text}, 95 % interval {shown(found.low, 2)} to {shown(found.high, 2)}"


def sweep_bar(
    sweep: Sweep,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
    number: int | None = None,
) -> ProgressBar[Status]:
    """Progress over all runs: steps, rate, and the interquartile mean of those that have finished.

    Args:
        sweep: which.
        stream: where to draw.
        clock: tells the time in seconds.
        number: how many of its runs; all by default.

    Example:
        >>> import io
        >>> out = io.StringIO()
        >>> with sweep_bar(Sweep(Path(), {"total_steps": 100}, (0, 1)), out) as bar:
        ...     bar(Status(50, 200, ("seed-1",), 1, (), {"seed-0": 31.0}))
        >>> out.getvalue().strip()
        '1 of 2 seeds · 50 of 200 steps · IQM 31.0'
    """
    began: list[tuple[float, int]] = []
    count = len(sweep) if number is None else number

    def tell(status: Status) -> Told:
        now = clock()
        began[1:] = [(now, status.env_steps)]  # the first stays
        seconds, steps = now - began[0][0], status.env_steps - began[0][1]
        parts = [f"{status.num_finished:,} of {count:,} {_things(sweep)}"]
        if status.failed:
            named = ", ".join(name.removeprefix("seed-") for name in status.failed[:_MOST_ROWS])
            parts.append(f"failed: {named if sweep.axes is None else len(status.failed)}")
        parts.append(f"{status.env_steps:,} of {status.total_steps:,} steps")
        left = ""
        if seconds > 0:
            parts.append(f"{steps / seconds:,.0f} steps/s")
            ahead = (status.total_steps - status.env_steps) * seconds / max(steps, 1)
            left = f"{ahead / 60:,.0f} min left" if ahead >= 90 else f"{ahead:.0f} s left"
        if status.returns and sweep.axes is None:
            parts.append(f"IQM {shown(float(interquartile_mean(list(status.returns.values()))))}")
        ended = status.num_finished + len(status.failed)
        return Told(status.env_steps, parts, left if steps else "", event=ended, total=status.total_steps)

    return ProgressBar(1, tell, stream, clock, _cells if sweep.axes else None)


def _cells(status: Status) -> Table:
    """What each combination of values has come to so far, the best first."""
    scores: dict[str, list[float]] = {}
    for name, score in status.returns.items():
        scores.setdefault(name.rpartition("/")[0], []).append(score)
    rows = [(float(interquartile_mean(found)), cell, len(found)) for cell, found in scores.items()]
    rows.sort(reverse=True)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading, justify in (("IQM", "right"), ("finished", "right"), ("options", "left")):
        table.add_column(heading, justify=justify, no_wrap=True)  # type: ignore[arg-type]  # one of rich's words
    for iqm, cell, number in rows[:_MOST_ROWS]:
        table.add_row(shown(iqm), str(number), escape(cell[: -len("-12345678")]))
    if len(rows) > _MOST_ROWS:
        table.add_row("…", "", f"and {len(rows) - _MOST_ROWS} more")
    return table

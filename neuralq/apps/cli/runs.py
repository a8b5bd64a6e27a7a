"""``neuralq train | resume | evaluate | report``."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from typing import Any

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.doctor import examined
from neuralq.apps.cli.filmstrip import filmstrip, filmstrip_unasked
from neuralq.apps.cli.kinds import changes_of, conclude, measured_by, new_budget, reported, resume_kind, say, train_kind
from neuralq.apps.cli.numbers import number
from neuralq.apps.cli.options import parse_train
from neuralq.apps.cli.progress import training_bar
from neuralq.apps.cli.sweeps import (
    a_configuration,
    add_trust,
    add_which,
    resume_seeds,
    single_run,
    started_from,
    train_seeds,
)
from neuralq.runs import Run, evaluate_run, load
from neuralq.runs.changes import told
from neuralq.runs.control import CONTROL, agent_of, last_cap
from neuralq.runs.estimate import estimate_policy
from neuralq.runs.evaluation import shown
from neuralq.runs.folder.best import load_best
from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.run_folder import (
    claimed,
    is_run_folder,
    read_changes,
    read_config,
    read_metrics,
    refuse_old_run,
)
from neuralq.runs.hooks import watching_hooks
from neuralq.runs.kinds import KINDS, kind_in, kind_named
from neuralq.runs.offline.files import read_recorded
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.report import write_report, write_sweep_report
from neuralq.runs.sweep import is_sweep_folder

__all__ = ["evaluate", "report", "resume", "train"]


def train(argv: list[str]) -> int:
    """Train as the options say; exit status 0 only if the target was reached, where one was set."""
    if argv[:1] != ["control"] and KINDS.keys() & set(argv[:1]):
        return train_kind(argv[0], argv[1:])
    parsed = parse_train(argv)
    if parsed is None:
        return 0
    config, options = parsed
    if options.seeds is not None:
        return train_seeds(config, options)
    with claimed(options.run_dir, lambda: CONTROL.default_path(config)) as path:
        refuse_old_run(path)  # also by the run, but preparing takes seconds
        origin = started_from(config, options)
        is_probed = config.resume_probe and config.dataset is None
        probed = "; for a second it is tried how exactly the environment can be resumed" if is_probed else ""
        say(f"run folder {path}{origin}; preparing (the first run on a machine compiles kernels{probed})")
        own = watching_hooks(path, config, options.tensorboard, options.wandb, options.hooks, say)
        with own as hooks, training_bar(CONTROL, config) as bar:
            run = CONTROL.train(config, path, [*hooks, bar])
    if options.doctor or (run.reached is False and run.stopped_by is None):
        for line in examined(run.run_dir, whole=options.doctor):
            say(line)
    return _conclude(run, options.json, config.stop_at_return, config.engine != "auto")


def resume(argv: list[str]) -> int:
    """Go on with a run."""
    options = _resume_parser().parse_args(argv)
    kind = kind_in(options.run)
    if kind not in (None, "control"):
        return resume_kind(kind, options)
    total_steps, changes = _asked_of(options)
    if is_sweep_folder(options.run):
        if options.hook is not None:
            raise Failure("a sweep goes on with the hooks that it was begun with; leave --hook out", 2)
        return resume_seeds(options.run, total_steps, options.workers, options.json, changes, options.trust)
    if options.workers is not None:
        raise Failure(f"--workers is for a sweep, and {options.run} is none; leave it out", 2)
    path = single_run(options.run, options.trust)
    planned = CONTROL.changed(config_from_dict(read_config(path)), total_steps, changes)
    board, tracker = (path / "tensorboard").is_dir(), (path / "wandb").is_dir()  # where it was begun with them
    own = watching_hooks(path, planned, board, tracker, options.hook or (), say)
    with own as hooks, training_bar(CONTROL, planned) as bar:
        run = CONTROL.resume(path, total_steps, [*hooks, bar], changes)
    return _conclude(run, options.json, planned.stop_at_return, planned.engine != "auto")


def _resume_parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "resume",
        "Go on with a run from its newest intact checkpoint, or with a sweep of seeds where each of them stands.",
        "neuralq resume runs/demo/cartpole",
    )
    parser.add_argument("run", help="run folder, or sweep folder")
    parser.add_argument("--total-steps", type=int, metavar="N", help="a new budget; lets a finished run go on")
    parser.add_argument("--games", type=int, metavar="N", help="the same for runs that count games, as td-gammon")
    parser.add_argument(
        "--stop-at-return", type=target, metavar="X", default=argparse.SUPPRESS,
        help="a new target, or none; lets a run go on that has reached the old one",
    )  # fmt: skip
    parser.add_argument(
        "--device", metavar="NAME", default=argparse.SUPPRESS, help="compute elsewhere: cpu, cuda, cuda:1, …"
    )
    parser.add_argument("--workers", type=int, metavar="N", help="of a sweep: how many seeds at a time")
    parser.add_argument(
        "--hook", action="append", metavar="module:name", help="of a run on an environment: as for neuralq train"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="key=value", dest="changes",
        help="go on with another value, may be repeated: budget, target, step size, evaluations, checkpoints, device",
    )  # fmt: skip
    add_trust(parser)
    return parser


def _asked_of(options: argparse.Namespace) -> tuple[int | None, dict[str, Any]]:
    """The new budget and the other changes that ``neuralq resume`` was given, by whichever option."""
    total_steps = new_budget(CONTROL, options)
    changes = {name: getattr(options, name) for name in ("stop_at_return", "device") if hasattr(options, name)}
    if not options.changes:
        return total_steps, changes
    stored = a_configuration(options.run) if is_sweep_folder(options.run) else read_config(options.run)
    asked = changes_of(CONTROL, config_from_dict(stored), options.changes)
    if twice := {*changes, *([] if total_steps is None else ["total_steps"])} & set(asked):
        raise Failure(f"{min(twice)} is given twice, with --set and by its own option; leave one out", 2)
    return asked.pop("total_steps", total_steps), {**changes, **asked}


def target(text: str) -> float | None:
    """A target as ``neuralq resume`` takes it: a number, or none.

    Example:
        >>> target("475"), target("none")
        (475.0, None)
    """
    return None if text.lower() in ("none", "null") else number(text)


def evaluate(argv: list[str]) -> int:
    """Play greedy episodes with a run's agent, its last parameters or its best; or a match of backgammon."""
    measure = measured_by(argv)
    if measure is not None:
        module, _, function = measure.partition(":")
        status: int = getattr(importlib.import_module(module), function)(argv)
        return status
    parser = command_parser(
        "evaluate",
        "Play greedy episodes with the agent of a run: its last parameters, or its best where the run ended well below "
        "them, which it says. One of TD-Gammon plays a match: neuralq evaluate --against --help.",
        "neuralq evaluate RUN --episodes 100",
        "neuralq evaluate RUN --on data.npz",
        "neuralq evaluate RUN --against gnubg --games 5000",
    )
    parser.add_argument("run", help="run folder")
    parser.add_argument("--episodes", type=int, default=100, help="how many (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes (default: 0)")
    parser.add_argument(
        "--on", metavar="DATA", help="play nothing: estimate the value from recorded steps, minari:ID or a file.npz"
    )
    add_which(parser)
    add_trust(parser)
    options = parser.parse_args(argv)
    path = single_run(options.run, options.trust)
    if options.on is not None:
        return _estimate(path, options)
    result = evaluate_run(path, options.episodes, options.seed, options.best)
    which = agent_of(path) if options.best is None else "best" if options.best else "final"
    named = {"run_dir": str(options.run), "parameters": which}
    played = f"played with the {which} parameters" + (", the agent of the run" if options.best is None else "")
    print_result({**result.plain(), **named}, options.json, [*result.lines(), played])
    return 0


def _estimate(path: Path, options: argparse.Namespace) -> int:
    """The value of the greedy policy by experience of others."""
    agent, config = load(path, options.best), config_from_dict(read_config(path))
    found = estimate_policy(agent, config, read_recorded(options.on), options.seed)
    print_result({**found.plain(), "run_dir": str(path), "dataset": options.on}, options.json, found.lines())
    return 0


def report(argv: list[str]) -> int:
    """Write a run's report."""
    parser = command_parser(
        "report",
        "Write report.html into the folder of a run or of a sweep (extra plot).",
        "neuralq report runs/cart",
        "neuralq report runs/cart --film",
        "neuralq report runs/cart-10-seeds",
    )
    parser.add_argument("run", help="folder of a run or of a sweep")
    parser.add_argument(
        "--film", action="store_true", default=None,
        help="play an episode and show a few pictures of it; unasked for our own environments, which draw at once",
    )  # fmt: skip
    parser.add_argument("--no-film", action="store_false", dest="film", help="show no pictures")
    add_trust(parser)
    options = parser.parse_args(argv)
    path = write_sweep_report(options.run) if is_sweep_folder(options.run) else _written(options)
    print_result({"report": str(path)}, options.json, [str(path)])
    return 0


def _written(options: argparse.Namespace) -> Path:
    """The page of one run, on an environment or of a kind with a page of its own."""
    command = kind_named(name).command if (name := kind_in(options.run)) is not None else None
    if command is not None and command.report is not None:
        if options.film is not None:
            raise Failure(f"--film is for runs on environments, and {options.run} is none; leave it out", 2)
        return write_report(options.run)
    path = single_run(options.run, options.trust)
    if options.film is None:
        return write_report(path, filmstrip_unasked(path) if is_run_folder(path) else ())
    return write_report(path, filmstrip(path) if options.film else ())


def _conclude(run: Run, as_json: bool, target: float | None, forced: bool) -> int:
    report_path = reported(run, filmstrip_unasked)
    say(run.resumability)
    if run.engine != "compiled" and not forced:
        say(f"values and gradients were computed by {run.engine}: there are no kernels for all of this representation")
    best = _best_return(run)
    notes = []
    if run.play_off is None and best is not None and run.greedy_return is not None and best > run.greedy_return:
        notes.append(f"the best evaluation scored {shown(best)}: neuralq evaluate {run.run_dir} --best")
    if (cut := _cut(run)) is not None:
        notes.append(cut)
    notes += [told(row) for row in read_changes(run.run_dir)]
    status = conclude(run, as_json, notes, best_return=best, report=report_path)
    if status == 0 and run.reached is False:
        within = "within the budget of" if run.stopped_by is None else f"before {run.stopped_by}, after"
        raise Failure(f"the target of {target:g} was not reached {within} {run.env_steps:,} steps", 1)
    return status


def _cut(run: Run) -> str | None:
    """A line where the last evaluation had to be cut short."""
    rows = [row for row in read_metrics(run.run_dir) if row.get("kind") == "evaluation"]
    if not rows or not rows[-1].get("num_cut"):
        return None
    most = read_config(run.run_dir).get("evaluation_max_steps") or last_cap(run.run_dir)
    return (
        f"{rows[-1]['num_cut']} of {len(rows[-1]['returns'])} evaluation episodes were cut off after {most:,} steps: "
        "the environment did not end them (--evaluation-max-steps sets how many)"
    )


def _best_return(run: Run) -> float | None:
    try:
        return load_best(run.run_dir).greedy_return
    except CheckpointError:  # not evaluated yet
        return None

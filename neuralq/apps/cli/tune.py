"""``neuralq tune``: look for better options than the preset's, and confirm on fresh seeds whether they are."""

from __future__ import annotations

import argparse
import contextlib
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import yaml  # type: ignore[import-untyped]

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.kinds import say
from neuralq.apps.cli.numbers import number
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.apps.cli.sweep import add_cluster
from neuralq.apps.cli.yaml_text import read_text, write_yaml
from neuralq.runs.evaluation import shown
from neuralq.runs.folder.files import FolderLock, write_durably
from neuralq.runs.recipe.config import LEARNERS
from neuralq.runs.recipe.environments import make_one
from neuralq.runs.report.tune import verdict, write_tune_report
from neuralq.runs.sweep import Engine, LocalProcesses, num_cores
from neuralq.runs.sweep.ray_cluster import RayCluster
from neuralq.runs.tune.asking import load_optuna
from neuralq.runs.tune.confirming import CANDIDATES, Confirmed, best_so_far, candidates, confirmed, winner
from neuralq.runs.tune.search import Limits, Progress, StudyFailed
from neuralq.runs.tune.search import tune as go_on
from neuralq.runs.tune.space import Space, Start, default_space, read_space, start_from
from neuralq.runs.tune.study import FRESH, Study, create_study, is_study_folder, open_study

__all__ = ["seconds_of", "tune", "tuning_bar"]

_TRIALS = 50
_ON_A_CLUSTER = 16
"""Runs at a time that trials are begun for, where nothing else is said."""
_UNITS = {"": 1, "s": 1, "m": 60, "h": 3600, "d": 86_400}


def tune(argv: list[str]) -> int:
    """Go on with a study, or begin one; the exit status is 0 whatever it finds."""
    options = _parser().parse_args(argv)
    if options.print_space:
        space = _space(options, _start(options))
        print_result(space.plain(), options.json, [write_yaml(space.plain()).rstrip()])
        return 0
    if options.dir is None:
        raise Failure("say where trials and runs are to be kept: --dir DIR (the same command goes on there)", 2)
    load_optuna()
    study = _study(options)
    most = options.trials if options.trials is not None else _TRIALS if options.time is None else None
    limits = Limits(most, options.time, options.stop_when)
    busy = f"the study in {study.path} is being gone on with"
    with contextlib.closing(FolderLock(study.path / "study.lock", busy)):
        study = open_study(study.path)  # as whoever held the lock before has left it
        say(f"study {study.path}: {len(study.trials)} trials so far, {study.few} to {study.most} seeds each")
        with tuning_bar(study, limits) as bar:
            try:
                why = go_on(study, lambda: _engine(study, options), limits, bar)
            except StudyFailed as error:
                raise Failure(str(error)) from error
        return _conclude(study, why, options)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "tune",
        "Look for options that learn better than the preset's. Trials are raced over seeds; the best three and the "
        f"preset are then run on {FRESH} fresh seeds, and only that is the result. The same command goes on with "
        "what was stopped or killed (docs/tuning.md).",
        "neuralq tune Acrobot-v1 --time 30m --dir runs/acrobot",
        "neuralq tune CartPole-v1 --learner replay --trials 40 --dir runs/cartpole",
        "neuralq train Acrobot-v1 --config runs/acrobot/preset.yaml",
    )
    parser.usage = "neuralq tune [-h] ENV --dir DIR [--time T] [--trials N] [--learner L] [options]"
    parser.add_argument("env", metavar="ENV", help="Gymnasium id, or module:id")
    parser.add_argument("--learner", choices=sorted(LEARNERS), metavar="L", help="which learner (default: rollout)")
    parser.add_argument("--dir", metavar="DIR", help="folder of the study; it is gone on with where there is one")
    parser.add_argument("--trials", type=int, metavar="N", help=f"trials in all (default: {_TRIALS}, or until --time)")
    parser.add_argument("--time", type=seconds_of, metavar="T", help="end within 90s, 30m, 2h; from this command on")
    parser.add_argument("--stop-when", type=float, metavar="X", help="end the race once a trial reaches a return of X")
    parser.add_argument("--total-steps", type=int, metavar="N", help="environment steps of every run")
    parser.add_argument("--seeds-most", type=int, metavar="N", help="seeds of a trial at most (default: 10)")
    parser.add_argument("--seed", type=int, metavar="N", help="the first seed, and that of what is tried (default: 0)")
    parser.add_argument("--space", metavar="FILE", help="where to look, as --print-space writes it")
    parser.add_argument("--print-space", action="store_true", help="print where would be looked, and run nothing")
    parser.add_argument("--workers", type=int, metavar="N", help="runs at a time (default: as many as there are cores)")
    add_cluster(parser)
    return parser


def seconds_of(text: str) -> float:
    """A time with its unit, in seconds.

    Raises:
        argparse.ArgumentTypeError: it is none.

    Example:
        >>> seconds_of("30m"), seconds_of("1.5h"), seconds_of("90")
        (1800.0, 5400.0, 90.0)
    """
    match = re.fullmatch(r"\s*([\d._]+)\s*([smhd]?)\s*", text)
    seconds = number(match[1]) * _UNITS[match[2]] if match is not None else 0.0
    if not seconds > 0:
        raise argparse.ArgumentTypeError(f"must be a time such as 90s, 30m or 2h, got {text!r}")
    return seconds


def _start(options: argparse.Namespace) -> Start:
    start = start_from(options.env, options.learner, options.total_steps)
    start.config({})  # what is wrong with the budget is said here
    return start


def _space(options: argparse.Namespace, start: Start) -> Space:
    if options.space is None:
        env = make_one(start.config({}))  # one that there is not is one line, and no study
        with contextlib.closing(env):
            return default_space(start, len(getattr(env.observation_space, "shape", None) or ()) == 3)
    try:
        return read_space(read_text(Path(options.space).read_text(encoding="utf-8")), start)
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise Failure(f"--space {options.space}: {' '.join(str(error).split())}", 2) from error


def _study(options: argparse.Namespace) -> Study:
    """The study that is asked for, begun where there is none."""
    if is_study_folder(options.dir):
        study = open_study(options.dir)
        _check_same(study, options)
        return study
    start = _start(options)
    space = _space(options, start)
    workers = options.workers or (_ON_A_CLUSTER if options.ray is not None else num_cores())
    most, seed = (10 if options.seeds_most is None else options.seeds_most), options.seed or 0
    study = create_study(options.dir, start, space, most=most, at_once=workers // 2 + 1, seed=seed)
    write_durably(study.path / "space.yaml", write_yaml(space.plain()))
    return study


def _check_same(study: Study, options: argparse.Namespace) -> None:
    """What a study is about is settled when it begins.

    Raises:
        Failure: something else is asked for.
    """
    there = {
        "ENV": (study.start.plain["env"], options.env),
        "--learner": (study.start.learner, options.learner),
        "--total-steps": (study.start.config({}).total_steps, options.total_steps),
        "--seeds-most": (study.most, options.seeds_most),
        "--seed": (study.seed, options.seed),
    }
    if options.space is not None:
        there["--space"] = (study.space, _space(options, study.start))
    for name, (own, asked) in there.items():
        if asked is not None and asked != own:
            what = "another space" if name == "--space" else f"{name} {own}"
            raise Failure(f"{study.path} holds a study with {what}; choose another --dir, or leave {name} as it was", 2)


def _engine(study: Study, options: argparse.Namespace) -> Engine:
    if options.ray is not None:
        return RayCluster(options.ray, study.path, options.cpus, options.gpus, options.storage)
    return LocalProcesses(options.workers, study.trials[0].config)


def _conclude(study: Study, why: str, options: argparse.Namespace) -> int:
    """Writes what came of it, and tells it."""
    found = confirmed(study)
    best, interrupted = winner(found), why in signal.Signals.__members__
    preset = None if best is None else _write_preset(study, best)
    report = write_tune_report(study)
    lines = [f"{len(study.trials)} trials; {'interrupted' if interrupted else why}", verdict(study)]
    if best is not None:
        ahead = max(found, key=lambda one: one.searched.iqm)
        name = f"trial {ahead.trial.number}" if ahead.trial.number else "the preset"
        lines.append(
            f"the race had {name} ahead with {shown(ahead.searched.iqm)}: flattered by {shown(ahead.flattery)}"
        )
        lines += [f"train with it: neuralq train {study.start.plain['env']} --config {preset}"]
    missing = {trial.number for trial in candidates(study)} - {one.trial.number for one in found}
    if missing and not interrupted:
        lines.append(f"not confirmed for want of time: trial{'s' * (len(missing) > 1)} {_joined(missing)}")
        lines.append(f"confirm with: {_again(study)} --trials {len(study.trials)}")
    print_result(_plain(study, found, why, preset, report), options.json, [*lines, f"report {report}"])
    if interrupted:
        most = "" if options.trials is None else f" --trials {options.trials}"
        say(f"{why}: go on with: {_again(study)}{most}")
        return 128 + signal.Signals[why].value
    return 0


def _joined(numbers: set[int]) -> str:
    return ", ".join(map(str, sorted(numbers)))


def _again(study: Study) -> str:
    return f"neuralq tune {study.start.plain['env']} --dir {study.path}"


def _write_preset(study: Study, best: Confirmed) -> Path:
    """The configuration of the result, as ``neuralq train --config`` takes it."""
    path = study.path / "preset.yaml"
    plain = {name: value for name, value in best.trial.config.items() if name != "seed"}
    said = "\n".join(f"# {line}" for line in verdict(study).splitlines())
    write_durably(path, f"# neuralq train {plain['env']} --config {path.name}\n{said}\n{write_yaml(plain)}")
    return path


def _plain(study: Study, found: list[Confirmed], why: str, preset: Path | None, report: Path) -> dict[str, Any]:
    ahead, best = best_so_far(study), winner(found)
    return {
        "study_dir": str(study.path),
        "num_trials": len(study.trials),
        "ended": why,
        "ahead": None if ahead is None else {"trial": ahead[0].number, "iqm": ahead[1].iqm},
        "result": None
        if best is None
        else {"trial": best.trial.number, "chosen": best.trial.chosen, "iqm": best.fresh.iqm},
        "better_than_preset": None if best is None else best.is_better,
        "confirmed": [_plain_confirmed(one) for one in found],
        "preset": None if preset is None else str(preset),
        "report": str(report),
    }


def _plain_confirmed(one: Confirmed) -> dict[str, Any]:
    gain = one.gain
    return {
        "trial": one.trial.number,
        "iqm": one.fresh.iqm,
        "low": one.fresh.low,
        "high": one.fresh.high,
        "searched_iqm": one.searched.iqm,
        "flattery": one.flattery,
        "gain": None if gain is None else {"value": gain.value, "low": gain.low, "high": gain.high},
    }


def tuning_bar(
    study: Study,
    limits: Limits,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> ProgressBar[Progress]:
    """Progress of a study: trials, what goes on, the best so far, and how long it will take yet.

    Example:
        >>> import io, tempfile
        >>> study = create_study(tempfile.mkdtemp(), start := start_from("CartPole-v1"), default_space(start))
        >>> out = io.StringIO()
        >>> with tuning_bar(study, Limits(8), out) as bar:
        ...     bar(Progress(True, (4, 20), 2, 1.0))
        >>> out.getvalue().strip()
        'trial 1 of 8 · confirming: 4 of 20 runs · 2 running'
    """
    before = sum(len(trial.runs) for trial in study.trials)

    def tell(progress: Progress) -> Told:
        ended = sum(len(trial.runs) for trial in study.trials)
        of = "" if limits.trials is None else f" of {limits.trials}"
        parts = [f"trial {len(study.trials)}{of}"]
        if progress.confirming:
            parts.append("confirming: {} of {} runs".format(*progress.runs))
        parts.append(f"{progress.running} running")
        ahead, preset = best_so_far(study), study.standing(0).estimate
        if ahead is not None and preset is not None:
            name = f"trial {ahead[0].number}, preset {shown(preset.iqm)}" if ahead[0].number else "the preset"
            parts.append(f"best {shown(ahead[1].iqm)} ({name})")
        left = _left(study, limits, progress, ended - before)
        if left is not None:
            parts.append(f"{left / 60:.0f} min left" if left >= 90 else f"{left:.0f} s left")
        total = None if left is None else max(int(progress.seconds + left), 1)
        return Told(int(progress.seconds), parts, event=len(study.trials) + progress.confirming, total=total)

    return ProgressBar(1, tell, stream, clock)


def _left(study: Study, limits: Limits, progress: Progress, ended: int) -> float | None:
    """Seconds until the end: by the time limit, else by what runs have taken; None where nothing is known yet."""
    if limits.seconds is not None:
        return max(limits.seconds - progress.seconds, 0.0)
    settled = [trial for trial in study.trials if study.standing(trial.number).is_settled]
    if not ended or not settled or limits.trials is None:
        return None
    if progress.confirming:
        runs = progress.runs[1] - progress.runs[0]
    else:
        each = sum(len(trial.runs) for trial in settled) / len(settled)
        runs = round(each * max(limits.trials - len(settled), 0)) + (CANDIDATES + 1) * FRESH
    return runs * progress.seconds / ended

"""``neuralq doctor``: why a value function is bad, of a run or of a file from another library."""

from __future__ import annotations

import argparse
import importlib
import re
from pathlib import Path
from typing import Any

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.kinds import say
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.apps.cli.sweeps import add_trust, single_run
from neuralq.checks import check_module_name, check_whole
from neuralq.doctor import CannotLoad, examine
from neuralq.doctor.examination import LEVELS, NUM_PARTS
from neuralq.doctor.probes import probe as run_probes
from neuralq.runs.folder.run_folder import is_run_folder
from neuralq.runs.sweep import is_sweep_folder, open_sweep
from neuralq.runs.trust import refuse_strangers

__all__ = ["doctor", "examined", "probe"]


_MINUTE, _MOMENT = 60.0, 4.0
"""Seconds for the doctor at the end of a run, where it was asked for, and where the target was not reached."""
_SUBJECT = (
    "a neuralq run folder, or a sweep's, whose worst seed is examined; a zip of Stable-Baselines3 (DQN) or "
    "sb3-contrib (QR-DQN); a .cleanrl_model; a state dict (.pth, .safetensors, .npz)"
)


def doctor(argv: list[str]) -> int:
    """Examine a subject; exit status 0 healthy, 1 a finding of grade A or B, 2 it cannot be loaded."""
    options = _parser().parse_args(argv)
    if is_run_folder(options.subject):
        single_run(options.subject, options.trust)
    elif is_sweep_folder(options.subject) and options.trust == "false":
        refuse_strangers(open_sweep(options.subject).config)
    with ProgressBar[tuple[int, str]](
        NUM_PARTS, lambda told: Told(told[0], [told[1]], f"{told[0]} of {NUM_PARTS}")
    ) as bar:
        try:
            report = examine(
                options.subject, options.env, gamma=options.gamma, data=options.data, settings=dict(options.set),
                net=options.net, level=options.level, seeds=options.seeds, budget_s=options.budget, seed=options.seed,
                progress=lambda so_far, text: bar((so_far, text)),
            )  # fmt: skip
        except CannotLoad as error:
            raise Failure(str(error), 2) from error
    page: dict[str, Any] = {}
    if options.report is not None:
        page["report"] = str(report.write(options.report))
        say(f"report {page['report']}")
    print_result({**report.plain(), **page}, options.json, report.lines())
    return 0 if report.healthy else 1


def examined(run: str | Path, whole: bool) -> list[str]:
    """What the doctor says of a run that has just ended: all of it, or its three first findings in a line each.

    Nothing where a short look is not possible: the run is whole without it.
    """
    try:
        report = examine(run, budget_s=_MINUTE if whole else _MOMENT)
    except (RuntimeError, ValueError, OSError) as error:
        return [f"the doctor could not look at the run: {error}"] if whole else []
    if whole:
        return report.lines()
    return [
        *(f"doctor: {one.line()}" for one in report.findings[:3]),
        f"all of it, with remedies: neuralq doctor {run}",
    ]


def probe(argv: list[str]) -> int:
    """Run the probe environments; exit status 0 if all were learned, 1 if not, 2 if there is nothing to run."""
    parser = command_parser(
        "probe",
        "Try a training function of your own, train(env, budget) -> q, on eight small environments whose values are "
        "known. "
        "The first that it fails names what is broken. It should learn with the discount env.gamma.",
        "neuralq probe my_agent:train --budget 5000",
    )
    parser.add_argument(
        "function", metavar="module:train", help="takes an environment and a number of its steps, gives q"
    )
    parser.add_argument(
        "--budget", type=int, default=5000, metavar="N", help="steps of each environment (default: 5000)"
    )
    options = parser.parse_args(argv)
    check_whole("budget", options.budget)
    try:
        found = run_probes(_function(options.function), options.budget, say=say)
    except CannotLoad as error:
        raise Failure(str(error), 2) from error
    broken = [one for one in found if one.flagged]
    lines = [f"{'BROKEN' if one.flagged else 'learned':<8} {one.evidence}" for one in found]
    if broken:
        lines += ["", f"first of all: {broken[0].title}; {broken[0].remedy}"]
    print_result({"healthy": not broken, "findings": [one.plain() for one in found]}, options.json, lines)
    return 1 if broken else 0


def _function(name: str) -> Any:
    module, _, attribute = name.partition(":")
    try:
        check_module_name("the training function", module, name)
        found = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise Failure(f"cannot import {name!r}: {error}; name it as module:function", 2) from error
    if not callable(found):
        raise Failure(f"{name} must be a function train(env, budget), got {type(found).__name__}", 2)
    return found


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "doctor",
        "Why is this value function bad: the environment, the algorithm, the representation, the data, or luck? "
        "Nothing in "
        "a file is ever run. Exit status 0: healthy; 1: a finding of grade A or B; 2: it cannot be loaded.",
        "neuralq doctor runs/cart",
        "neuralq doctor dqn_cartpole.zip --env CartPole-v1 --report doctor.html",
        "neuralq doctor weights.pth --net my_module:QNetwork --env my_package:MyEnv-v0 --gamma 0.99",
    )
    add = parser.add_argument
    add("subject", help=_SUBJECT)
    add("--env", metavar="ID", help="the environment, as 'ID' or 'module:ID'; of a run folder its own")
    add(
        "--net",
        metavar="M:C",
        help="module:Class of the network that a state dict belongs to, called without arguments",
    )
    add("--data", metavar="NPZ", help="what was learned from: obs, action, reward, terminated, truncated, next_obs")
    add("--gamma", type=float, metavar="G", help="discount; by default the file's, else 0.99")
    add(
        "--set", type=_setting, nargs="+", action="extend", default=[], metavar="NAME=X",
        help="settings of the training that the file does not hold: lr=1e-3 target_period_updates=500 updates=50000 …",
    )  # fmt: skip
    add("--level", choices=LEVELS, default=LEVELS[0], help="how far to go (default: exam)")
    add(
        "--budget",
        type=_seconds,
        default=60.0,
        metavar="T",
        help="time for all of it, as 90, 120s or 2m (default: 60s)",
    )
    add("--seeds", type=int, default=3, metavar="N", help="runs of each kind that experiments compare (default: 3)")
    add("--seed", type=int, default=0, metavar="N", help="of every draw (default: 0)")
    add("--report", metavar="HTML", help="also write a page (extra plot)")
    add_trust(parser)
    return parser


def _setting(text: str) -> tuple[str, str]:
    """A setting as it is typed.

    Example:
        >>> _setting("lr=1e-3")
        ('lr', '1e-3')
    """
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"a setting is NAME=VALUE, as in lr=1e-3; got {text!r}")
    return name.replace("-", "_"), value


def _seconds(text: str) -> float:
    """A time: seconds, or with a unit.

    Example:
        >>> _seconds("120s"), _seconds("2m"), _seconds("90")
        (120.0, 120.0, 90.0)
    """
    match = re.fullmatch(r"([0-9.]+)\s*(s|m|min|h)?", text)
    try:
        return float(match[1]) * {"m": 60, "min": 60, "h": 3600}.get(match[2] or "s", 1) if match else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"a time is 90, 120s or 2m; got {text!r}") from None

"""``neuralq doctor``: why a value function is bad, of a run or of a file from another library."""

from __future__ import annotations

import argparse
import re
from typing import Any

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.kinds import say
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.apps.cli.sweeps import add_trust, single_run
from neuralq.doctor import CannotLoad, examine
from neuralq.doctor.examination import LEVELS, NUM_PARTS
from neuralq.runs.folder.run_folder import is_run_folder

__all__ = ["doctor"]


_SUBJECT = (
    "a neuralq run folder; a zip of Stable-Baselines3 (DQN) or sb3-contrib (QR-DQN); a .cleanrl_model; a state dict "
    "(.pth, .safetensors, .npz)"
)


def doctor(argv: list[str]) -> int:
    """Examine a subject; exit status 0 healthy, 1 a finding of grade A or B, 2 it cannot be loaded."""
    options = _parser().parse_args(argv)
    if is_run_folder(options.subject):
        single_run(options.subject, options.trust)
    with ProgressBar[tuple[int, str]](
        NUM_PARTS, lambda told: Told(told[0], [told[1]], f"{told[0]} of {NUM_PARTS}")
    ) as bar:
        try:
            report = examine(
                options.subject, options.env, gamma=options.gamma, data=options.data, settings=dict(options.set),
                net=options.net, level=options.level, budget_s=options.budget, seed=options.seed,
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

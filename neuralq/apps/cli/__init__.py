"""The command line. Nothing heavy is imported here: ``neuralq --help`` answers at once."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

__all__ = ["COMMANDS", "Failure", "command_parser", "main", "print_result"]

COMMANDS = {
    "train": ("neuralq.apps.cli.runs", "train", "train on a Gymnasium environment, or td-gammon, by TD(λ)"),
    "resume": ("neuralq.apps.cli.runs", "resume", "go on with a run that was stopped or killed"),
    "evaluate": ("neuralq.apps.cli.runs", "evaluate", "play greedy episodes with a trained run"),
    "report": ("neuralq.apps.cli.runs", "report", "write a run's report.html"),
    "compare": ("neuralq.apps.cli.compare", "compare", "table and plot of several runs or sweeps side by side"),
    "presets": ("neuralq.apps.cli.presets", "presets", "list the tuned settings per environment"),
    "watch": ("neuralq.apps.cli.media", "watch", "watch a trained run play in a window"),
    "record": ("neuralq.apps.cli.media", "record", "film a trained run as a GIF or MP4"),
    "export": ("neuralq.apps.cli.export", "export", "write a run's network as ONNX, checked against its values"),
    "solve": ("neuralq.apps.cli.exact", "solve", "compute the exact answer of an environment with a model"),
    "chapter": ("neuralq.apps.cli.chapter", "chapter", "run the figures and exercises of Mitchell's chapter 13"),
    "baird": ("neuralq.apps.cli.demo", "baird", "predict divergence on Baird's star, then measure it"),
    "lab": (
        "neuralq.apps.cli.lab",
        "lab",
        "the divergence lab: diagnose, critical, prescribe, matrix, or --serve a page",
    ),
    "play": (
        "neuralq.apps.cli.play",
        "play",
        "play backgammon against a trained agent, or tic-tac-toe, in the browser",
    ),
    "demo": ("neuralq.apps.cli.demo", "demo", "learn CartPole, predict a divergence, write a page about both"),
}

EXAMPLES = """examples:
  neuralq demo
  neuralq train CartPole-v1 --stop-at-return 475
  neuralq train neuralq/MitchellGrid-v0 --layout table
  neuralq resume runs/CartPole-v1-action-output-s0-20260101-120000
  neuralq solve FrozenLake-v1 --gamma 0.95

`neuralq COMMAND --help` tells a command's options. Every command takes --json."""


class Failure(Exception):
    """A command ends with this message and exit status; nothing else is printed."""

    def __init__(self, message: str, status: int = 1) -> None:
        super().__init__(message)
        self.status = status


def print_result(result: dict[str, Any], as_json: bool, lines: Sequence[str]) -> None:
    """The result for people, or, with ``--json``, as one JSON object on the last line of standard output."""
    if as_json:
        print(json.dumps(result, allow_nan=False), flush=True)
        return
    for line in lines:
        print(line, flush=True)


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: Any = None, line: Any = None
) -> None:
    """A warning for whoever typed the command: what it says, not where in the code."""
    print(f"neuralq: warning: {message}", file=sys.stderr)


def command_parser(name: str, description: str, *examples: str) -> argparse.ArgumentParser:
    """The parser of one command: its examples stand below the options, and it takes ``--json``."""
    parser = argparse.ArgumentParser(
        prog=f"neuralq {name}",
        description=description,
        epilog="\n  ".join(["example:" if len(examples) == 1 else "examples:", *examples]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    return parser


def _top_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="neuralq",
        description="Learn value functions beside the exact answer, and know before training what converges.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    from neuralq import __version__

    parser.add_argument("--version", action="version", version=f"neuralq {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, (_, _, summary) in COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)
    return parser


@contextlib.contextmanager
def _present_folder() -> Iterator[None]:
    """Environments and bodies of the user's own are found where the command was given, after all that is installed."""
    here = str(Path.cwd())
    if added := here not in sys.path:
        sys.path.append(here)
    try:
        yield
    finally:
        if added and here in sys.path:
            sys.path.remove(here)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit status: 0 as asked, 1 not reached or failed, 2 wrong usage."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments:
        _top_parser().print_help(sys.stderr)
        return 2
    if arguments[0] not in COMMANDS:
        _top_parser().parse_args(arguments)
        return 2  # not reached: argparse has ended the process with help or an error
    module, function, _ = COMMANDS[arguments[0]]
    try:
        with _present_folder(), warnings.catch_warnings():
            command: Callable[[list[str]], int] = getattr(importlib.import_module(module), function)
            warnings.showwarning = _show_warning
            return command(arguments[1:])
    except Failure as failure:
        print(f"neuralq: {failure}", file=sys.stderr)
        return failure.status
    except BrokenPipeError:  # whoever read our output has gone
        sys.stderr.close()
        return 1
    except KeyboardInterrupt:
        print("neuralq: interrupted", file=sys.stderr)
        return 130
    except (ValueError, RuntimeError, OSError, ImportError, MemoryError) as error:
        from neuralq.apps.cli.faults import USER_FAULTS

        if not isinstance(error, USER_FAULTS):
            raise
        print(f"neuralq: error: {error}", file=sys.stderr)
        return 1

"""The command line. Nothing heavy is imported here: ``neuralq --help`` answers at once."""

from __future__ import annotations

import argparse
import contextlib
import contextvars
import difflib
import importlib
import importlib.util
import itertools
import json
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from neuralq.apps.cli.numbers import joined, number, whole_number
from neuralq.apps.cli.terminal import (
    descriptor_of_its_own,
    end_without_waiting,
    listening,
    make_standard_streams_safe,
)
from neuralq.checks import ELSEWHERE

__all__ = [
    "COMMANDS",
    "DEBUG",
    "Command",
    "CommandParser",
    "Failure",
    "command_parser",
    "main",
    "option_as_typed",
    "parser_of",
    "print_result",
]


class Command(NamedTuple):
    """A command: where it lives, what it does in a line, and under what it stands in the help."""

    module: str
    function: str
    summary: str
    group: str


_LOOK, _KNOW, _EXACT, _PLAY = "train and look", "know before training", "exact answers, and the book", "play and begin"


def _of(module: str, function: str, summary: str, group: str) -> Command:
    return Command(f"neuralq.apps.cli.{module}", function, summary, group)


COMMANDS = {
    "train": _of("runs", "train", "train on a Gymnasium environment, or td-gammon, by TD(λ)", _LOOK),
    "resume": _of("runs", "resume", "go on with a run that was stopped or killed", _LOOK),
    "evaluate": _of("runs", "evaluate", "play greedy episodes with a trained run", _LOOK),
    "sweep": _of("sweep", "sweep", "a run for every combination of options and seed, here or on a cluster", _LOOK),
    "report": _of("runs", "report", "write a run's report.html", _LOOK),
    "tune": _of("tune", "tune", "look for better options than a preset's, confirmed on fresh seeds", _LOOK),
    "compare": _of("compare", "compare", "table and plot of several runs or sweeps side by side", _LOOK),
    "presets": _of("presets", "presets", "an overview of tuned settings, or one of them whole", _LOOK),
    "watch": _of("media", "watch", "watch a trained run play in a window", _LOOK),
    "record": _of("media", "record", "film a trained run as a GIF or MP4", _LOOK),
    "export": _of("export", "export", "write a run's network as ONNX, checked against its values", _LOOK),
    "doctor": _of("doctor", "doctor", "why a value function is bad, of a run or a file of another library", _LOOK),
    "probe": _of("doctor", "probe", "try a training function of yours on eight environments of known values", _LOOK),
    "lab": _of("lab", "lab", "the divergence lab: diagnose, critical, prescribe, matrix, or --serve a page", _KNOW),
    "baird": _of("demo", "baird", "predict divergence on Baird's star, then measure it", _KNOW),
    "solve": _of("exact", "solve", "compute the exact answer of an environment with a model", _EXACT),
    "chapter": _of("chapter", "chapter", "run the figures, exercises and systems of Mitchell's chapter 13", _EXACT),
    "demo": _of("demo", "demo", "learn CartPole, predict a divergence, write a page about both", _PLAY),
    "play": _of("play", "play", "play backgammon, checkers or tic-tac-toe in the browser", _PLAY),
    "completion": _of("completion", "completion", "print a script that completes commands in your shell", _PLAY),
}

EXAMPLES = """examples:
  neuralq demo
  neuralq train CartPole-v1 --stop-at-return 475
  neuralq train neuralq/MitchellGrid-v0 --layout table
  neuralq resume runs/CartPole-v1-action-output-s0-20260101-120000
  neuralq solve FrozenLake-v1 --gamma 0.95

`neuralq COMMAND --help` tells a command's options. Every command takes --json and --debug."""

DEBUG = "show the whole traceback of what goes wrong"


class Failure(Exception):
    """A command ends with this message and exit status; nothing else is printed."""

    def __init__(self, message: str, status: int = 1) -> None:
        super().__init__(message)
        self.status = status


def print_result(result: dict[str, Any], as_json: bool, lines: Sequence[str]) -> None:
    """The result for people, or, with ``--json``, as one JSON object on the last line of standard output."""
    if as_json:
        print(json.dumps(result, allow_nan=False), flush=True, file=_output.get())
        return
    for line in lines:
        print(line, flush=True, file=_output.get())


_output: contextvars.ContextVar[TextIO | None] = contextvars.ContextVar("_output", default=None)
"""Standard output as it was when the command began: environments print into it, or put something else in its place."""


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: Any = None, line: Any = None
) -> None:
    """A warning for whoever typed the command: what it says, not where in the code, nor in which colour."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(message)).removeprefix("WARN: ")  # as Gymnasium writes its own
    print(f"neuralq: warning: {text}", file=sys.stderr)


class _Asked(Exception):
    """A command was asked for its parser, not to run."""


_asking = contextvars.ContextVar("_asking", default=False)


class CommandParser(argparse.ArgumentParser):
    """The parser of a command: options have hyphens, and λ is ``--lambda``, whichever way they are typed.

    Numbers are read as people write them (`neuralq.apps.cli.numbers`) wherever an option's type is int or float.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.register("type", int, whole_number)
        self.register("type", float, number)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does; the parser itself is handed out where a command was asked for it."""
        if _asking.get() and self.add_help:  # one without help only looks ahead
            raise _Asked(self)
        return super().parse_known_args(joined(option_as_typed(token) for token in args or ()), namespace)


def option_as_typed(token: str) -> str:
    """An option as the help spells it; everything else is left alone.

    Example:
        >>> option_as_typed("--lambda_=0.5"), option_as_typed("--num_seeds"), option_as_typed("a_b")
        ('--lambda=0.5', '--num-seeds', 'a_b')
    """
    if not token.startswith("--"):
        return token
    name, equals, value = token.partition("=")
    return name.rstrip("_").replace("_", "-") + equals + value


def parser_of(module: str, function: str) -> argparse.ArgumentParser:
    """The parser of a command, which is asked for it before it does anything."""
    token = _asking.set(True)
    try:
        getattr(importlib.import_module(module), function)([])
    except _Asked as asked:
        parser: argparse.ArgumentParser = asked.args[0]
        return parser
    finally:
        _asking.reset(token)
    raise AssertionError(f"{module}.{function} ran without reading its options")


def command_parser(name: str, description: str, *examples: str) -> CommandParser:
    """The parser of one command: its examples stand below the options, and it takes ``--json``."""
    parser = CommandParser(
        prog=f"neuralq {name}",
        description=description,
        epilog="\n  ".join(["example:" if len(examples) == 1 else "examples:", *examples]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    parser.add_argument("--debug", action="store_true", help=DEBUG)
    return parser


def _top_help() -> str:
    """The commands, grouped by what they are for, and examples."""
    lines = [
        "usage: neuralq [-h] [--version] COMMAND ...",
        "",
        "Learn value functions beside the exact answer, and know before training what converges.",
    ]
    for group, members in itertools.groupby(COMMANDS.items(), key=lambda item: item[1].group):
        lines += ["", f"{group}:", *(f"  {name:<11} {command.summary}" for name, command in members)]
    return "\n".join([*lines, "", EXAMPLES])


def _top(first: str) -> int:
    """What is answered where no command is named."""
    if first in ("-h", "--help", "help"):
        print(_top_help())
        return 0
    if first == "--version":
        from neuralq import __version__

        print(f"neuralq {__version__}")
        return 0
    close = difflib.get_close_matches(first, COMMANDS, 1)
    hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(COMMANDS)}"
    if re.search(r"-v\d+$", first):
        hint = f"an environment goes with one, as in neuralq train {first}"
    print(f"neuralq: there is no command {first!r}; {hint} (neuralq --help)", file=sys.stderr)
    return 2


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


@contextlib.contextmanager
def _own_output(as_json: bool) -> Iterator[None]:
    """With ``--json`` nothing but the result gets onto standard output; what else is printed goes beside it."""
    with contextlib.ExitStack() as stack:
        token = _output.set(stack.enter_context(descriptor_of_its_own()) if as_json else sys.stdout)
        stack.callback(_output.reset, token)
        stack.enter_context(contextlib.redirect_stdout(sys.stderr if as_json else sys.stdout))
        yield


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit status: 0 as asked, 1 not reached or failed, 2 wrong usage, 130 interrupted."""
    make_standard_streams_safe()
    with listening() as heard:
        status = _main(argv)
        if heard and status == 0:
            print("neuralq: interrupted", file=sys.stderr)
            status = 130
    if argv is None:  # the process ends with this command
        end_without_waiting(status)
    return status


def _main(argv: Sequence[str] | None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    if not arguments:
        print(_top_help(), file=sys.stderr)
        return 2
    if arguments[0] not in COMMANDS:
        return _top(arguments[0])
    if importlib.util.find_spec("fcntl") is None:
        print(f"neuralq: {ELSEWHERE}", file=sys.stderr)
        return 1
    module, function = COMMANDS[arguments[0]][:2]
    asks = bool({"-h", "--help", "--print-config", "--print_config"} & set(arguments))  # and prints what it is told
    try:
        with _present_folder(), warnings.catch_warnings(), _own_output("--json" in arguments and not asks):
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
    except Exception as error:
        from neuralq.runs.faults import explained

        lines = explained(error)
        if lines is None:
            raise
        if debug:
            traceback.print_exception(error)
        print(f"neuralq: error: {lines[0]}", *lines[1:], sep="\n", file=sys.stderr)
        return 1

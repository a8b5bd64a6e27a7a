"""``neuralq lab``: the divergence lab, one command for each question. Nothing heavy is imported before it is needed."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from neuralq.apps.cli import CommandParser, Failure, command_parser, option_as_typed, print_result

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from neuralq.lab import Method, Problem

__all__ = ["COMMANDS", "Parser", "add_problem", "chosen_problem", "lab", "show", "spelled"]

COMMANDS = {
    "list": ("neuralq.apps.cli.lab", "list_command", "every problem and every method, with what is known of them"),
    "baird": (
        "neuralq.apps.cli.lab_matrix",
        "baird",
        "Baird's star: predicted, measured, and what each method makes of it",
    ),
    "matrix": ("neuralq.apps.cli.lab_matrix", "matrix", "every problem under every method, predicted and measured"),
    "diagnose": ("neuralq.apps.cli.lab_cases", "diagnose", "what a method will do on a problem, before it is trained"),
    "critical": ("neuralq.apps.cli.lab_cases", "critical", "the value of a parameter at which stability changes"),
    "prescribe": ("neuralq.apps.cli.lab_cases", "prescribe", "what to change so that learning converges, best first"),
    "run": ("neuralq.apps.cli.lab_cases", "run", "train a method on a problem, over many seeds"),
    "fitted": (
        "neuralq.apps.cli.lab_fitted",
        "fitted",
        "fitted value iteration: which functions may be fitted, and why",
    ),
}

Parser = CommandParser


def lab(argv: list[str]) -> int:
    """Answer one question about divergence, or serve the page on which all can be asked."""
    if argv and argv[0] in COMMANDS:
        module, function, _ = COMMANDS[argv[0]]
        command: Callable[[list[str]], int] = getattr(importlib.import_module(module), function)
        return command(argv[1:])
    parser = _parser()
    if argv and not argv[0].startswith("-"):
        parser.error(f"there is no command {argv[0]!r}; there are {', '.join(COMMANDS)}")
    options = parser.parse_args(argv)
    if not options.serve:
        parser.print_help(sys.stderr)
        return 2
    if not 0 <= options.port <= 65535:
        parser.error(f"--port must lie in 0..65535 (0 takes a free one), got {options.port}")
    _serve(options.host, options.port)
    return 0


def _parser() -> Parser:
    parser = Parser(
        prog="neuralq lab",
        usage="neuralq lab COMMAND [options]\n       neuralq lab --serve [--host HOST] [--port PORT]",
        description="The divergence lab: know before training what converges, why, and what to change.",
        epilog="\n".join(
            [
                "commands:",
                *(f"  {name:<10}{summary}" for name, (_, _, summary) in COMMANDS.items()),
                "",
                "examples:",
                "  neuralq lab baird",
                "  neuralq lab diagnose baird --method td --lambda 0.9",
                "  neuralq lab critical baird --parameter lambda",
                "  neuralq lab --serve",
                "",
                "`neuralq lab COMMAND --help` tells a command's options. Every command takes --json.",
            ]
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--serve", action="store_true", help="serve the lab's page to a browser (extra: web)")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve on (default: this machine only)")
    parser.add_argument("--port", type=int, default=8765, help="port to serve on (default: 8765; 0 takes a free one)")
    return parser


def _serve(host: str, port: int) -> None:
    try:
        from neuralq.apps.web import serve

        serve(host, port)
    except ImportError as error:
        from neuralq.checks import MissingExtra

        if isinstance(error, MissingExtra):  # it says itself what to install
            raise
        raise Failure(
            f"the page needs packages that are not installed ({error}); install them by: pip install 'neuralq[web]'"
        ) from error


def list_command(argv: list[str]) -> int:
    """List problems, methods, and what `neuralq lab fitted` knows."""
    parser = command_parser(
        "lab list", "Every problem and every method of the lab, with their sources.", "neuralq lab list"
    )
    options = parser.parse_args(argv)
    from neuralq.apps.cli.fitted_choices import fitted_table, plain_choices
    from neuralq.lab import METHODS, PROBLEMS
    from neuralq.lab.plain import fields_of

    problems = [entry.make() for entry in PROBLEMS]
    if options.json:
        names = ("name", "title", "source", "known", "gamma", "step_size", "num_weights", "learns_q")
        plain = [fields_of(one, *names) for one in problems]
        show(True, {"problems": plain, "methods": [one.plain() for one in METHODS], **plain_choices()})
    else:
        show(False, {}, *_tables(problems, METHODS), fitted_table())
    return 0


def _tables(made: Sequence[Problem], known: Sequence[Method]) -> tuple[Table, Table]:
    """Problems and methods for people."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    problems = Table("problem", "what it is", "rows", "weights", "γ", title="problems", box=SIMPLE_HEAD)
    for one in made:
        rows = int(one.mdp.num_rows if one.learns_q else (~one.mdp.is_terminal).sum())
        kind = f"{rows} {'pairs' if one.learns_q else 'states'}"
        title = Text.assemble(one.title, (f" ({one.source})" * bool(one.source), "dim"))
        problems.add_row(one.name, title, kind, str(one.num_weights), f"{one.gamma:g}")
    methods = Table("method", "what it is", "options", title="methods", box=SIMPLE_HEAD)
    for method in known:
        settings = ", ".join(f"{spelled(name)}={value:g}" for name, value in method.defaults.items())
        on = "; learns pairs" if method.rows == "pairs" else ""
        methods.add_row(method.name, Text.assemble(method.title, (f" ({method.source}{on})", "dim")), settings)
    for table in (problems, methods):
        table.title_justify, table.columns[0].no_wrap = "left", True
    return problems, methods


def spelled(name: str) -> str:
    """The name of an option as it is typed.

    Example:
        >>> spelled("lambda_"), spelled("beta_over_alpha")
        ('lambda', 'beta-over-alpha')
    """
    return option_as_typed(f"--{name}").removeprefix("--")


def show(as_json: bool, plain: dict[str, Any], *parts: RenderableType) -> None:
    """Tables and paragraphs for people on standard output, or one JSON object."""
    if as_json:
        print_result(plain, True, [])
        return
    from rich.console import Console

    console = Console(highlight=False)
    for part in parts:
        console.print(part)


def add_problem(parser: Parser, *, step_size: str) -> None:
    """The arguments that say which problem is meant."""
    parser.add_argument("problem", metavar="PROBLEM", help="a name from `neuralq lab list`, such as baird")
    parser.add_argument("--gamma", type=float, help="discount (default: the problem's own)")
    parser.add_argument("--step-size", type=float, metavar="A", help=f"α (default: {step_size})")


def chosen_problem(options: argparse.Namespace) -> Problem:
    """The problem that the arguments of `add_problem` name, with its γ."""
    from dataclasses import replace

    from neuralq.lab import problem
    from neuralq.lab.linear.process import check_values

    made = problem(options.problem)
    if options.gamma is not None:
        made = replace(made, gamma=options.gamma)
    check_values(made)
    return made

"""``neuralq completion``: scripts with which a shell completes commands, options and environments."""

from __future__ import annotations

import argparse
from typing import Any

import shtab

from neuralq.apps.cli import COMMANDS, command_parser, parser_of, print_result

__all__ = ["completion"]

SHELLS = {
    "bash": "neuralq completion bash > ~/.local/share/bash-completion/completions/neuralq",
    "zsh": "neuralq completion zsh > ~/.zfunc/_neuralq  (with fpath+=~/.zfunc in .zshrc)",
    "fish": "neuralq completion fish > ~/.config/fish/completions/neuralq.fish",
}
_FOLDERS = {"run", "runs", "run_dir"}
_FILES = {"config", "out", "output", "svg", "plot"}


def completion(argv: list[str]) -> int:
    """Print the script of a shell."""
    parser = command_parser(
        "completion",
        "Print a script that makes a shell complete commands, options and environments; open a new shell afterwards.",
        *SHELLS.values(),
    )
    parser.add_argument("shell", choices=SHELLS, help="which shell")
    options = parser.parse_args(argv)
    script = shtab.complete(_everything(), options.shell)
    print_result({"shell": options.shell, "script": script}, options.json, [script.rstrip("\n")])
    return 0


def _everything() -> argparse.ArgumentParser:
    """One parser that knows every command with its options; it is only looked at."""
    from neuralq.apps.cli import lab

    whole = argparse.ArgumentParser(prog="neuralq")
    whole.add_argument("--version", action="store_true", help="print the version")
    commands = whole.add_subparsers()
    for name, command in COMMANDS.items():
        if name == "train":
            _add_train(commands.add_parser(name, help=command.summary))
        elif name == "lab":
            of_lab = commands.add_parser(name, help=command.summary)
            questions = of_lab.add_subparsers()
            for question, (module, function, summary) in lab.COMMANDS.items():
                _copy(parser_of(module, function), questions.add_parser(question, help=summary))
            _copy(parser_of(command.module, command.function), of_lab)
        else:
            _copy(parser_of(command.module, command.function), commands.add_parser(name, help=command.summary))
    return whole


def _add_train(to: argparse.ArgumentParser) -> None:
    """The options of every learner; a run takes those of its own."""
    from neuralq.apps.cli.option_table import train_parser
    from neuralq.runs.kinds import KINDS
    from neuralq.runs.recipe.config import LEARNERS

    to.add_argument(
        "env", choices=[*_environments(), *(kind for kind in KINDS if kind != "control")], help="environment"
    )
    for learner in LEARNERS:
        _copy(train_parser(learner, {}), to)


def _environments() -> list[str]:
    """Environments that have a preset, and neuralq's own."""
    from neuralq.runs.recipe.presets import PRESETS
    from neuralq.runs.recipe.replay_presets import ANY
    from neuralq_envs import ENVIRONMENTS

    return [*dict.fromkeys(env for env, _ in PRESETS if env != ANY), *ENVIRONMENTS]


def _copy(parser: argparse.ArgumentParser, to: argparse.ArgumentParser) -> None:
    known = set(to._option_string_actions)
    for action in parser._actions:
        names = [_typed(name) for name in action.option_strings]
        if action.help == argparse.SUPPRESS or known.intersection(names):
            continue
        more: dict[str, Any] = {"help": action.help}
        if isinstance(action, argparse._StoreTrueAction):
            more["action"] = "store_true"
        elif action.choices is not None:
            more["choices"] = list(action.choices)
        elif action.dest == "env":
            more["choices"] = _environments()
        if not names:
            more["nargs"] = action.nargs
        copied = to.add_argument(*(names or [action.dest]), **more)
        if action.dest in _FOLDERS:
            copied.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
        elif action.dest in _FILES:
            copied.complete = shtab.FILE  # type: ignore[attr-defined]


def _typed(name: str) -> str:
    return name.rstrip("_").replace("_", "-")

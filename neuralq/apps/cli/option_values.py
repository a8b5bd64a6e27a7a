"""What is typed and what stands in a file: names of options, and the values behind them."""

from __future__ import annotations

import argparse
import contextlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import yaml  # type: ignore[import-untyped]

from neuralq.apps.cli import Failure
from neuralq.apps.cli.numbers import any_number, joined
from neuralq.apps.cli.yaml_text import read_text
from neuralq.runs.recipe.config import fitted_value
from neuralq.runs.recipe.keywords import called_here

__all__ = ["ENV_KWARGS", "as_typed", "hyphenated", "read_config_file", "read_options", "reader"]

ENV_KWARGS = "YAML or JSON mapping passed to gymnasium.make, as in '{is_slippery: false}'"


def hyphenated(argv: Sequence[str]) -> list[str]:
    """``--stop-at-return`` and ``--rollout.lambda`` as the names of their fields; values are left alone.

    Example:
        >>> hyphenated(["--stop-at-return=475", "--rollout.lambda", "-1"])
        ['--stop_at_return=475', '--rollout.lambda_', '-1']
    """
    out = []
    for token in argv:
        match = re.fullmatch(r"--([A-Za-z][\w.-]*)(=.*)?", token, re.DOTALL)
        if match is None:
            out.append(token)
            continue
        name = re.sub(r"(^|\.)lambda$", r"\1lambda_", match[1].replace("-", "_"))
        out.append(f"--{name}{match[2] or ''}")
    return out


def as_typed(text: str) -> str:
    """Option names in a text of the parser's, with hyphens.

    Example:
        >>> as_typed("--lambda_ and --step_size")
        '--lambda and --step-size'
    """
    return re.sub(r"--[a-z_.]+", lambda m: m[0].rstrip("_").replace("_", "-"), text)


def reader(hint: Any) -> Callable[[str], Any]:
    """What reads an option's text as the kind of value that its field holds."""

    def read(text: str) -> Any:
        try:
            return fitted_value("", _value(text, hint), hint, text)
        except ValueError as error:
            if str in get_args(hint):
                return text
            raise argparse.ArgumentTypeError(str(error)) from error

    return read


def _value(text: str, hint: Any) -> Any:
    """The text as a number where one is wanted, else as YAML; what is neither is what it is."""
    kinds = {hint, *get_args(hint)}
    if kinds & {int, float}:
        if NoneType in kinds and text.lower() in ("none", "null", "~", ""):
            return None
        with contextlib.suppress(ValueError):
            return any_number(text)
        return text
    if hint is str:
        return text
    try:
        return read_text(text)
    except yaml.YAMLError:
        return text
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"cannot be read: {error}") from error


def read_options(parser: argparse.ArgumentParser, argv: Sequence[str]) -> dict[str, Any]:
    """What was given, by name, settings of a learner as a mapping.

    Raises:
        Failure: for wrong usage, in one line instead of all the options, with exit status 2.
    """
    hint = f"; `{parser.prog} --help` lists the options"
    try:
        found, unknown = parser.parse_known_args(joined(argv))
    except argparse.ArgumentError as error:
        said, name = " ".join(error.message.split()), error.argument_name
        if name is not None:
            said = f"{name} {said}" if said.startswith("must ") else f"{name}: {said}"
        raise Failure(as_typed(said) + hint, 2) from error
    if unknown:
        known = {action.dest.rpartition(".")[2]: action.option_strings for action in parser._actions}
        names = [word[2:].partition("=")[0] for word in unknown if word.startswith("--")]
        ours = [called_here(name.rpartition(".")[2], known) for name in names]
        told = [f"--{name} is called {known[one][0]} here" for name, one in zip(names, ours, strict=True) if one]
        told = told or [f"unrecognized arguments: {' '.join(unknown)}"]
        raise Failure(as_typed(", ".join(told)) + hint, 2)
    given: dict[str, Any] = {}
    for name, value in vars(found).items():
        place, _, field = name.rpartition(".")
        (given.setdefault(place, {}) if place else given)[field] = value
    return given


def read_config_file(path: str) -> dict[str, Any]:
    """The mapping in a file of options, JSON or YAML.

    Raises:
        Failure: if it cannot be read or holds something else, with exit status 2.
    """
    try:
        content = read_text(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise Failure(f"cannot read --config {path}: {' '.join(str(error).split())}", 2) from error
    content = {} if content is None else content
    if not isinstance(content, dict):
        raise Failure(f"--config {path} must hold a mapping of options, got {type(content).__name__}", 2)
    return content

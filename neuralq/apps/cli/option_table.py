"""The options of ``neuralq train``: one for each field of the configuration, and those that only a command has."""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Collection, Mapping
from dataclasses import MISSING, dataclass, fields
from types import MappingProxyType
from typing import Any, get_args, get_origin, get_type_hints

from neuralq.apps.cli import DEBUG
from neuralq.apps.cli.option_values import ENV_KWARGS, reader
from neuralq.q.named_bodies import NAMED_BODIES
from neuralq.runs import RunConfig
from neuralq.runs.recipe.config import LAYOUTS, LEARNERS
from neuralq.runs.recipe.replay_presets import AGENTS

__all__ = ["TrainOptions", "add_fields", "train_parser"]

_EXAMPLES = """examples:
  neuralq train CartPole-v1 --seed 3 --stop-at-return 475
  neuralq train CartPole-v1 --seeds 10
  neuralq train CartPole-v1 --learner replay --layout separate --total-steps 50k
  neuralq train FrozenLake-v1 --layout table --env-kwargs '{is_slippery: false}'
  neuralq train td-gammon --games 100k  (backgammon; has options of its own)
  neuralq train my_package:MyEnv-v0 --lambda 0.8 --hidden 64,64
  neuralq train CartPole-v1 --print-config > run.yaml; neuralq train --config run.yaml --seed 4"""

_OWN_PARSING = {"env", "env_kwargs", "wrappers", "learner", "layout", "body", "rules", *LEARNERS}


@dataclass(frozen=True)
class TrainOptions:
    """What was asked for on the command line, beside the configuration of the run.

    Args:
        run_dir: folder for the run, or None for one of its own.
        tensorboard: whether to write event files.
        wandb: whether to log to Weights & Biases.
        doctor: whether to examine the run at its end.
        hooks: hooks of the user's own as "module:name".
        seeds: how many seeds to run side by side, or None for one run.
        workers: how many of them at a time, or None for as many as there are cores.
        json: whether to print the result as JSON.
        preset: the preset that gave defaults, in words; empty for none.
        notes: what was made of schedules that the budget would not have let finish.
    """

    run_dir: str | None
    tensorboard: bool
    wandb: bool
    doctor: bool
    hooks: tuple[str, ...]
    seeds: int | None
    workers: int | None
    json: bool
    preset: str
    notes: tuple[str, ...]


def _field_help(settings: type) -> dict[str, str]:
    """What each field of a dataclass is for, read from its docstring, so that it is written once."""
    # Python 3.13 takes the indentation away when it compiles, and `python -OO` the docstring.
    text = inspect.cleandoc(settings.__doc__ or "")
    block = re.split(r"\n\w+:", text.partition("Args:")[2])[0]
    return {m[1]: " ".join(m[2].split()) for m in re.finditer(r"\n {4}(\w+): (.*?)(?=\n {4}\w+:|\Z)", block, re.DOTALL)}


def add_fields(
    parser: Any,
    settings: type[Any],
    prefix: str = "",
    defaults: Mapping[str, Any] = MappingProxyType({}),
    short: Mapping[str, str] = MappingProxyType({}),
    leave_out: Collection[str] = (),
) -> None:
    """An option for each field of a dataclass, with its type, its default and what its docstring says of it.

    Args:
        parser: takes the options.
        settings: the dataclass.
        prefix: before the name of each option.
        defaults: those that are not the dataclass's own.
        short: options that are named otherwise than their fields, by field.
        leave_out: fields that have no option.

    Example:
        >>> parser = argparse.ArgumentParser()
        >>> add_fields(parser, TrainOptions, leave_out=("hooks", "notes"))
        >>> parser.parse_args(["--seeds", "3"]).seeds
        3
    """
    texts, types = _field_help(settings), get_type_hints(settings)
    for f in fields(settings):
        if f.name in leave_out:
            continue
        default, hint = defaults.get(f.name, f.default), types[f.name]
        more: dict[str, Any] = {"type": reader(hint)}
        if get_origin(hint) is tuple:
            more, default = {"type": reader(get_args(hint)[0]), "nargs": "+"}, " ".join(map(str, default))
        words = {int: "N", float: "X", str: "NAME", bool: "{true,false}"}
        kind = next((k for k in (hint, *get_args(hint)) if k in words), str)
        shown = "" if default is MISSING else f" (default: {'none' if default is None else default})"
        text = f"{texts.get(f.name, f.name.replace('_', ' ')).rstrip('.')}{shown}".replace("%", "%%")
        option = f"--{prefix}{short.get(f.name, f.name)}"
        parser.add_argument(option, dest=prefix + f.name, metavar=words[kind], help=text, **more)


_MORE: tuple[tuple[str, Any, str, str], ...] = (
    ("env_kwargs", dict, "MAPPING", ENV_KWARGS),
    (
        "wrappers",
        tuple[str | dict[str, Any], ...],
        "LIST",
        "wrappers around the environment, the first innermost: '[pkg:Wrapper, {pkg:Other: {size: 3}}]'",
    ),
    (
        "body",
        dict | str | None,
        "NAME",
        f"network body: {', '.join(NAMED_BODIES)}, module:Class of your own, or a mapping: "
        "'{class: MLP, hidden: [64]}'",
    ),
    ("hidden", str, "N,N", "widths of the hidden layers, e.g. 64,64"),
    ("layer_norm", bool | None, "{true,false}", "layer normalisation in the network"),
    ("activation", str, "NAME", "relu, tanh, leaky_relu or sigmoid"),
    (
        "rules",
        tuple[dict[str, Any], ...],
        "LIST",
        "advice that begins as units of the network: '[{conditions: {2: [0, 0.1]}, action: 1, value: 5}]' makes "
        "action 1 worth 5 more where input 2 has gone from 0 to .1 (docs/runs.md)",
    ),
    ("config", str, "FILE", "YAML file of options, as --print-config writes it"),
    ("run_dir", str, "FOLDER", "where the run goes (default: a folder under runs/)"),
    ("preset", str, "NAME", f"true (the environment's), false, or a whole agent: {', '.join(AGENTS)} (default: true)"),
    ("seeds", int, "N", "run N seeds, counted from --seed, in processes side by side"),
    ("workers", int, "N", "how many seeds at a time (default: as many as there are cores)"),
    ("hook", str, "module:name", "function or class of your own that watches the run (docs/hooks.md); may be repeated"),
)
_FLAGS = {
    "print_config": "print the resulting configuration and exit",
    "tensorboard": "write TensorBoard event files (extra tensorboard)",
    "wandb": "log to Weights & Biases (extra wandb)",
    "doctor": "examine the run at its end, as neuralq doctor does, for a minute at most",
    "json": "print the result as one JSON object on the last line",
    "debug": DEBUG,
}


def train_parser(learner: str, preset: dict[str, Any]) -> argparse.ArgumentParser:
    """The parser of a run by ``learner``; the preset's values stand in the help, and what is not given is left out."""
    parser = argparse.ArgumentParser(
        prog="neuralq train",
        usage="neuralq train ENV [options]",
        description="Train on a Gymnasium environment by TD(λ). ENV is a registered id, or module:id for your own.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        exit_on_error=False,
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument("--env", type=str, help=argparse.SUPPRESS)
    for name, choices, default, text in (
        ("learner", tuple(LEARNERS), RunConfig.learner, "how to learn"),
        ("layout", LAYOUTS, LEARNERS[learner].layout, "how values are represented"),
    ):
        parser.add_argument(f"--{name}", choices=choices, help=f"{text} (default: {default})")
    add_fields(parser, RunConfig, defaults=preset, leave_out=_OWN_PARSING)
    for name, hint, metavar, text in _MORE:
        action = "append" if name == "hook" else "store"
        parser.add_argument(f"--{name}", action=action, type=reader(hint), metavar=metavar, help=text)
    for name, text in _FLAGS.items():
        parser.add_argument(f"--{name}", action="store_true", help=text)
    kind = LEARNERS[learner]
    group = parser.add_argument_group(f"options of the {learner} learner", f"{kind.title}: {kind.source}")
    add_fields(group, kind.settings, f"{learner}.", preset.get(learner, {}))
    return parser

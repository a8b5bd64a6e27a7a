"""Options of ``neuralq train``: preset, then configuration file, then command line, the later winning."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import inspect
import itertools
import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args, get_origin, get_type_hints

import yaml  # type: ignore[import-untyped]

from neuralq.apps.cli import DEBUG, Failure
from neuralq.apps.cli.yaml_text import read_yaml
from neuralq.q.bodies import NAMED_BODIES
from neuralq.runs import RunConfig, preset_for
from neuralq.runs.recipe.budget import cut_to_budget
from neuralq.runs.recipe.config import (
    LAYOUTS,
    LEARNERS,
    NETWORKS,
    body_to_dict,
    config_from_dict,
    config_to_dict,
    fitted_value,
)

__all__ = [
    "TrainOptions",
    "add_fields",
    "as_typed",
    "hyphenated",
    "parse_train",
    "read_config_file",
    "read_options",
    "train_parser",
]

_EXAMPLES = """examples:
  neuralq train CartPole-v1 --seed 3 --stop-at-return 475
  neuralq train CartPole-v1 --seeds 10
  neuralq train CartPole-v1 --learner replay --layout separate --total-steps 50000
  neuralq train FrozenLake-v1 --layout table --env-kwargs '{"is_slippery": false}'
  neuralq train td-gammon --games 100000  (backgammon; has options of its own)
  neuralq train my_package:MyEnv-v0 --lambda 0.8 --hidden 64,64
  neuralq train CartPole-v1 --print_config > run.yaml; neuralq train --config run.yaml --seed 4"""

_OWN_PARSING = {"env", "env_kwargs", "learner", "layout", "body", *LEARNERS}
_MOST_SEEDS = 10_000
_WITHOUT_VALUE = {"h", "help", "json", "debug", "tensorboard", "wandb", "print_config"}


@dataclass(frozen=True)
class TrainOptions:
    """What was asked for on the command line, beside the configuration of the run.

    Args:
        run_dir: folder for the run, or None for one of its own.
        tensorboard: whether to write event files.
        wandb: whether to log to Weights & Biases.
        hooks: hooks of the user's own as "module:name".
        seeds: how many seeds to run side by side, or None for one run.
        workers: how many of them at a time, or None for as many as there are cores.
        json: whether to print the result as JSON.
        preset: whether a preset gave defaults.
        notes: what was made of schedules that the budget would not have let finish.
    """

    run_dir: str | None
    tensorboard: bool
    wandb: bool
    hooks: tuple[str, ...]
    seeds: int | None
    workers: int | None
    json: bool
    preset: bool
    notes: tuple[str, ...]


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
    return re.sub(r"--[a-z_.]+", lambda m: m[0].rstrip("_").replace("_", "-"), text).replace(
        "--print-config", "--print_config"
    )


def _reader(hint: Any) -> Callable[[str], Any]:
    """What reads an option's text as the kind of value that its field holds."""

    def read(text: str) -> Any:
        value: Any = text
        if hint is not str:
            try:
                value = read_yaml(text)
            except yaml.YAMLError:
                pass  # a word that is no YAML is what it is
            except ValueError as error:
                raise argparse.ArgumentTypeError(f"cannot be read: {error}") from error
            with contextlib.suppress(ValueError):  # YAML 1.1 takes 1e-5 for a word
                value = float(text) if isinstance(value, str) else value
        try:
            return fitted_value("", value, hint, text)
        except ValueError as error:
            if str in get_args(hint):
                return text
            raise argparse.ArgumentTypeError(str(error)) from error

    return read


def read_options(parser: argparse.ArgumentParser, argv: Sequence[str]) -> dict[str, Any]:
    """What was given, by name, settings of a learner as a mapping.

    Raises:
        Failure: for wrong usage, in one line instead of all the options, with exit status 2.
    """
    hint = f"; `{parser.prog} --help` lists the options"
    try:
        found, unknown = parser.parse_known_args(list(argv))
    except argparse.ArgumentError as error:
        said, name = " ".join(error.message.split()), error.argument_name
        if name is not None:
            said = f"{name} {said}" if said.startswith("must ") else f"{name}: {said}"
        raise Failure(as_typed(said) + hint, 2) from error
    if unknown:
        raise Failure(as_typed(f"unrecognized arguments: {' '.join(unknown)}") + hint, 2)
    given: dict[str, Any] = {}
    for name, value in vars(found).items():
        place, _, field = name.rpartition(".")
        (given.setdefault(place, {}) if place else given)[field] = value
    return given


def _with_env_named(argv: Sequence[str]) -> list[str]:
    """The one word that is neither an option nor the value of one is the environment, wherever it stands."""
    out: list[str] = []
    takes_value = False
    for token in argv:
        is_option = token.startswith("-") and not re.fullmatch(r"-\.?\d.*", token)
        if not is_option and not takes_value:
            out.append("--env")
        out.append(token)
        takes_value = is_option and "=" not in token and token.lstrip("-") not in _WITHOUT_VALUE
    if out.count("--env") > 1:
        words = [value for name, value in itertools.pairwise(out) if name == "--env"]
        raise Failure(f"one environment at a time, got {' and '.join(map(repr, words))}", 2)
    return out


def _peek(argv: Sequence[str]) -> tuple[argparse.Namespace, dict[str, Any], list[str]]:
    """What decides which options there are, the configuration file's content, and the rest of the command line."""
    light = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    light.add_argument("--config")
    _, rest = light.parse_known_args(list(argv))
    for name in ("env", "learner", "layout", "preset"):
        light.add_argument(f"--{name}")
    try:
        known, _ = light.parse_known_args(list(argv))
    except argparse.ArgumentError as error:
        raise Failure(f"{error}; `neuralq train --help` lists the options", 2) from error
    file = {} if known.config is None else _read_file(known.config)
    for name, default in (("env", ""), ("learner", RunConfig.learner), ("layout", RunConfig.layout)):
        setattr(known, name, getattr(known, name) or file.get(name) or default)
    if str(known.learner) not in LEARNERS:  # refused with the right words later
        known.learner = RunConfig.learner
    return known, file, rest


def read_config_file(path: str) -> dict[str, Any]:
    """The mapping in a file of options, JSON or YAML.

    Raises:
        Failure: if it cannot be read or holds something else, with exit status 2.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        try:
            content = json.loads(text, object_pairs_hook=_once)  # YAML 1.1 takes 1e-05 for a word
        except (ValueError, RecursionError):
            content = read_yaml(text)
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise Failure(f"cannot read --config {path}: {' '.join(str(error).split())}", 2) from error
    content = {} if content is None else content
    if not isinstance(content, dict):
        raise Failure(f"--config {path} must hold a mapping of options, got {type(content).__name__}", 2)
    return content


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(found := dict(pairs)) < len(pairs):
        raise ValueError("a key is given twice")
    return found


def _read_file(path: str) -> dict[str, Any]:
    content = read_config_file(path)
    known = [f.name for f in fields(RunConfig)]
    for name in content:
        if name not in known:
            close = difflib.get_close_matches(str(name), known, 1)
            hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
            raise Failure(f"--config {path} has the unknown key {name!r}; {hint}", 2)
    return content


def _refuse_other_learners(argv: Sequence[str], learner: str) -> None:
    for token in argv:
        other = re.match(r"--(\w+)[.=]", token)
        if other is not None and other[1] in LEARNERS and other[1] != learner:
            option = as_typed(token.split("=")[0])
            raise Failure(
                f"{option} is for the {other[1]} learner, and this is a {learner} run: "
                f"add --learner {other[1]} or leave it out",
                2,
            )


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
        more: dict[str, Any] = {"type": _reader(hint)}
        if get_origin(hint) is tuple:
            more, default = {"type": _reader(get_args(hint)[0]), "nargs": "+"}, " ".join(map(str, default))
        words = {int: "N", float: "X", str: "NAME", bool: "{true,false}"}
        kind = next((k for k in (hint, *get_args(hint)) if k in words), str)
        shown = "" if default is MISSING else f" (default: {'none' if default is None else default})"
        text = f"{texts.get(f.name, f.name.replace('_', ' ')).rstrip('.')}{shown}".replace("%", "%%")
        option = f"--{prefix}{short.get(f.name, f.name)}"
        parser.add_argument(option, dest=prefix + f.name, metavar=words[kind], help=text, **more)


_MORE: tuple[tuple[str, Any, str, str], ...] = (
    ("env_kwargs", dict, "MAPPING", "JSON or YAML mapping passed to gymnasium.make"),
    (
        "body",
        dict | str | None,
        "NAME",
        f"network body: {', '.join(NAMED_BODIES)}, module:Class of your own, or a mapping: "
        "'{class: MLP, hidden: [64]}'",
    ),
    ("hidden", str, "N,N", "widths of the hidden layers, e.g. 64,64"),
    ("layer_norm", bool | None, "{true,false}", "layer normalisation in the network"),
    ("activation", str, "NAME", "relu, tanh or leaky_relu"),
    ("config", str, "FILE", "YAML file of options, as --print_config writes it"),
    ("run_dir", str, "FOLDER", "where the run goes (default: a folder under runs/)"),
    ("preset", bool, "{true,false}", "whether to start from the environment's preset (default: true)"),
    ("seeds", int, "N", "run N seeds, counted from --seed, in processes side by side"),
    ("workers", int, "N", "how many seeds at a time (default: as many as there are cores)"),
    ("hook", str, "module:name", "function or class of your own that watches the run (docs/hooks.md); may be repeated"),
)
_FLAGS = {
    "print_config": "print the resulting configuration and exit",
    "tensorboard": "write TensorBoard event files (extra tensorboard)",
    "wandb": "log to Weights & Biases (extra wandb)",
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
        ("layout", LAYOUTS, RunConfig.layout, "how values are represented"),
    ):
        parser.add_argument(f"--{name}", choices=choices, help=f"{text} (default: {default})")
    add_fields(parser, RunConfig, defaults=preset, leave_out=_OWN_PARSING)
    for name, hint, metavar, text in _MORE:
        action = "append" if name == "hook" else "store"
        parser.add_argument(f"--{name}", action=action, type=_reader(hint), metavar=metavar, help=text)
    for name, text in _FLAGS.items():
        parser.add_argument(f"--{name}", action="store_true", help=text)
    kind = LEARNERS[learner]
    group = parser.add_argument_group(f"options of the {learner} learner", f"{kind.title}: {kind.source}")
    add_fields(group, kind.settings, f"{learner}.", preset.get(learner, {}))
    return parser


def parse_train(argv: Sequence[str]) -> tuple[RunConfig, TrainOptions] | None:
    """The configuration asked for and the other options; None where printing the options or that was all.

    Raises:
        Failure: for unknown options, values of the wrong kind and contradictions, with exit status 2.
    """
    argv = _with_env_named(hyphenated(argv))
    known, file, rest = _peek(argv)
    preset = preset_for(str(known.env), known.learner) if str(known.preset).lower() not in ("false", "no", "0") else {}
    if known.layout not in NETWORKS:  # a preset's body is for networks
        preset = {name: value for name, value in preset.items() if name != "body"}
    has_preset = bool(preset)
    if {"-h", "--help"} & set(rest):
        print(as_typed(train_parser(known.learner, preset).format_help()))
        return None
    _refuse_other_learners(rest, known.learner)
    # A run has one learner, so that λ needs no place.
    rest = [re.sub(r"^--lambda_(?==|$)", f"--{known.learner}.lambda_", token) for token in rest]
    given = read_options(train_parser(known.learner, preset), rest)
    preset, notes = cut_to_budget(preset, {**file, **given, "learner": known.learner})
    options = TrainOptions(
        run_dir=given.pop("run_dir", None),
        tensorboard=given.pop("tensorboard", False),
        wandb=given.pop("wandb", False),
        hooks=tuple(given.pop("hook", ())),
        seeds=given.pop("seeds", None),
        workers=given.pop("workers", None),
        json=given.pop("json", False),
        preset=has_preset,
        notes=tuple(notes),
    )
    _check_counts(options)
    printed = given.pop("print_config", False)
    given.pop("preset", None)
    try:
        config = config_from_dict(_merged(known.learner, preset, file, given))
    except ValueError as error:
        raise Failure(str(error), 2) from error
    if printed:
        print(yaml.safe_dump(json.loads(json.dumps(config_to_dict(config))), sort_keys=False), end="")
        return None
    return config, options


def _check_counts(options: TrainOptions) -> None:
    for name in ("seeds", "workers"):
        number = getattr(options, name)
        if number is not None and number < 1:
            raise Failure(f"--{name} must be a whole number of at least 1, got {number}", 2)
        if number is not None and number > _MOST_SEEDS:
            raise Failure(f"--{name} must be at most {_MOST_SEEDS:,}, got a number of {number.bit_length()} bits", 2)
    if options.workers is not None and options.seeds is None:
        raise Failure("--workers says how many seeds run at a time; add --seeds or leave it out", 2)


def _merged(learner: str, preset: dict[str, Any], file: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """Preset, file and command line, the later winning; settings of the learner one by one, everything else whole."""
    short = {name: given.pop(name) for name in ("hidden", "layer_norm", "activation") if given.get(name) is not None}
    values = {**preset, **file, **given}
    if not values.get("env"):
        raise Failure("name an environment, e.g. neuralq train CartPole-v1", 2)
    layers = [layer.get(learner) or {} for layer in (preset, file, given)]
    for layer in layers:
        if not isinstance(layer, dict):
            raise Failure(f"{learner} must be a mapping, got {layer!r}", 2)
    values[learner] = {name: value for layer in layers for name, value in layer.items()}
    if "hidden" in short:
        try:
            short["hidden"] = [int(width) for width in re.split(r"[,\s]+", short["hidden"].strip("[] "))]
        except ValueError as error:
            raise Failure(f"--hidden takes whole numbers like 64,64, got {short['hidden']!r}", 2) from error
    if short:
        body = values.get("body") or {}
        if isinstance(body, str) and body in NAMED_BODIES:
            body = body_to_dict(NAMED_BODIES[body])
        elif isinstance(body, str) and ":" in body:
            body = {"class": "Custom", "module": body}
        values["body"] = {"class": "MLP", **body, **short} if isinstance(body, dict) else body
    return values

"""Options of ``neuralq train``: preset, then configuration file, then command line, the later winning."""

from __future__ import annotations

import argparse
import difflib
import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import Any

from neuralq.apps.cli import Failure
from neuralq.apps.cli.option_table import TrainOptions, train_parser
from neuralq.apps.cli.option_values import as_typed, hyphenated, read_config_file, read_options
from neuralq.apps.cli.yaml_text import write_yaml
from neuralq.q.named_bodies import NAMED_BODIES
from neuralq.runs import RunConfig
from neuralq.runs.recipe.budget import cut_to_budget
from neuralq.runs.recipe.config import LEARNERS, body_to_dict, config_from_dict, config_to_dict, layout_for
from neuralq.runs.recipe.presets import started, under, yielding
from neuralq.runs.recipe.replay_presets import AGENTS

__all__ = ["parse_train"]

_MOST_SEEDS = 10_000
_WITHOUT_VALUE = {"h", "help", "json", "debug", "tensorboard", "wandb", "doctor", "print_config"}


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
    agent = AGENTS.get(str(known.preset).lower(), {})
    for name, default in (
        ("env", ""),
        ("learner", agent.get("learner", RunConfig.learner)),
        ("layout", RunConfig.layout),
    ):
        setattr(known, name, getattr(known, name) or file.get(name) or default)
    if str(known.learner) not in LEARNERS:  # refused with the right words later
        known.learner = RunConfig.learner
    return known, file, rest


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


def _shown(known: argparse.Namespace, preset: dict[str, Any]) -> dict[str, Any]:
    """The defaults that help shows: over a table learners have some of their own."""
    kind, own = LEARNERS[known.learner], preset.get(known.learner, {})
    if layout_for(known.learner, str(known.layout)) != "table":
        return preset
    return {**preset, known.learner: asdict(kind.settings_for("table", own))}


def parse_train(argv: Sequence[str]) -> tuple[RunConfig, TrainOptions] | None:
    """The configuration asked for and the other options; None where printing the options or that was all.

    Raises:
        Failure: for unknown options, values of the wrong kind and contradictions, with exit status 2.
    """
    argv = _with_env_named(hyphenated(argv))
    known, file, rest = _peek(argv)
    preset, origin = _preset(known)
    if {"-h", "--help"} & set(rest):
        print(as_typed(train_parser(known.learner, _shown(known, preset)).format_help()))
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
        doctor=given.pop("doctor", False),
        hooks=tuple(given.pop("hook", ())),
        seeds=given.pop("seeds", None),
        workers=given.pop("workers", None),
        json=given.pop("json", False),
        preset=origin,
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
        print(write_yaml(json.loads(json.dumps(config_to_dict(config)))), end="")
        return None
    return config, options


def _preset(known: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """The preset that was asked for, or that the environment has, and what it is called."""
    asked = str(known.preset).lower()
    if asked in ("false", "no", "0"):
        return {}, ""
    name = None if asked in ("none", "true", "yes", "1") else asked
    try:
        _, preset = under({"env": known.env, "learner": known.learner, "layout": str(known.layout)}, name)
    except ValueError as error:
        raise Failure(f"--preset is true, false or the name of an agent: {error}", 2) from error
    return preset, started(str(known.env), known.learner, name) if preset else ""


def _check_counts(options: TrainOptions) -> None:
    for name in ("seeds", "workers"):
        number = getattr(options, name)
        if number is not None and number < 1:
            raise Failure(f"--{name} must be a whole number of at least 1, got {number}", 2)
        if number is not None and number > _MOST_SEEDS:
            raise Failure(f"--{name} must be at most {_MOST_SEEDS:,}, got a number of {number.bit_length()} bits", 2)
    if options.doctor and options.seeds is not None:
        raise Failure("--doctor examines one run; leave it out, and examine a seed: neuralq doctor SWEEP/seed-0", 2)
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
    own, *others = layers
    given_settings = {name: value for layer in others for name, value in layer.items()}
    values[learner] = {**yielding(own, given_settings), **given_settings}
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

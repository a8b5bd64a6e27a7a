"""Options of ``neuralq train``: preset, then configuration file, then command line, the later winning."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import MISSING, fields
from typing import Any

import yaml
from jsonargparse import ActionConfigFile, ArgumentParser, Namespace

from neuralq.recipes import RunConfig, preset_for
from neuralq.recipes.config import LAYOUTS, LEARNERS, config_from_dict

__all__ = ["hyphenated", "parse_train"]

_EXAMPLES = """examples:
  neuralq train CartPole-v1 --seed 3 --stop-at-return 475
  neuralq train CartPole-v1 --learner replay --layout separate --total-steps 50000
  neuralq train my_package:MyEnv-v0 --rollout.lambda 0.8 --hidden 64,64
  neuralq train CartPole-v1 --print_config > run.yaml; neuralq train --config run.yaml"""

_SKIPPED = {"env", "env_kwargs", "body", *LEARNERS}
_HELP: dict[str, str] = {}


def hyphenated(argv: Sequence[str]) -> list[str]:
    """``--stop-at-return`` and ``--rollout.lambda`` as the names of their fields; values are left alone.

    Example:
        >>> hyphenated(["--stop-at-return=475", "--rollout.lambda", "-1"])
        ['--stop_at_return=475', '--rollout.lambda_', '-1']
    """
    out = []
    for token in argv:
        match = re.fullmatch(r"--([A-Za-z][\w.-]*)(=.*)?", token, re.DOTALL)
        if match is None or match[1] == "print_config":
            out.append(token)
            continue
        name = re.sub(r"(^|\.)lambda$", r"\1lambda_", match[1].replace("-", "_"))
        out.append(f"--{name}{match[2] or ''}")
    return out


class _Parser(ArgumentParser):
    """Shows option names with hyphens, as they are typed."""

    def format_help(self) -> str:
        text: str = super().format_help()
        names = re.sub(r"--[a-z_.]+", lambda m: m[0].rstrip("_").replace("_", "-") if m[0] != "--print_config" else m[0], text)
        return names


def _field_help() -> dict[str, str]:
    """What each field of `RunConfig` is for, read from its docstring, so that it is written once."""
    block = (RunConfig.__doc__ or "").split("Args:")[1]
    return {m[1]: " ".join(m[2].split()) for m in re.finditer(r"\n {8}(\w+): (.*?)(?=\n {8}\w+:|\Z)", block, re.DOTALL)}


def _peek(argv: Sequence[str]) -> tuple[str, str]:
    """Environment and learner, which decide the preset and the learner's options, before the real parsing."""
    light = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    light.add_argument("--env")
    light.add_argument("--learner")
    light.add_argument("--config")
    known, _ = light.parse_known_args(list(argv))
    file: Any = {}
    if known.config is not None:
        with open(known.config, encoding="utf-8") as stream:
            file = yaml.safe_load(stream) or {}
        if not isinstance(file, dict):
            raise ValueError(f"{known.config} must hold a mapping of options, got {type(file).__name__}")
    learner = known.learner or file.get("learner", "rollout")
    return known.env or file.get("env", ""), learner if learner in LEARNERS else "rollout"


def _build(learner: str, preset: dict[str, Any]) -> ArgumentParser:
    parser = _Parser(
        prog="neuralq train ENV",
        description="Train on a Gymnasium environment by TD(λ). ENV is a registered id, or module:id for your own.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    texts = _field_help()
    parser.add_argument("--config", action=ActionConfigFile, help="YAML file of options, as --print_config writes it")
    parser.add_argument("--env", type=str, help=argparse.SUPPRESS)
    parser.add_argument("--env_kwargs", type=dict, default={}, help=texts["env_kwargs"])
    for f in fields(RunConfig):
        if f.name in _SKIPPED:
            continue
        kind: Any = {"learner": None, "layout": None}.get(f.name, _types()[f.name])
        default = None if f.default is MISSING else f.default
        if f.name == "learner":
            parser.add_argument("--learner", choices=tuple(LEARNERS), default=learner, help=texts[f.name])
        elif f.name == "layout":
            parser.add_argument("--layout", choices=LAYOUTS, default=default, help=texts[f.name])
        else:
            parser.add_argument(f"--{f.name}", type=kind, default=default, help=f"{texts[f.name]} (default: {default})")
    parser.add_argument("--body", type=dict | None, help="network body as a mapping, e.g. '{class: Conv, channels: [16]}'")
    parser.add_argument("--hidden", type=str, help="widths of the hidden layers, e.g. 64,64")
    parser.add_argument("--layer_norm", type=bool | None, help="layer normalisation in the network: true or false")
    parser.add_argument("--activation", type=str, help="relu, tanh or leaky_relu")
    parser.add_class_arguments(LEARNERS[learner], learner, help=f"options of the {learner} learner")
    parser.add_argument("--run_dir", type=str, help="folder for the run (default: one under runs/, named after it)")
    parser.add_argument("--preset", type=bool, default=True, help="use the environment's preset (default: true)")
    parser.add_argument("--tensorboard", type=bool, default=False, help="write TensorBoard event files (extra tensorboard)")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    parser.set_defaults(_flattened({k: v for k, v in preset.items() if k != "body"}))
    if "body" in preset:
        parser.set_defaults({"body": preset["body"]})
    return parser


def _types() -> dict[str, Any]:
    from typing import get_type_hints

    return get_type_hints(RunConfig)


def _flattened(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flattened(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def parse_train(argv: Sequence[str]) -> tuple[RunConfig, Namespace, bool]:
    """The configuration asked for, the options that are not part of it, and whether a preset gave defaults.

    Raises:
        ValueError: for contradictions.
        SystemExit: for help and unknown options, as argparse does.
    """
    argv = hyphenated(argv)
    # A flag with a value of its own would otherwise need "--json true".
    if argv and not argv[0].startswith("-"):
        argv = ["--env", *argv]
    env, learner = _peek(argv)
    wanted = "--preset=false" not in argv and not ("--preset" in argv and argv[argv.index("--preset") + 1 :][:1] == ["false"])
    preset = preset_for(env, learner) if wanted else {}
    parsed = _build(learner, preset).parse_args(argv)
    if not parsed.env:
        raise ValueError("name an environment, e.g. neuralq train CartPole-v1")
    values = parsed.as_dict()
    extra = Namespace(**{name: values.pop(name) for name in ("run_dir", "tensorboard", "json", "preset")})
    values.pop("config", None)
    _shorthands(values)
    return config_from_dict(values), extra, bool(preset)


def _shorthands(values: dict[str, Any]) -> None:
    """Fold --hidden, --layer-norm and --activation into the body."""
    short = {name: values.pop(name) for name in ("hidden", "layer_norm", "activation")}
    given = {name: value for name, value in short.items() if value is not None}
    if "hidden" in given:
        try:
            given["hidden"] = [int(width) for width in re.split(r"[,\s]+", given["hidden"].strip("[] "))]
        except ValueError as error:
            raise ValueError(f"--hidden takes whole numbers like 64,64, got {short['hidden']!r}") from error
    if given:
        values["body"] = {"class": "MLP", **(values.get("body") or {}), **given}
    elif values["layout"] in ("table", "linear"):
        values["body"] = None  # a preset's body is for networks

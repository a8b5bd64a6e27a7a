"""Where tuning looks: options of a run, each with its values or its range, and conditions among them.

A space is a mapping by names of options, as a person writes it in YAML:

    learning_rate: {from: 0.0001, to: 0.005, scale: log}
    batch_size: [32, 64, 128]
    target_rate: {from: 0.002, to: 0.05, scale: log, or: null}
    target_period_updates: {from: 50, to: 2000, scale: log, when: {target_rate: null}}

A list holds values; a range holds numbers, whole ones where the option counts something; ``or`` is a value beside the
range, and ``when`` names values of options further up without which this one is left as the preset has it.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import UnionType
from typing import Any, Protocol, get_args, get_type_hints

import numpy as np

from neuralq.checks import check_positive
from neuralq.q import MLP
from neuralq.runs.folder.files import as_float
from neuralq.runs.recipe.budget import cut_to_budget
from neuralq.runs.recipe.config import LEARNERS, NETWORKS, RunConfig, config_from_dict, config_to_dict
from neuralq.runs.recipe.keywords import BODY_NAMES, nested, with_body
from neuralq.runs.recipe.presets import under, yielding

__all__ = ["Drawn", "Option", "Space", "Start", "Suggests", "default_space", "read_space", "start_from"]

_DIGITS = 3
"""Of numbers that are tried: what comes out is to be read by people."""
_NOT_TUNED = frozenset(
    ("env", "env_kwargs", "learner", "seed", "total_steps", "stop_at_return", "dataset", "warm_start", "device")
) | {name for name in RunConfig.__dataclass_fields__ if name.startswith("evaluat")}
"""What decides which problem is solved, or how it is measured: scores could not be compared."""
_TRIES = 20


class Suggests(Protocol):
    """What values are asked of: a trial of Optuna's, or a generator."""

    def suggest_float(self, name: str, low: float, high: float, *, log: bool = False) -> float:
        """A number in [low, high]."""
        ...

    def suggest_int(self, name: str, low: int, high: int, *, log: bool = False) -> int:
        """A whole number in [low, high]."""
        ...

    def suggest_categorical(self, name: str, choices: Sequence[str]) -> Any:
        """One of some texts."""
        ...


@dataclass(frozen=True)
class Drawn:
    """Values drawn uniformly, on a logarithmic scale where the range has one.

    Args:
        rng: draws them.

    Example:
        >>> 1 <= Drawn(np.random.default_rng(0)).suggest_int("n", 1, 8, log=True) <= 8
        True
    """

    rng: np.random.Generator

    def suggest_float(self, name: str, low: float, high: float, *, log: bool = False) -> float:
        """A number in [low, high]."""
        value = float(np.exp(self.rng.uniform(np.log(low), np.log(high)))) if log else self.rng.uniform(low, high)
        return min(max(value, low), high)

    def suggest_int(self, name: str, low: int, high: int, *, log: bool = False) -> int:
        """A whole number in [low, high]."""
        return min(max(round(self.suggest_float(name, low - 0.499, high + 0.499, log=log)), low), high)

    def suggest_categorical(self, name: str, choices: Sequence[str]) -> str:
        """One of some texts."""
        return choices[int(self.rng.integers(len(choices)))]


@dataclass(frozen=True)
class Option:
    """An option of a run and where to look for its value.

    Args:
        name: of a field of the configuration, of its learner's settings or of the network body's.
        values: of which one is chosen; empty for a range.
        low: smallest number of a range.
        high: its largest.
        log: whether numbers are drawn on a logarithmic scale.
        whole: whether they are whole.
        beside: values that may stand in place of a number of the range.
        when: for names of options further up those of their values with which this one is looked for.
    """

    name: str
    values: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    whole: bool = False
    beside: tuple[Any, ...] = ()
    when: Mapping[str, tuple[Any, ...]] = dataclasses.field(default_factory=dict)

    @property
    def shown(self) -> str:
        """The name as people write it."""
        return self.name.rstrip("_")

    @property
    def which(self) -> str:
        """The name of the choice between the range and what may stand in its place."""
        return f"{self.shown} in range"

    def is_active(self, chosen: Mapping[str, Any]) -> bool:
        """Whether it is looked for, with the values of the options further up."""
        return all(name in chosen and chosen[name] in values for name, values in self.when.items())

    def asked_of(self, suggests: Suggests) -> Any:
        """A value that is suggested."""
        if self.values:
            return json.loads(suggests.suggest_categorical(self.shown, self.texts))
        if self.beside:
            choice = json.loads(suggests.suggest_categorical(self.which, self.texts))
            if choice != "range":
                return choice[0]
        if self.whole:
            return suggests.suggest_int(self.shown, int(self.low), int(self.high), log=self.log)
        value = float(f"{suggests.suggest_float(self.shown, self.low, self.high, log=self.log):.{_DIGITS}g}")
        return min(max(value, self.low), self.high)

    @property
    def texts(self) -> list[str]:
        """The choices as an optimiser is told them, which knows numbers and texts only."""
        if self.values:
            return [json.dumps(value) for value in self.values]
        return [json.dumps("range"), *(json.dumps([value]) for value in self.beside)]

    def told(self, value: Any) -> dict[str, Any]:
        """A value as an optimiser is told it; empty where it cannot be."""
        if self.values:
            return {self.shown: json.dumps(_plain(value))} if _plain(value) in self.values else {}
        if value in self.beside:
            return {self.which: json.dumps([value])}
        number = as_float(value)
        if not self.low <= number <= self.high:
            return {}
        chosen = {self.which: json.dumps("range")} if self.beside else {}
        return {**chosen, self.shown: int(number) if self.whole else number}

    def holding(self, value: Any) -> Option:
        """The same option, looked for where this value is, too."""
        value = _plain(value)
        if self.told(value):
            return self
        if self.values:
            return dataclasses.replace(self, values=(*self.values, value))
        number = as_float(value)
        if not np.isfinite(number) or (self.log and number <= 0):
            return dataclasses.replace(self, beside=(*self.beside, value))
        return dataclasses.replace(self, low=min(self.low, number), high=max(self.high, number))

    def plain(self) -> Any:
        """As `read_space` reads it.

        Example:
            >>> Option("step_size", low=0.1, high=1.0, log=True, beside=(None,)).plain()
            {'from': 0.1, 'to': 1.0, 'scale': 'log', 'or': None}
        """
        when = {name.rstrip("_"): list(v) if len(v) > 1 else v[0] for name, v in self.when.items()}
        if self.values:
            return {"values": list(self.values), "when": when} if when else list(self.values)
        kind = int if self.whole else float
        return {
            "from": kind(self.low),
            "to": kind(self.high),
            **({"scale": "log"} if self.log else {}),
            **({"or": self.beside[0] if len(self.beside) == 1 else list(self.beside)} if self.beside else {}),
            **({"when": when} if when else {}),
        }


@dataclass(frozen=True)
class Space:
    """Options in the order in which they are chosen.

    Args:
        options: whose conditions name options before them.
    """

    options: tuple[Option, ...]

    def asked_of(self, suggests: Suggests) -> dict[str, Any]:
        """A value for every option that is looked for, as it is suggested.

        Example:
            >>> space = Space((Option("a", values=(1, 2)), Option("b", values=(3,), when={"a": (2,)})))
            >>> [space.asked_of(Drawn(np.random.default_rng(seed))) for seed in (0, 1)]
            [{'a': 2, 'b': 3}, {'a': 1}]
        """
        chosen: dict[str, Any] = {}
        for option in self.options:
            if option.is_active(chosen):
                chosen[option.name] = option.asked_of(suggests)
        return chosen

    def told(self, chosen: Mapping[str, Any]) -> dict[str, Any]:
        """Chosen values as an optimiser is told them, without those that lie outside."""
        found: dict[str, Any] = {}
        for option in self.options:
            if option.name in chosen and option.is_active(chosen):
                found |= option.told(chosen[option.name])
        return found

    def holding(self, chosen: Mapping[str, Any]) -> Space:
        """The same space, so wide that it holds these values."""
        return Space(
            tuple(
                option.holding(chosen[option.name]) if option.name in chosen and option.is_active(chosen) else option
                for option in self.options
            )
        )

    def plain(self) -> dict[str, Any]:
        """As `read_space` reads it."""
        return {option.shown: option.plain() for option in self.options}


@dataclass(frozen=True)
class Start:
    """What every trial begins with.

    Args:
        plain: the preset's settings by name, with environment, learner and budget, as far as they are set.
    """

    plain: Mapping[str, Any]

    def config(self, chosen: Mapping[str, Any]) -> RunConfig:
        """The configuration with chosen values in place of the preset's.

        Raises:
            ValueError: they do not go together.
        """
        given = nested({"env": self.plain["env"], "learner": self.learner}, chosen)
        own = given.get(self.learner) or {}
        merged = {self.learner: {**yielding(self.plain.get(self.learner) or {}, own), **own}}
        return config_from_dict(with_body({**self.plain, **given, **merged}))

    def plain_config(self, chosen: Mapping[str, Any]) -> dict[str, Any]:
        """The same as plain values, as they come back from a file."""
        plain: dict[str, Any] = json.loads(json.dumps(config_to_dict(self.config(chosen))))
        return plain

    @property
    def learner(self) -> str:
        """The learner's name."""
        return str(self.plain["learner"])

    def values(self, names: Sequence[str]) -> dict[str, Any]:
        """The values that options have without anything chosen.

        Example:
            >>> start_from("CartPole-v1").values(["num_envs", "gamma", "hidden"])
            {'num_envs': 16, 'gamma': 0.99, 'hidden': [64, 64]}
        """
        config = self.config({})
        body = config.body if config.body is not None else MLP()
        places = (config.settings, config, body)
        found = ((name, next((p for p in places if hasattr(p, name)), None)) for name in names)
        return {name: _plain(getattr(place, name)) for name, place in found if place is not None}


def start_from(env: str, learner: str | None = None, total_steps: int | None = None) -> Start:
    """The preset of an environment and a learner, for a budget; the defaults where there is no preset.

    Raises:
        ValueError: there is no such learner.
    """
    given: dict[str, Any] = {"env": env}
    given |= {"learner": learner} if learner is not None else {}
    given |= {"total_steps": total_steps} if total_steps is not None else {}
    name, preset = under(given)
    preset, _ = cut_to_budget(preset, {**given, "learner": name})
    return Start(json.loads(json.dumps({**preset, **given, "learner": name})))


def default_space(start: Start, has_images: bool = False) -> Space:
    """The options that the learner's record names, and what matters with any learner, around what a run begins with.

    Args:
        start: what a run begins with.
        has_images: whether observations are images, for which another body is made than for vectors.

    Example:
        >>> [option.shown for option in default_space(start_from("FrozenLake-v1", "tabular")).options][:3]
        ['algorithm', 'schedule', 'step_size']
    """
    config = start.config({})
    plain: dict[str, Any] = {**config.kind.space, "gamma": [0.95, 0.98, 0.99, 0.995, 0.999]}
    if config.kind.experience != "table" and not config.kind.normalises(config.settings)[1]:
        plain["reward_scale"] = {"from": config.reward_scale / 10, "to": config.reward_scale * 10, "scale": "log"}
    most = max(config.total_steps // 2, 1)
    plain["epsilon_end"] = {"from": 0.005, "to": 0.2, "scale": "log"}
    plain["epsilon_decay_steps"] = {"from": max(most // 25, 1), "to": most, "scale": "log"}
    body = config.body or MLP()
    if config.layout in NETWORKS and isinstance(body, MLP) and not (config.body is None and has_images):
        plain["hidden"] = [[64, 64], [128, 128], [256, 256]]
        if body.affine:  # says how layers are normalised, and goes with no others
            plain["layer_norm"] = [True, False]
    space = Space(tuple(_options(plain, config.learner)))
    return space.holding(start.values([option.name for option in space.options]))


def read_space(plain: Any, start: Start) -> Space:
    """The space that a person has written, as `Space.plain` writes it.

    Raises:
        ValueError: it cannot be read, or a value in it goes with nothing else in it.

    Example:
        >>> read_space({"learning_rate": {"from": 1e-4, "to": 1e-2}}, start_from("CartPole-v1")).options[0].high
        0.01
    """
    if not isinstance(plain, Mapping) or not plain:
        raise ValueError(f"a space must be a mapping by names of options, got {plain!r}")
    space = Space(tuple(_options(plain, start.learner)))
    for option in space.options:
        for value in [*option.values, *option.beside, *(() if option.values else (option.low, option.high))]:
            _check_goes(space, option, value, start)
    return space


def _options(plain: Mapping[str, Any], learner: str) -> Iterator[Option]:
    hints = _hints(learner)
    found: dict[str, Option] = {}
    for shown, given in plain.items():
        name = "lambda_" if shown == "lambda" else str(shown)
        if name not in hints:
            close = difflib.get_close_matches(name, hints, 1)
            hint = f"did you mean {close[0].rstrip('_')}?" if close else f"there are {', '.join(sorted(hints))}"
            raise ValueError(f"there is no option {shown!r} to be tuned with the {learner} learner; {hint}")
        found[name] = _option(name, given, hints[name], found)
    yield from found.values()


def _hints(learner: str) -> dict[str, Any]:
    """What can be tuned, with the kinds of the values."""
    general = {name: hint for name, hint in get_type_hints(RunConfig).items() if name not in {*_NOT_TUNED, *LEARNERS}}
    body = {name: hint for name, hint in get_type_hints(MLP).items() if name in BODY_NAMES}
    return {**general, **body, **get_type_hints(LEARNERS[learner].settings)}


def _option(name: str, given: Any, hint: Any, before: Mapping[str, Option]) -> Option:
    if not isinstance(given, Mapping):
        given = {"values": given}
    shown = name.rstrip("_")
    known = ("values", "when") if "values" in given else ("from", "to", "scale", "or", "when")
    if unknown := [key for key in given if key not in known]:
        raise ValueError(f"{shown} has {unknown[0]!r}, which is none of {', '.join(known)}")
    when = {("lambda_" if k == "lambda" else k): _several(v) for k, v in (given.get("when") or {}).items()}
    for other in when:
        if other not in before:
            raise ValueError(f"{shown} depends on {other!r}, which must stand above it in the space")
    if "values" in given:
        if not (values := _several(given["values"])):
            raise ValueError(f"{shown} has no values; name one or more, or leave it out")
        return Option(name, values=values, when=when)
    kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    low, high = (as_float(given.get(end)) for end in ("from", "to"))
    if not low <= high or not np.isfinite([low, high]).all() or not {int, float} & set(kinds):
        raise ValueError(f"{shown} needs numbers from … to …, the smaller first, or a list of values, got {given!r}")
    if given.get("scale", "log") != "log":
        raise ValueError(f"the scale of {shown} must be log, or left out, got {given['scale']!r}")
    if "scale" in given:
        check_positive(f"the begin of the logarithmic range of {shown}", low)
    whole = int in kinds and float not in kinds
    if whole and not (low.is_integer() and high.is_integer()):
        raise ValueError(f"{shown} takes whole numbers, got {given!r}")
    beside = _several(given["or"]) if "or" in given else ()
    return Option(name, low=low, high=high, log="scale" in given, whole=whole, beside=beside, when=when)


def _several(given: Any) -> tuple[Any, ...]:
    return tuple(_plain(given)) if isinstance(given, list | tuple) else (given,)


def _plain(value: Any) -> Any:
    return [_plain(one) for one in value] if isinstance(value, list | tuple) else value


def _check_goes(space: Space, option: Option, value: Any, start: Start) -> None:
    """There is something in the space that goes with a value.

    Raises:
        ValueError: otherwise.
    """
    reason, rng = f"no values above it fulfil its condition {dict(option.when)}", np.random.default_rng(0)
    fixed = {option.name: (int(value) if option.whole and value not in option.beside else value)}
    for _ in range(_TRIES):
        chosen = space.asked_of(Drawn(rng))
        if option.name not in chosen:
            continue
        try:
            start.config(_again(space, chosen, fixed))
            return
        except (ValueError, TypeError) as error:
            reason = str(error)
    raise ValueError(f"{option.shown} cannot be {value!r}: {reason}")


def _again(space: Space, chosen: Mapping[str, Any], fixed: Mapping[str, Any]) -> dict[str, Any]:
    """The chosen values with one of them another, without those whose condition that breaks."""
    found: dict[str, Any] = {}
    for option in space.options:
        if option.name in chosen and option.is_active(found):
            found[option.name] = fixed.get(option.name, chosen[option.name])
    return found

"""A request for the lab, checked: what it may hold, and the words for what it may not.

Infinite numbers are refused, as are numbers where a word belongs, words where a number belongs, and names that mean
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

from neuralq.apps.web.catalogue import FIELDS, SAMPLINGS, critical_parameters, field_of
from neuralq.lab.methods import METHODS, Method, Option, method
from neuralq.lab.problems import PROBLEMS

__all__ = ["ANSWERS", "read_request"]

Spec = dict[str, Any]


def read_request(kind: str, given: Mapping[str, Any]) -> Spec:
    """The request with every field present and checked.

    Args:
        kind: one of `ANSWERS`.
        given: the object sent.

    Raises:
        ValueError: a field that is missing, unknown, of the wrong type or out of range; the message says which.

    Example:
        >>> read_request("prescribe", {"problem": "baird", "gamma": 0.99, "step_size": 0.01})
        {'problem': 'baird', 'gamma': 0.99, 'step_size': 0.01}
        >>> read_request("prescribe", {"problem": "baird", "gamma": 2, "step_size": 0.01})
        Traceback (most recent call last):
        ValueError: gamma must be a number from 0 to 1, got 2
    """
    return ANSWERS[kind](given)


def _diagnose(given: Mapping[str, Any]) -> Spec:
    return _setting(given, ())


def _run(given: Mapping[str, Any]) -> Spec:
    spec = _setting(given, ("num_steps", "num_seeds"))
    if spec["sampling"] == "expected":
        spec["num_seeds"] = 1
    return spec


def _critical(given: Mapping[str, Any]) -> Spec:
    spec = _setting(given, ("parameter",))
    spec["parameter"] = _choice(given, "parameter", critical_parameters(method(spec["method"])))
    return spec


def _prescribe(given: Mapping[str, Any]) -> Spec:
    _known(given, ("problem", "gamma", "step_size"))
    return _place(given)


ANSWERS: dict[str, Callable[[Mapping[str, Any]], Spec]] = {
    "diagnose": _diagnose,
    "run": _run,
    "critical": _critical,
    "prescribe": _prescribe,
}
"""Every kind of request with its check."""


def _setting(given: Mapping[str, Any], more: Collection[str]) -> Spec:
    """A method on a problem."""
    _known(given, ("problem", "gamma", "step_size", "method", "sampling", "options", *more))
    spec = _place(given)
    chosen = method(_choice(given, "method", [one.name for one in METHODS if one.expected is not None]))
    spec["method"] = chosen.name
    spec["sampling"] = _choice(given, "sampling", SAMPLINGS)
    spec["options"] = _options(chosen, given.get("options", {}))
    for name in more:
        if name in FIELDS:
            spec[name] = int(_number(given, name, FIELDS[name]))
    return spec


def _place(given: Mapping[str, Any]) -> Spec:
    spec: Spec = {"problem": _choice(given, "problem", [entry.name for entry in PROBLEMS])}
    for name in ("gamma", "step_size"):
        spec[name] = _number(given, name, FIELDS[name])
    return spec


def _options(chosen: Method, given: Any) -> dict[str, float]:
    if not isinstance(given, dict):
        raise ValueError(f"options must be an object, got {type(given).__name__}")
    for name in given:
        if name not in chosen.options:
            chosen.checked({_short(name): 0.0})  # refuses it
    return {**chosen.defaults, **{name: _number(given, name, field_of(chosen, name)) for name in given}}


def _known(given: Mapping[str, Any], names: Collection[str]) -> None:
    for name in given:
        if name not in names:
            raise ValueError(f"there is no field {_short(name)!r}; there are {', '.join(names)}")


def _choice(given: Mapping[str, Any], name: str, choices: Collection[str]) -> str:
    value = given.get(name)
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {_shown(value)}")
    return value


def _number(given: Mapping[str, Any], name: str, field: Option) -> float:
    value = given.get(name)
    wrong = f"{name} must be {field.range_text}, got {_shown(value)}"
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(wrong)
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        raise ValueError(wrong) from None
    if not (math.isfinite(number) and field.accepts(number)):
        raise ValueError(wrong)
    return number


def _shown(value: Any) -> str:
    return "nothing" if value is None else _short(str(value) if isinstance(value, bool) else f"{value}")


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."

"""What can be chosen on the page: problems, methods, and the range of every number."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

from neuralq.lab.methods import METHODS, Method, Option
from neuralq.lab.plain import fields_of
from neuralq.lab.problems import PROBLEMS, Problem, problem
from neuralq.lab.verdicts.critical import CRITICAL_PARAMETERS
from neuralq.lab.verdicts.remedies import usual_method

__all__ = ["FIELDS", "SAMPLINGS", "catalogue", "critical_parameters", "field_of", "problem_named"]

SAMPLINGS = ("expected", "iid", "markov")
FIELDS = {
    "gamma": Option(0.99, 0.0, 1.0, "γ, discount"),
    "step_size": Option(0.01, 1e-6, 10.0, "α, step size", "log", most=1e6),
    "num_steps": Option(1000, 10, 20_000, "updates in the run", "whole", least=1),
    "num_seeds": Option(20, 1, 50, "independent runs", "whole"),
}
"""Numbers that every method has."""

_MOST = {"num_steps": 256, "period": 1024}
"""What a visitor may ask of a method at most, where more would keep a worker busy for long."""


def field_of(method: Method, option: str) -> Option:
    """What a request may hold for an option of a method.

    Example:
        >>> from neuralq.lab.methods import method
        >>> field_of(method("etd"), "beta").range_text, field_of(method("n-step"), "num_steps").range_text
        ('a number from 0 to 1 (or -1 for γ)', 'a whole number from 1 to 256')
    """
    own = method.options[option]
    return replace(own, most=min(own.largest, _MOST.get(option, own.largest)))


def critical_parameters(method: Method) -> list[str]:
    """Parameters whose critical value can be asked for, with this method."""
    return ["gamma", "step_size", *(name for name in method.options if name in CRITICAL_PARAMETERS)]


@lru_cache(maxsize=len(PROBLEMS))
def problem_named(name: str) -> Problem:
    """The problem of this name; the same object every time, for it is frozen and some take a second to build."""
    return problem(name)


@lru_cache(maxsize=1)
def catalogue() -> dict[str, Any]:
    """All that can be chosen, as JSON.

    Example:
        >>> [one["name"] for one in catalogue()["problems"]][:2]
        ['baird', 'baird-1995']
    """
    return {
        "problems": [_problem_entry(entry.name, problem_named(entry.name)) for entry in PROBLEMS],
        "methods": [_method_entry(one) for one in METHODS if one.expected is not None],
        "fields": {name: field.plain() for name, field in FIELDS.items()},
        "samplings": list(SAMPLINGS),
    }


def _problem_entry(name: str, one: Problem) -> dict[str, Any]:
    return {
        **fields_of(one, "source", "known", "gamma", "step_size", "num_weights"),
        "name": name,
        "title": one.title or name,
        "num_states": one.mdp.num_states,
        "pairs": one.learns_q,
        "method": usual_method(one),
        "nonlinear": one.value is not None,
    }


def _method_entry(one: Method) -> dict[str, Any]:
    return {
        **fields_of(one, "name", "title", "source", "note"),
        "pairs": one.rows == "pairs",
        "sampled": one.learner is not None,
        "options": [{"name": name, "value": own.default, **own.plain()} for name, own in one.options.items()],
        "critical": critical_parameters(one),
    }

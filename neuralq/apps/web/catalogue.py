"""What can be chosen on the page: problems, methods, and the range of every number.

A range is what a request may hold; ``low`` to ``high`` of a slider is the useful part of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from neuralq.lab.methods import METHODS, Method
from neuralq.lab.problems import PROBLEMS, Problem, problem
from neuralq.lab.verdicts.critical import CRITICAL_PARAMETERS

__all__ = ["FIELDS", "SAMPLINGS", "Field", "catalogue", "critical_parameters", "field_of", "problem_named"]

SAMPLINGS = ("expected", "iid", "markov")


@dataclass(frozen=True)
class Field:
    """A number that a request may hold, and the slider that sets it.

    Args:
        label: shown beside the slider.
        low: left end of the slider.
        high: right end.
        spacing: ``"linear"``, ``"log"`` or ``"whole"`` (whole numbers, spaced by factors).
        least: smallest value accepted; ``low`` where None.
        most: largest value accepted; ``high`` where None.
        special: a value outside the range with a meaning of its own.
        special_label: that meaning.

    Example:
        >>> Field("τ", 1e-6, 1.0, "log").accepts(0.5), Field("n", 1, 64, "whole").accepts(1.5)
        (True, False)
    """

    label: str
    low: float
    high: float
    spacing: str
    least: float | None = None
    most: float | None = None
    special: float | None = None
    special_label: str = ""

    def accepts(self, value: float) -> bool:
        """Whether a request may hold this value."""
        if self.special is not None and value == self.special:
            return True
        low = self.low if self.least is None else self.least
        high = self.high if self.most is None else self.most
        return low <= value <= high and (self.spacing != "whole" or value == int(value))

    @property
    def range_text(self) -> str:
        """The values accepted, in words."""
        low = self.low if self.least is None else self.least
        high = self.high if self.most is None else self.most
        kind = "a whole number" if self.spacing == "whole" else "a number"
        or_special = "" if self.special is None else f" (or {self.special:g} for {self.special_label})"
        return f"{kind} from {low:g} to {high:g}{or_special}"


_RATIO = "linear"
FIELDS = {
    "gamma": Field("γ, discount", 0.0, 1.0, _RATIO),
    "step_size": Field("α, step size", 1e-6, 10.0, "log", least=1e-12, most=1e6),
    "num_steps": Field("updates in the run", 10, 20_000, "whole", least=1),
    "num_seeds": Field("independent runs", 1, 50, "whole"),
}
"""Numbers that every method has."""

_OPTIONS = {
    "lambda_": Field("λ, trace", 0.0, 1.0, _RATIO),
    "eta": Field("η, penalty on the weights", 0.0, 2.0, _RATIO, most=1e6),
    "phi": Field("φ, share of the residual gradient", 0.0, 1.0, _RATIO),
    "tracking": Field("tracking weight", 1e-4, 1.0, "log", least=1e-9),
    "margin": Field("margin", 0.0, 1.0, _RATIO),
    "beta_over_alpha": Field("β/α, second time scale", 1e-2, 1e3, "log", least=1e-6, most=1e6),
    "beta": Field("β, regularisation of h", 0.0, 2.0, _RATIO, most=1e6),
    "num_steps": Field("n, steps before bootstrapping", 1, 64, "whole", most=256),
    "rho_bar": Field("ρ̄, cap on the ratio", 0.1, 10.0, "log", least=1e-9, most=1e9),
    "c_bar": Field("c̄, cap on the trace's ratio", 0.1, 10.0, "log", least=1e-9, most=1e9),
    "period": Field("period of the copy", 1, 1024, "whole"),
    "tau": Field("τ, averaging", 1e-4, 1.0, "log", least=1e-9),
    "ball_w": Field("radius of the ball of w", 1.0, 1e3, "log", least=1e-6, most=1e9),
    "ball_u": Field("radius of the ball of the target", 1.0, 1e3, "log", least=1e-6, most=1e9),
    "epsilon": Field("ε, exploration", 0.0, 1.0, _RATIO),
}
_EMPHATIC_BETA = Field("β, decay of the follow-on", 0.0, 1.0, _RATIO, special=-1.0, special_label="γ")


def field_of(method: Method, option: str) -> Field:
    """The field of an option of a method.

    Example:
        >>> from neuralq.lab.methods import method
        >>> field_of(method("etd"), "beta").range_text
        'a number from 0 to 1 (or -1 for γ)'
    """
    return _EMPHATIC_BETA if (method.name, option) == ("etd", "beta") else _OPTIONS[option]


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
        "fields": {name: _field_entry(field) for name, field in FIELDS.items()},
        "samplings": list(SAMPLINGS),
    }


def _problem_entry(name: str, one: Problem) -> dict[str, Any]:
    return {
        "name": name,
        "title": one.title or name,
        "source": one.source,
        "known": one.known,
        "gamma": one.gamma,
        "step_size": one.step_size,
        "num_states": one.mdp.num_states,
        "num_weights": one.num_weights,
        "pairs": one.learns_q,
        "method": ("sarsa" if one.exploration is not None else "q-learning") if one.control else "td",
        "nonlinear": one.value is not None,
    }


def _method_entry(one: Method) -> dict[str, Any]:
    return {
        "name": one.name,
        "title": one.title,
        "source": one.source,
        "note": one.note,
        "pairs": one.rows == "pairs",
        "sampled": one.learner is not None,
        "options": [
            {"name": name, "value": value, **_field_entry(field_of(one, name))} for name, value in one.options.items()
        ],
        "critical": critical_parameters(one),
    }


def _field_entry(field: Field) -> dict[str, Any]:
    return {
        "label": field.label,
        "low": field.low,
        "high": field.high,
        "spacing": field.spacing,
        "special": field.special,
        "special_label": field.special_label,
    }

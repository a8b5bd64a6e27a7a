"""What the lab says to a checked request, as JSON without NaN and without infinity."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from neuralq.apps.web.catalogue import problem_named
from neuralq.lab.linear.process import linear_process
from neuralq.lab.methods import method
from neuralq.lab.plain import plain
from neuralq.lab.problems import Problem
from neuralq.lab.trial import run
from neuralq.lab.verdicts.critical import StabilityScan, scan
from neuralq.lab.verdicts.diagnosis import diagnose
from neuralq.lab.verdicts.remedies import Remedy, prescribe

__all__ = ["answer"]

Spec = Mapping[str, Any]
Json = dict[str, Any]

MOST_WEIGHTS = 12
"""Weights drawn over time; of more, the first."""

MOST_EIGENVALUES = 400
"""Eigenvalues drawn; of more, the largest."""

_UNSAID = ("problem", "method", "options", "sampling", "step_size", "drift")  # the page knows them, or has no use


def answer(kind: str, spec: Spec) -> Json:
    """The answer to a request that `neuralq.apps.web.requests.read_request` has checked.

    Raises:
        ValueError: the method cannot be looked at on this problem; the message says why.

    Example:
        >>> spec = {"problem": "baird", "gamma": 0.99, "step_size": 0.01, "method": "td", "sampling": "expected"}
        >>> answer("diagnose", {**spec, "options": {}})["verdict"]
        'diverges'
    """
    where = replace(problem_named(spec["problem"]), gamma=spec["gamma"], step_size=spec["step_size"])
    return _ANSWERS[kind](where, spec)


def _diagnose(where: Problem, spec: Spec) -> Json:
    found = diagnose(where, spec["method"], None, spec["sampling"], **spec["options"])
    shown = {name: one for name, one in found.plain().items() if name not in _UNSAID}
    return shown | {
        "eigenvalues": shown["eigenvalues"][:MOST_EIGENVALUES],
        **{name: _bound(getattr(found, name)) for name in ("step_size_bound", "step_size_bound_second_moment")},
        **{name: plain(found.rounded(getattr(found, name))) for name in ("fixed_point_error", "best_error")},
    }


def _run(where: Problem, spec: Spec) -> Json:
    if where.value is not None:
        raise ValueError(f"the values of {where.name} are not linear in its weights, so that no run is drawn")
    went = run(
        where, spec["method"], spec["num_steps"], None, spec["sampling"], spec["num_seeds"], 0, spec["options"]
    )  # fmt: skip
    shown = {
        name: one for name, one in went.plain().items() if name in ("steps", "num_seeds", "num_diverged", "growth")
    }
    return shown | {
        "rmsve": plain(went.quantiles().T),
        "rmspbe": plain(went.quantiles([0.5], of="rmspbe")[:, 0]),
        "weights": plain(went.path[:, :MOST_WEIGHTS].T),
        "num_weights": where.num_weights,
    }


def _critical(where: Problem, spec: Spec) -> Json:
    parameter, options = spec["parameter"], dict(spec["options"])
    if parameter == "step_size":
        found = diagnose(where, spec["method"], None, spec["sampling"], **options)
        return {
            "parameter": parameter,
            "bound": _bound(found.step_size_bound),
            "bound_second_moment": _bound(found.step_size_bound_second_moment),
        }
    options.pop(parameter, None)
    chosen = method(spec["method"])
    here = scan(where, parameter, chosen.name, where.step_size, **options)
    reply: Json = {"parameter": parameter, **_stable(here), "limit": None}
    assert chosen.expected is not None
    if chosen.expected(linear_process(where), chosen.checked(options)).generator is not None:
        reply["limit"] = _stable(scan(where, parameter, chosen.name, None, **options))
    return reply


def _stable(found: StabilityScan) -> Json:
    return {name: one for name, one in found.plain().items() if name in ("range", "boundaries", "stable")}


def _prescribe(where: Problem, spec: Spec) -> Json:
    return {"remedies": [_remedy(remedy) for remedy in prescribe(where)]}


def _remedy(remedy: Remedy) -> Json:
    kept = ("kind", "change", "margin", "options", "step_size", "scatters", "spectral_radius", "updates_to_tenth")
    found = remedy.diagnosis
    return {name: one for name, one in remedy.plain().items() if name in kept} | {
        "change": remedy.change[0].upper() + remedy.change[1:],
        "text": remedy.explain(),
        "error": plain(found.rounded(found.fixed_point_error)),
        "method": None if remedy.kind == "distribution" else remedy.method,
        "verdict": remedy.diagnosis.verdict,
    }


_ANSWERS: dict[str, Callable[[Problem, Spec], Json]] = {
    "diagnose": _diagnose,
    "run": _run,
    "critical": _critical,
    "prescribe": _prescribe,
}


def _bound(value: float | None) -> Json:
    """A bound that may be infinite: then every step size will do."""
    return {"value": plain(value), "every": value is not None and math.isinf(value)}

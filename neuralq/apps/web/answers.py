"""What the lab says to a checked request, as JSON without NaN and without infinity."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from neuralq.apps.web.catalogue import problem_named
from neuralq.lab.linear.process import linear_process
from neuralq.lab.methods import method
from neuralq.lab.problems import Problem
from neuralq.lab.trial import run
from neuralq.lab.verdicts.critical import StabilityScan, scan
from neuralq.lab.verdicts.diagnosis import Diagnosis, diagnose
from neuralq.lab.verdicts.remedies import Remedy, prescribe
from neuralq.types import Floats

__all__ = ["answer"]

Spec = Mapping[str, Any]
Json = dict[str, Any]

MOST_WEIGHTS = 12
"""Weights drawn over time; of more, the first."""

MOST_EIGENVALUES = 400
"""Eigenvalues drawn; of more, the largest."""


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
    return _diagnosis(diagnose(where, spec["method"], None, spec["sampling"], **spec["options"]))


def _diagnosis(found: Diagnosis) -> Json:
    small = 1e-9 * max(found.scale or 0.0, 1.0)  # less than this is rounding
    factors = found.eigenvalues[np.isfinite(found.eigenvalues)][:MOST_EIGENVALUES]
    return {
        "verdict": found.verdict,
        "converges": found.converges,
        "explanation": found.explain(),
        "eigenvalues": [[float(one.real), float(one.imag)] for one in factors],
        "rank": found.rank,
        "spectral_radius": _finite(found.spectral_radius),
        "second_moment_radius": _finite(found.second_moment_radius),
        "step_size_bound": _bound(found.step_size_bound),
        "step_size_bound_second_moment": _bound(found.step_size_bound_second_moment),
        "oscillates": found.oscillates,
        "doubling_time": _finite(found.doubling_time),
        "fixed_point": None if found.fixed_point is None else _row(found.fixed_point),
        "fixed_point_error": _error(found.fixed_point_error, small),
        "best_error": _error(found.best_error, small),
        "distance_to_singularity": _finite(found.distance_to_singularity),
        "updates": found.updates,
        "local": found.local,
    }


def _run(where: Problem, spec: Spec) -> Json:
    if where.value is not None:
        raise ValueError(f"the values of {where.name} are not linear in its weights, so that no run is drawn")
    went = run(
        where, spec["method"], spec["num_steps"], None, spec["sampling"], spec["num_seeds"], 0, spec["options"]
    )  # fmt: skip
    shown = went.path[:, :MOST_WEIGHTS]
    growth = went.growth
    return {
        "steps": [int(step) for step in went.steps],
        "rmsve": [_row(column) for column in went.quantiles().T],
        "rmspbe": _row(went.quantiles([0.5], of="rmspbe")[:, 0]),
        "weights": [_row(column) for column in shown.T],
        "num_weights": where.num_weights,
        "num_seeds": went.rmsve.shape[1],
        "num_diverged": int(went.diverged.sum()),
        "growth": _finite(growth),
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
    return {
        "range": [float(found.values[0]), float(found.values[-1])],
        "boundaries": [float(value) for value in found.boundaries],
        "stable": [list(interval) for interval in found.stable],
    }


def _prescribe(where: Problem, spec: Spec) -> Json:
    return {"remedies": [_remedy(remedy) for remedy in prescribe(where)]}


def _remedy(remedy: Remedy) -> Json:
    return {
        "kind": remedy.kind,
        "text": remedy.explain(),
        "method": None if remedy.kind == "distribution" else remedy.method,
        "options": dict(remedy.options),
        "step_size": remedy.step_size,
        "scatters": remedy.scatters,
        "verdict": remedy.diagnosis.verdict,
        "spectral_radius": _finite(remedy.diagnosis.spectral_radius),
    }


_ANSWERS: dict[str, Callable[[Problem, Spec], Json]] = {
    "diagnose": _diagnose,
    "run": _run,
    "critical": _critical,
    "prescribe": _prescribe,
}


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _error(value: float | None, small: float) -> float | None:
    return 0.0 if value is not None and value < small else _finite(value)


def _bound(value: float | None) -> Json:
    """A bound that may be infinite: then every step size will do."""
    return {"value": _finite(value), "every": value is not None and math.isinf(value)}


def _row(values: Floats) -> list[float | None]:
    return [_finite(float(value)) for value in values]

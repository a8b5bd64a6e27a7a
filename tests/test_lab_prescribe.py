"""Remedies: each one is trained, each smaller change is shown not to be enough, and the order is what it says.

Mutants that die here: a recommendation on the wrong side of its edge; a remedy listed although it diverges; the error
of another distribution's fixed point; variance left out of the order; a remedy for a problem that needs none.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from neuralq.lab.problems import problem
from neuralq.lab.trial import run
from neuralq.lab.verdicts.remedies import Remedy, _rank, prescribe


@pytest.fixture(scope="module", params=["baird", "emphatic"])
def remedies(request: pytest.FixtureRequest) -> list[Remedy]:
    return prescribe(problem(request.param))


@pytest.mark.slow
def test_each_remedy_trains(remedies: list[Remedy]) -> None:
    assert len(remedies) >= 9
    for one in remedies:
        trained = run(one.problem, one.method, 10**9, one.step_size, options=one.options)
        assert not trained.diverged.any(), one.change
        # Every weight vector that TD can settle on is right in these two problems: the values are representable.
        assert trained.rmsve[-1, 0] < 1e-6 * trained.rmsve[0, 0], one.change


def test_td_without_a_remedy_diverges(remedies: list[Remedy]) -> None:
    one = remedies[0]
    assert run(problem(one.problem.name), "td", 10**9, one.step_size).diverged.all()


def test_less_of_a_change_is_not_enough(remedies: list[Remedy]) -> None:
    for one in remedies:
        if one.critical is None or one.kind == "step_size":
            continue
        edge = one.critical
        short = {"period": edge - 1, "num_steps": edge - 1, "tau": min(edge * 1.01, 1.0)}.get(one.kind, edge * 0.99)
        trained = run(one.problem, one.method, 10**9, one.step_size, options={**one.options, one.kind: float(short)})
        assert trained.diverged.any(), one.change


def test_the_best_comes_first(remedies: list[Remedy]) -> None:
    assert [one.scatters for one in remedies] == sorted(one.scatters for one in remedies)
    calm = [one.updates_to_tenth for one in remedies if not one.scatters]
    assert calm == sorted(calm)  # every fixed point is exact here, so speed decides
    emphatic = next(one for one in remedies if one.method == "etd")
    # γ² E[ρ²]: .99²·7 on the star and .9²·2 on the two-state problem, by hand.
    expected = 0.99**2 * 7 if emphatic.problem.name == "baird" else 0.9**2 * 2
    assert emphatic.second_moment_radius == pytest.approx(expected, rel=1e-9)
    assert emphatic.scatters and "scatter" in emphatic.explain()


def test_what_it_says_of_speed_is_what_training_shows(remedies: list[Remedy]) -> None:
    for one in remedies:
        if one.updates_to_tenth < 1e5 and one.kind != "period" and one.diagnosis.spectral_radius > 0:
            late = math.ceil(5 * one.updates_to_tenth)
            errors = [
                run(one.problem, one.method, n, one.step_size, options=one.options).rmsve[-1, 0]
                for n in (late, late + math.ceil(one.updates_to_tenth))
            ]
            if errors[0] > 1e-9 and not one.diagnosis.oscillates:
                assert errors[1] / errors[0] == pytest.approx(0.1, rel=0.2), one.change


def test_a_poor_fixed_point_ranks_below_a_good_one() -> None:
    found = prescribe(problem("kolter"))
    error = {one.kind: one.diagnosis.fixed_point_error for one in found}
    assert error["distribution"] is not None and error["eta"] is not None
    assert error["distribution"] < error["eta"]
    kinds = [one.kind for one in found]
    assert kinds.index("distribution") < kinds.index("eta")


def test_a_fixed_point_ranks_by_half_and_by_ten_times_the_best_error() -> None:
    one = next(one for one in prescribe(problem("kolter")) if one.diagnosis.fixed_point_error is not None)

    def rank(error: float) -> int:
        found = dataclasses.replace(one.diagnosis, fixed_point_error=error, best_error=1.0, scale=1.0)
        return _rank(dataclasses.replace(one, diagnosis=found))[1]

    assert [rank(error) for error in (1.0, 1.4, 1.6, 9.9, 10.1, 1e9)] == [0, 0, 1, 1, 2, 2]


def test_nothing_is_prescribed_where_nothing_is_wrong() -> None:
    assert prescribe(problem("baird-tabular")) == []


def test_steps_that_are_merely_too_long() -> None:
    found = prescribe(problem("baird-tabular"), step_size=20.0)
    shorter = next(one for one in found if one.kind == "step_size")
    # The table's matrix is (I − γP)/7, P all into the lower state: eigenvalues 1/7 and .01/7, so α < 14.
    assert shorter.critical == pytest.approx(14.0, rel=1e-9)
    assert shorter.step_size == pytest.approx(7.0, rel=1e-9)


def test_control_gets_methods_for_control() -> None:
    assert [one.method for one in prescribe(problem("baird-control"))] == ["greedy-gq"]


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="step_size must be a finite number above 0"):
        prescribe(problem("baird"), step_size=float("nan"))
    with pytest.raises(ValueError, match="not linear in its weights"):
        prescribe(problem("spiral"))
    assert np.isfinite([len(one.explain()) for one in prescribe(problem("chattering"))]).all()

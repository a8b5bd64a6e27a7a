"""Remedies: each one is trained, each smaller change is shown not to be enough, and the order is what it says.

Mutants that die here: a recommendation on the wrong side of its edge; a remedy listed although it diverges; the error
of another distribution's fixed point; variance left out of the order; a remedy for a problem that needs none.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from neuralq.lab.problems import problem
from neuralq.lab.trial import run
from neuralq.lab.verdicts import remedies as remedies_module
from neuralq.lab.verdicts.critical import StabilityScan
from neuralq.lab.verdicts.diagnosis import diagnose
from neuralq.lab.verdicts.remedies import (
    Remedy,
    _on_policy,
    _rank,
    _round,
    _smaller_steps,
    _some_way_on,
    prescribe,
    usual_method,
)
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem


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


def test_of_two_stable_ranges_the_one_at_the_usual_end_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stable from 1 to 2 and from 5 to 9: τ is lowered from the upper end, all else raised from the lower."""
    taken: dict[str, tuple[float, float]] = {}

    def two_ranges(problem: Problem, parameter: str, step_size: float) -> StabilityScan:
        values, margins = np.array([1.0, 9.0]), np.ones(2)
        return StabilityScan("toy", "td", parameter, step_size, values, margins, (2.0, 5.0))

    def note(
        kind: str, problem: Problem, chosen: Any, options: dict[str, float], alpha: float, edge: float, *_: str
    ) -> None:
        taken[kind] = (edge, round(options[kind], 3))

    monkeypatch.setattr(remedies_module, "scan", two_ranges)
    monkeypatch.setattr(remedies_module, "_remedy", note)
    list(remedies_module._parameters(problem("baird"), 0.1))
    low = {"lambda_": 1.1, "eta": 1.072, "phi": 1.1, "num_steps": 2.0, "period": 2.0, "beta_over_alpha": 1.072}
    assert taken == {**{name: (1.0, value) for name, value in low.items()}, "tau": (9.0, 8.486)}


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


def by_hand(**changes: Any) -> Remedy:
    """A remedy whose mean error shrinks by .5 in every update."""
    found = diagnose(problem("baird-tabular"))
    names = ("spectral_radius", "updates", "fixed_point_error", "best_error", "scale")
    told = {name: changes.pop(name) for name in names if name in changes}
    found = dataclasses.replace(found, **{"spectral_radius": 0.5, "fixed_point_error": None, **told})
    given = Remedy("phi", "do so", None, problem("baird"), "td", {}, 0.1, None, found, None)
    return dataclasses.replace(given, **changes)


def test_what_a_remedy_costs_in_words() -> None:
    assert by_hand().explain() == "Do so. The slowest error shrinks to a tenth in 3 updates."
    assert by_hand(updates=100, margin="from 1 on").explain() == (
        "Do so (it converges from 1 on). The slowest error shrinks to a tenth in 332 updates."
    )
    assert by_hand(spectral_radius=0.0).explain() == "Do so. The mean is right after one application."
    assert by_hand(spectral_radius=1.0).explain() == "Do so."
    assert by_hand(fixed_point_error=0.5, best_error=None).explain().endswith("updates.")
    assert (
        by_hand(fixed_point_error=0.5, best_error=1e-12)
        .explain()
        .endswith(" It ends 0.5 (RMS) from the true values; the best weights are 0 from them.")
    )
    for radius, scatters in ((None, False), (0.999, False), (1.0, True), (1.5, True)):
        one = by_hand(second_moment_radius=radius)
        assert one.scatters == scatters == one.plain()["scatters"]
        assert one.explain().endswith("only the average converges.") == scatters


def test_updates_to_a_tenth() -> None:
    for radius, updates, expected in (
        (0.1, 1, 1.0),
        (0.01, 6, 3.0),
        (0.0, 6, 6.0),
        (1.0, 1, math.inf),
        (2.0, 1, math.inf),
    ):
        one = by_hand(spectral_radius=radius, updates=updates)
        assert one.updates_to_tenth == pytest.approx(expected)
    assert by_hand(spectral_radius=1.0).plain()["updates_to_tenth"] is None
    assert [_round(updates) for updates in (2.4, 999_999.0, 1e6, 1.26e7)] == ["2", "999,999", "1e+06", "1.3e+07"]


def test_the_rank_of_a_fixed_point_leaves_rounding_and_puts_the_unknown_last() -> None:
    def grade(**changes: Any) -> int:
        return _rank(by_hand(**changes))[1]

    assert [grade(), grade(fixed_point_error=0.0, best_error=None)] == [2, 2]
    for scale, unit in ((4.0, 4.0), (None, 1.0)):
        errors = ((0.9e-6, 0), (1.1e-6, 2))  # beside a best error of 0, with a millionth of the size of values
        for error, expected in errors:
            assert grade(fixed_point_error=error * unit, best_error=0.0, scale=scale) == expected
    assert grade(fixed_point_error=1.5, best_error=1.0, scale=1e-9) == 0
    assert _rank(by_hand(second_moment_radius=1.0))[::2] == (True, pytest.approx(math.log(10) / math.log(2)))


@pytest.mark.parametrize(
    ("spacing", "edge", "far", "value"),
    [
        ("linear", 0.5, 1.0, 0.55),
        ("linear", 0.5, 0.0, 0.45),
        ("log", 1e-2, 1.0, 1e-2 * 100**0.1),
        ("log", 1.0, 1e-2, 100**-0.1),
        ("whole", 77.0, 1024.0, 85.0),  # 7.7 more, rounded up
        ("whole", 5.0, 1024.0, 6.0),
        ("whole", 77.0, 80.0, 80.0),
    ],
)
def test_a_tenth_of_the_way_on(spacing: str, edge: float, far: float, value: float) -> None:
    assert _some_way_on(spacing, edge, far) == pytest.approx(value, rel=1e-12)


def test_shorter_steps_are_prescribed_up_to_the_bound() -> None:
    table = problem("baird-tabular")
    trouble = diagnose(table, step_size=20.0)
    for bound, given in ((14.0, 7.0), (20.0, 10.0), (20.1, None), (0.0, None), (None, None)):
        found = list(_smaller_steps(table, "td", dataclasses.replace(trouble, step_size_bound=bound)))
        assert [one.step_size for one in found if one is not None] == ([] if given is None else [given])


def test_the_usual_method_and_whether_the_target_has_a_distribution() -> None:
    assert [usual_method(problem(name)) for name in ("baird", "baird-control", "chattering")] == [
        "td", "q-learning", "sarsa",
    ]  # fmt: skip
    two = FiniteMDP.from_arrays([[[1.0, 0.0], [0.0, 1.0]]], np.zeros((2, 1)))  # two classes: which, is not determined
    apart = Problem.from_mdp(two, np.eye(2), gamma=0.5, state_distribution=[0.5, 0.5])
    assert list(_on_policy(apart, 0.1)) == []
    (one,) = _on_policy(problem("baird"), 0.1)
    assert one is not None and one.problem.behaviour_policy is not problem("baird").behaviour_policy
    assert one.problem.state_distribution == pytest.approx(np.array([0.0] * 6 + [1.0]))

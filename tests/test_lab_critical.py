"""Critical values: closed forms, published ones, and training on both sides of every boundary.

Mutants that die here: bisection without a scan; whole numbers off by one; γ changed without the values that depend on
it; a margin that counts directions which nothing moves; a parameter handed to a method that ignores it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from neuralq.lab.methods import method
from neuralq.lab.trial import run
from neuralq.lab.verdicts.critical import (
    CRITICAL_PARAMETERS,
    NoBoundary,
    StabilityScan,
    _crossings,
    _values_of,
    critical,
    scan,
    stability_margin,
)
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star


def two_states(x: tuple[float, float], gamma: float = 0.9, epsilon: float = 0.0) -> Problem:
    """1 → 2, 2 → 2 or ends w.p. ε, no rewards, both updated equally often (Tsitsiklis & Van Roy 1996 with x = 1, 2)."""
    mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 1 - epsilon]]], np.zeros((2, 1)), substochastic=True)
    return Problem.from_mdp(mdp, [[x[0]], [x[1]]], gamma=gamma, state_distribution=[0.5, 0.5])


@pytest.mark.parametrize("num_upper", [5, 7, 9, *(pytest.param(n, marks=pytest.mark.slow) for n in (6, 8))])
def test_gamma_of_the_star_has_a_closed_form(num_upper: int) -> None:
    assert critical(star(num_upper), "gamma") == pytest.approx((num_upper + 9) / (2 * num_upper + 5), abs=1e-10)


@pytest.mark.parametrize("num_upper", [1, 4, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
def test_small_stars_never_diverge(num_upper: int) -> None:
    with pytest.raises(NoBoundary, match="is stable for every gamma"):
        critical(star(num_upper), "gamma")


@pytest.mark.parametrize("epsilon", [0.0, 0.1, 0.2])
def test_gamma_of_w_to_2w(epsilon: float) -> None:
    # A = (5 − γ (6 − 4ε)) / 2: by hand from features 1 and 2.
    assert critical(two_states((1, 2), epsilon=epsilon), "gamma") == pytest.approx(5 / (6 - 4 * epsilon), abs=1e-12)


def test_two_boundaries_are_both_found() -> None:
    # With one weight, 1 − α(A + η) leaves (−1, 1) at η = −A and at η = 2/α − A.
    problem, alpha = two_states((1, 2)), 0.5  # A = −0.2 at γ = .9
    found = scan(problem, "eta", step_size=alpha)
    assert found.boundaries == pytest.approx((0.2, 2 / alpha + 0.2), rel=1e-9)
    assert found.first() == pytest.approx(0.2, rel=1e-9)


def test_a_narrow_window_between_two_points_is_found() -> None:
    values = np.linspace(0, 1, 11)

    def margin(x: float) -> float:
        return (x - 0.5512) * (x - 0.5538)

    found = _crossings(margin, values, np.array([margin(x) for x in values]))
    assert found == pytest.approx((0.5512, 0.5538), abs=1e-9)


def test_published_values_of_the_star() -> None:
    # Stable for n ≥ 13 and η > 0.2392504643; a hard target is stable for T ≥ 9 at α = .1 and for T ≥ 2 at α = .5: from
    # an independent eigenvalue computation.
    assert critical(star(), "num_steps") == 13
    assert critical(star(), "eta") == pytest.approx(0.2392504643, rel=1e-8)
    assert critical(star(), "period", step_size=0.1) == 9
    assert critical(star(), "period", step_size=0.5) == 2


SIDES = [("gamma", "td"), ("lambda_", "td"), ("eta", "td"), ("phi", "residual"), ("tau", "polyak-target"),
         ("beta_over_alpha", "tdc"), ("num_steps", "n-step"), ("period", "hard-target")]  # fmt: skip


@pytest.mark.parametrize(("parameter", "name"), SIDES)
def test_training_agrees_on_both_sides(parameter: str, name: str) -> None:
    alpha = 0.01
    found = scan(star(), parameter, step_size=alpha)
    assert found.method == name
    whole = CRITICAL_PARAMETERS[parameter].spacing == "whole"
    assert len(found.boundaries) == (2 if parameter in ("eta", "beta_over_alpha") else 1)
    values = [edge + by for edge in found.boundaries for by in ((-1, 0) if whole else (-0.01 * edge, 0.01 * edge))]
    for value in values:
        given = {} if parameter == "gamma" else {parameter: float(value)}
        problem = replace(star(), gamma=float(value)) if parameter == "gamma" else star()
        inside = any(low <= value <= high for low, high in found.stable)
        trained = run(problem, name, num_steps=10**8, step_size=alpha, options=given)
        assert bool(trained.diverged[0]) is not inside, (parameter, value)


def test_margins_ignore_weights_that_nothing_sees() -> None:
    twice = replace(star(), features=np.hstack([star().features, star().features]), initial_weights=np.ones(16))
    assert critical(twice, "gamma") == pytest.approx(15 / 17, abs=1e-10)
    assert stability_margin(star(), method("td")) == pytest.approx(-0.2392504643, abs=1e-9)


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="parameter must be one of 'gamma', 'lambda_'"):
        critical(star(), "alpha")
    with pytest.raises(ValueError, match="gtd2 has no option 'phi'"):
        critical(star(), "phi", "gtd2")
    with pytest.raises(ValueError, match="step_size must be a finite number above 0"):
        critical(star(), "gamma", step_size=-1.0)
    with pytest.raises(ValueError, match="changes with the weights"):
        stability_margin(star(), method("residual-adaptive"))


@pytest.mark.parametrize(
    ("parameter", "first", "second", "last", "count"),
    [
        ("gamma", 0.0, 1 / 240, 1 - 1e-9, 241),
        ("lambda_", 0.0, 1 / 240, 1 - 1e-9, 241),
        ("eta", 1e-6, 1e-6 * 10 ** (9 / 240), 1e3, 241),
        ("phi", 0.0, 1 / 240, 1 - 1e-9, 241),
        ("period", 1.0, 2.0, 1024.0, 1024),
        ("tau", 1e-6, 1e-6 * 10 ** (6 / 240), 1.0, 241),
        ("beta", 0.0, 1 / 240, 1 - 1e-9, 241),
        ("beta_over_alpha", 1e-4, 1e-4 * 10 ** (8 / 240), 1e4, 241),
        ("num_steps", 1.0, 2.0, 256.0, 256),
    ],
)
def test_where_each_parameter_is_looked_at(
    parameter: str, first: float, second: float, last: float, count: int
) -> None:
    values = _values_of(parameter, CRITICAL_PARAMETERS[parameter], None)
    assert len(values) == count and (values[0], values[-1]) == pytest.approx((first, last), rel=1e-13)
    assert values[1] == pytest.approx(second, rel=2e-9)


def test_bounds_replace_the_range() -> None:
    for parameter, bounds, ends in (
        ("gamma", (-0.5, 2.0), (-0.5, 2.0)),
        ("gamma", (0.25, 1.0), (0.25, 1 - 1e-9)),  # at γ = 1 there are no values
        ("eta", (0.5, 1.0), (0.5, 1.0)),
        ("period", (3.0, 5.0), (3.0, 5.0)),
    ):
        values = _values_of(parameter, CRITICAL_PARAMETERS[parameter], bounds)
        assert (values[0], values[-1]) == pytest.approx(ends, rel=1e-13)
        assert len(values) == (3 if parameter == "period" else 241)
    for parameter, bounds in (
        ("gamma", (0.5, 0.5)),
        ("gamma", (0.6, 0.5)),
        ("gamma", (-np.inf, 0.5)),
        ("gamma", (0.5, np.nan)),
        ("eta", (0.0, 1.0)),
        ("period", (0.0, 5.0)),
        ("period", (-1.0, 5.0)),
    ):
        with pytest.raises(ValueError, match="must be finite numbers"):
            scan(star(), parameter, bounds=bounds)


def crossings(margin: Callable[[float], float], values: np.ndarray) -> tuple[float, ...]:
    return _crossings(margin, values, np.array([margin(x) for x in values]))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("middle", [0.1, 0.55, 0.9])
def test_a_dip_between_two_points_is_found_from_both_sides_and_at_both_ends(sign: float, middle: float) -> None:
    found = crossings(lambda x: sign * ((x - middle - 0.003) ** 2 - 1e-6), np.linspace(0, 1, 11))
    assert found == pytest.approx((middle + 0.002, middle + 0.004), abs=1e-9)


def test_dips_that_are_alike_at_all_points_are_looked_into_and_what_only_touches_zero_is_no_crossing() -> None:
    # -.1 half-way between neighbours, 1.9 at every point
    found = crossings(lambda x: 0.9 + float(np.cos(2 * np.pi * x)), np.arange(4.0))
    assert len(found) >= 2 and np.cos(2 * np.pi * np.array(found)) == pytest.approx(-0.9)
    assert crossings(lambda x: max(abs(x - 0.45) - 0.01, 0.0), np.linspace(0, 1, 6)) == ()
    # at a point where the margin is 0 it is not stable: two ends of what is stable meet there, or none
    assert crossings(lambda x: abs(x - 2), np.arange(1.0, 4.0)) == pytest.approx((2.0, 2.0))
    assert crossings(lambda x: -abs(x - 2), np.arange(1.0, 4.0)) == ()
    # ends of the range are no dips, and the margin of one that falls to its end is not looked at beyond it
    assert crossings(lambda x: 1.01 - x, np.linspace(0, 1, 11)) == ()
    assert crossings(lambda x: x - 0.5, np.array([0.0, 1.0])) == pytest.approx((0.5,))


def by_hand(margins: list[float], boundaries: tuple[float, ...]) -> StabilityScan:
    return StabilityScan("toy", "td", "eta", None, np.arange(1.0, len(margins) + 1), np.array(margins), boundaries)


def test_intervals_begin_as_the_first_margin_says_and_change_at_every_boundary() -> None:
    assert by_hand([0.5, -1.0, 1.0, 1.0], (1.5, 2.5)).intervals == ((1, 1.5, True), (1.5, 2.5, False), (2.5, 4, True))
    edge = by_hand([0.0, 1.0, -1.0], (1.5, 2.5))  # at 0 it is not stable yet
    assert edge.intervals == ((1, 1.5, False), (1.5, 2.5, True), (2.5, 3, False)) and edge.stable == ((1.5, 2.5),)
    assert edge.first() == 1.5 and edge.plain()["critical"] == 1.5 and edge.plain()["range"] == [1.0, 3.0]
    still = by_hand([1.0, 2.0], ())
    assert still.stable == ((1.0, 2.0),) and still.plain()["critical"] is None
    with pytest.raises(NoBoundary, match="is unstable for every eta from 1 to 2"):
        by_hand([0.0, 0.0], ()).first()


def test_margins_with_a_step_size_are_what_is_left_to_one() -> None:
    problem = replace(two_states((1, 2)), step_size=0.5)  # A = −.2
    assert stability_margin(problem, method("td")) == pytest.approx(-0.2)
    assert stability_margin(problem, method("td"), 0.25) == pytest.approx(1 - 1.05)
    nothing = replace(problem, features=np.zeros((2, 1)))
    assert stability_margin(nothing, method("td")) > 1e300 and stability_margin(nothing, method("td"), 0.5) == 1.0
    # a target that is copied every time is TD with the problem's own step size, though it is no flow
    assert stability_margin(problem, method("hard-target"), period=1) == pytest.approx(1 - 1.1)
    # A method without an expected update, and a scan in which no value has one.
    with pytest.raises(ValueError, match="no expected update"):
        stability_margin(problem, replace(method("td"), expected=None))
    with pytest.raises(ValueError, match="changes with the weights"):
        scan(problem, "gamma", "residual-adaptive")

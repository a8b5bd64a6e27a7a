"""Critical values: closed forms, published ones, and training on both sides of every boundary.

Mutants that die here: bisection without a scan; whole numbers off by one; γ changed without the values that depend on
it; a margin that counts directions which nothing moves; a parameter handed to a method that ignores it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from neuralq.lab.methods import method
from neuralq.lab.trial import run
from neuralq.lab.verdicts.critical import CRITICAL_PARAMETERS, NoBoundary, critical, scan, stability_margin
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star


def two_states(x: tuple[float, float], gamma: float = 0.9, epsilon: float = 0.0) -> Problem:
    """1 → 2, 2 → 2 or ends w.p. ε, no rewards, both updated equally often (Tsitsiklis & Van Roy 1996 with x = 1, 2)."""
    mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 1 - epsilon]]], np.zeros((2, 1)), substochastic=True)
    return Problem.from_mdp(mdp, [[x[0]], [x[1]]], gamma=gamma, state_distribution=[0.5, 0.5])


@pytest.mark.parametrize("num_upper", [5, 6, 7, 8, 9])
def test_gamma_of_the_star_has_a_closed_form(num_upper: int) -> None:
    assert critical(star(num_upper), "gamma") == pytest.approx((num_upper + 9) / (2 * num_upper + 5), abs=1e-10)


@pytest.mark.parametrize("num_upper", [1, 2, 3, 4])
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
    from neuralq.lab.verdicts.critical import _crossings

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

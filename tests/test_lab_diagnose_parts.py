"""The parts of a diagnosis one by one, at the places where they turn, and against long runs and plain algebra.

Mutants that die here: a bound that is scanned where it is known; weights that nothing sees lost on the way back; an
edge of a verdict moved; normal equations in place of the features themselves.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from neuralq.lab.linear.process import linear_process
from neuralq.lab.methods import Expected, Method, method
from neuralq.lab.methods.td import TD
from neuralq.lab.verdicts import update_maps as maps_module
from neuralq.lab.verdicts.diagnosis import _doubling, _is_flow, _scanned_bound, _turns, _verdict, diagnose
from neuralq.lab.verdicts.moments import known_second_moment, mean_radius
from neuralq.lab.verdicts.update_maps import update_maps
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star
from neuralq_envs.counterexamples.baird import star_control

Floats = NDArray[np.float64]


def garnet(seed: int, num_weights: int = 3, **changes: Any) -> Problem:
    """Six states, on-policy, so that TD converges."""
    rng = np.random.default_rng(seed)
    given = {"gamma": 0.8, "step_size": 0.05, "initial_weights": rng.normal(size=num_weights), **changes}
    return Problem.from_mdp(FiniteMDP.garnet(6, 2, 3, seed=seed), rng.normal(size=(6, num_weights)), **given)


def one_weight(gamma: float = 0.9, reward: float = 1.0, **changes: Any) -> Problem:
    """One state for ever, x = 1: w ← w + α (r − (1 − γ) w)."""
    return Problem.from_mdp(FiniteMDP.from_arrays([[[1.0]]], [[reward]]), [[1.0]], gamma=gamma, **changes)


def own(at: Callable[[Floats, float], tuple[Floats, Floats]], size: int = 1) -> Method:
    return Method("mine", "mine", "", {}, lambda process, options: Expected(size, at, linear=False), TD.learner)


def line(m: float, c: float) -> Method:
    return own(lambda theta, step_size: (np.array([[m]]), np.array([c])))


def test_a_drift_takes_every_bound_and_both_radii_with_it() -> None:
    for sampling, second in (("expected", None), ("iid", 1.0), ("markov", 1.0)):
        found = diagnose(one_weight(gamma=1.0, step_size=0.1), sampling=sampling)  # type: ignore[arg-type]
        bounds = (found.step_size_bound, found.step_size_bound_second_moment)
        assert bounds == (0.0, None if second is None else 0.0)
        assert (found.spectral_radius, found.second_moment_radius, found.rank) == (1.0, second, 0)
        assert found.drift == pytest.approx(0.1)


def test_independent_draws_of_a_linear_update_have_the_bound_and_the_factors_of_its_mean() -> None:
    problem = garnet(0)
    expected, drawn = diagnose(problem), diagnose(problem, sampling="iid")
    assert drawn.step_size_bound == expected.step_size_bound  # to the last bit: it is not scanned
    assert drawn.eigenvalues.tolist() == expected.eigenvalues.tolist()
    assert drawn.follow_on is False and drawn.sampling == "iid" and drawn.flow is True
    assert drawn.second_moment_radius is not None and drawn.step_size_bound_second_moment is not None


def test_a_sampled_extragradient_has_a_mean_of_its_own() -> None:
    problem, one = garnet(1, step_size=0.5), method("gtd2-mp")
    maps = update_maps(linear_process(problem), one, one.checked({}), 0.5)
    drawn, expected = diagnose(problem, one, sampling="iid"), diagnose(problem, one)
    assert drawn.spectral_radius == pytest.approx(mean_radius(maps, "iid"), rel=1e-12)
    assert abs(drawn.spectral_radius - expected.spectral_radius) > 1e-6
    bound = drawn.step_size_bound
    assert bound is not None and 0 < bound < math.inf
    for share, stable in ((0.999, True), (1.001, False)):
        near = update_maps(linear_process(problem), one, one.checked({}), share * bound)
        assert (mean_radius(near, "iid") < 1) == stable


def test_a_rare_large_update_has_a_variance_that_settles_at_much_smaller_steps() -> None:
    """w ← (1 − α) w in one of two thousand draws: the mean allows α < 4000, the mean square α < 2."""
    mdp = FiniteMDP.from_arrays(np.zeros((1, 2, 2)), np.zeros((2, 1)), substochastic=True)
    problem = Problem.from_mdp(mdp, [[1.0], [0.0]], gamma=0.5, state_distribution=[5e-4, 1 - 5e-4], step_size=1.0)
    found = diagnose(problem, sampling="iid")
    assert found.step_size_bound == pytest.approx(4000.0, rel=1e-12)
    assert found.step_size_bound_second_moment == pytest.approx(2.0, rel=1e-8)
    assert found.second_moment_radius == pytest.approx(1 - 5e-4)  # (1 − α)² is 0 at α = 1


@pytest.mark.parametrize(("alpha", "bound"), [(1e-4, math.inf), (1e-3, 2.0), (1.0, 2.0), (1e5, 2.0), (1e6, 0.0)])
def test_bounds_of_what_is_no_flow_are_looked_for_from_a_hundred_thousandth_to_ten_thousand_times_the_step_size(
    alpha: float, bound: float
) -> None:
    assert _scanned_bound(lambda a: np.array([[1 - a]]), alpha) == pytest.approx(bound, rel=1e-8)
    assert _scanned_bound(lambda a: np.eye(2), alpha) == math.inf  # nothing moves


def test_a_flow_changes_in_proportion_to_the_step_size() -> None:
    for power, flows in ((1.0, True), (2.0, False), (1 + 1e-6, False), (0.5, False)):
        one = Expected(2, lambda theta, a, p=power: (np.eye(2) * (1 - a**p), theta), linear=False)
        assert _is_flow(one, np.ones(2), 1e-3) == flows, power


def test_what_turns_and_what_doubles() -> None:
    slow = 1 - 1e-10 + 5e-14j  # a mode near 1 turns little in a step, and much in the time that it takes
    for factors, turns in (
        ([], False), ([0.9], False), ([0.0], False), ([-0.1], True), ([0.9 + 0.05j], True), ([slow], True),
        ([0.9, -0.1], False), ([0.9 + 1e-12j], False),
    ):  # fmt: skip
        assert _turns(np.array(factors, dtype=np.complex128)) == turns, factors
    assert _doubling(2.0, 3) == 3.0 and _doubling(1.1, 1) == pytest.approx(math.log(2) / math.log(1.1))
    assert _doubling(1 + 1e-9, 1) is None and _doubling(1 + 3e-9, 1) is not None and _doubling(0.5, 1) is None


@pytest.mark.parametrize(
    ("arguments", "verdict"),
    [
        ((1 + 2e-9, None, 0.0, False), "diverges"),
        ((1 + 1e-9, None, 0.0, False), "neutral"),
        ((1 - 1e-9, None, 0.0, False), "neutral"),
        ((1 - 2e-9, None, 0.0, False), "converges"),
        ((0.5, None, 1e-300, False), "neutral"),
        ((0.5, None, 0.0, True), "stable but poor fixed point"),
        ((0.5, 1 - 1e-9, 0.0, True), "mean-stable but variance diverges"),
        ((0.5, 1 - 2e-9, 0.0, True), "stable but poor fixed point"),
        ((0.5, 0.5, 0.0, False), "converges"),
        ((1.5, 3.0, 1.0, True), "diverges"),
    ],
)
def test_verdicts_where_they_turn(arguments: tuple[float, float | None, float, bool], verdict: str) -> None:
    assert _verdict(*arguments) == verdict


@pytest.mark.parametrize(
    ("m", "c", "start", "verdict", "point", "doubling", "bound"),
    [
        (0.5, 1.0, 0.0, "converges", 2.0, None, math.inf),  # whatever the step size: it does not look at it
        (2.0, 0.0, 1.0, "diverges", None, 1.0, 0.0),
        (2.0, 0.0, 0.0, "diverges", 0.0, 1.0, 0.0),  # it rests where it starts, and only there
        (-1.0, 0.0, 0.0, "neutral", 0.0, None, None),
        (1 + 1e-9, 0.0, 0.0, "neutral", 0.0, None, None),
        (1.0, 1e-3, 0.0, "neutral", None, None, None),
    ],
)
def test_a_run_in_one_piece(
    m: float, c: float, start: float, verdict: str, point: float | None, doubling: float | None, bound: float | None
) -> None:
    problem = one_weight(reward=0.2, initial_weights=np.array([start]))  # v = 2
    found = diagnose(problem, line(m, c))
    assert found.verdict == verdict and found.converges == (verdict == "converges")
    assert found.fixed_point == (None if point is None else pytest.approx(np.array([point])))
    assert found.fixed_point_error == (None if point is None else pytest.approx(abs(point - 2)))
    assert (found.doubling_time, found.step_size_bound) == (doubling, bound)
    assert found.spectral_radius == (abs(m) if m != 1 else 0.0) and found.rank == len(found.eigenvalues) == (m != 1)
    assert found.drift == 0.0 and len(found.regions) == 1 and found.second_moment_radius is None
    assert found.oscillates == (m < 0)


def test_a_piece_is_as_near_to_a_singular_one_as_its_slowest_direction_to_its_fastest() -> None:
    M = np.diag([0.5, 0.9])  # I − M = diag(.5, .1)
    found = diagnose(garnet(0, num_weights=2), own(lambda theta, step_size: (M, np.ones(2)), size=2))
    assert found.distance_to_singularity == pytest.approx(0.2)


def test_where_the_mean_settles_at_every_step_size_the_variance_is_looked_for_around_the_own_one() -> None:
    """An update whose mean is given implicitly, M = 1/(1 + α), and whose samples are TD's, 1 − α/10."""

    def implicit(process: object, options: object) -> Expected:
        return Expected(1, lambda theta, a: (np.eye(1) / (1 + a), theta * 0), linear=True)

    one = dataclasses.replace(TD, expected=implicit)
    for alpha, bound in ((1e-3, 20.0), (2.0, 20.0), (1e-5, math.inf)):  # up to 1e5 times the step size
        found = diagnose(one_weight(reward=0.0, step_size=alpha), one, sampling="iid")
        assert found.step_size_bound_second_moment == pytest.approx(bound, rel=1e-6)


def test_a_run_that_settles_far_from_the_values_settles_on_poor_ones() -> None:
    found = diagnose(one_weight(), line(0.5, 1.0))  # at 2, where the value is 10
    assert found.verdict == "stable but poor fixed point" and found.converges
    assert found.fixed_point_error == pytest.approx(8.0)


def test_the_size_of_values_is_the_larger_of_theirs_and_of_the_first_error() -> None:
    for start, scale in ((-5.0, 15.0), (8.0, 10.0), (25.0, 15.0)):
        assert diagnose(one_weight(initial_weights=np.array([start]))).scale == pytest.approx(scale)


def test_the_best_weights_are_found_where_features_are_nearly_alike() -> None:
    mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [1.0, 0.0]]], [[1.0], [-1.0]])
    found = diagnose(Problem.from_mdp(mdp, [[1.0, 1.0], [1.0, 1.0 + 1e-8]], gamma=0.5))
    assert found.best_error == pytest.approx(0.0, abs=1e-5)  # their squares differ by less than rounding
    apart = Problem.from_mdp(mdp, [[1.0], [3.0]], gamma=0.5)  # v = ±2/3: the best of w x is (1 − 3)/(1 + 9) · 2/3
    w = -2 / 10 * 2 / 3
    assert diagnose(apart).best_error == pytest.approx(math.sqrt(((w - 2 / 3) ** 2 + (3 * w + 2 / 3) ** 2) / 2))


@pytest.mark.parametrize(
    ("name", "options"),
    [("td", {}), ("hard-target", {"period": 3}), ("tdc", {"beta_over_alpha": 1.0}), ("n-step", {"num_steps": 2})],
)
def test_weights_that_nothing_sees_stay_where_they_begin(name: str, options: dict[str, float]) -> None:
    """Against 2^30 applications of the update of the whole problem, twice the same feature and one of zeros in it."""
    one, problem = method(name), garnet(2, num_weights=2)
    X = np.column_stack([problem.features, problem.features[:, 0], np.zeros(6)])
    wide = dataclasses.replace(problem, features=X, initial_weights=np.array([1.0, -2.0, 0.5, 7.0]), step_size=0.3)
    found = diagnose(wide, one, **options)
    assert one.expected is not None and found.fixed_point is not None and found.fixed_point.shape == (4,)
    expected = one.expected(linear_process(wide), one.checked(options))
    theta = expected.initial(wide.initial_weights)
    M, c = expected.at(theta, 0.3)
    for _ in range(30):
        M, c = M @ M, M @ c + c
    assert found.fixed_point == pytest.approx((M @ theta + c)[:4], abs=1e-7)
    assert found.fixed_point[3] == 7.0


def test_a_run_through_pieces_keeps_what_nothing_sees() -> None:
    X = np.array([[1.0, 1.0, 0.0]])
    problem = dataclasses.replace(one_weight(reward=0.2), features=X, initial_weights=np.array([3.0, 1.0, 5.0]))
    found = diagnose(problem, line(0.5, 0.0))  # the weight along (1, 1)/√2, all that is seen, goes to 0
    assert found.fixed_point == pytest.approx(np.array([1.0, -1.0, 5.0])) and found.rank == 1
    assert found.fixed_point_error == pytest.approx(2.0)


@pytest.mark.parametrize(("name", "known"), [("gq", True), ("expected-sarsa", True), ("q-learning", False)])
def test_errors_are_known_of_the_values_of_a_policy_that_stands(name: str, known: bool) -> None:
    found = diagnose(star_control(), name)
    assert [x is not None for x in (found.best_error, found.fixed_point_error, found.scale)] == [known] * 3
    assert found.best_error == (pytest.approx(0.0, abs=1e-9) if known else None)


class Straight:
    """Values that are linear in the weights, given as those that need not be."""

    def __init__(self, X: Floats) -> None:
        self._X = X

    def values(self, theta: Floats) -> Floats:
        return self._X @ theta

    def jacobian(self, theta: Floats) -> Floats:
        return self._X

    def hessian(self, theta: Floats) -> Floats:
        return np.zeros((*self._X.shape, self._X.shape[1]))


@pytest.mark.parametrize("problem", [garnet(3), one_weight(gamma=1.0, initial_weights=np.array([2.0]))])
def test_values_that_are_linear_after_all_are_diagnosed_alike(problem: Problem) -> None:
    one = diagnose(problem)
    found = diagnose(dataclasses.replace(problem, value=Straight(problem.features)), sampling="markov")
    assert found.local and found.sampling == "markov" and found.verdict == one.verdict
    np.testing.assert_allclose(found.eigenvalues, one.eigenvalues, rtol=1e-12)
    for name in ("spectral_radius", "step_size_bound", "drift", "distance_to_singularity", "scale", "rank"):
        assert getattr(found, name) == pytest.approx(getattr(one, name)), name
    assert (found.fixed_point, found.fixed_point_error, found.best_error) == (None, None, None)
    with pytest.raises(ValueError, match="only plain TD"):
        diagnose(dataclasses.replace(problem, value=Straight(problem.features)), lambda_=0.5)


def test_each_reason_alone_leaves_the_second_moment_unknown() -> None:
    problem, known = garnet(4), TD.checked({})
    assert known_second_moment(problem, TD, known, 0.05, "markov") is not None
    for lacks in ({"expected": None}, {"learner": None}, {"remembers": lambda options: True}):
        assert known_second_moment(problem, dataclasses.replace(TD, **lacks), known, 0.05, "markov") is None
    control = method("q-learning")  # its piece changes with the weights
    assert known_second_moment(star_control(), control, control.checked({}), 0.01, "markov") is None


def test_maps_asked_for_in_small_parts_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    one, process = method("tdc"), linear_process(star())
    whole = update_maps(process, one, one.checked({}), 0.1)
    monkeypatch.setattr(maps_module, "_CHUNK", 1)
    parts = update_maps(process, one, one.checked({}), 0.1)
    assert (parts.M == whole.M).all() and (parts.c == whole.c).all()
    monkeypatch.setattr(maps_module, "LARGEST", 49 * 16 * 16)
    assert len(update_maps(process, one, one.checked({}), 0.1).M) == 49
    monkeypatch.setattr(maps_module, "LARGEST", 49 * 16 * 16 - 1)
    with pytest.raises(ValueError, match="49 transitions with maps of 16x16 are too many"):
        update_maps(process, one, one.checked({}), 0.1)

"""Laws of the regressors, Gordon's derived model, fitted evaluation and Q-iteration on finite models, Grow-Support.

Mutants that die: the sweep without row discounts; terminal rows of H kept; the nearest neighbour skipped; interpolation
weights swapped; the projection without D; the worst action in place of the best in Q-iteration.
"""

from __future__ import annotations

import numpy as np
import pytest
from fitted_models import derived_mdp, sweep_of_mdp
from hypothesis import given, settings
from hypothesis import strategies as st

from neuralq.exact import solve
from neuralq.lab import diagnose, run
from neuralq.lab.fitted.diagnosis import hat_norm, is_averager, policy_growth
from neuralq.lab.fitted.grow_support import greedy_costs, grow_support
from neuralq.lab.fitted.iteration import fitted_iteration, iterate, sweep_of_model
from neuralq.lab.fitted.regressors import (
    GridInterpolation,
    KernelSmoothing,
    LeastSquares,
    LocallyWeighted,
    NearestNeighbours,
    StateAggregation,
    quadratic_features,
)
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.boyan_moore import car_on_the_hill, gridworld, puddle_world
from neuralq_envs.counterexamples.continuous import ContinuousModel, grid_support, random_support, reachable_mdp
from neuralq_envs.counterexamples.problem import Problem

GRID = gridworld()
GRID16 = grid_support(GRID, 16)


# Laws of the hat matrices


def _points(seed: int, num: int) -> np.ndarray:
    return np.random.default_rng(seed).random((num, 2))


AVERAGERS = {
    "1-nearest": NearestNeighbours(1),
    "3-nearest": NearestNeighbours(3),
    "3-nearest weighted": NearestNeighbours(3, "inverse-distance"),
    "kernel": KernelSmoothing(0.1),
    "one box": StateAggregation((0.0, 0.0), (1.0, 1.0), 1),
}


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), num=st.integers(3, 30), name=st.sampled_from(sorted(AVERAGERS)))
def test_averagers_never_exaggerate(seed, num, name):
    hat = AVERAGERS[name].fit(_points(seed, num)).hat(_points(seed + 1, 40))
    assert is_averager(hat) and hat_norm(hat) == pytest.approx(1.0)
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=num), rng.normal(size=num)
    assert np.abs(hat @ a - hat @ b).max() <= np.abs(a - b).max() + 1e-12
    assert (hat @ np.maximum(a, b) >= hat @ a - 1e-12).all()  # monotone


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), sides=st.tuples(st.integers(2, 5), st.integers(2, 5), st.integers(2, 4)))
def test_interpolation_is_an_averager_and_exact_on_multilinear_functions(seed, sides):
    rng = np.random.default_rng(seed)
    axes = [np.sort(rng.random(m)) for m in sides]
    support = rng.permutation(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3))
    inside = np.stack([rng.uniform(axis[0], axis[-1], 20) for axis in axes], axis=1)
    fit = GridInterpolation().fit(support)
    assert is_averager(fit.hat(rng.normal(size=(20, 3))))  # outside too

    def multilinear(x: np.ndarray) -> np.ndarray:
        return 1 + x @ np.array([1.0, -2.0, 3.0]) + 4 * x[:, 0] * x[:, 1] - 5 * x.prod(axis=1)

    np.testing.assert_allclose(fit.predict(multilinear(support), inside), multilinear(inside), atol=1e-10)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_regression_reproduces_its_features_and_is_no_averager(seed):
    support, query = _points(seed, 25), 3 * _points(seed + 1, 10) - 1

    def bowl(x: np.ndarray) -> np.ndarray:
        return 1 + x[:, 0] - 2 * x[:, 1] ** 2 + x[:, 0] * x[:, 1]

    fit = LeastSquares(quadratic_features).fit(support)
    np.testing.assert_allclose(fit.predict(bowl(support), query), bowl(query), atol=1e-8)
    np.testing.assert_allclose(fit.predict(bowl(support), query), fit.hat(query) @ bowl(support), atol=1e-8)
    line = LocallyWeighted(0.3).fit(support)
    np.testing.assert_allclose(line.predict(support @ [2.0, 3.0], support), support @ [2.0, 3.0], atol=1e-6)
    assert not is_averager(fit.hat(query))


def test_nearest_neighbours_agree_with_sorting_by_hand():
    support, query = _points(3, 20), _points(4, 7)
    hat = NearestNeighbours(3, "inverse-distance").fit(support).hat(query).toarray()
    for row, x in zip(hat, query, strict=True):
        near = sorted((float(np.hypot(*(x - p))), i) for i, p in enumerate(support))[:3]
        total = sum(1 / d for d, _ in near)
        expected = np.zeros(20)
        expected[[i for _, i in near]] = [1 / d / total for d, _ in near]
        np.testing.assert_allclose(row, expected, atol=1e-12)
    on_a_point = NearestNeighbours(3, "inverse-distance").fit(support).hat(support)
    np.testing.assert_allclose(on_a_point.toarray(), np.eye(20), atol=1e-12)


def test_a_ridge_shrinks_and_kernels_and_boxes_are_means():
    support, y = np.array([[1.0], [2.0]]), np.array([2.0, 4.0])
    shrunk = LeastSquares(lambda x: x, ridge=5.0).fit(support).predict(y, np.array([[1.0]]))
    assert shrunk[0] == pytest.approx(1.0)  # Σ x y / (Σ x² + 5) = 10 / 10
    smooth = KernelSmoothing(0.5).fit(support).predict(y, np.array([[1.0]]))
    assert smooth[0] == pytest.approx((2 + 4 * np.exp(-2)) / (1 + np.exp(-2)))
    with pytest.raises(ValueError, match="no support point lies in the box"):
        StateAggregation((0.0,), (4.0,), 4).fit(support).hat(np.array([[3.5]]))


# Gordon's derived model


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), gamma=st.floats(0.1, 0.95), num_support=st.integers(1, 6))
def test_fitted_iteration_with_an_averager_is_exact_iteration_of_the_derived_model(seed, gamma, num_support):
    rng = np.random.default_rng(seed)
    mdp = FiniteMDP.garnet(8, 3, 3, seed=seed)
    support = rng.permutation(8)[:num_support]
    hat = rng.dirichlet(np.ones(num_support + 1), size=8)[:, :num_support]  # sums below 1: the rest is worth 0
    ran = iterate(sweep_of_mdp(mdp, support, hat), gamma=gamma, num_iterations=5000, tolerance=1e-13)
    # The oracle of the oracle: a dense backup of all states, of which the support is read off.
    v = np.zeros(8)
    dense = mdp.transition.toarray().reshape(8, 3, 8)
    for _ in range(ran.iterations):
        v = hat @ (mdp.reward.reshape(8, 3) + gamma * dense @ v).max(axis=1)[support]
    np.testing.assert_allclose(ran.values[-1], -v[support], atol=1e-9)
    exact = solve(derived_mdp(sweep_of_mdp(mdp, support, hat)), gamma, tol=1e-11)
    np.testing.assert_allclose(ran.targets, -exact.v, atol=1e-8)


@pytest.mark.parametrize("model", [GRID, puddle_world(), car_on_the_hill()], ids=lambda model: model.name)
@pytest.mark.parametrize("regressor", [NearestNeighbours(1), GridInterpolation(), KernelSmoothing(0.05)])
def test_the_derived_model_of_a_continuous_problem_has_the_fixed_point_as_its_values(model: ContinuousModel, regressor):
    support = grid_support(model, 11)
    sweep = sweep_of_model(model, support, regressor)
    ran = iterate(sweep, gamma=0.9, num_iterations=2000, tolerance=1e-12)
    exact = solve(derived_mdp(sweep), 0.9, tol=1e-10)
    assert ran.converged
    np.testing.assert_allclose(ran.targets, -exact.v, atol=1e-8)


def test_the_undiscounted_derived_model_too():
    sweep = sweep_of_model(GRID, GRID16, GridInterpolation())
    np.testing.assert_allclose(iterate(sweep).targets, -solve(derived_mdp(sweep), 1.0).v, atol=1e-8)


def test_terminal_states_discounts_and_missing_actions_enter_the_sweep():
    """State 0 may stay (reward 1, discount ½) or leave (reward 0, to the end); state 1 may only go to 0."""
    mdp = FiniteMDP(
        3, 2, np.array([0, 0, 1]), np.array([0, 1, 0]),
        FiniteMDP.from_arrays([[[1.0, 0, 0], [0, 0, 1.0], [1.0, 0, 0]]] * 1, [[0.0], [0.0], [0.0]]).transition,
        np.array([1.0, 0.0, 0.0]), np.array([0.5, 1.0, 1.0]),
    )  # fmt: skip
    sweep = sweep_of_mdp(mdp, [0, 1], np.array([[1.0, 0], [0, 1.0], [7.0, 7.0]]))
    np.testing.assert_allclose(iterate(sweep).targets, [-2.0, -2.0], atol=1e-9)  # 1 + ½ + ¼ + …, from 1 one step later
    ran = iterate(sweep, gamma=0.8, tolerance=1e-13)
    np.testing.assert_allclose(ran.targets, [-1 / 0.6, -0.8 / 0.6], atol=1e-9)  # 1 + .4 + .16 + …
    np.testing.assert_allclose(ran.targets, -solve(mdp, 0.8).v[:2], atol=1e-7)
    assert derived_mdp(sweep).num_rows == 3


def test_a_regression_derives_no_model():
    with pytest.raises(ValueError, match="only an averager"):
        derived_mdp(sweep_of_model(GRID, GRID16, LeastSquares()))


# Finite problems: least squares backed up


def _two_states(gamma: float, epsilon: float) -> Problem:
    """States with features 1 and 2; 1 → 2, and 2 → 2 unless it ends, with probability ε (Tsitsiklis & Van Roy)."""
    mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 1.0 - epsilon]]], [[0.0], [0.0]], substochastic=True)
    return Problem.from_mdp(mdp, [[1.0], [2.0]], gamma=gamma, state_distribution=[0.5, 0.5])


@settings(max_examples=30, deadline=None)
@given(gamma=st.floats(0.05, 1.0), epsilon=st.floats(0.0, 0.9))
def test_the_factor_of_w_to_2w(gamma, epsilon):
    factor = (6 - 4 * epsilon) * gamma / 5  # Sutton & Barto 2018, equation 11.10
    problem = _two_states(gamma, epsilon)
    assert diagnose(problem, "fitted").spectral_radius == pytest.approx(factor)
    np.testing.assert_allclose(run(problem, "fitted", 5).path[:, 0], factor ** np.arange(6), rtol=1e-9)


@pytest.mark.parametrize("epsilon", [0.0, 0.1, 0.25])
def test_w_to_2w_diverges_beyond_its_threshold_only(epsilon):
    edge = 5 / (6 - 4 * epsilon)
    above = run(_two_states(min(edge * 1.01, 1.0), epsilon), "fitted", 5000)
    below = run(_two_states(edge * 0.99, epsilon), "fitted", 5000)
    assert not below.diverged.any() and below.path[-1] == pytest.approx(0.0, abs=1e-12)
    assert above.diverged.all() == (edge * 1.01 <= 1) and np.isfinite(above.path).all()


def test_regression_on_two_states_is_no_averager_and_its_growth_is_six_fifths_of_gamma():
    phi = np.array([[1.0], [2.0]])
    hat = phi @ np.linalg.pinv(phi)
    assert hat_norm(hat) == pytest.approx(6 / 5)  # rows 1/5, 2/5 and 2/5, 4/5: by hand
    sweep = sweep_of_mdp(_two_states(0.9, 0.0).mdp, [0, 1], hat)
    assert policy_growth(sweep, np.zeros(2, dtype=np.int64), 0.9) == pytest.approx(1.08)
    ran = iterate(sweep, gamma=0.9, start=[1.0, 2.0], num_iterations=5000)
    assert ran.stopped_on_cap and ran.growth == pytest.approx(1.08)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_fitted_evaluation_finds_the_projected_fixed_point(seed):
    rng = np.random.default_rng(seed)
    mdp = FiniteMDP.garnet(7, 2, 3, seed=seed)
    problem = Problem.from_mdp(mdp, rng.normal(size=(7, 3)), gamma=0.7, target_policy=np.full((7, 2), 0.5))
    ran, found = run(problem, "fitted", 3000), diagnose(problem, "fitted")  # on-policy: a contraction in the norm of d
    chain = 0.5 * (mdp.transition.toarray()[0::2] + mdp.transition.toarray()[1::2])
    reward = 0.5 * (mdp.reward[0::2] + mdp.reward[1::2])
    x, d = problem.features, np.diag(problem.state_distribution)
    expected = np.linalg.solve(x.T @ d @ (x - 0.7 * chain @ x), x.T @ d @ reward)
    assert found.converges and found.spectral_radius < 0.7 + 1e-9
    np.testing.assert_allclose(ran.path[-1], expected, rtol=1e-6, atol=1e-8)


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_fitted_q_iteration_with_a_table_is_value_iteration(seed):
    mdp = FiniteMDP.garnet(5, 2, 2, seed=seed)
    table = np.eye(10).reshape(5, 2, 10)
    d = np.random.default_rng(seed).dirichlet(np.ones(5))
    problem = Problem.from_mdp(mdp, table, gamma=0.8, state_distribution=d)
    ran, found = run(problem, "fitted-q", 500), diagnose(problem, "fitted-q")
    assert found.converges and found.spectral_radius == pytest.approx(0.8)
    np.testing.assert_allclose(ran.path[-1].reshape(5, 2), solve(mdp, 0.8, tol=1e-11).q, atol=1e-8)


def test_fitted_q_iteration_on_w_to_2w_diverges_and_on_its_table_does_not():
    mdp = _two_states(0.95, 0.0).mdp
    rough = Problem.from_mdp(mdp, [[[1.0]], [[2.0]]], gamma=0.95, state_distribution=[0.5, 0.5])
    for name in ("fitted-q", "fitted"):  # with one action both back up the same values of pairs
        assert run(rough, name, 5000).diverged.all()
        assert diagnose(rough, name).spectral_radius == pytest.approx(1.14)  # 6 · .95 / 5
    with pytest.raises(ValueError, match="state-action pairs"):
        run(_two_states(0.9, 0.0), "fitted-q")


# Grow-Support


def test_growing_the_support_finds_the_right_costs_where_plain_iteration_diverges():
    exact = GRID.cost_to_go(GRID16)
    assert fitted_iteration(GRID, GRID16, LeastSquares()).stopped_on_cap
    grown = grow_support(GRID, GRID16, LeastSquares())
    assert grown.complete and grown.settled and grown.history[0] == 1  # one of 256 points lies in the goal
    np.testing.assert_allclose(grown.costs, exact, atol=1e-9)
    assert np.abs(grown.predict(GRID16) - exact).max() < 0.5  # as near as any quadratic comes to the staircase
    paid, reached = greedy_costs(GRID, grown.fitted, grown.costs, GRID16)
    assert reached.all()
    np.testing.assert_allclose(paid, exact, atol=1e-9)


@settings(max_examples=10, deadline=None)
@given(side=st.integers(5, 20), tolerance=st.floats(0.01, 3.0))
def test_a_grown_cost_is_never_below_the_optimal_one(side, tolerance):
    support = grid_support(GRID, side)
    grown = grow_support(GRID, support, LeastSquares(), tolerance=tolerance)
    assert (grown.costs >= GRID.cost_to_go(grown.states) - 1e-9).all()
    assert list(grown.history) == sorted(grown.history)
    np.testing.assert_array_equal(grown.states, support[grown.index])


def test_growing_stops_rather_than_believe_a_fit_that_does_not_hold():
    """No quadratic follows the puddles, so some states never join; those that did paid what they claim."""
    world = puddle_world()
    support = grid_support(world, 16)
    mdp, index = reachable_mdp(world, support)
    exact = -solve(mdp, 1.0).v[index]
    grown = grow_support(world, support, LeastSquares())
    assert grown.settled and not grown.complete
    assert (grown.costs >= exact[grown.index] - 1e-9).all()


@pytest.mark.slow
def test_local_lines_grow_over_the_puddles():
    world = puddle_world()
    support = grid_support(world, 16)
    mdp, index = reachable_mdp(world, support)
    better = grow_support(world, support, LocallyWeighted(0.1), tolerance=10.0)
    assert better.complete and np.abs(better.costs + solve(mdp, 1.0).v[index]).max() < 5.0


def test_growing_needs_a_beginning():
    with pytest.raises(ValueError, match="in the goal or one step"):
        grow_support(GRID, np.array([[0.1, 0.1], [0.2, 0.3]]), LeastSquares())


# What callers get wrong


@pytest.mark.parametrize(("call", "message"), [
    (lambda: fitted_iteration(GRID, np.zeros((3, 1)), LeastSquares()), r"support must have shape \[n, 2\]"),
    (lambda: fitted_iteration(GRID, GRID16, LeastSquares(), gamma=1.1), "gamma"),
    (lambda: fitted_iteration(GRID, GRID16, LeastSquares(), start=np.ones(3)), "start must hold 256"),
    (lambda: LeastSquares(ridge=-1.0).fit(GRID16), "ridge must be at least 0"),
    (lambda: NearestNeighbours(300).fit(GRID16), "at most the 256 points"),
    (lambda: NearestNeighbours(1, "nearest").fit(GRID16), "weighting must be one of"),
    (lambda: GridInterpolation().fit(GRID16[:-1]), "needs a full grid"),
    (lambda: sweep_of_mdp(_two_states(0.9, 0.0).mdp, [0, 0], np.eye(2)), "different states"),
    (lambda: sweep_of_mdp(_two_states(0.9, 0.0).mdp, [0, 1], np.eye(3)), r"hat must have shape \(2, 2\)"),
    (lambda: ContinuousModel("x", np.ones(2), np.zeros(2), ("a",), GRID.step, GRID.is_goal), "low must lie below"),
    (lambda: grid_support(GRID, 1), "num_per_side"),
    (lambda: random_support(GRID, 0, np.random.default_rng(0)), "num_points"),
])  # fmt: skip
def test_refusals_say_what_was_got(call, message):
    with pytest.raises(ValueError, match=message):
        call()

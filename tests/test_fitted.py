"""Fitted iteration: published-problem figures, averager laws, the derived model, Grow-Support, and negative controls.

The figures of the 16 × 16 grid come from an independent float64 iteration of the normal equations, made with six
hand-written monomials and no code of the package; `_oracle` repeats it here.

Mutants that die: y at goal points not pinned to 0; the fit instead of 0 at a successor in the goal; steps of .06; the
argmin of the cost without the fit; H_π from the wrong action; the puddle's distance to the endless line; no bend term.
"""

from __future__ import annotations

import numpy as np
import pytest

from neuralq.exact import solve
from neuralq.lab.fitted.diagnosis import diagnose_fitted
from neuralq.lab.fitted.iteration import fitted_iteration
from neuralq.lab.fitted.network import NetworkRegressor
from neuralq.lab.fitted.regressors import (
    GridInterpolation,
    KernelSmoothing,
    LeastSquares,
    LocallyWeighted,
    NearestNeighbours,
    StateAggregation,
    linear_features,
)
from neuralq_envs.counterexamples.boyan_moore import car_on_the_hill, gridworld, puddle_depth, puddle_world
from neuralq_envs.counterexamples.continuous import grid_support, random_support, reachable_mdp

GRID = gridworld()
GRID16 = grid_support(GRID, 16)
# Tilts the start by a thousandth off the diagonal that the grid, the moves and the goal are symmetric about.
TILT = 1e-3 * (GRID16[:, 0] - GRID16[:, 1])


def _oracle(num_per_side: int, gamma: float, num_sweeps: int) -> list[float]:
    """max |V| over the grid after each sweep, by a weight iteration written out by hand."""
    g = np.linspace(0, 1, num_per_side)
    x, y = (part.reshape(-1) for part in np.meshgrid(g, g))

    def phi(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([x**0, x, y, x * x, x * y, y * y], axis=1)

    def at_goal(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x > 0.9499999) & (y > 0.9499999)

    fit, *_ = np.linalg.lstsq(phi(x, y), np.eye(len(x)), rcond=None)
    moves = [
        (np.clip(x + dx, 0, 1), np.clip(y + dy, 0, 1)) for dx, dy in ((0, 0.05), (0, -0.05), (0.05, 0), (-0.05, 0))
    ]
    w, out = np.zeros(6), []
    for _ in range(num_sweeps):
        q = [0.5 + gamma * np.where(at_goal(*to), 0.0, phi(*to) @ w) for to in moves]
        w = fit @ np.where(at_goal(x, y), 0.0, np.min(q, axis=0))
        out.append(float(np.abs(phi(x, y) @ w).max()))
    return out


# The problems


def test_the_grid_costs_half_a_step_and_its_closed_form_is_the_shortest_path():
    points = np.concatenate([GRID16, [[0.3, 0.72], [0.949999, 0.2], [0.95, 0.0]]])
    mdp, index = reachable_mdp(GRID, points)
    solution = solve(mdp, 1.0)
    np.testing.assert_allclose(-solution.v[index], GRID.cost_to_go(points), atol=1e-12)
    assert GRID.cost_to_go(np.array([[0.0, 0.0]]))[0] == 19.0  # 19 steps east, 19 north, half each: by hand


def test_the_plane_of_the_paper_lies_over_the_staircase_by_half_a_step_at_most():
    points = random_support(GRID, 500, np.random.default_rng(0))
    points = points[(points < 0.95).all(axis=1)]
    gap = 20 - 10 * points.sum(axis=1) - GRID.cost_to_go(points)
    assert (gap > -1e-6).all() and (gap < 1 + 1e-6).all()  # 19 to 20 in each of two coordinates, half a step each


def test_a_puddle_is_a_capsule_of_radius_a_tenth():
    # On the axis of the flat puddle, off its left end, beside the upright one, and where both overlap: by hand.
    states = np.array([[0.2, 0.75], [0.04, 0.75], [0.5, 0.5], [0.45, 0.85], [0.9, 0.1], [0.1, 0.66], [0.45, 0.33]])
    np.testing.assert_allclose(puddle_depth(states), [0.1, 0.04, 0.05, 0.05, 0.0, 0.01, 0.03], atol=1e-12)
    assert puddle_world().step(np.array([[0.95, 0.9]])).ended[0].tolist() == [True, False, True, False]


def test_the_way_round_the_puddles_is_cheaper_than_through():
    world = puddle_world()
    mdp, index = reachable_mdp(world, np.array([[0.1, 0.85], [0.0, 0.0]]))
    cost = -solve(mdp, 1.0).v[index]
    assert cost[1] == 38.0  # along the south and east walls: 38 dry steps of .05 make x + y = 1.9
    assert cost[0] < 40.0 + 1e-9


def test_the_car_keeps_its_energy_where_nothing_drives_it():
    """With ±u averaged out the hill is conservative: E = ½ ṗ²(1 + h'²) + g h, and ΔE = u Δs along the track."""
    car = car_on_the_hill()
    rng = np.random.default_rng(0)
    states = rng.uniform([-0.7, -1.5], [0.7, 1.5], size=(200, 2))
    steps = car.step(states)

    def height(p: np.ndarray) -> np.ndarray:
        return np.where(p < 0, p * p + p, p / np.sqrt(1 + 5 * p * p))

    def energy(s: np.ndarray) -> np.ndarray:
        eps = 1e-6  # the slope by differences, so that no formula of the model is used
        slope = (height(s[..., 0] + eps) - height(s[..., 0] - eps)) / (2 * eps)
        return 0.5 * s[..., 1] ** 2 * (1 + slope**2) + 9.81 * height(s[..., 0])

    # The thrust acts on p̈ as u/(1 + h'²), so its power is u ṗ and its work u Δp.
    work = (steps.successor[..., 0] - states[:, None, 0]) * np.array([-4.0, 4.0])
    gained = energy(steps.successor) - energy(states)[:, None]
    assert np.abs(gained - work).max() < 0.03  # Euler steps of a millisecond; the bend left out makes .9


def test_the_car_cannot_climb_at_once_but_can_with_a_run_up():
    car = car_on_the_hill()
    state, backed_up = np.array([[-0.5, 0.0]]), np.array([[-0.5, 0.0]])
    for _ in range(60):
        assert not car.step(state).ended[0, 1]
        state = car.step(state).successor[:, 1]
    moves, k = [0] * 8 + [1] * 60, 0
    while not car.step(backed_up).ended[0, moves[k]]:
        backed_up, k = car.step(backed_up).successor[:, moves[k]], k + 1
    assert car.is_goal(car.step(backed_up).successor[:, moves[k]]).item()


def test_the_best_time_of_the_car_from_a_fine_grid():
    """Two grids, one twice as fine, agree that it takes the car about 1.9 s from rest in the valley."""
    times = []
    for side in (61, 121):
        support = grid_support(car_on_the_hill(), side)
        run = fitted_iteration(car_on_the_hill(), support, GridInterpolation(), num_iterations=400)
        assert run.converged
        times.append(GridInterpolation().fit(support).predict(run.targets, np.array([[-0.5, 0.0]])).item())
    assert abs(times[0] - times[1]) < 0.05 and 1.8 < times[1] < 1.95


def test_a_model_that_does_not_close_under_its_steps_is_refused():
    with pytest.raises(ValueError, match="more than max_states=500"):
        reachable_mdp(car_on_the_hill(), np.array([[0.0, 0.0]]), max_states=500)


# Least squares on the grid


def test_quadratic_features_diverge_on_the_16_grid():
    run = fitted_iteration(GRID, GRID16, LeastSquares(), num_iterations=600)
    # max |V| after 12, 25, 40, 300, 400 and 500 sweeps, by an independent float64 iteration.
    expected = {12: 6.0722, 25: 10.5909, 40: 12.5578, 300: 15.0143, 400: 5.4285e4, 500: 1.9097e8}
    for k, size in expected.items():
        assert run.max_abs[k] == pytest.approx(size, rel=1e-4), k
    np.testing.assert_allclose(run.max_abs[1:501], _oracle(16, 1.0, 500), rtol=1e-6)
    assert run.stopped_on_cap and not run.converged
    assert run.growth == pytest.approx(1.0850436, rel=1e-6)
    assert np.isfinite(run.values).all() and np.isfinite(run.targets).all()


def test_the_growth_of_the_run_is_an_eigenvalue_at_its_greedy_policy():
    found = diagnose_fitted(GRID, GRID16, LeastSquares())
    assert found.verdict == "diverges" and not found.guaranteed and found.averager is False
    assert found.hat_norm == pytest.approx(3.0336, rel=1e-4)  # independent float64 computation
    assert found.ray_growth == pytest.approx(1.0850436, rel=1e-6)
    assert found.growth > found.ray_growth  # the worst direction is not symmetric, and the run is
    assert "Diverges" in found.explain()


def test_the_divergence_hangs_on_the_symmetry_of_the_start():
    """From zero every iterate is symmetric in x and y; a tilt of a thousandth leads to a fixed point instead."""
    straight = fitted_iteration(GRID, GRID16, LeastSquares(), num_iterations=1000)
    tilted = diagnose_fitted(GRID, GRID16, LeastSquares(), start=TILT)
    assert straight.stopped_on_cap
    assert tilted.verdict == "converges" and tilted.growth < 0.95
    assert tilted.run.max_abs[-1] == pytest.approx(19.88957, rel=1e-6)  # the plane of the paper has 20 at the origin


def test_without_an_undiscounted_goal_the_16_grid_neither_diverges_nor_converges():
    """γ = .99 keeps the sweeps bounded, in a cycle: max |V| swings for ever between 16.3976 and 16.4449."""
    found = diagnose_fitted(GRID, GRID16, LeastSquares(), gamma=0.99, num_iterations=3500)
    late = found.run.max_abs[-1400:]  # a little more than one turn
    assert found.verdict == "chatters" and not found.run.converged and not found.run.stopped_on_cap
    assert late.min() == pytest.approx(16.3976, rel=1e-4)  # by an independent float64 iteration
    assert late.max() == pytest.approx(max(_oracle(16, 0.99, 3500)[-1400:]), rel=1e-5)


def test_a_fixed_point_reached_by_symmetry_is_called_unstable():
    found = diagnose_fitted(GRID, GRID16, LeastSquares(), gamma=0.95)
    assert found.run.converged and found.verdict == "unstable" and found.growth > 1.01
    later = fitted_iteration(GRID, GRID16, LeastSquares(), gamma=0.95, num_iterations=5000, tolerance=1e-300)
    assert np.abs(np.diff(later.values[-100:], axis=0)).max() > 1e-6  # rounding has led it away


def test_the_21_grid_and_linear_features_converge():
    finer = fitted_iteration(GRID, grid_support(GRID, 21), LeastSquares())
    assert finer.converged and finer.max_abs[-1] == pytest.approx(19.3551, rel=1e-4)  # independent iteration
    assert diagnose_fitted(GRID, GRID16, LeastSquares(linear_features)).verdict == "converges"


@pytest.mark.parametrize("side", [11, 16, 21])
def test_leaving_out_the_goal_diverges_on_every_grid(side):
    support = grid_support(GRID, side)
    found = diagnose_fitted(GRID, support[~GRID.is_goal(support)], LeastSquares())
    assert found.verdict == "diverges"
    assert found.run.growth == pytest.approx(found.ray_growth, rel=1e-5)


def test_random_supports_of_one_size_differ_in_their_outcome():
    outcomes = [
        diagnose_fitted(GRID, random_support(GRID, 256, np.random.default_rng(s)), LeastSquares(), num_iterations=2000)
        for s in range(5)
    ]
    verdicts = [found.verdict for found in outcomes]
    assert {"converges", "diverges"} <= set(verdicts), verdicts
    for found in outcomes:
        if found.ray_growth is not None:
            assert found.ray_growth == pytest.approx(found.run.growth, rel=1e-4)
        if found.verdict == "converges":
            assert found.growth < 1


# Regressors that are safe, or happen to be


@pytest.mark.parametrize("regressor", [
    NearestNeighbours(1), NearestNeighbours(2, "inverse-distance"), NearestNeighbours(4, "inverse-distance"),
    NearestNeighbours(2), NearestNeighbours(4), GridInterpolation(), KernelSmoothing(0.05),
])  # fmt: skip
def test_averagers_are_certified_and_converge_on_the_16_grid(regressor):
    found = diagnose_fitted(GRID, GRID16, regressor)
    assert found.guaranteed and found.averager and found.run.converged and found.run.iterations <= 160
    assert found.hat_norm <= 1 + 1e-12
    assert "for certain" in found.explain()


def test_nearest_neighbours_settle_in_so_many_sweeps():
    # 31 sweeps of half a cost each reach 15; counted by a loop over brute-force distances, outside the package.
    counts = [fitted_iteration(GRID, GRID16, NearestNeighbours(k)).iterations for k in (1, 2)]
    assert counts == [31, 128]


def test_an_averager_with_cells_wider_than_a_step_has_no_certificate_and_drifts():
    """Two neighbouring points of one cell are one state, and a step inside it is a loop that costs for ever."""
    found = diagnose_fitted(GRID, GRID16, StateAggregation((0.0, 0.0), (1.0, 1.0), 8))
    assert found.averager and not found.guaranteed
    assert found.verdict == "drifts" and found.growth == pytest.approx(1.0)
    assert found.run.max_abs[-1] == 500.0  # half a cost for each of 1000 sweeps
    discounted = diagnose_fitted(GRID, GRID16, StateAggregation((0.0, 0.0), (1.0, 1.0), 8), gamma=0.9)
    assert discounted.guaranteed and discounted.run.converged and discounted.contraction == pytest.approx(0.9)


def test_local_lines_do_not_diverge_here_though_nothing_certifies_them():
    found = diagnose_fitted(GRID, GRID16, LocallyWeighted(0.1))
    assert found.verdict == "converges" and not found.guaranteed and found.hat_norm > 1.3
    lively = ~GRID.is_goal(GRID16)
    middle = 19.5 - 10 * GRID16.sum(axis=1)  # half-way up the steps of the staircase
    assert np.abs(found.run.values[-1] - middle)[lively].max() < 0.40


def test_puddles_defeat_a_quadratic_and_not_a_grid():
    world = puddle_world()
    support = grid_support(world, 16)
    mdp, index = reachable_mdp(world, support)
    exact = -solve(mdp, 1.0).v[index]
    assert diagnose_fitted(world, support, LeastSquares()).verdict == "diverges"
    errors = []
    for side in (16, 21, 61):
        fine = grid_support(world, side)
        run = fitted_iteration(world, fine, GridInterpolation())
        assert run.converged
        errors.append(np.abs(GridInterpolation().fit(fine).predict(run.targets, support) - exact).max())
    assert errors[2] < 1e-9 < errors[0]  # 61 points a side hold every state that 16 points can reach


def test_the_car_is_learned_by_interpolation():
    found = diagnose_fitted(car_on_the_hill(), grid_support(car_on_the_hill(), 16), GridInterpolation())
    assert found.guaranteed and found.run.converged


@pytest.mark.slow
def test_a_network_is_run_but_never_certified():
    network = NetworkRegressor(num_hidden=6, num_steps=40)
    found = diagnose_fitted(GRID, grid_support(GRID, 6), network, num_iterations=20)
    again = fitted_iteration(GRID, grid_support(GRID, 6), network, num_iterations=20)
    assert not found.guaranteed and found.hat_norm is None and found.growth is None
    assert np.isfinite(found.run.values).all() and "network" in found.explain()
    np.testing.assert_array_equal(found.run.values, again.values)


def test_a_network_fits_a_bowl_and_repeats_itself():
    fit = NetworkRegressor(num_hidden=10, num_steps=150).fit(GRID16)
    bowl = ((GRID16 - 0.4) ** 2).sum(axis=1)
    first, second = fit.predict(bowl, GRID16), fit.predict(bowl, GRID16)
    assert np.abs(first - bowl).max() < 0.02
    np.testing.assert_array_equal(first, second)

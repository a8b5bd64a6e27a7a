"""The edges of the oracle: where a verdict turns, a check refuses, a method gives way to another.

Mutants that die here: a comparison that takes its edge in, or leaves it out; the slack of optimal actions once too
often or too rarely; a check that asks for both of two wrongs.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from neuralq.exact import (
    count_optimal_policies,
    optimal_policies,
    predict_expected_td,
    rmsve,
    solve,
    solve_average,
    td_operator,
)
from neuralq.exact.problem import prepare
from neuralq.exact.undiscounted import _most_steps, certified
from neuralq.mdp import FiniteMDP


@pytest.mark.parametrize(
    ("matrix", "step_size", "radius", "converges", "bound", "oscillates", "doubling"),
    [
        ([[2.0]], 0.25, 0.5, True, 1.0, False, None),  # 1 − α λ = ½
        ([[2.0]], 0.5, 0.0, True, 1.0, False, None),
        ([[2.0]], 0.75, 0.5, True, 1.0, True, None),  # −½
        ([[2.0]], 1.0, 1.0, False, 1.0, True, None),  # −1: neither shrinks nor grows
        ([[2.0]], 1.5, 2.0, False, 1.0, True, 1.0),  # −2: doubles in every step
        ([[-1.0]], 1.0, 2.0, False, 0.0, False, 1.0),
        ([[-1.0]], 3.0, 4.0, False, 0.0, False, 0.5),
        ([[0.0, -1.0], [1.0, 0.0]], 1.0, math.sqrt(2), False, 0.0, True, 2.0),  # 1 ∓ i
        ([[1.0, -1.0], [1.0, 1.0]], 0.5, math.sqrt(0.5), True, 1.0, True, None),  # 1 − ½ (1 ± i) = ½ (1 ∓ i)
        ([[1.0, 0.0], [0.0, 4.0]], 0.25, 0.75, True, 0.5, False, None),  # the slow mode decides: ¾ and 0
        ([[1.0, 0.0], [0.0, 4.0]], 0.45, 0.8, True, 0.5, True, None),  # the fast one: .55 and −.8
    ],
)
def test_verdicts_at_the_places_where_they_turn(
    matrix: list[list[float]],
    step_size: float,
    radius: float,
    converges: bool,
    bound: float,
    oscillates: bool,
    doubling: float | None,
) -> None:
    found = predict_expected_td(matrix, step_size)
    assert found.spectral_radius == pytest.approx(radius) and found.converges == converges
    assert found.step_size_bound == pytest.approx(bound) and found.oscillates == oscillates
    assert found.doubling_time == (None if doubling is None else pytest.approx(doubling))
    assert found.rank == len(matrix) and found.min_real_eigenvalue == pytest.approx(min(np.linalg.eigvals(matrix).real))
    assert np.all(np.diff(found.eigenvalues.real) >= 0)


def test_what_moves_nothing_is_called_stable() -> None:
    for nothing in (np.zeros((2, 2)), np.zeros((0, 0))):
        found = predict_expected_td(nothing, 0.5)
        assert (found.spectral_radius, found.min_real_eigenvalue, found.converges) == (0.0, 0.0, True)
        assert (found.step_size_bound, found.oscillates, found.doubling_time, found.rank) == (math.inf, False, None, 0)
    seen = predict_expected_td(np.diag([3.0, 0.0, 1e-6]), 0.5)  # small is not nothing
    assert seen.rank == 2 and seen.eigenvalues.real == pytest.approx([1e-6, 3.0])
    for size in (2, 4):  # rounding grows with the size of the matrix: up to 10⁻¹² of the largest for each row
        for times, rank in ((0.9, size - 1), (1.1, size)):
            assert predict_expected_td(np.diag([1.0] * (size - 1) + [times * size * 1e-12]), 0.5).rank == rank


@pytest.mark.parametrize(
    "wrong",
    [
        {"P_pi": np.eye(3)},
        {"P_pi": np.ones((2, 3))},
        {"features": np.ones((3, 2))},
        {"features": np.ones(2)},
        {"features": np.ones((2, 1, 1))},
        {"d": np.ones(3)},
        {"d": np.ones((2, 1))},
        {"P_pi": sparse.eye_array(3)},
    ],
)
def test_each_shape_that_does_not_fit_is_refused(wrong: dict[str, Any]) -> None:
    right: dict[str, Any] = {"P_pi": np.eye(2), "r_pi": [0.0, 1.0], "features": np.eye(2), "d": [0.5, 0.5]}
    assert td_operator(**right, gamma=0.5)[0].shape == (2, 2)
    with pytest.raises(ValueError, match=r"P_pi must be \[S, S\], r_pi \[S\], features \[S, d\] and d \[S\], got"):
        td_operator(**{**right, **wrong}, gamma=0.5)


@pytest.mark.parametrize("matrix", [np.ones((2, 3)), np.ones(2), np.ones((1, 1, 1)), [[math.nan]], [[math.inf]]])
def test_only_finite_square_matrices_have_a_verdict(matrix: Any) -> None:
    with pytest.raises(ValueError, match="A must be a finite square matrix"):
        predict_expected_td(matrix, 0.1)


def test_the_vector_of_the_operator_by_hand() -> None:
    # Two states, 0 → 1 → 1, r = (3, 5), X = (1, 2), d = (¼, ¾), γ = ½, λ = ½. (I − ¼P)⁻¹ = [[1, ⅓], [0, 4/3]].
    A, b = td_operator([[0.0, 1.0], [0.0, 1.0]], [3.0, 5.0], [[1.0], [2.0]], [0.25, 0.75], 0.5, 0.5)
    # (I − ½P) X = (1 − 1, 2 − 1) = (0, 1) → (⅓, 4/3); A = ¼ · 1 · ⅓ + ¾ · 2 · 4/3; r → (3 + 5/3, 20/3).
    assert A.tolist() == [[pytest.approx(1 / 12 + 2)]] and b.tolist() == [pytest.approx(14 / 12 + 10)]
    assert rmsve([3.0, 1.0], [1.0, 1.0], [0.25, 0.75]) == 1.0


def line(num_states: int) -> FiniteMDP:
    s = np.arange(num_states)
    p = sparse.csr_array((np.ones(num_states), (s, np.minimum(s + 1, num_states - 1))), shape=(num_states, num_states))
    return FiniteMDP(num_states, 1, s, np.zeros(num_states, dtype=int), p, np.ones(num_states))


def test_the_method_that_is_chosen_changes_at_two_thousand_states() -> None:
    assert solve(line(2000), 0.5).method == "policy-iteration"
    assert solve(line(2001), 0.5).method == "modified-policy-iteration"


def test_optimal_actions_are_those_within_twice_the_error_of_the_best() -> None:
    mdp = FiniteMDP.garnet(60, 6, 3, seed=1)
    for sweeps in (20, 40, 60):
        early = solve(mdp, 0.9, "gauss-seidel", max_iterations=sweeps)
        gap = early.q.max(axis=1, keepdims=True) - early.q
        slack = early.bound + early.residual
        assert np.array_equal(early.optimal_actions, gap <= 2 * slack)
        assert early.bound > 0 and np.any((gap > 2 * slack) & (gap < 40 * slack))  # a larger slack would take more in


def test_the_policies_of_two_choices_and_an_end() -> None:
    twice = FiniteMDP.from_functions(3, 2, lambda s: [0, 1][: 2 - s], lambda s, a: [(1.0, 2, 1.0, False)])
    answer = solve(twice, 0.5)
    assert count_optimal_policies(answer) == 2
    assert [policy.tolist() for policy in optimal_policies(answer)] == [[0, 0, -1], [1, 0, -1]]
    with pytest.raises(ValueError, match="seed must be a whole number of at least 0"):
        solve(twice, 0.5, "rtdp", seed=-1)
    assert solve(twice, 0.5, "rtdp", seed=0, max_iterations=1).iterations == 1


def test_the_seed_of_simulated_trials_is_0_unless_another_is_named() -> None:
    mdp = FiniteMDP.garnet(30, 3, 3, seed=0)
    for method in ("rtdp", "labelled-rtdp"):
        plain, zero, one = (solve(mdp, 0.9, method, **more) for more in ({}, {"seed": 0}, {"seed": 1}))  # type: ignore[arg-type]
        assert plain.backups == zero.backups != one.backups


def test_sweeping_by_priority_counts_no_iteration_where_nothing_waits() -> None:
    # From s one step leads to the end. Nothing is earned: 0 is right at once. With a reward one state waits, once.
    for reward in (0.0, 3.0):
        mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 1.0]]], [[reward], [np.nan]])
        answer = solve(mdp, 0.9, "prioritized-sweeping")
        assert answer.v.tolist() == [reward, 0.0] and answer.iterations == (reward > 0)


def test_seconds_are_those_of_this_answer() -> None:
    began = time.perf_counter()
    found = [solve(line(9), 0.5).seconds, solve(line(9), 1.0 - 1e-3, "value-iteration").seconds]
    resting = FiniteMDP.from_arrays([[[1.0]]], [[0.0]])
    found += [solve(resting, 1.0).seconds, solve_average(resting).seconds]
    assert all(0 < seconds < time.perf_counter() - began for seconds in found)


def test_the_bound_on_the_number_of_steps_is_above_the_number() -> None:
    # 0 → 1 → 2 → end, and 0 → end: three steps at most; rounding must not leave the bound below it.
    mdp = FiniteMDP.from_functions(3, 2, lambda s: [0, 1], lambda s, a: [(1.0, min(s + 1, 2), -1.0, a == 1 or s == 2)])
    assert 3 < _most_steps(prepare(mdp, 1.0), np.ones(mdp.num_rows, dtype=bool)) < 3 + 1e-6


def test_a_cycle_is_named_whole_where_the_action_before_ends() -> None:
    # In both states action 0 ends; action 1 leads to the other one and earns 1.
    mdp = FiniteMDP.from_functions(2, 2, lambda s: [0, 1], lambda s, a: [(1.0, 1 - s, float(a), a == 0)])
    with pytest.raises(
        ValueError, match=r"cycle state (0 → state 1 → state 0|1 → state 0 → state 1) earns 2 each time"
    ):
        solve(mdp, 1.0, "bellman-ford")


@pytest.mark.parametrize(("cost", "reach"), [(0.7, 3.0), (0.5, math.inf), (0.3, math.inf)])
def test_a_way_that_never_ends_is_ruled_out_by_more_than_the_error_of_all_steps(cost: float, reach: float) -> None:
    """Leave for −1, or stay at a cost; values .1 too low may be off by .2 a step, of which there are up to three."""
    mdp = FiniteMDP.from_arrays([[[0.0]], [[1.0]]], [[-1.0, -cost]], substochastic=True)
    assert certified(prepare(mdp, 1.0), np.array([-1.1])).reach == pytest.approx(reach)

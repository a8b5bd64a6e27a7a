"""Exact answers do not depend on the unit in which rewards are counted, nor on the exit by which an iteration ends.

Mutants that die here: the constant taken out only where the tolerance is met; a tolerance that large rewards cannot
meet at all, or that small ones meet at once; ties judged by 1 + size; a linear program with rewards of 1e-12.
"""

from __future__ import annotations

import dataclasses
import math
from fractions import Fraction

import numpy as np
import pytest
from numpy.typing import NDArray

from neuralq.apps.cli import main
from neuralq.exact import METHODS as ALL_METHODS
from neuralq.exact import (
    Solution,
    count_optimal_policies,
    evaluate_average,
    optimal_policies,
    solve,
    solve_average,
)
from neuralq.mdp import FiniteMDP
from neuralq.tabular import Experience, batch_td

METHODS = [method for method in ALL_METHODS if method != "bellman-ford"]


def scaled(mdp: FiniteMDP, factor: float) -> FiniteMDP:
    return dataclasses.replace(mdp, reward=mdp.reward * factor, outcomes=None)


def dense_answer(mdp: FiniteMDP, gamma: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """V* and the optimal actions by dense policy iteration; every state has every action."""
    n, m = mdp.num_states, mdp.num_actions
    p, r = mdp.transition.toarray().reshape(n, m, n), mdp.reward.reshape(n, m)
    policy = np.zeros(n, dtype=int)
    for _ in range(50):
        v = np.linalg.solve(np.eye(n) - gamma * p[np.arange(n), policy], r[np.arange(n), policy])
        q = r + gamma * p @ v
        policy = q.argmax(axis=1)
    return v, q >= q.max(axis=1, keepdims=True) - 1e-9 * np.abs(v).max()


@pytest.mark.parametrize("method", METHODS)
def test_an_iteration_that_stops_at_rounding_adds_the_constant_too(method: str) -> None:
    # (I − γP) V = r by Cramer's rule: det = (1 − .3γ)(1 − .4γ) − .42γ², V₀ = (1000 (1 − .4γ) + 1400 γ) / det.
    g, p = Fraction(999, 1000), [[Fraction(3, 10), Fraction(7, 10)], [Fraction(6, 10), Fraction(4, 10)]]
    det = (1 - g * p[0][0]) * (1 - g * p[1][1]) - g * g * p[0][1] * p[1][0]
    right = [
        float((1000 * (1 - g * p[1][1]) + 2000 * g * p[0][1]) / det),
        float((2000 * (1 - g * p[0][0]) + 1000 * g * p[1][0]) / det),
    ]
    assert right == pytest.approx([1_538_047.24, 1_538_816.65], abs=0.005)
    answer = solve(FiniteMDP.from_arrays([[[0.3, 0.7], [0.6, 0.4]]], [[1000.0], [2000.0]]), 0.999, method)
    assert answer.converged and np.abs(answer.v - right).max() <= answer.bound < 1e-4


@pytest.mark.parametrize("method", [method for method in METHODS if method not in ("gauss-seidel", "labelled-rtdp")])
def test_every_exit_gives_the_same_values_and_actions_at_a_reach_of_ten_thousand(method: str) -> None:
    if method in ("rtdp", "prioritized-sweeping"):
        mdp, gamma = (
            scaled(FiniteMDP.garnet(20, 3, 3, seed=0), 10.0),
            0.999,
        )  # one state at a time: slow where γ is near 1
    else:
        mdp, gamma = scaled(FiniteMDP.garnet(200, 4, 3, seed=0), 10.0), 0.9999
    v, optimal = dense_answer(mdp, gamma)
    answer = solve(mdp, gamma, method)
    assert answer.converged and answer.separated.all()
    assert np.abs(answer.v - v).max() <= answer.bound + 1e-6
    assert answer.bound < 1e-9 * np.abs(v).max()
    assert np.array_equal(answer.optimal_actions, optimal)


@pytest.mark.parametrize("method", ["auto", "policy-iteration", "modified-policy-iteration", "linear-programming"])
def test_an_action_that_is_better_by_less_than_the_error_counts_where_the_reach_is_long(method: str) -> None:
    # Both actions lead to either state alike, so V = r + γ · mean of V: with actions of 1 and 1 + δ in each state
    # V = (1 + δ)/(1 − γ) = 10⁶ (1 + δ). Rounding leaves an error of some 10⁻³; δ is below, and adds up to 10⁶ δ.
    for delta in (1e-3, 1e-6):
        mdp = FiniteMDP.from_arrays(np.full((2, 2, 2), 0.5), [[1.0, 1.0 + delta], [1.0, 1.0 + delta]])
        answer = solve(mdp, 1 - 1e-6, method)
        assert answer.policy.tolist() == [1, 1] and answer.optimal_actions[:, 1].all()
        assert np.abs(answer.v - 1e6 * (1 + delta)).max() <= answer.bound + 1e-4 and answer.bound < 0.1


def test_policies_of_a_random_model_at_a_reach_of_a_million_are_those_of_its_average() -> None:
    # As γ → 1 a discount-optimal policy earns the best average reward; found by its own equations.
    mdp = FiniteMDP.garnet(200, 3, 3, seed=1)
    best = solve_average(mdp).gain
    for method in ("policy-iteration", "modified-policy-iteration"):
        answer = solve(mdp, 1 - 1e-6, method)
        assert evaluate_average(mdp, answer.policy).gain == pytest.approx(best, abs=1e-9)
        assert answer.bound < 1e-8 * np.abs(answer.v).max()


def test_an_early_stop_takes_the_constant_out_as_well() -> None:
    # One modulus everywhere: after 60 sweeps the span is small, but 0.9999^60 of the constant is left.
    mdp = FiniteMDP.garnet(200, 4, 3, seed=0)
    v, _ = dense_answer(mdp, 0.9999)
    for method, sweeps in (("value-iteration", 60), ("modified-policy-iteration", 8)):
        early = solve(mdp, 0.9999, method, max_iterations=sweeps)
        assert early.iterations == sweeps
        assert np.abs(early.v - v).max() <= early.bound < 1e-3 * np.abs(v).max()


@pytest.mark.parametrize("exponent", [-60, -33, 33, 60])
def test_the_unit_of_rewards_changes_no_answer(exponent: int) -> None:
    mdp, unit = FiniteMDP.garnet(12, 3, 3, seed=0), 2.0**exponent
    v, optimal = dense_answer(mdp, 0.99)
    for method in METHODS:
        answer = solve(scaled(mdp, unit), 0.99, method)
        assert answer.converged and np.array_equal(answer.optimal_actions, optimal), method
        assert answer.v / unit == pytest.approx(v, abs=1e-4), method


@pytest.mark.parametrize("exponent", [-60, -33, 33, 60])
@pytest.mark.parametrize("method", ["policy-iteration", "relative-value-iteration"])
def test_the_unit_of_rewards_changes_no_average(method: str, exponent: int) -> None:
    # Stay for 1, or go round 0 → 1 → 0 for (0 + 3) / 2 a step.
    unit = 2.0**exponent
    mdp = FiniteMDP.from_arrays([[[1, 0], [1, 0]], [[0, 1], [0, 1]]], [[unit, 0.0], [3 * unit, math.nan]])
    answer = solve_average(mdp, method)
    assert answer.gain / unit == pytest.approx([1.5, 1.5], abs=1e-5) and answer.policy.tolist() == [1, 0]
    assert answer.converged and answer.iterations < 1000


@pytest.mark.parametrize("exponent", [-60, -33, 33, 60])
def test_the_unit_of_rewards_changes_no_proof_at_a_discount_of_1(exponent: int) -> None:
    # 0 may wait for −1, or leave for −3; waiting for ever loses without bound, so its rows are not near the best ones.
    unit = 2.0**exponent
    rows = {(0, 0): [(1.0, 0, -unit, False)], (0, 1): [(0.5, 0, -3 * unit, False), (0.5, 0, -3 * unit, True)]}
    mdp = FiniteMDP.from_functions(1, 2, lambda s: [0, 1], lambda s, a: rows[s, a])
    answer = solve(mdp, 1.0)
    assert answer.converged and answer.v / unit == pytest.approx([-6.0]) and answer.policy.tolist() == [1]


def test_the_unit_of_rewards_changes_no_batch_fit() -> None:
    # 0 → 1 → end with reward 1, and 1 → end with reward 0: V = ½ everywhere (certainty equivalence).
    for unit in (2.0**-60, 1.0, 2.0**60):
        steps = Experience([0, 1, 1], [0, 0, 0], [0.0, unit, 0.0], [1.0, 0.0, 0.0], [1, 1, 1], [False, True, True])  # type: ignore[arg-type]
        v, converged = batch_td([0.0, 0.0], steps, lambda_=0.0, step_size=0.1)
        assert converged and v / unit == pytest.approx([0.5, 0.5], abs=1e-8)


def undecided() -> Solution:
    return solve(FiniteMDP.garnet(50, 3, 4, seed=0), 0.99, "gauss-seidel", max_iterations=2)


def test_optimal_actions_are_claimed_only_where_the_bound_separates_them() -> None:
    early = undecided()
    assert not early.converged and not early.separated.all()
    _, optimal = dense_answer(FiniteMDP.garnet(50, 3, 4, seed=0), 0.99)
    assert not np.any(optimal & ~early.optimal_actions)  # none is missing
    s = int(np.argmin(early.separated))
    for claim in (count_optimal_policies, lambda answer: next(optimal_policies(answer))):
        with pytest.raises(ValueError, match=f"which actions of state {s} are optimal is not known: .* tol"):
            claim(early)


def test_the_command_line_claims_no_action_that_is_not_known(capsys: pytest.CaptureFixture[str]) -> None:
    stopped = ["--gamma", "0.95", "--method", "gauss-seidel", "--max-iterations", "2"]
    assert main(["solve", "neuralq/DynaMaze-v0", *stopped]) == 1
    assert "optimal policies: not known: the bound separates no actions in" in capsys.readouterr().out
    assert main(["solve", "neuralq/DynaMaze-v0", *stopped, "--json"]) == 1
    assert "null" in capsys.readouterr().out.splitlines()[-1]
    assert main(["solve", "neuralq/RandomWalk-v0", "--gamma", "0.9"]) == 0

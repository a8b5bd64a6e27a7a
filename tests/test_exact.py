"""The exact solvers against the book, dense linear algebra and brute-force sums.

Mutants that die here: γ missing from, or squared in, a backup; the row discount ignored; an illegal or terminal entry
read as 0 in a maximum of negative values; a bound without the factor 1/(1 − c); the challenger taken on ties; P where
Pᵀ belongs in A; λ applied once too often; D of the target instead of the update distribution; the null space kept.
"""

from __future__ import annotations

import itertools
import math

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse

from neuralq.exact import METHODS as ALL_METHODS
from neuralq.exact import (
    action_values,
    count_optimal_policies,
    evaluate,
    optimal_policies,
    policy_process,
    predict_expected_td,
    rmsve,
    solve,
    td_operator,
)
from neuralq.mdp import FiniteMDP
from neuralq_envs import mitchell
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.baird import critical_gamma

METHODS = [method for method in ALL_METHODS if method != "bellman-ford"]
X = np.nan


@pytest.mark.parametrize("method", METHODS)
def test_figure_13_2(method: str) -> None:
    answer = solve(mitchell.mdp(), 0.9, method)
    assert answer.v.reshape(2, 3) == pytest.approx(np.array([[90, 100, 0], [81, 90, 100]]))
    q = [[X, 90, 72.9, X], [X, 100, 81, 81], [X, X, X, X], [81, 81, X, X], [90, 90, X, 72.9], [100, X, X, 81]]
    np.testing.assert_allclose(answer.q, q, atol=1e-9)  # north, east, south, west
    assert answer.policy.tolist() == [1, 1, -1, 0, 0, 0]
    ties = [[1], [1], [], [0, 1], [0, 1], [0]]  # exercise 13.1: 2 × 2 optimal policies
    assert [np.flatnonzero(row).tolist() for row in answer.optimal_actions] == ties
    assert answer.converged and answer.bound <= 1e-8
    assert count_optimal_policies(answer) == 4
    assert sorted(policy.tolist() for policy in optimal_policies(answer)) == [
        [1, 1, -1, north_or_east, also, 0] for north_or_east in (0, 1) for also in (0, 1)
    ]


def dense(mdp: FiniteMDP) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """P [S, A, S] with row discounts and R [S, A], −∞ where illegal."""
    p = np.zeros((mdp.num_states, mdp.num_actions, mdp.num_states))
    r = np.full((mdp.num_states, mdp.num_actions), -np.inf)
    for k in range(mdp.num_rows):
        p[mdp.s_tm1[k], mdp.a_tm1[k]] = mdp.transition[[k]].toarray()[0] * mdp.row_discount[k]
        r[mdp.s_tm1[k], mdp.a_tm1[k]] = mdp.reward[k]
    return p, r


def newest(name: str) -> str:
    """The newest version that the installed Gymnasium has; it warns about, or refuses, the others."""
    return max(env_id for env_id in gymnasium.registry if env_id.startswith(f"{name}-v"))


@pytest.mark.parametrize(
    ("name", "gamma"),
    [
        ("FrozenLake8x8", 0.95),
        ("FrozenLake8x8", 0.99),
        ("Taxi", 0.99),
        pytest.param("Taxi", 0.95, marks=pytest.mark.slow),
    ],
)
def test_gymnasium_models_against_a_dense_solution(name: str, gamma: float) -> None:
    env = gymnasium.make(newest(name)).unwrapped
    n, m = env.observation_space.n, env.action_space.n  # type: ignore[attr-defined]
    p, r = np.zeros((n, m, n)), np.zeros((n, m))
    for s in range(n):
        for a in range(m):
            for probability, s_t, reward, terminated in env.P[s][a]:  # type: ignore[attr-defined]
                p[s, a, s_t] += 0 if terminated else probability
                r[s, a] += probability * reward
    v = np.zeros(n)
    for _ in range(400):
        v = (r + gamma * p @ v).max(axis=1)
    policy = (r + gamma * p @ v).argmax(axis=1)
    v = np.linalg.solve(np.eye(n) - gamma * p[np.arange(n), policy], r[np.arange(n), policy])
    assert (r + gamma * p @ v).max(axis=1) == pytest.approx(v, abs=1e-10)  # so v is optimal
    mdp = FiniteMDP.from_gymnasium(env)
    for method in METHODS:
        if method == "labelled-rtdp" and name != "Taxi":
            continue  # its checks grow with the greedy envelope: seconds where everything leads everywhere
        limit = 60 if "policy" in method else None  # a solver that cycles fails here instead of hanging
        answer = solve(mdp, gamma, method, max_iterations=limit)
        assert answer.converged
        assert np.abs(answer.v - v).max() <= answer.bound + 1e-10 <= 2e-8
        assert evaluate(mdp, answer.policy, gamma) == pytest.approx(v, abs=1e-6)
        if "policy" in method:  # ties do not cycle
            assert answer.iterations < 40


@st.composite
def models(draw: st.DrawFn) -> FiniteMDP:
    """Random models with terminal states, illegal actions, missing mass, row discounts and ties."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    n, m = draw(st.integers(1, 6)), draw(st.integers(1, 3))
    legal = rng.random((n, m)) < draw(st.sampled_from([0.5, 1.0]))
    legal[0, 0] = True
    s_tm1, a_tm1 = np.nonzero(legal)
    k = len(s_tm1)
    p = rng.dirichlet(np.full(n, 0.3), size=k) * np.where(rng.random((k, 1)) < 0.3, rng.random((k, 1)), 1.0)
    discount = np.where(rng.random(k) < 0.2, rng.random(k), 1.0)
    return FiniteMDP(n, m, s_tm1, a_tm1, sparse.csr_array(p), rng.integers(-2, 2, k).astype(float), discount)


@given(models(), st.sampled_from([0.0, 0.5, 0.9, 0.97]))
def test_all_methods_agree_within_their_bounds_and_solve_the_bellman_equation(mdp: FiniteMDP, gamma: float) -> None:
    answers = [solve(mdp, gamma, method) for method in METHODS]
    assert all(answer.converged for answer in answers)
    for one, two in itertools.combinations(answers, 2):
        assert np.abs(one.v - two.v).max() <= one.bound + two.bound, (one.method, two.method)
    p, r = dense(mdp)
    for answer in answers:
        backup = np.where(mdp.is_terminal, 0.0, (r + gamma * p @ answer.v).max(axis=1))
        assert backup == pytest.approx(answer.v, abs=1e-7)
        assert np.array_equal(np.isnan(answer.q), ~mdp.legal)
        best = np.where(mdp.is_terminal, 0.0, np.nanmax(np.where(mdp.is_terminal[:, None], 0.0, answer.q), axis=1))
        assert best == pytest.approx(answer.v, abs=1e-7)
        assert np.array_equal(answer.optimal_actions.any(axis=1), ~mdp.is_terminal)
        assert evaluate(mdp, answer.policy, gamma) == pytest.approx(answer.v, abs=1e-5)
        # A uniform mixture of the optimal actions is optimal too.
        mixture = answer.optimal_actions / np.maximum(1, answer.optimal_actions.sum(axis=1, keepdims=True))
        assert evaluate(mdp, mixture, gamma) == pytest.approx(answer.v, abs=1e-5)


@settings(max_examples=30, deadline=None)
@given(models(), st.integers(1, 30))
def test_the_bound_holds_wherever_a_solver_is_stopped(mdp: FiniteMDP, max_iterations: int) -> None:
    exact = solve(mdp, 0.95, "policy-iteration").v
    for method in METHODS:
        early = solve(mdp, 0.95, method, tol=1e-12, max_iterations=max_iterations)
        assert np.abs(early.v - exact).max() <= early.bound + 1e-10
        assert early.bound <= 1e-12 * max(1.0, np.abs(early.v).max()) if early.converged else early.bound > 1e-12


def test_a_solver_that_stops_early_says_so() -> None:
    mdp = FiniteMDP.garnet(50, 3, 4, seed=0)
    early = solve(mdp, 0.99, "value-iteration", max_iterations=5)
    assert not early.converged and early.bound > 1e-8 and early.iterations == 5
    assert early.backups == 6 * mdp.num_rows
    # The bound is sharp on a single absorbing state: V_n = Σ γ^k, k < n, is off by exactly γ^n / (1 − γ).
    loop = solve(FiniteMDP.from_arrays([[[1.0]]], [[1.0]]), 0.5, "gauss-seidel", max_iterations=3)
    assert loop.v[0] == 1.875 and loop.bound == pytest.approx(0.125)
    for method in METHODS:  # a tolerance below rounding is not claimed
        assert not solve(FiniteMDP.from_arrays([[[1.0]]], [[1e9]]), 0.99, method, tol=1e-12).converged


def test_large_ties_do_not_cycle() -> None:
    # Every action is a copy: any change is a pointless one.
    one = FiniteMDP.garnet(60, 1, 5, seed=1)
    blocks = [one.transition] * 4
    mdp = FiniteMDP.from_arrays(blocks, np.repeat(one.reward[:, None], 4, axis=1))
    answer = solve(mdp, 0.99, "policy-iteration")
    assert answer.iterations == 1 and answer.optimal_actions.all() and answer.policy.tolist() == [0] * 60
    assert count_optimal_policies(answer) == 4**60


def test_random_policies_against_dense_linear_algebra() -> None:
    mdp = FiniteMDP.garnet(20, 3, 4, seed=2)
    pi = np.random.default_rng(0).dirichlet(np.ones(3), size=20)
    p, r = dense(mdp)
    p_pi, r_pi = np.einsum("sa,sat->st", pi, p), (pi * r).sum(axis=1)
    found_p, found_r = policy_process(mdp, pi)
    assert found_p.toarray() == pytest.approx(p_pi) and found_r == pytest.approx(r_pi)
    v = np.linalg.solve(np.eye(20) - 0.9 * p_pi, r_pi)
    assert evaluate(mdp, pi, 0.9) == pytest.approx(v)
    assert action_values(mdp, v, 0.9) == pytest.approx(r + 0.9 * p @ v)


def walk() -> FiniteMDP:
    """Sutton's random walk on 5 states: left, right; 1 for leaving on the right."""

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        s_t = s + (1 if a else -1)
        return [(1.0, min(max(s_t, 0), 4), float(s_t == 5), s_t in (-1, 5))]

    return FiniteMDP.from_functions(5, 2, lambda s: [0, 1], transitions)


def test_undiscounted_walk_and_improper_policies() -> None:
    v = evaluate(walk(), np.full((5, 2), 0.5), 1.0)
    assert v == pytest.approx(np.arange(1, 6) / 6)  # Sutton 1988
    assert evaluate(walk(), [1] * 5, 1.0).tolist() == [1.0] * 5
    with pytest.raises(ValueError, match="from state 0 it never does; use gamma < 1"):
        evaluate(walk(), [1, 0, 0, 0, 0], 1.0)
    with pytest.raises(ValueError, match=r"gamma=1 does not contract: row 1 \(s=0, a=1\) can be repeated for ever"):
        solve(walk(), 1, "value-iteration")


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ([2, 0, 0, 0, 0], "takes action 2 in state 0, which is not legal"),
        ([0, 0, 0.5, 0, 0], r"takes action 0\.5 in state 2"),
        (np.full((5, 2), 0.4), r"policy in state 0 must sum to 1, got 0\.8"),
        (np.tile([1.5, -0.5], (5, 1)), r"policy\[0, 1\] must be a probability, got -0\.5"),
        (np.full((5, 2), np.nan), r"policy\[0, 0\] must be a probability, got nan"),
        (np.zeros(4), r"policy must be actions of shape \(5,\) or probabilities"),
    ],
)
def test_broken_policies_are_named(policy: NDArray[np.float64], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(walk(), policy, 0.9)


def test_illegal_moves_of_a_policy_are_named() -> None:
    with pytest.raises(ValueError, match=r"takes action 0 in state 0 \(row 0, column 0\), which is not legal"):
        evaluate(mitchell.mdp(), np.zeros(6), 0.9)
    with pytest.raises(ValueError, match=r"policy\[0, 0\] must be 0, for it is not legal, got 0\.25"):
        evaluate(mitchell.mdp(), np.full((6, 4), 0.25), 0.9)


def test_broken_arguments_are_named() -> None:
    mdp = walk()
    for call, message in [
        (lambda: solve(mdp, 1.5), "gamma must lie in"),
        (lambda: solve(mdp, 0.9, "magic"), "method must be one of 'auto', 'value-iteration', 'gauss-seidel'"),
        (lambda: solve(mdp, 0.9, tol=0.0), "tol must be a finite number above 0"),
        (lambda: solve(mdp, 0.9, max_iterations=0), "max_iterations"),
        (lambda: td_operator(np.eye(2), [0, 0], np.eye(2), [0.5, 0.5], 0.9, 1.5), "for Monte Carlo use lambda_=1"),
        (lambda: td_operator(np.eye(2), [0, 0], np.eye(3), [0.5, 0.5], 0.9), "got .2, 2., .2,., .3, 3. and .2,."),
        (lambda: predict_expected_td(np.zeros((2, 3)), 0.1), "A must be a finite square matrix"),
        (lambda: predict_expected_td(np.eye(2), 0.0), "step_size must be a finite number above 0"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize("lambda_", [0.0, 0.4, 0.9, 1.0])
def test_td_operator_is_the_sum_over_the_trace(lambda_: float) -> None:
    # A = Σ_k (γλ)^k Xᵀ D P^k (X − γ P X), b = Σ_k (γλ)^k Xᵀ D P^k r: what an eligibility trace accumulates.
    rng = np.random.default_rng(1)
    p, r = rng.dirichlet(np.ones(6), size=6), rng.standard_normal(6)
    x, d, gamma = rng.standard_normal((6, 3)), rng.dirichlet(np.ones(6)), 0.9
    a_sum, b_sum, ahead = np.zeros((3, 3)), np.zeros(3), np.diag(d)
    for _ in range(600):
        a_sum += x.T @ ahead @ (x - gamma * p @ x)
        b_sum += x.T @ ahead @ r
        ahead = gamma * lambda_ * ahead @ p
    a, b = td_operator(sparse.csr_array(p), r, x, d, gamma, lambda_)
    np.testing.assert_allclose(a, a_sum, atol=1e-12)
    np.testing.assert_allclose(b, b_sum, atol=1e-12)


def star_matrix(num_upper: int = 6, gamma: float = 0.99) -> NDArray[np.float64]:
    problem = star(num_upper)
    process = policy_process(problem.mdp, problem.target_policy)
    return td_operator(*process, problem.features, problem.state_distribution, gamma)[0]


def test_the_stars_eigenvalues() -> None:
    verdict = predict_expected_td(star_matrix(), 0.01)
    assert verdict.rank == 7  # 8 weights, one direction redundant
    assert verdict.eigenvalues.real[:2] == pytest.approx([-0.2392504643, -0.0221781], abs=5e-8)
    assert verdict.eigenvalues[2:] == pytest.approx(np.full(5, 4 / 7))
    assert not verdict.converges and verdict.step_size_bound == 0 and not verdict.oscillates
    assert verdict.min_real_eigenvalue == pytest.approx(-0.2392504643, abs=1e-10)
    for step_size, radius in [(0.01, 1.0023925), (0.005, 1.0011963)]:  # mean of i.i.d. sampling
        assert predict_expected_td(star_matrix(), step_size).spectral_radius == pytest.approx(radius, abs=5e-8)
    assert verdict.doubling_time == pytest.approx(math.log(2) / math.log(1.002392504643))


@pytest.mark.parametrize("step_size", [1e-4, 1e-3, 0.01, 0.1, 1.0])
def test_no_step_size_saves_the_star(step_size: float) -> None:
    assert predict_expected_td(star_matrix(), step_size).spectral_radius > 1


@pytest.mark.parametrize("num_upper", range(1, 10))
@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.9, 0.99])
def test_the_stars_closed_form(num_upper: int, gamma: float) -> None:
    # (n+1) λ is 4 (n − 1 times) or a root of λ² − T λ + (n+20)(1−γ), T = n + 9 − (2n+5) γ.
    n = num_upper
    half = (n + 9 - (2 * n + 5) * gamma) / 2
    root = np.emath.sqrt(half**2 - (n + 20) * (1 - gamma))
    expected = np.array([half - root, half + root, *[4.0] * (n - 1)]) / (n + 1)
    verdict = predict_expected_td(star_matrix(n, gamma), 0.01)
    np.testing.assert_allclose(np.sort_complex(verdict.eigenvalues), np.sort_complex(expected), atol=1e-7)
    assert (verdict.min_real_eigenvalue < 0) == (gamma > critical_gamma(n))
    assert verdict.converges == (gamma < critical_gamma(n))


def test_the_stars_threshold() -> None:
    assert critical_gamma(6) == 15 / 17
    for n in range(1, 10):
        critical = critical_gamma(n)
        if critical >= 1:
            assert n <= 4
            assert predict_expected_td(star_matrix(n, 0.9999), 1e-3).converges
        else:
            assert predict_expected_td(star_matrix(n, critical - 1e-6), 1e-6).min_real_eigenvalue > 0
            assert predict_expected_td(star_matrix(n, critical + 1e-6), 1e-6).min_real_eigenvalue < 0
    assert predict_expected_td(star_matrix(5), 0.01).oscillates  # it swings while it diverges
    assert not predict_expected_td(star_matrix(6), 0.01).oscillates


def test_controls_converge() -> None:
    problem = star()
    process = policy_process(problem.mdp, problem.target_policy)
    lower_only = np.eye(7)[6]
    for features, d in [(np.eye(7), problem.state_distribution), (problem.features, lower_only)]:
        verdict = predict_expected_td(td_operator(*process, features, d, 0.99)[0], 0.01)
        assert verdict.converges and verdict.step_size_bound > 0.01 and verdict.doubling_time is None
    # Ridge: eigenvalues move right by η; with η = .5 the largest, 4/7 + 1/2, gives the bound 28/15.
    ridge = predict_expected_td(star_matrix() + 0.5 * np.eye(8), 0.01)
    assert ridge.step_size_bound == pytest.approx(28 / 15) and ridge.rank == 8
    assert predict_expected_td(star_matrix() + 0.5 * np.eye(8), 28 / 15 - 1e-6).converges
    over = predict_expected_td(star_matrix() + 0.5 * np.eye(8), 28 / 15 + 1e-6)
    assert not over.converges and over.oscillates  # its factor is −1
    assert predict_expected_td(np.zeros((3, 3)), 0.1).converges


def test_a_direction_that_only_one_side_annihilates_stays() -> None:
    verdict = predict_expected_td([[0.0, 1.0], [0.0, 1.0]], 0.1)  # e₁ is never corrected, but w₁ drifts with w₂
    assert verdict.rank == 2 and not verdict.converges and verdict.spectral_radius == pytest.approx(1)


def test_prediction_equals_training_on_random_problems() -> None:
    outcomes = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        mdp = FiniteMDP.garnet(8, 2, 3, seed=seed)
        pi, d = rng.dirichlet(np.full(2, 0.3), size=8), rng.dirichlet(np.full(8, 0.3))
        x = rng.standard_normal((8, 3)) @ rng.standard_normal((3, 4))  # redundant: 4 weights, rank 3
        step_size, lambda_ = rng.uniform(0.05, 0.6), rng.choice([0.0, 0.5])
        p_pi, r_pi = policy_process(mdp, pi)
        a, b = td_operator(p_pi, r_pi, x, d, 0.99, lambda_)
        verdict = predict_expected_td(a, step_size)
        if abs(verdict.spectral_radius - 1) < 4e-3:
            continue
        w, change, first = rng.standard_normal(4), 0.0, None
        for _ in range(3000):
            move = step_size * (b - a @ w)
            w, change = w + move, float(np.abs(move).max())
            first = first or change
            if change > 1e9:
                break
        outcomes.append(verdict.converges)
        assert (change < 1e-2 * first) == verdict.converges, seed
    assert 5 < sum(outcomes) < len(outcomes) - 5  # both kinds occur


def test_rmsve_weighs_states() -> None:
    assert rmsve([1.0, 2.0], [0.0, 0.0], [0.25, 0.75]) == pytest.approx(math.sqrt(0.25 + 3.0))


@pytest.mark.parametrize("method", ["auto", "value-iteration", "policy-iteration", "linear-programming", "rtdp"])
def test_a_discount_of_its_own_ends_a_loop(method: str) -> None:
    # State 1 stays where it is, and each step ends the episode with probability 1/2: V(1) = −1 + V(1)/2 = −2.
    loop = FiniteMDP(2, 1, [0, 1], [0, 0], sparse.csr_array([[0.0, 1.0], [0.0, 1.0]]), [-1.0, -1.0], [1.0, 0.5])  # type: ignore[arg-type]
    assert solve(loop, 1.0, method=method).v == pytest.approx([-3.0, -2.0], abs=1e-7)

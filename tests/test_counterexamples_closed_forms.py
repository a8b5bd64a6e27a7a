"""Problems on which learning goes wrong: closed forms in γ, ε, λ, β and p against matrices, and published numbers.

Numbers with many digits were computed by an independent float64 matrix iteration, unless a source is named.

Mutants that die here: ε on the wrong side of w → 2w, its threshold as 5/(6 − 2ε), its shares of visits exchanged;
rewards of Kolter's states exchanged, or paid by action; p and 1 − p exchanged; costs of Bertsekas' chain exchanged, or
one state left out; the wrong states alike in A-presplit; rewards of B exchanged, B that does not lead to A; an averager
whose rows may be negative; chattering with rewards exchanged; the spiral turning the other way, by ``expm``, without
its Hessian's cross term; the limit that the book prints for the Bellman error on the right.
"""

from __future__ import annotations

from math import log, sqrt

import numpy as np
import pytest
from counterexample_algebra import Floats, chain, dense, fixed_point, rmsve, td, values
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from neuralq.lab.fitted.diagnosis import is_averager
from neuralq.lab.problems import Problem
from neuralq_envs.counterexamples import (
    bertsekas,
    chains,
    chattering,
    emphatic,
    gordon,
    kolter,
    spiral,
    split,
    w2w,
)

# --- w to 2w, Gordon --------------------------------------------------------------------------------------------------


def least_squares_factor(gamma: float, epsilon: float) -> float:
    """Refitting by least squares multiplies w by γ(6 − 4ε)/5."""
    return gamma * (6 - 4 * epsilon) / 5


def hat_matrix(p: Problem) -> Floats:
    """Least squares weighted by d fits ŷ = H y with H = X (XᵀDX)⁺ XᵀD."""
    root = np.sqrt(p.state_distribution)
    return p.features @ np.linalg.pinv(root[:, None] * p.features) * root


def critical_lambda(gamma: float) -> float:
    """On the two states of emphatic TD, TD(λ) is stable iff λ > 6 − 5/γ."""
    return 6 - 5 / gamma


def follow_on_window(gamma: float) -> tuple[float, float]:
    """ETD(0, β) is stable there, with a follow-on of finite variance, for β in this open interval."""
    return max(0.0, (6 * gamma - 5) / (3 - 2 * gamma)), sqrt(0.5)


@given(st.floats(0, 1), st.floats(0, 1))
def test_w2w_in_gamma_and_epsilon(gamma: float, epsilon: float) -> None:
    p = w2w.w2w(gamma, epsilon)
    a = float(td(p)[0][0, 0])
    assert a == pytest.approx((5 - gamma * (6 - 4 * epsilon)) / 2, abs=1e-12)
    c = 2.5  # ½(1 + 4)
    assert least_squares_factor(gamma, epsilon) == pytest.approx(1 - a / c, abs=1e-12)
    if abs(gamma - w2w.critical_gamma(epsilon)) > 1e-9:
        assert (a < 0) == (gamma > w2w.critical_gamma(epsilon))
    residual = p.features - gamma * chain(p, p.target_policy)[0] @ p.features
    assert float(residual[:, 0] @ residual[:, 0]) == pytest.approx(
        (1 - 2 * gamma) ** 2 + (2 - 2 * gamma * (1 - epsilon)) ** 2, abs=1e-12
    )
    assert w2w.w2w_single(gamma).features[0, 0] * (1 - 2 * gamma) == pytest.approx(td(w2w.w2w_single(gamma))[0][0, 0])


@pytest.mark.parametrize(
    ("gamma", "epsilon", "factor", "a"),
    [(0.9, 0, 1.08, -0.2), (0.8, 0, 0.96, 0.1), (5 / 6, 0, 1, 0), (0.99, 0.1, 1.1088, -0.272)],
)
def test_w2w_numbers(gamma: float, epsilon: float, factor: float, a: float) -> None:
    assert least_squares_factor(gamma, epsilon) == pytest.approx(factor, abs=1e-12)
    assert td(w2w.w2w(gamma, epsilon))[0][0, 0] == pytest.approx(a, abs=1e-12)


@given(st.floats(0, 1), st.floats(0.01, 1))
def test_w2w_on_policy_never_diverges(gamma: float, epsilon: float) -> None:
    p = w2w.w2w_on_policy(gamma, epsilon)
    by_visits = chains.stationary_distribution(p.mdp, p.behaviour_policy)  # 1 visit to w, then 1/ε on average
    np.testing.assert_allclose(p.state_distribution, by_visits, atol=1e-12)
    a = td(p)[0][0, 0]
    assert a == pytest.approx((epsilon * (1 + 2 * gamma) + 4 * (1 - gamma)) / (1 + epsilon), abs=1e-12)
    assert a > 0


def test_gordon_extrapolates_and_his_averager_does_not() -> None:
    hat = hat_matrix(gordon.gordon())
    np.testing.assert_allclose(hat, np.outer([1, 2], [1, 2]) / 5, atol=1e-15)
    assert not is_averager(hat)
    p = gordon.gordon_averager()
    averager = hat_matrix(p)
    assert is_averager(averager)
    # fitted value iteration, by hand: the averager contracts by γ, least squares multiplies by 6γ/5
    step, _ = chain(p, p.target_policy)
    ratios = [np.abs(np.linalg.eigvals(p.gamma * fit @ step)).max() for fit in (hat, averager)]
    assert ratios == pytest.approx([1.08, 0.9])


@pytest.mark.parametrize(("matrix", "answer"), [([[1.1]], False), ([[1.5, -0.5]], False), ([[0.0]], True)])
def test_averager_needs_both_conditions(matrix: list[list[float]], answer: bool) -> None:
    assert is_averager(np.array(matrix)) is answer


# --- the spiral -------------------------------------------------------------------------------------------------------


def drift(p: Problem, theta: float) -> float:
    """dθ/dt of expected TD(0)."""
    step, _ = chain(p, p.target_policy)
    at = np.array([theta])
    assert p.value is not None
    v = p.value.values(at)
    return float(p.value.jacobian(at)[:, 0] @ (p.state_distribution * (p.gamma * step @ v - v)))


def conserved(v: Floats, theta: float, epsilon: float) -> bool:
    """Whether ‖V‖² e^{−2εθ} is what it was."""
    return float(v @ v) * np.exp(-2 * epsilon * theta) == pytest.approx(15800, rel=1e-9)


def test_spiral_curve_is_the_solution_of_its_equation() -> None:
    p = spiral.spiral()
    step, _ = chain(p, p.target_policy)
    q = 1 + step - step.T
    np.testing.assert_array_equal(q, [[1, 0.5, 1.5], [1.5, 1, 0.5], [0.5, 1.5, 1]])
    assert p.value is not None
    for theta in (-30.0, -1.0, 0.0, 0.7, 5.0, 60.0):
        at, h = np.array([theta]), np.array([1e-5])
        v = p.value.values(at)
        np.testing.assert_allclose(p.value.jacobian(at)[:, 0], (q + 0.05 * np.eye(3)) @ v, rtol=1e-9, atol=1e-9)
        slope = (p.value.values(at + h) - p.value.values(at - h)) / 2e-5
        np.testing.assert_allclose(p.value.jacobian(at)[:, 0], slope, rtol=1e-5, atol=1e-4)
        bend = (p.value.jacobian(at + h) - p.value.jacobian(at - h))[:, 0] / 2e-5
        np.testing.assert_allclose(p.value.hessian(at)[:, 0, 0], bend, rtol=1e-5, atol=1e-4)
        assert conserved(v, theta, 0.05)
        assert abs(v.sum()) < 1e-12 * np.abs(v).max()
    quarter = p.value.values(np.array([np.pi / sqrt(3)])) / np.exp(0.05 * np.pi / sqrt(3))
    np.testing.assert_allclose(quarter, [23.094011, 75.055535, -98.149546], atol=1e-6)


def test_spiral_by_expm_is_not_conserved() -> None:
    p = spiral.spiral()
    step, _ = chain(p, p.target_policy)
    generator = 1 + step - step.T + 0.05 * np.eye(3)
    wrong = expm(15 * generator) @ np.array([100.0, -70.0, -30.0])
    assert not conserved(wrong, 15, 0.05)
    assert conserved(expm(1 * generator) @ np.array([100.0, -70.0, -30.0]), 1, 0.05)


def test_spiral_blows_up_when_it_should() -> None:
    end = spiral.blow_up_time()
    assert end == pytest.approx(0.006355595572, abs=5e-13)
    assert spiral.theta_at(0.9 * end) == pytest.approx(23.02585093, abs=1e-8)
    assert spiral.theta_at(0.9 * end) == pytest.approx(log(10) / 0.1)
    p = spiral.spiral()
    path = solve_ivp(lambda t, y: [drift(p, y[0])], (0, 0.9 * end), [0.0], rtol=1e-9, atol=1e-9)
    assert path.y[0, -1] == pytest.approx(spiral.theta_at(0.9 * end), abs=1e-5)


@given(st.floats(0, 1), st.floats(0, 1))
def test_spiral_diverges_below_the_critical_epsilon(gamma: float, epsilon: float) -> None:
    p = spiral.spiral(epsilon, gamma)
    kappa = (0.375 * gamma - epsilon * (1 - gamma / 4)) / 3
    for theta in (-3.0, 0.0, 2.0):
        assert drift(p, theta) == pytest.approx(kappa * 15800 * np.exp(2 * epsilon * theta), rel=1e-8, abs=1e-8)
    assert (spiral.blow_up_time(epsilon, gamma) < np.inf) == (kappa * epsilon > 0)
    if abs(kappa) > 1e-9:
        assert (kappa > 0) == (epsilon < spiral.critical_epsilon(gamma))
    t = min(0.5 * spiral.blow_up_time(epsilon, gamma), 1e-4)
    speed = (spiral.theta_at(1.01 * t, epsilon, gamma) - spiral.theta_at(0.99 * t, epsilon, gamma)) / (0.02 * t)
    theta = spiral.theta_at(t, epsilon, gamma)
    assert speed == pytest.approx(kappa * 15800 * np.exp(2 * epsilon * theta), rel=1e-3, abs=1e-6)


def test_spiral_thresholds() -> None:
    assert spiral.critical_epsilon(0.9) == pytest.approx(0.435484, abs=5e-7)
    assert spiral.critical_epsilon(1.0) == 0.5
    assert spiral.critical_epsilon(0.129032) == pytest.approx(0.05, abs=1e-6)
    assert spiral.blow_up_time(0.45, 0.9) == np.inf
    assert spiral.theta_at(1.0, 0.45, 0.9) < -1  # falls for ever: the values vanish
    with pytest.raises(ValueError, match=r"below t\*"):
        spiral.theta_at(0.01)
    with pytest.raises(ValueError, match="narrows"):
        spiral.spiral(-0.1)


@pytest.mark.parametrize(("step_size", "updates"), [(1e-5, 641), (1e-4, 68)])
def test_spiral_updates_until_a_million(step_size: float, updates: int) -> None:
    p = spiral.spiral()
    assert p.value is not None
    theta, k = 0.0, 0
    while np.linalg.norm(p.value.values(np.array([theta]))) <= 1e6:
        theta, k = theta + step_size * drift(p, theta), k + 1
    assert k == updates
    assert np.isfinite(p.value.values(np.array([1e9]))).all()


# --- Kolter, emphatic, Bertsekas --------------------------------------------------------------------------------------


@given(st.floats(-0.04, 0.5))
def test_kolter_critical_probability(epsilon: float) -> None:
    formula = (2961 + 45240 * epsilon + 40400 * epsilon**2) / (4141 + 84840 * epsilon + 40400 * epsilon**2)
    p_star = kolter.critical_probability(epsilon)
    if epsilon > -0.03:  # the rational function has a pole, and p* passes 1, before ε = −.05
        assert p_star == pytest.approx(formula, rel=1e-9)
    if 0.01 < p_star < 0.99:
        assert td(kolter.kolter(p_star, epsilon))[0][0, 0] == pytest.approx(0, abs=1e-12)
        assert (
            td(kolter.kolter(p_star + 1e-3, epsilon))[0][0, 0] < 0 < td(kolter.kolter(p_star - 1e-3, epsilon))[0][0, 0]
        )


def test_kolter_numbers() -> None:
    assert kolter.critical_probability(0.0) == pytest.approx(0.7150446752, abs=5e-11)
    p = kolter.kolter(0.5, 0.01)
    np.testing.assert_allclose(values(p), [1, 1.05], atol=1e-12)
    np.testing.assert_allclose(p.mdp.reward[::2], [-0.01475, 0.03525], atol=1e-15)
    even = np.full(2, 0.5)
    w = fixed_point(p)
    best = np.linalg.lstsq(p.features, values(p), rcond=None)[0]
    assert w[0] == pytest.approx(0.982492, abs=5e-7)
    assert rmsve(p, w, even) == pytest.approx(0.013780, abs=5e-7)
    assert rmsve(p, best, even) == pytest.approx(0.004852, abs=5e-7)
    p_star = kolter.critical_probability(0.01)
    beside = [float(fixed_point(kolter.kolter(p_star + shift, 0.01))[0]) for shift in (-1e-4, 1e-4)]
    assert beside[0] * beside[1] < 0 and min(map(abs, beside)) > 5
    for share in (0.3, 0.9):  # representable values are always the fixed point
        assert fixed_point(kolter.kolter(share, 0.0))[0] == pytest.approx(1.0)


def test_kolter_beyond_the_critical_probability() -> None:
    p = kolter.kolter(kolter.critical_probability(0.01) + 0.05, 0.01)
    a, b = (float(part.reshape(-1)[0]) for part in td(p))
    c = float(p.state_distribution @ p.features[:, 0] ** 2)
    assert a == pytest.approx(-0.0031209, abs=5e-8)
    assert [b / (a + eta) for eta in (0.01, 0.1)] == pytest.approx([-0.131925, -0.009368], abs=5e-7)
    assert [(c - a) / (c + eta) for eta in (0, 0.01)] == pytest.approx([1.003022, 0.993403], abs=5e-7)


def test_emphatic_numbers() -> None:
    p = emphatic.emphatic()
    assert td(p)[0][0, 0] == pytest.approx(-0.2)
    assert td(p, 1.0)[0][0, 0] == pytest.approx(2.5)
    step, _ = chain(p, p.target_policy)
    follow_on = np.linalg.solve(np.eye(2) - 0.9 * step.T, p.state_distribution)
    np.testing.assert_allclose(follow_on, [0.5, 9.5])
    assert p.features[:, 0] @ (follow_on * ((np.eye(2) - 0.9 * step) @ p.features)[:, 0]) == pytest.approx(3.4)
    for lambda_, m_2, a in ((0.25, 7.25, 3.370968), (0.5, 5, 3.318182), (0.75, 2.75, 3.192308), (1.0, 0.5, 2.5)):
        p_lambda = np.eye(2) - np.linalg.solve(np.eye(2) - 0.9 * lambda_ * step, np.eye(2) - 0.9 * step)
        m = np.linalg.solve(np.eye(2) - p_lambda.T, p.state_distribution)
        # the emphasis m(λ) is linear in λ here
        assert m[1] == pytest.approx(m_2) and m[0] == pytest.approx(0.5)
        weighted = m * ((np.eye(2) - p_lambda) @ p.features)[:, 0]
        assert p.features[:, 0] @ weighted == pytest.approx(a, abs=5e-7)


@given(st.floats(0.01, 0.999), st.floats(0, 1), st.floats(0, 0.999))
def test_emphatic_closed_forms(gamma: float, lambda_: float, beta: float) -> None:
    p = emphatic.emphatic(gamma)
    a = td(p, lambda_)[0][0, 0]
    assert a == pytest.approx(0.5 * (5 - 6 * gamma + gamma * lambda_) / (1 - gamma * lambda_), rel=1e-9, abs=1e-9)
    if abs(lambda_ - critical_lambda(gamma)) > 1e-6:
        assert (a > 0) == (lambda_ > critical_lambda(gamma))
    step, _ = chain(p, p.target_policy)
    f = np.linalg.solve(np.eye(2) - beta * step.T, p.state_distribution)
    mean = p.features[:, 0] @ (f * ((np.eye(2) - gamma * step) @ p.features)[:, 0])
    low, high = follow_on_window(gamma)
    if abs(beta - low) > 1e-6 and low > 0:
        assert (mean > 0) == (beta > low)
    elif low == 0 and beta > 0:
        assert mean > 0
    # E[F²] grows by β² Σ_a μ ρ² = 2β² a step
    second = beta**2 * float((p.behaviour_policy * p.importance_ratio**2).sum(axis=1)[0])
    if abs(beta - high) > 1e-6:
        assert (second < 1) == (beta < high)


def test_emphatic_thresholds_at_nine_tenths() -> None:
    assert critical_lambda(0.9) == pytest.approx(4 / 9)
    assert follow_on_window(0.9) == pytest.approx((1 / 3, sqrt(0.5)))
    for gamma in (0.84, 0.87, 0.95, 0.99):  # A is 0 on both thresholds
        p = emphatic.emphatic(gamma)
        assert td(p, critical_lambda(gamma))[0][0, 0] == pytest.approx(0, abs=1e-12)
        step, _ = chain(p, p.target_policy)
        f = np.linalg.solve(np.eye(2) - follow_on_window(gamma)[0] * step.T, p.state_distribution)
        assert (f * p.features[:, 0]) @ (np.eye(2) - gamma * step) @ p.features == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("n", [2, 7, 50])
def test_bertsekas_flips_the_sign(n: int) -> None:
    p = bertsekas.bertsekas(n)
    np.testing.assert_allclose(values(p), [0, *[-(n - 1.0)] * (n - 1), -(n - 2.0)], atol=1e-9)
    np.testing.assert_allclose(p.state_distribution, [0, *[1 / n] * n], atol=1e-12)
    assert fixed_point(p)[0] == pytest.approx(2 / (n * (n + 1))) == bertsekas.fixed_point(n)
    if n == 50:
        assert fixed_point(p)[0] == pytest.approx(7.84314e-4, rel=1e-6)
        assert fixed_point(p, 1.0)[0] == pytest.approx(-1.4542807, abs=5e-8)


# --- what data cannot tell --------------------------------------------------------------------------------------------


def td_error_minimiser(p: Problem) -> Floats:
    """argmin E[δ²] over single transitions, by weighted least squares."""
    transition, reward = chain(p, p.target_policy)
    x, rows, targets = p.features, [], []
    for s in np.flatnonzero(p.state_distribution):
        leaves = 1 - transition[s].sum()
        for chance, x_t in [*zip(transition[s], x, strict=True), (leaves, np.zeros(x.shape[1]))]:
            root = np.sqrt(max(chance, 0.0) * p.state_distribution[s])
            rows.append(root * (x[s] - p.gamma * x_t))
            targets.append(root * reward[s])
    return np.linalg.lstsq(np.array(rows), np.array(targets), rcond=None)[0]


def bellman_error_minimiser(p: Problem) -> tuple[Floats, float]:
    """argmin of the Bellman error, and its square."""
    step, r = chain(p, p.target_policy)
    root = np.sqrt(p.state_distribution)
    matrix = root[:, None] * (p.features - p.gamma * step @ p.features)
    w = np.linalg.lstsq(matrix, root * r, rcond=None)[0]
    return w, float(np.sum((matrix @ w - root * r) ** 2))


def test_splits() -> None:
    p, q = split.a_split(), split.a_presplit()
    np.testing.assert_allclose(values(p), [0.5, 1, 0], atol=1e-15)
    np.testing.assert_allclose(fixed_point(p), [0.5, 1, 0], atol=1e-12)
    np.testing.assert_allclose(bellman_error_minimiser(p)[0], [0.5, 1, 0], atol=1e-12)
    np.testing.assert_allclose(td_error_minimiser(p), [0.5, 0.75, 0.25], atol=1e-12)
    np.testing.assert_allclose(q.state_distribution, 0.25, atol=1e-12)
    np.testing.assert_allclose(fixed_point(q), [0.5, 1, 0], atol=1e-12)
    np.testing.assert_allclose(bellman_error_minimiser(q)[0], [0.5, 0.75, 0.25], atol=1e-12)


def test_bellman_error_cannot_be_learned() -> None:
    left, right = split.bellman_error_left(), split.bellman_error_right()
    np.testing.assert_allclose(left.state_distribution, [1 / 3, 2 / 3], atol=1e-12)
    np.testing.assert_allclose(right.state_distribution, 1 / 3, atol=1e-12)
    for p, squared in ((left, 0.0), (right, 2 / 3)):
        _, r = chain(p, p.target_policy)  # at w = 0 the Bellman error is the expected reward
        assert p.state_distribution @ r**2 == pytest.approx(squared)
        np.testing.assert_allclose(fixed_point(p), 0, atol=1e-12)
    assert sqrt(2 / 3) == pytest.approx(0.816497, abs=5e-7)


def words(p: Problem, length: int) -> dict[tuple[tuple[float, ...], ...], float]:
    """The distribution of (features, reward) words of some length, by enumeration."""
    outcomes = p.mdp.outcomes
    assert outcomes is not None
    paths: list[tuple[float, int, tuple[tuple[float, ...], ...]]]
    paths = [(chance, s, ()) for s, chance in enumerate(p.state_distribution)]
    for _ in range(length):
        longer = []
        for chance, s, word in paths:
            for k in range(outcomes.indptr[s], outcomes.indptr[s + 1]):
                letter = (*p.features[s], outcomes.reward[k])
                longer.append((chance * outcomes.probability[k], int(outcomes.s_t[k]), (*word, letter)))
        paths = longer
    total: dict[tuple[tuple[float, ...], ...], float] = {}
    for chance, _, word in paths:
        total[word] = total.get(word, 0.0) + chance
    return total


def test_both_processes_show_the_same_data() -> None:
    left, right = words(split.bellman_error_left(), 6), words(split.bellman_error_right(), 6)
    assert left.keys() == right.keys()
    assert all(left[word] == pytest.approx(right[word]) for word in left)


@given(st.floats(0.0, 0.999))
def test_minimiser_on_the_right_in_closed_form(gamma: float) -> None:
    p = split.bellman_error_right(gamma)
    np.testing.assert_allclose(bellman_error_minimiser(p)[0], split.right_minimiser(gamma), atol=1e-9)


def test_minimiser_on_the_right_does_not_tend_to_the_limit_in_the_book() -> None:
    expected = {0.5: (-0.285714, 0.142857), 0.9: (-0.332103, 0.166052), 0.99: (-0.333322, 0.166661)}
    for gamma, weights in expected.items():
        assert bellman_error_minimiser(split.bellman_error_right(gamma))[0] == pytest.approx(weights, abs=5e-7)
    assert split.right_minimiser(1.0) == pytest.approx((-1 / 3, 1 / 6))
    # Sutton & Barto 2018 print (−1/2, 0): near γ = 1 it has a larger error than the minimiser, by (1 − γ)²/36
    for gamma in (0.99, 0.999):
        p = split.bellman_error_right(gamma)
        step, r = chain(p, p.target_policy)
        residual = r + (gamma * step - np.eye(3)) @ p.features @ np.array([-0.5, 0.0])
        excess = p.state_distribution @ residual**2 - bellman_error_minimiser(p)[1]
        assert excess == pytest.approx((1 - gamma) ** 2 / 36, rel=0.05)


# --- chattering -------------------------------------------------------------------------------------------------------


@given(st.floats(0, 1))
def test_chattering_fixed_points(epsilon: float) -> None:
    p = chattering.chattering(epsilon)
    x, (_, reward) = p.features[0, :, 0], dense(p)
    found = []
    for greedy in range(2):
        chance = np.full(2, epsilon / 2)
        chance[greedy] += 1 - epsilon
        found.append(float((chance * x * reward[0]).sum() / (chance * x**2).sum()))
    assert chattering.policy_fixed_points(epsilon) == pytest.approx(found, abs=1e-12)
    assert (chattering.greedy_share(epsilon) < 1) == (found[0] > 1e-12) or abs(found[0]) < 1e-9


def test_chattering_numbers() -> None:
    assert chattering.policy_fixed_points(0.1) == pytest.approx((0.739130, -0.480519), abs=5e-7)
    assert chattering.greedy_share(0.1) == pytest.approx(1.85 / 2.70) == pytest.approx(0.685185, abs=5e-7)
    p = chattering.chattering()
    assert p.control and p.exploration == 0.1 and p.learns_q and p.mdp.termination.tolist() == [1, 1]


def test_chattering_is_seen_in_a_simulation() -> None:
    p = chattering.chattering()
    rng = np.random.default_rng(0)
    explore, coin = (rng.random(200_000) < 0.1).tolist(), rng.integers(2, size=200_000).tolist()
    x, reward = p.features[0, :, 0].tolist(), dense(p)[1][0].tolist()
    w, count, largest = 0.0, 0, 0.0
    for random, other in zip(explore, coin, strict=True):
        greedy = 1 if w > 0 else 0
        count += greedy == 0
        a = other if random else greedy
        w += 0.001 * x[a] * (reward[a] - x[a] * w)
        largest = max(largest, abs(w))
    assert count / 200_000 == pytest.approx(0.685185, abs=0.01)
    assert largest < 0.05  # it stays at 0

"""Emphatic TD: emphasis vectors, operators, windows of β, the published expected run, and the sampled recursion.

Mutants that die here: P for Pᵀ in f; λ and 1 − λ swapped in M; the ratio of the present step in the follow-on instead
of the last one's; β forgotten in it, or γ in its place; β that survives an end; the emphasis left out of the trace; the
trace that does not start anew; ρ instead of ρ² in the second moment; β instead of β² in front of it; the run of figure
11.6 begun at the limit of the emphasis, or with f updated before w.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from lab_laws import assert_law, assert_long_run, min_real, process_of

from neuralq.lab.linear.process import linear_process
from neuralq.lab.linear.sampling import stream
from neuralq.lab.methods.emphatic import ETD, emphasis, expected_emphatic_run, follow_on, follow_on_second_moment
from neuralq.lab.methods.td import TD
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.emphatic import emphatic


@pytest.mark.parametrize("pairs", [False, True])
def test_without_memory_the_law_holds_exactly(pairs: bool) -> None:
    process = process_of(3, pairs)
    assert not ETD.remembers(ETD.checked({"beta": 0.0}))
    assert_law(process, ETD, beta=0.0)


@pytest.mark.parametrize("options", [{}, {"lambda_": 0.6}, {"beta": 0.5}, {"lambda_": 0.4, "beta": 0.3}])
@pytest.mark.parametrize("pairs", [False, True])
def test_long_chains_have_the_expected_increment(pairs: bool, options: dict[str, float]) -> None:
    process = process_of(3, pairs)
    assert ETD.remembers(ETD.checked(options))
    assert follow_on_second_moment(process, options.get("beta")) < 1  # else a standard error would mean nothing
    assert_long_run(process, ETD, np.array([0.7, -1.1, 0.4]), **options)


def test_the_sampled_update_is_the_published_recursion() -> None:
    """S&B 2018, section 11.8 and Sutton, Mahmood & White 2016, equations 18 to 20, one number at a time."""
    process = process_of(8)
    lambda_, beta, alpha = 0.7, 0.6, 0.05
    learner = ETD.learner(process, np.ones((1, 3)), ETD.checked({"lambda_": lambda_, "beta": beta}))
    w, samples = np.ones(3), stream(process, "markov", 1, np.random.default_rng(5))
    F = rho_before = gamma_in = 0.0
    e = np.zeros(3)
    ends = 0
    for _ in range(60):
        sample = next(samples)
        if sample.begins[0]:
            F, rho_before, gamma_in, e = 0.0, 0.0, 0.0, np.zeros(3)
            ends += 1
        F = rho_before * beta * F + 1
        M = lambda_ * 1 + (1 - lambda_) * F
        rho, x, x_next = sample.rho[0], sample.x[0], sample.x_next[0]
        e = rho * (gamma_in * lambda_ * e + M * x)
        w = w + alpha * (sample.reward[0] + sample.discount[0] * w @ x_next - w @ x) * e
        rho_before, gamma_in = rho, sample.discount[0]
        learner.update(sample, alpha)
        np.testing.assert_allclose(learner.theta[0], w, rtol=1e-12)
    assert ends > 3


def test_two_state_numbers() -> None:
    """Numbers computed by an independent float64 solution of the formulas of Sutton, Mahmood & White 2016."""
    process = linear_process(emphatic())
    np.testing.assert_allclose(follow_on(process), [0.5, 9.5], rtol=1e-12)
    assert min_real(TD, process) == pytest.approx(-0.2, rel=1e-12)
    assert min_real(TD, process, lambda_=1.0) == pytest.approx(2.5, rel=1e-12)
    table = {0.0: (9.5, 3.4), 0.25: (7.25, 3.370968), 0.5: (5.0, 3.318182), 0.75: (2.75, 3.192308), 1.0: (0.5, 2.5)}
    for lambda_, (m, A) in table.items():
        np.testing.assert_allclose(emphasis(process, lambda_), [0.5, m], rtol=1e-12)
        assert min_real(ETD, process, lambda_=lambda_) == pytest.approx(A, abs=5.1e-7)
    assert follow_on_second_moment(process) == pytest.approx(1.62, rel=1e-12)


def test_emphasis_is_the_published_resolvent() -> None:
    """m = (I − P_λᵀ)⁻¹ d with P_λ = I − (I − γλP)⁻¹ (I − γP), and A = Xᵀ diag(m) (I − P_λ) X: another way to both."""
    process = process_of(11)
    eye, P, gamma = np.eye(3), process.P, process.gamma
    for lambda_ in (0.0, 0.3, 0.8, 1.0):
        P_lambda = eye - np.linalg.solve(eye - gamma * lambda_ * P, eye - gamma * P)
        m = np.linalg.solve(eye - P_lambda.T, process.D)
        np.testing.assert_allclose(emphasis(process, lambda_), m, rtol=1e-12)
        G, g = ETD.expected(process, ETD.checked({"lambda_": lambda_})).generator  # type: ignore[misc]
        np.testing.assert_allclose(G, process.X.T @ np.diag(m) @ (eye - P_lambda) @ process.X, atol=1e-12)
        np.testing.assert_allclose(
            g, process.X.T @ (m * np.linalg.solve(eye - gamma * lambda_ * P, process.r)), atol=1e-12
        )
    np.testing.assert_allclose(follow_on(process, num_steps=500), follow_on(process), rtol=1e-12)
    assert np.array_equal(follow_on(process, num_steps=0), process.D)


def test_lambda_one_is_td_one_up_to_the_weights_of_rows() -> None:
    """With λ = 1 the emphasis is the interest: ETD(1) is TD(1), in the mean and transition by transition."""
    process = process_of(4)
    ours, td = (m.expected(process, m.checked({"lambda_": 1.0})).generator for m in (ETD, TD))
    np.testing.assert_allclose(ours[0], td[0], atol=1e-12)  # type: ignore[index]
    options = {"lambda_": 1.0}
    one, other = (m.learner(process, np.ones((4, 3)), m.checked(options)) for m in (ETD, TD))
    samples = stream(process, "markov", 4, np.random.default_rng(1))
    for _ in range(50):
        sample = next(samples)
        one.update(sample, 0.05)
        other.update(sample, 0.05)
    np.testing.assert_allclose(one.theta, other.theta, rtol=1e-12)


def test_window_of_beta_on_two_states() -> None:
    """By hand: A(β) = −.4 + .2 (1 + β)/(1 − β) > 0 iff β > 1/3, and E[F²] is finite iff 2β² < 1."""
    process = linear_process(emphatic())
    assert min_real(ETD, process, beta=1 / 3 - 1e-6) < 0 < min_real(ETD, process, beta=1 / 3 + 1e-6)
    for beta in (0.1, 0.5, 0.7):
        assert min_real(ETD, process, beta=beta) == pytest.approx(-0.4 + 0.2 * (1 + beta) / (1 - beta), rel=1e-12)
    limit = math.sqrt(0.5)
    assert follow_on_second_moment(process, limit - 1e-6) < 1 < follow_on_second_moment(process, limit + 1e-6)


def test_variance_of_the_follow_on_is_what_sampling_shows() -> None:
    """E[F_t²] itself, by its recursion over all paths: a coin decides whether F doubles with β or starts again."""
    process, beta = linear_process(emphatic()), 0.6
    values, chances = np.array([1.0]), np.array([1.0])
    second = []
    for _ in range(18):  # from either state ρ is 2 or 0 by the coin
        values = np.concatenate([2 * beta * values + 1, np.ones(len(values))])
        chances = np.concatenate([chances, chances]) / 2
        second.append(chances @ values**2)
    steps = np.diff(second)
    assert steps[-1] / steps[-2] == pytest.approx(max(follow_on_second_moment(process, beta), beta), rel=0.03)


def test_star_numbers() -> None:
    """Computed by an independent float64 iteration of the formulas; F² grows by 7γ² (S&B 2018, section 11.9)."""
    process = linear_process(star())
    np.testing.assert_allclose(follow_on(process), [1 / 7] * 6 + [99 + 1 / 7], rtol=1e-10)
    G, _ = ETD.expected(process, ETD.checked({})).generator  # type: ignore[misc]
    eigenvalues = np.sort(np.linalg.eigvals(G).real)
    np.testing.assert_allclose(eigenvalues, [0, *[0.571429] * 5, 0.997725, 3.690847], atol=5.1e-7)
    assert follow_on_second_moment(process) == pytest.approx(7 * 0.99**2, rel=1e-12)
    # no β does both: the mean needs β > .83945, a finite variance β < 1/√7 = .378
    assert min_real(ETD, process, beta=0.8394) < 0 < min_real(ETD, process, beta=0.8395)
    assert follow_on_second_moment(process, 0.8395) > 4


def test_figure_11_6() -> None:
    """S&B 2018, figure 11.6, α = .03; RMSVE and limit computed by an independent float64 iteration.

    The emphasis begins with the run: M_{−1} = 0, so the first is the interest, and each is the exact conditional mean.
    """
    problem = star()
    process = linear_process(problem)
    run = expected_emphatic_run(process, problem.initial_weights, 0.03, 3000)
    error = np.sqrt((process.X @ run.T).T ** 2 @ process.D)
    assert error[[1, 10, 50, 100, 200]] == pytest.approx([5.6522, 8.4412, 7.2122, 0.9567, 0.0204], abs=5.1e-5)
    np.testing.assert_allclose(run[-1], 1.692308 * np.array([1, 1, 1, 1, 1, 1, 4, -2]), atol=2e-6)


def test_what_is_refused() -> None:
    process = linear_process(star())
    with pytest.raises(ValueError, match="no limit"):
        follow_on(process, beta=1.0)
    with pytest.raises(ValueError, match="beta"):
        follow_on(process, beta=1.5)
    with pytest.raises(ValueError, match="beta"):
        ETD.expected(process, ETD.checked({"beta": -0.5}))
    with pytest.raises(ValueError, match="lambda_"):
        ETD.learner(process, np.ones((1, 8)), ETD.checked({"lambda_": 2.0}))
    with pytest.raises(ValueError, match="beta"):
        ETD.learner(process, np.ones((1, 8)), ETD.checked({"beta": 2.0}))

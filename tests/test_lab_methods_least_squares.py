"""Methods that solve: LSTD, Bellman residual minimisation, fitted iteration and LSPI.

Mutants that die here: x' for x in a factor; the ratio missing; the same successor twice in
the residual; η forgotten or of the other sign; the trace that does not start anew; C for A; the fixed point of the
behaviour's chain; the policy of the weights before last; a cycle of two reported as convergence.
"""

from __future__ import annotations

import numpy as np
import pytest
from lab_laws import Floats, process_of, radius

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import SampledTransition, sample_along, stream
from neuralq.lab.methods import Method
from neuralq.lab.methods.chains import greedy_policy, pairs_of
from neuralq.lab.methods.least_squares import BRM, FITTED, FITTED_Q, LSPI, LSTD
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star
from neuralq_envs.counterexamples.kolter import kolter
from neuralq_envs.counterexamples.split import a_presplit, a_split, bellman_error_left, bellman_error_right
from neuralq_envs.counterexamples.w2w import w2w


def solution(one: Method, process: Process, **options: float) -> Floats:
    """Where the expected method ends, at once and from anywhere."""
    M, c = one.expected(process, one.checked(options)).at(np.full(process.num_weights, 7.0), 0.1)  # type: ignore[misc]
    assert not M.any()
    return c


def learned(one: Method, process: Process, samples: list[SampledTransition], **options: float) -> Floats:
    """The weights of one seed after these transitions."""
    w0 = np.full((1, process.num_weights), 7.0)
    learner = one.learner(process, w0, one.checked(options))  # type: ignore[misc]
    assert np.array_equal(learner.theta, w0)
    for sample in samples:
        learner.update(sample, 0.1)
    return learner.theta[0]


def every_case(process: Process, times: int) -> list[SampledTransition]:
    """Every transition with every second transition, each as often as its chance says in ``times`` draws."""
    transitions, target, cases = process.transitions, process.target_transitions, []
    for k, i in enumerate(transitions.row):
        for q in range(target.starts[i], target.starts[i + 1]):
            count = times * process.D[i] * transitions.probability[k] * target.probability[q]
            assert abs(count - round(count)) < 1e-9
            case = sample_along(process, np.array([k]), np.array([q]), np.ones(1, dtype=bool))
            cases += [case] * round(count)
    return cases


@pytest.mark.parametrize(("probability", "limit"), [(0.5, 0.982492)])
def test_lstd_on_kolter(probability: float, limit: float) -> None:
    """ε = .01: w_TD by an independent scalar computation after Kolter 2011; exact sampling finds it exactly."""
    process = linear_process(kolter(probability, epsilon=0.01))
    assert solution(LSTD, process) == pytest.approx([limit], abs=5.1e-7)
    assert learned(LSTD, process, every_case(process, 8)) == pytest.approx(solution(LSTD, process), rel=1e-10)
    eta = 0.03
    A = 0.5 * (1 * (1 - 0.99 * 1.03) + 1.06 * (1.06 - 0.99 * 1.03))
    b = 0.5 * (-0.01475 + 1.06 * 0.03525)
    assert solution(LSTD, process, eta=eta) == pytest.approx([b / (A + eta)], rel=1e-12)
    assert learned(LSTD, process, every_case(process, 8), eta=eta) == pytest.approx([b / (A + eta)], rel=1e-12)


def test_lstd_solves_where_td_diverges() -> None:
    """On the star: all values 0, with the weights of least norm although the features are redundant."""
    process = linear_process(star())
    np.testing.assert_allclose(solution(LSTD, process), np.zeros(8), atol=1e-12)
    found = learned(LSTD, process, every_case(process, 49))
    np.testing.assert_allclose(found, np.zeros(8), atol=1e-10)


@pytest.mark.parametrize("lambda_", [0.0, 0.8])
@pytest.mark.parametrize("pairs", [False, True])
def test_lstd_in_the_long_run(pairs: bool, lambda_: float) -> None:
    """Many chains: the error of the averaged solution is within 4 standard errors, up to its bias of order 1/t."""
    process, seeds, steps = process_of(3, pairs), 300, 2000
    learner = LSTD.learner(process, np.zeros((seeds, 3)), LSTD.checked({"lambda_": lambda_}))  # type: ignore[misc]
    samples = stream(process, "markov", seeds, np.random.default_rng(0))
    for _ in range(steps):
        learner.update(next(samples), 0.1)
    exact = solution(LSTD, process, lambda_=lambda_)
    error = learner.theta.std(axis=0, ddof=1)
    assert (error < 0.3 * np.abs(exact).max()).all()
    assert (np.abs(learner.theta.mean(axis=0) - exact) < 4 * error / np.sqrt(seeds) + 20 * error**2).all()


def test_lstd_trace_is_the_textbooks() -> None:
    """Boyan 2002 with ratios, one number at a time; the solution asked for only at the end."""
    process, lambda_ = process_of(7), 0.6
    samples = [
        sample for sample, _ in zip(stream(process, "markov", 1, np.random.default_rng(2)), range(50), strict=False)
    ]
    A, b, z, decay = np.zeros((3, 3)), np.zeros(3), np.zeros(3), 0.0
    for sample in samples:
        z = sample.rho[0] * ((0.0 if sample.begins[0] else decay) * lambda_ * z + sample.x[0])
        A += np.outer(z, sample.x[0] - sample.discount[0] * sample.x_next[0])
        b += sample.reward[0] * z
        decay = sample.discount[0]
    np.testing.assert_allclose(learned(LSTD, process, samples, lambda_=lambda_), np.linalg.solve(A, b), rtol=1e-9)


def test_a_new_episode_starts_a_new_trace() -> None:
    process, samples = process_of(7), stream(process_of(7), "iid", 1, np.random.default_rng(2))
    drawn = [next(samples) for _ in range(20)]
    assert np.array_equal(learned(LSTD, process, drawn, lambda_=0.9), learned(LSTD, process, drawn))


def test_bellman_residual_minimisers() -> None:
    """S&B 2018, examples 11.2 to 11.4: the minimisers of the Bellman error, by hand or from the book.

    For the process on the right the exact minimiser is −γ/(1 + γ + γ²) (1, −1/2), whose limit for γ → 1 is
    (−1/3, 1/6), not the (−1/2, 0) that the book prints.
    """
    np.testing.assert_allclose(solution(BRM, linear_process(a_split())), [0.5, 1, 0], atol=1e-12)
    np.testing.assert_allclose(solution(BRM, linear_process(a_presplit())), [0.5, 0.75, 0.25], atol=1e-12)
    np.testing.assert_allclose(solution(LSTD, linear_process(a_presplit())), [0.5, 1, 0], atol=1e-12)
    np.testing.assert_allclose(solution(BRM, linear_process(bellman_error_left(0.9))), [0, 0], atol=1e-12)
    published = {0.5: (-0.285714, 0.142857), 0.9: (-0.332103, 0.166052), 0.99: (-0.333322, 0.166661)}
    for gamma, weights in published.items():
        process = linear_process(bellman_error_right(gamma))
        assert solution(BRM, process) == pytest.approx(weights, abs=5.1e-7)
        assert solution(LSTD, process) == pytest.approx([0, 0], abs=1e-12)


def test_sampled_residual_minimisation() -> None:
    """Exact sampling finds the exact minimiser, two successors apart; with one it would be that of another error."""
    for problem, times in ((a_split(), 16), (a_presplit(), 4), (kolter(0.75, epsilon=0.01), 32)):
        process = linear_process(problem)
        found = learned(BRM, process, every_case(process, times))
        np.testing.assert_allclose(found, solution(BRM, process), atol=1e-10)


def test_residual_minimiser_is_the_least_squares_fit() -> None:
    """Against numpy's own least squares on the weighted rows."""
    for pairs in (False, True):
        process = process_of(4, pairs)
        root = np.sqrt(process.D)
        rows = process.X - process.gamma * (process.P @ process.X)
        fit, *_ = np.linalg.lstsq(root[:, None] * rows, root * process.r, rcond=None)
        np.testing.assert_allclose(solution(BRM, process), fit, rtol=1e-9)


@pytest.mark.parametrize(
    ("gamma", "epsilon", "factor"), [(0.9, 0.0, 1.08), (0.8, 0.0, 0.96), (5 / 6, 0.0, 1.0), (0.99, 0.1, 1.1088)]
)
def test_fitted_iteration_on_w2w(gamma: float, epsilon: float, factor: float) -> None:
    """(6 − 4ε)γ/5, S&B 2018, equation 11.10 (Tsitsiklis & Van Roy 1996), whatever the step size."""
    expected = FITTED.expected(linear_process(w2w(gamma, epsilon)), FITTED.checked({}))  # type: ignore[misc]
    for step_size in (0.01, 1.0):
        M, c = expected.at(np.ones(1), step_size)
        assert M[0, 0] == pytest.approx(factor, rel=1e-12)
        assert c.tolist() == [0.0]


def test_fitted_iteration_is_a_regression() -> None:
    """One sweep is numpy's least squares of the backed-up values; on the star, whose rows are independent, M has γ."""
    process, w = process_of(6), np.array([1.0, -2.0, 0.5])
    root = np.sqrt(process.D)
    target = process.r + process.gamma * (process.P @ process.X @ w)
    fit, *_ = np.linalg.lstsq(root[:, None] * process.X, root * target, rcond=None)
    M, c = FITTED.expected(process, FITTED.checked({})).at(w, 0.1)  # type: ignore[misc]
    np.testing.assert_allclose(M @ w + c, fit, rtol=1e-10)
    M, _ = FITTED.expected(linear_process(star()), FITTED.checked({})).at(w, 0.1)  # type: ignore[misc]
    assert radius(M) == pytest.approx(0.99, rel=1e-9)  # Che et al. 2024: over-parameterised, it is value iteration


def lspi(process: Process, w: Floats, num_iterations: int = 50) -> tuple[list[Floats], int]:
    """Weights after every sweep from w, and after how many the last greedy policy comes back; 0 where none did."""
    at, row_of = LSPI.expected(process, LSPI.defaults).at, pairs_of(process, "lspi")  # type: ignore[misc]
    weights, policies = [w], [greedy_policy(process, row_of, w)]
    for _ in range(num_iterations):
        M, c = at(weights[-1], 0.1)
        assert not M.any()
        weights.append(c)
        policies.append(greedy_policy(process, row_of, c))
        for k, policy in enumerate(policies[-2::-1], start=1):
            if np.array_equal(policies[-1], policy):
                return weights, k
    return weights, 0


def best_values(mdp: FiniteMDP, gamma: float) -> Floats:
    """Q* by value iteration on the model's own arrays, ``[rows]``."""
    Q = np.zeros(mdp.num_rows)
    for _ in range(2000):
        best = np.full(mdp.num_states, -np.inf)
        np.maximum.at(best, mdp.s_tm1, Q)
        Q = mdp.reward + gamma * (mdp.transition.toarray() @ best)
    return Q


def test_tables_find_the_optimum() -> None:
    """Fitted Q iteration and LSPI on a table are value iteration and policy iteration."""
    mdp = FiniteMDP.garnet(6, 3, 2, seed=3)
    process = linear_process(Problem.from_mdp(mdp, np.eye(18).reshape(6, 3, 18), gamma=0.9))
    exact = best_values(mdp, 0.9)
    weights, cycle = lspi(process, np.zeros(18))
    assert cycle == 1
    np.testing.assert_allclose(weights[-1], exact, rtol=1e-9)
    expected = FITTED_Q.expected(process, FITTED_Q.checked({}))  # type: ignore[misc]
    w = np.zeros(18)
    for _ in range(300):
        M, c = expected.at(w, 0.1)
        w = M @ w + c
    np.testing.assert_allclose(w, exact, rtol=1e-9)


def test_lspi_cycles() -> None:
    """With three weights for eight pairs some problems have a consistent policy, others a cycle of two or three."""
    for seed, cycle in ((0, 1), (3, 2), (47, 3)):
        rng = np.random.default_rng(seed)
        mdp = FiniteMDP.garnet(4, 2, 2, seed=seed)
        process = linear_process(Problem.from_mdp(mdp, rng.normal(size=(4, 2, 3)), gamma=0.95))
        assert lspi(process, rng.normal(size=3))[1] == cycle
    assert lspi(process, np.zeros(3), num_iterations=1)[1] == 0  # not enough to tell


def test_what_is_refused() -> None:
    process = process_of(1)
    for one in (FITTED_Q, LSPI):
        with pytest.raises(ValueError, match="state-action pairs"):
            one.expected(process, one.checked({}))  # type: ignore[misc]
    with pytest.raises(ValueError, match="lambda_"):
        LSTD.learner(process, np.zeros((1, 3)), LSTD.checked({"lambda_": 3.0}))  # type: ignore[misc]

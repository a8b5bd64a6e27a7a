"""Target networks and ridge: the composed map, stability on both sides of each threshold, and the sampled updates.

Mutants that die here: one update too few or too many between copies; the target copied after the period's first update
instead of before; S_T with one power too many; ridge on the target's share only, or left out of B; u moved after w (or
towards the new w); τ and 1 − τ swapped; the projection of w left out, or done after the average; projection that
stretches; the ratio missing.
"""

from __future__ import annotations

import numpy as np
import pytest
from lab_laws import assert_law, mean_over_transitions, min_real, process_of, radius
from numpy.typing import NDArray

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import SampledTransition, sample_along
from neuralq.lab.methods import method
from neuralq.lab.methods.operators import covariance, cross
from neuralq.lab.methods.targets import HARD_TARGET, POLYAK_TARGET, PROJECTED_TARGET, frozen_target_map
from neuralq.lab.methods.td import TD
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.kolter import critical_probability, kolter


def hard_radius(process: Process, step_size: float, period: int) -> float:
    """Spectral radius of M_T on the weights that some row sees."""
    M, _ = HARD_TARGET.expected(process, HARD_TARGET.checked({"period": period})).at(np.zeros(0), step_size)
    R = process.visible
    return radius(R.T @ M @ R)


def polyak_radius(process: Process, step_size: float, tau: float) -> float:
    """Spectral radius on (w, u) as far as some row sees them."""
    M, _ = POLYAK_TARGET.expected(process, POLYAK_TARGET.checked({"tau": tau})).at(np.zeros(0), step_size)
    R = np.kron(np.eye(2), process.visible)
    return radius(R.T @ M @ R)


def along(process: Process, transition: NDArray[np.int64]) -> SampledTransition:
    """The transitions along given transitions."""
    second = process.target_transitions.starts[process.transitions.row[transition]]
    return sample_along(process, transition, second, np.ones(len(transition), dtype=bool))


@pytest.mark.parametrize("pairs", [False, True])
def test_the_law(pairs: bool) -> None:
    process = process_of(3, pairs)
    assert_law(process, HARD_TARGET, period=1, eta=0.2)
    assert_law(process, POLYAK_TARGET, tau=0.3, eta=0.2)
    assert_law(process, PROJECTED_TARGET, tau=0.3, eta=0.2, ball_w=1.0, ball_u=0.8)  # random θ lie on both sides
    assert_law(process, PROJECTED_TARGET, tau=0.3, eta=0.2)


@pytest.mark.parametrize("period", [2, 3])
def test_the_law_of_a_whole_period(period: int) -> None:
    """Independent transitions: the exact mean over all sequences of T, one after the other through the learner."""
    process, theta = process_of(5), np.array([0.4, -1.0, 0.3])
    transitions = process.transitions
    sequences = np.array(np.meshgrid(*[np.arange(len(transitions.row))] * period)).reshape(period, -1)
    weight = np.prod((process.D[transitions.row] * transitions.probability)[sequences], axis=0)
    options = HARD_TARGET.checked({"period": period, "eta": 0.1})
    learner = HARD_TARGET.learner(process, np.tile(theta, (sequences.shape[1], 1)), options)  # type: ignore[misc]
    for transition in sequences:
        learner.update(along(process, transition), 0.3)
    expected = HARD_TARGET.expected(process, options)  # type: ignore[misc]
    M, c = expected.at(theta, 0.3)
    np.testing.assert_allclose(weight @ learner.theta, M @ theta + c, atol=1e-12)
    assert expected.updates_per_sweep == period


def test_the_copy_is_made_after_every_period() -> None:
    """Against a loop written out for one seed, over several periods."""
    process, alpha, eta = process_of(9), 0.2, 0.05
    learner = HARD_TARGET.learner(process, np.ones((1, 3)), {"period": 4.0, "eta": eta})  # type: ignore[misc]
    w = u = np.ones(3)
    for t in range(1, 31):
        sample = along(process, np.array([t * 7 % len(process.transitions.row)]))
        x, target = sample.x[0], sample.reward[0] + sample.discount[0] * u @ sample.x_next[0]
        w = w + alpha * (sample.rho[0] * (target - w @ x) * x - eta * w)
        if t % 4 == 0:
            u = w
        learner.update(sample, alpha)
        np.testing.assert_allclose(learner.theta[0], w, rtol=1e-12)


def test_the_composed_map_is_the_loop() -> None:
    """Against T updates written out, with a singular C, for which no inverse exists."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(2, 3))
    C, H, b, alpha = root.T @ root, rng.normal(size=(3, 3)), rng.normal(size=3), 0.1
    for period in (1, 2, 3, 7, 8, 100):
        M, c = frozen_target_map(C, H, b, alpha, period)
        w0 = rng.normal(size=3)
        w, u = w0.copy(), w0.copy()
        for _ in range(period):
            w = w + alpha * (b + H @ u - C @ w)
        np.testing.assert_allclose(M @ w0 + c, w, rtol=1e-11, atol=1e-11)


def test_the_composed_map_is_the_closed_form() -> None:
    """M_T = (I − αC)^T + (I − (I − αC)^T) C⁺ H where C is invertible (Fellows, Smith & Whiteson 2023)."""
    process = process_of(6)
    C, H = covariance(process), cross(process)
    power = np.linalg.matrix_power(np.eye(3) - 0.2 * C, 9)
    closed = power + (np.eye(3) - power) @ np.linalg.solve(C, H)
    M, _ = frozen_target_map(C, H, np.zeros(3), 0.2, 9)
    np.testing.assert_allclose(M, closed, atol=1e-12)


def test_period_one_and_tau_one() -> None:
    """A copy after every update is TD; averaging at τ = 1 lets u follow one step behind."""
    process, theta = process_of(7), np.array([1.0, 2.0, -1.0])
    M, c = HARD_TARGET.expected(process, HARD_TARGET.checked({"period": 1})).at(theta, 0.1)  # type: ignore[misc]
    M_td, c_td = TD.expected(process, TD.checked({})).at(theta, 0.1)  # type: ignore[misc]
    np.testing.assert_allclose(M, M_td, atol=1e-14)
    np.testing.assert_allclose(c, c_td, atol=1e-14)
    both = np.concatenate([theta, 5 * theta])
    after = mean_over_transitions(process, POLYAK_TARGET, both, 0.1, tau=1.0)
    np.testing.assert_allclose(after[3:], theta, atol=1e-12)  # the w from before the update


def test_star_hard_period() -> None:
    """Thresholds computed by an independent matrix iteration; a short period is worse than none."""
    process = linear_process(star())
    for step_size, least in ((0.1, 9), (0.5, 2), (0.01, 77)):
        stable = [period for period in range(1, 200) if hard_radius(process, step_size, period) < 1]
        assert stable == list(range(least, 200))
    assert hard_radius(process, 0.1, 3) > hard_radius(process, 0.1, 2) > hard_radius(process, 0.1, 1) > 1


def late_growth(sizes: list[float]) -> float:
    """How much larger the last quarter of a swinging run is than the quarter before it."""
    quarter = len(sizes) // 4
    return max(sizes[-quarter:]) / max(sizes[-2 * quarter : -quarter])


@pytest.mark.parametrize(("period", "grows"), [(70, True), (85, False)])
def test_star_run_agrees_with_the_threshold(period: int, grows: bool) -> None:
    """Plain updates towards a frozen copy, no composed matrix: late periods shrink or grow."""
    process, w = linear_process(star()), star().initial_weights
    C, H = covariance(process), cross(process)
    sizes = []
    for _ in range(400):
        pull = H @ w
        for _ in range(period):
            w = w + 0.01 * (pull - C @ w)
        sizes.append(float(np.linalg.norm(process.X @ w)))
    assert (late_growth(sizes) > 1) == grows


def test_star_polyak_threshold() -> None:
    """τ* at α = .01, found by scanning: stable below, unstable from there up to τ = 1."""
    process = linear_process(star())
    taus = np.concatenate([np.logspace(-5, 0, 300), [0.02019407063061695]])
    for tau in taus[:-1]:
        assert (polyak_radius(process, 0.01, tau) < 1) == (tau < taus[-1])
    assert polyak_radius(process, 0.01, 0.020194) < 1 < polyak_radius(process, 0.01, 0.020195)
    C, H = 0.01 * covariance(process), 0.01 * cross(process)
    for tau, grows in ((0.016, False), (0.025, True)):
        w = u = star().initial_weights
        sizes = []
        for _ in range(20_000):
            w, u = w + (H @ u - C @ w), u + tau * (w - u)
            sizes.append(float(np.linalg.norm(process.X @ w)))
        assert (late_growth(sizes) > 1) == grows


def test_star_ridge() -> None:
    """Ridge TD is stable iff η > .2392504643, the size of the negative eigenvalue; α < 2/(4/7 + η) at η = .5."""
    process = linear_process(star())
    assert min_real(TD, process) == pytest.approx(-0.2392504643, rel=1e-9)
    assert min_real(TD, process, eta=0.2392504642) < 0 < min_real(TD, process, eta=0.2392504644)
    G, _ = TD.expected(process, TD.checked({"eta": 0.5})).generator  # type: ignore[misc]
    eigenvalues = np.linalg.eigvals(G)
    assert (2 * eigenvalues.real / np.abs(eigenvalues) ** 2).min() == pytest.approx(1.86667, abs=5.1e-6)


def test_kolter_ridge_and_targets() -> None:
    """ε = .01 at p* + .05; numbers by an independent scalar computation after Kolter 2011."""
    process = linear_process(kolter(critical_probability(0.01) + 0.05, epsilon=0.01))
    (A,), (b,) = TD.expected(process, TD.checked({})).generator  # type: ignore[misc]
    assert A[0] == pytest.approx(-0.0031209, abs=5.1e-8)
    assert b / (A[0] + 0.01) == pytest.approx(-0.131925, abs=5.1e-7)  # stable, with the wrong sign
    assert b / (A[0] + 0.1) == pytest.approx(-0.009368, abs=5.1e-7)
    for eta, factor in ((0.0, 1.003022), (0.01, 0.993403)):
        M, _ = frozen_target_map(covariance(process) + eta, cross(process), np.zeros(1), 0.5, 1000)
        assert M[0, 0] == pytest.approx(factor, abs=5.1e-7)
        M, _ = method("fitted").expected(process, {"eta": eta}).at(np.zeros(1), 0.1)  # type: ignore[misc]
        assert M[0, 0] == pytest.approx(factor, abs=5.1e-7)


def test_projected_target_converges_where_td_diverges() -> None:
    """Its limit is (A + ηI)⁻¹ b where that lies in the balls (Zhang, Yao & Whiteson 2021, theorem 2)."""
    process = linear_process(kolter(critical_probability(0.01) + 0.05, epsilon=0.01))
    options = PROJECTED_TARGET.checked({"tau": 0.1, "eta": 0.1})
    expected = PROJECTED_TARGET.expected(process, options)  # type: ignore[misc]
    theta = expected.initial(np.array([150.0]))
    assert theta.tolist() == [150.0, 150.0]
    for _ in range(3000):
        M, c = expected.at(theta, 0.5)
        theta = M @ theta + c
    assert theta == pytest.approx([-0.009368, -0.009368], abs=5.1e-7)
    inside = PROJECTED_TARGET.expected(process, options).at(np.array([3.0, 4.0]), 0.1)[0]  # type: ignore[misc]
    polyak = POLYAK_TARGET.expected(process, {"tau": 0.1, "eta": 0.1}).at(theta, 0.1)[0]  # type: ignore[misc]
    assert np.array_equal(inside, polyak)


def test_projection_by_hand() -> None:
    """w = (3, 4) to the ball of radius 1: (.6, .8); half-way from u = 0: (.3, .4), to the ball of .25: (.15, .2)."""
    process = process_of(2, num_weights=2)
    options = PROJECTED_TARGET.checked({"tau": 0.5, "ball_w": 1.0, "ball_u": 0.25})
    learner = PROJECTED_TARGET.learner(process, np.array([[3.0, 4.0]]), options)  # type: ignore[misc]
    learner.theta[:, 2:] = 0.0
    transition = np.zeros(1, dtype=np.int64)
    learner.update(sample_along(process, transition, transition, np.ones(1, dtype=bool)), 0.0)
    assert learner.theta[0] == pytest.approx([3.0, 4.0, 0.15, 0.2], rel=1e-12)


@pytest.mark.parametrize(
    ("one", "options", "message"),
    [
        (HARD_TARGET, {"period": 0}, "period"),
        (HARD_TARGET, {"period": 2.5}, "period"),
        (POLYAK_TARGET, {"tau": 0.0}, "tau"),
        (POLYAK_TARGET, {"tau": 1.5}, "tau"),
        (PROJECTED_TARGET, {"ball_w": 0.0}, "ball_w"),
        (PROJECTED_TARGET, {"ball_u": -1.0}, "ball_u"),
    ],
)
def test_what_is_refused(one, options, message) -> None:  # type: ignore[no-untyped-def]
    process = process_of(1)
    with pytest.raises(ValueError, match=message):
        one.expected(process, one.checked(options))
    with pytest.raises(ValueError, match=message):
        one.learner(process, np.ones((1, 3)), one.checked(options))

"""Adaptive residual learning: φ by brute force, the mix it makes, descent on the star, and Baird's recursion by hand.

Mutants that die here: φ clipped to 1 instead of left at 0; φ of either newest term alone; W_rg with x' for x''; the
ratio missing from δ; the mix the wrong way round, sampled or expected; the margin missing, or not capped.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import stream
from neuralq.lab.methods import Expected, Method, SampledUpdate
from neuralq.lab.methods.residual import RESIDUAL, RESIDUAL_ADAPTIVE, least_phi
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star

Floats = NDArray[np.float64]


def expected_of(process: Process, one: Method, **options: float) -> Expected:
    assert one.expected is not None
    return one.expected(process, one.checked(options))


def learner_of(process: Process, w0: Floats, **options: float) -> SampledUpdate:
    assert RESIDUAL_ADAPTIVE.learner is not None
    return RESIDUAL_ADAPTIVE.learner(process, w0, RESIDUAL_ADAPTIVE.checked(options))


def random_process(seed: int) -> Process:
    """Five states, two actions, transitions that may end the episode, random policies, features and update weights."""
    rng = np.random.default_rng(seed)
    mdp = FiniteMDP.from_arrays(
        0.9 * rng.dirichlet(np.ones(5) / 2, size=(2, 5)), rng.normal(size=(5, 2)), substochastic=True
    )
    pi, mu = rng.dirichlet(np.ones(2), size=(2, 5))
    return linear_process(
        Problem.from_mdp(
            mdp, rng.normal(size=(5, 3)), gamma=0.95, target_policy=pi, behaviour_policy=mu,
            state_distribution=rng.dirichlet(np.ones(5) / 2),
        )
    )  # fmt: skip


def test_least_phi_is_the_least_that_descends() -> None:
    rng, grid = np.random.default_rng(0), np.linspace(0, 1, 2001)
    direct, residual = rng.normal(size=(2, 300, 2))
    direct[0], residual[1], direct[2] = 0.0, 0.0, residual[2]
    direct[3] = 3 * residual[3]  # W_d·W_rg > W_rg·W_rg
    assert least_phi(np.array([[-1.0, 0.0]] * 2), np.ones((2, 2)), 0.3).tolist() == pytest.approx([1 / 3 + 0.3] * 2)
    assert least_phi(-residual[:1], residual[:1], 0.9).tolist() == [1.0]
    for got, W_d, W_rg in zip(least_phi(direct, residual), direct, residual, strict=True):
        descends = ((1 - grid)[:, None] * W_d + grid[:, None] * W_rg) @ W_rg >= -1e-12
        assert got == pytest.approx(grid[np.argmax(descends)], abs=5.1e-4)


def test_adaptive_residual_mixes_the_two_expected_updates() -> None:
    process = random_process(1)
    expected = expected_of(process, RESIDUAL_ADAPTIVE)
    used = set()
    for w in 5 * np.random.default_rng(3).normal(size=(40, 3)):
        step = {k: expected_of(process, RESIDUAL, phi=k).at(w, 0.1) for k in (0.0, 1.0)}
        W_d, W_rg = ((M @ w + c - w) / 0.1 for M, c in step.values())
        phi = least_phi(W_d[None], W_rg[None], 0.1)[0]
        M, c = expected.at(w, 0.1)
        assert M @ w + c - w == pytest.approx(0.1 * ((1 - phi) * W_d + phi * W_rg), abs=1e-12)
        used.add(bool(phi > 0))
    assert not expected.linear and used  # which of the two is seen depends on the problem


def sweep_the_star(margin: float, num_sweeps: int) -> tuple[Floats, bool]:
    """RMSBE before every expected update at α = .001, and whether φ was above 0 in any of them."""
    process, X = linear_process(star()), star().features
    expected = expected_of(process, RESIDUAL_ADAPTIVE, margin=margin)
    w, errors, mixed = expected.initial(star().initial_weights), [], False
    plain = np.eye(8) - 0.001 * X.T @ (X - 0.99 * process.P @ X) / 7
    for _ in range(num_sweeps):
        value = X @ w
        errors.append(float(np.sqrt(np.mean((0.99 * value[6] - value) ** 2))))  # the target always goes to state 6
        M, c = expected.at(w, 0.001)
        mixed = mixed or bool(np.abs(M - plain).max() > 1e-12)
        w = M @ w + c
    return np.array(errors), mixed


def test_with_a_margin_the_error_falls_on_the_star_and_without_it_stays() -> None:
    falling, mixed = sweep_the_star(0.5, 8000)
    assert mixed and (np.diff(falling) < 0).all() and falling[-1] < 0.1
    level, mixed = sweep_the_star(0.0, 2000)
    assert mixed and level == pytest.approx(level[0], rel=1e-5)


def test_sampled_adaptive_residual_is_bairds_recursion() -> None:
    process, rng = random_process(3), np.random.default_rng(3)
    samples = list(itertools.islice(stream(process, "markov", 4, rng), 40))
    w0 = rng.normal(size=(4, 3))
    learner = learner_of(process, w0, tracking=0.2, margin=0.05)
    for sample in samples:
        learner.update(sample, 0.05)
    positive = 0
    for n in range(4):
        w, trace_d, trace_rg = w0[n], np.zeros(3), np.zeros(3)
        for t in samples:
            x, x2 = t.x[n], t.discount_second[n] * t.x_second[n]
            d = t.rho[n] * (t.reward[n] + t.discount[n] * w @ t.x_next[n] - w @ x)
            trace_d, trace_rg = 0.8 * trace_d + 0.2 * d * x, 0.8 * trace_rg + 0.2 * d * (x - x2)
            gap = (trace_d - trace_rg) @ trace_rg
            phi = trace_d @ trace_rg / gap if gap != 0 else 0.0
            phi = min(phi + 0.05, 1.0) if 0 < phi <= 1 else 0.0
            positive += phi > 0
            w = w + 0.05 * d * ((1 - phi) * x + phi * (x - x2))
        assert learner.theta[n] == pytest.approx(w, abs=1e-12)
    assert positive > 0


@pytest.mark.parametrize("margin", [-0.1, 1.5])
def test_margin_outside_its_range_is_refused(margin: float) -> None:
    with pytest.raises(ValueError, match="margin"):
        expected_of(linear_process(star()), RESIDUAL_ADAPTIVE, margin=margin)


@pytest.mark.parametrize("tracking", [0.0, 1.5])
def test_tracking_outside_its_range_is_refused(tracking: float) -> None:
    with pytest.raises(ValueError, match="tracking"):
        learner_of(linear_process(star()), np.zeros((1, 8)), tracking=tracking)

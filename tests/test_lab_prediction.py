"""The verdict before training equals what training does, on hundreds of random problems and for six kinds of method.

Training here is the expected update written from each method's definition, in a few lines that share nothing with the
lab: its affine map is read off by applying it to unit vectors, and 2¹⁸ updates are that map to a power. Off the band
|ρ − 1| < 1e-4 every error has then changed by more than e²⁶, so there is no doubt about the outcome.

Mutants that die here: a verdict from the symmetric part; a bound of 1/|λ|; the ratio twice; λ in the wrong resolvent; a
target network whose period is off by one; emphasis that starts at the wrong interest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from neuralq.lab.verdicts.diagnosis import diagnose
from neuralq_envs.counterexamples import Problem
from neuralq_envs.counterexamples.garnet import garnet

Floats = NDArray[np.float64]
Update = Callable[[Floats], Floats]
BAND = 1e-4


class Model:
    """The numbers of a problem, from its arrays alone."""

    def __init__(self, problem: Problem) -> None:
        mdp, pi = problem.mdp, problem.target_policy
        n = mdp.num_states
        full = np.zeros((n, mdp.num_actions, n))
        full[mdp.s_tm1, mdp.a_tm1] = mdp.transition.toarray()
        reward = np.zeros((n, mdp.num_actions))
        reward[mdp.s_tm1, mdp.a_tm1] = mdp.reward
        self.P = np.einsum("sa,sat->st", pi, full)
        self.r = (pi * reward).sum(axis=1)
        self.X, self.d, self.gamma = np.array(problem.features), np.array(problem.state_distribution), problem.gamma

    def error(self, w: Floats) -> Floats:
        """The Bellman error of every state."""
        return np.asarray(self.r + self.gamma * self.P @ self.X @ w - self.X @ w)

    def lambda_error(self, w: Floats, lambda_: float, weight: Floats) -> Floats:
        """Σ_k (γλ)^k of what flows along the chain, the traces of all states: Xᵀ diag(weight) (I − γλP)⁻¹ error."""
        ahead = np.linalg.solve(np.eye(len(self.d)) - self.gamma * lambda_ * self.P, self.error(w))
        return np.asarray(self.X.T @ (weight * ahead))


def td(m: Model, alpha: float, lambda_: float) -> Update:
    return lambda w: w + alpha * m.lambda_error(w, lambda_, m.d)


def residual(m: Model, alpha: float, phi: float) -> Update:
    back = m.X - phi * m.gamma * m.P @ m.X
    return lambda w: w + alpha * back.T @ (m.d * m.error(w))


def emphatic(m: Model, alpha: float) -> Update:
    f = np.linalg.solve(np.eye(len(m.d)) - m.gamma * m.P.T, m.d)
    return lambda w: w + alpha * m.X.T @ (f * m.error(w))


def tdc(m: Model, alpha: float, ratio: float) -> Update:
    k, ahead = m.X.shape[1], m.gamma * m.P @ m.X

    def step(theta: Floats) -> Floats:
        w, h = theta[:k], theta[k:]
        push = m.X.T @ (m.d * m.error(w))
        correction = ahead.T @ (m.d * (m.X @ h))
        return np.concatenate([w + alpha * (push - correction), h + alpha * ratio * (push - m.X.T @ (m.d * (m.X @ h)))])

    return step


def gtd2(m: Model, alpha: float, ratio: float) -> Update:
    k, back = m.X.shape[1], m.X - m.gamma * m.P @ m.X

    def step(theta: Floats) -> Floats:
        w, h = theta[:k], theta[k:]
        push = m.X.T @ (m.d * m.error(w)) - m.X.T @ (m.d * (m.X @ h))
        return np.concatenate([w + alpha * back.T @ (m.d * (m.X @ h)), h + alpha * ratio * push])

    return step


def frozen_target(m: Model, alpha: float, period: int) -> Update:
    def cycle(u: Floats) -> Floats:
        w = u
        for _ in range(period):
            target = m.r + m.gamma * m.P @ m.X @ u
            w = w + alpha * m.X.T @ (m.d * (target - m.X @ w))
        return w

    return cycle


def soft_target(m: Model, alpha: float, tau: float) -> Update:
    k = m.X.shape[1]

    def step(theta: Floats) -> Floats:
        w, u = theta[:k], theta[k:]
        target = m.r + m.gamma * m.P @ m.X @ u
        return np.concatenate([w + alpha * m.X.T @ (m.d * (target - m.X @ w)), u + tau * (w - u)])

    return step


def ends_up_growing(step: Update, theta: Floats) -> bool:
    """Whether 2¹⁸ updates make the change per update larger."""
    c = step(np.zeros_like(theta))
    M = np.stack([step(e) - c for e in np.eye(len(theta))], axis=1)
    first = M @ theta + c - theta
    with np.errstate(all="ignore"):
        late = np.linalg.matrix_power(M, 2**18) @ first
        return not np.linalg.norm(late) < np.linalg.norm(first)


def drawn(seed: int) -> tuple[Problem, np.random.Generator]:
    rng = np.random.default_rng([seed, 77])
    updates = ("behaviour", "random")[seed % 2]
    size = int(rng.integers(3, 13))
    features = int(rng.integers(1, size + 1))
    gamma = float(rng.choice([0.5, 0.9, 0.95, 0.99, 0.999]))
    return garnet(size, int(rng.integers(2, 5)), 2, features, gamma, seed, updates), rng  # type: ignore[arg-type]


def case(name: str, seed: int) -> tuple[Problem, Update, dict[str, float], str, float, int]:
    """A random problem with random options of a method."""
    problem, rng = drawn(seed)
    m, alpha = Model(problem), float(10 ** rng.uniform(-3, 0))
    ratio, w0 = float(10 ** rng.uniform(-2, 1)), len(problem.initial_weights)
    if name == "td":
        lambda_ = float(rng.choice([0.0, 0.0, rng.uniform(), 1.0]))
        return problem, td(m, alpha, lambda_), {"lambda_": lambda_}, "td", alpha, w0
    if name == "residual":
        phi = float(rng.choice([rng.uniform(0, 0.3), rng.uniform(), 1.0]))
        return problem, residual(m, alpha, phi), {"phi": phi}, "residual", alpha, w0
    if name == "etd":
        return problem, emphatic(m, alpha), {}, "etd", alpha, w0
    if name == "tdc":
        return problem, tdc(m, alpha, ratio), {"beta_over_alpha": ratio}, "tdc", alpha, 2 * w0
    if name == "gtd2":
        return problem, gtd2(m, alpha, ratio), {"beta_over_alpha": ratio}, "gtd2", alpha, 2 * w0
    if name == "hard-target":
        period = int(rng.integers(1, 60))
        return problem, frozen_target(m, alpha, period), {"period": float(period)}, name, alpha, w0
    tau = float(10 ** rng.uniform(-3, 0))
    return problem, soft_target(m, alpha, tau), {"tau": tau}, name, alpha, 2 * w0


METHODS = ["td", "residual", "etd", "tdc", "gtd2", "hard-target", "polyak-target"]


def compare(name: str, seeds: range) -> tuple[int, int]:
    """How many problems were clear, and how many of them diverged; any disagreement fails."""
    clear = diverged = 0
    for seed in seeds:
        problem, step, options, method, alpha, size = case(name, seed)
        found = diagnose(problem, method, alpha, "expected", **options)
        if abs(found.spectral_radius - 1) < BAND:
            continue
        theta = np.random.default_rng([seed, 5]).normal(size=size)
        grows = ends_up_growing(step, theta)
        assert grows is (found.verdict == "diverges"), (name, seed, alpha, options, found.spectral_radius)
        clear, diverged = clear + 1, diverged + grows
    return clear, diverged


@pytest.mark.parametrize("name", METHODS)
def test_prediction_is_training(name: str) -> None:
    clear, diverged = compare(name, range(20))
    assert clear >= 10
    assert diverged >= 1 and diverged < clear  # both outcomes are there to be told apart


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_prediction_is_training_on_500_problems(name: str) -> None:
    clear, diverged = compare(name, range(1000, 1500))
    assert clear >= 250
    assert diverged >= 5


def test_the_comparison_can_fail() -> None:
    problem, step, options, method, alpha, size = case("td", 1)
    wrong = replace(problem, gamma=0.0)
    found = [diagnose(p, method, alpha, "expected", **options).spectral_radius for p in (problem, wrong)]
    assert abs(found[0] - found[1]) > 1e-6
    assert ends_up_growing(lambda theta: 1.001 * theta, np.ones(2))
    assert not ends_up_growing(lambda theta: 0.999 * theta, np.ones(2))
    assert size == len(problem.initial_weights) and step(np.ones(size)).shape == (size,)

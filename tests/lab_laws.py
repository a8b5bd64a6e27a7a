"""What tests of the lab's methods share: a problem without symmetries, and the two laws that sampled updates obey."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import sample_along, stream
from neuralq.lab.methods import Method
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem

Floats = NDArray[np.float64]


def uneven_problem(seed: int, pairs: bool = False, num_weights: int = 3) -> Problem:
    """Three states, three actions of which one is illegal in state 1, transitions that may end the episode.

    Updates are made as often as the behaviour visits, so that long chains have the stationary distribution D. The
    policies are close enough for ratios to have small variance.
    """
    rng = np.random.default_rng(seed)
    legal = np.ones((3, 3), dtype=bool)
    legal[1, 2] = False
    transition = rng.dirichlet(np.ones(3), size=(3, 3)) * rng.uniform(0.6, 1, size=(3, 3, 1))

    def policy() -> Floats:
        chance = legal * rng.uniform(0.5, 1, size=(3, 3))
        return np.asarray(chance / chance.sum(axis=1, keepdims=True))

    mdp = FiniteMDP.from_arrays(
        transition, rng.normal(size=(3, 3)), legal=legal, substochastic=True, start=[0.5, 0.2, 0.3]
    )
    X = rng.normal(size=(3, 3, num_weights) if pairs else (3, num_weights))
    return Problem.from_mdp(mdp, X, gamma=0.9, target_policy=policy(), behaviour_policy=policy())


def process_of(seed: int, pairs: bool = False, num_weights: int = 3) -> Process:
    """The rows and chains of `uneven_problem`."""
    return linear_process(uneven_problem(seed, pairs, num_weights))


def mean_over_transitions(process: Process, one: Method, theta: Floats, step_size: float, **options: float) -> Floats:
    """Exact mean of θ after one sampled update: over transitions and second successors by their chances, ``[size]``."""
    transitions, target = process.transitions, process.target_transitions
    cases = [
        (k, q, process.D[i] * transitions.probability[k] * target.probability[q])
        for k, i in enumerate(transitions.row)
        for q in range(target.starts[i], target.starts[i + 1])
    ]
    transition, second, weight = (np.array(column) for column in zip(*cases, strict=True))
    learner = one.learner(process, np.tile(theta[: process.num_weights], (len(transition), 1)), one.checked(options))
    learner.theta[:] = theta
    learner.update(sample_along(process, transition, second, np.ones(len(transition), dtype=bool)), step_size)
    return weight @ learner.theta


def long_run_increment(
    process: Process, one: Method, theta: Floats, *, seeds: int = 1000, length: int = 150, **options: float
) -> tuple[Floats, Floats]:
    """Mean of the sampled increment per unit of step size while θ is held, and its standard error, ``[size]`` each.

    Chains of the behaviour; the first 60 steps, in which traces build up, are left out.
    """
    step_size = 1e-7  # so small that updates within one call do not see one another
    learner = one.learner(process, np.tile(theta[: process.num_weights], (seeds, 1)), one.checked(options))
    samples = stream(process, "markov", seeds, np.random.default_rng(0))
    total = np.zeros((seeds, len(theta)))
    for t in range(60 + length):
        learner.update(next(samples), step_size)
        if t >= 60:
            total += (learner.theta - theta) / step_size
        learner.theta[:] = theta
    total /= length
    return total.mean(axis=0), total.std(axis=0, ddof=1) / np.sqrt(seeds)


def assert_long_run(process: Process, one: Method, theta: Floats, **options: float) -> None:
    """The mean increment of long chains is the expected one within 4 standard errors, which are small against it."""
    mean, error = long_run_increment(process, one, theta, **options)
    M, c = one.expected(process, one.checked(options)).at(theta, 1.0)
    exact = M @ theta + c - theta
    assert np.abs(mean - exact).max() / np.abs(exact).max() < 0.1  # the comparison is not idle
    assert (np.abs(mean - exact) < 4 * error + 1e-7).all(), (mean, exact, error)


def assert_law(process: Process, one: Method, seed: int = 0, **options: float) -> None:
    """At several θ the mean over transitions of the sampled update is the expected update."""
    rng = np.random.default_rng(seed)
    expected = one.expected(process, one.checked(options))
    for _ in range(expected.size + 2):
        theta = rng.normal(size=expected.size)
        M, c = expected.at(theta, 0.07)
        np.testing.assert_allclose(
            mean_over_transitions(process, one, theta, 0.07, **options), M @ theta + c, rtol=0, atol=1e-12
        )


def min_real(one: Method, process: Process, **options: float) -> float:
    """The least real part of the eigenvalues of G on the weights that some row sees."""
    generator = one.expected(process, one.checked(options)).generator
    assert generator is not None
    R = process.visible
    return float(np.linalg.eigvals(R.T @ generator[0] @ R).real.min())


def radius(matrix: Floats) -> float:
    """Spectral radius."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())

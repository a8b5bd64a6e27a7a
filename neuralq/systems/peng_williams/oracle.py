"""What Q(λ) must be at both ends: one-step Q-learning at λ = 0, and Monte Carlo at λ = 1."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.runs.report.claims import Row, number
from neuralq.systems.peng_williams.trials import Settings, train
from neuralq.tabular import Experience, apply_lambda
from neuralq.tabular.kernels.acting import Table, choose
from neuralq.tabular.kernels.random_numbers import Seed, new_stream, uniform
from neuralq.tabular.policies import acting_code
from neuralq_envs.pole import PoleBoxesEnv
from neuralq_envs.pole_kernels import NUM_BOXES

__all__ = ["monte_carlo_difference", "one_step_training", "oracle"]


def oracle() -> tuple[Row, ...]:
    """Both ends, as rows."""
    num_failures = 40
    plain, lengths = one_step_training(0, num_failures)
    ours = train(0, Settings(lambda_=0.0, most_failures=num_failures))
    same = float(np.abs(ours.q - plain).max()) + float(np.abs(ours.lengths - lengths).max())
    return (
        number(
            "λ = 0: difference from one-step Q-learning", 0.0, same, tol=0.0, note=f"{num_failures} trials, bit for bit"
        ),
        number("λ = 1, a greedy episode: difference from Monte Carlo", 0.0, monte_carlo_difference(), tol=1e-12),
    )


def one_step_training(seed: Seed, num_failures: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """One-step Q-learning written out in Python on the Gymnasium environment: its table and the lengths of its trials.

    It shares with the compiled loop where random numbers come from, and nothing of how it learns.

    Example:
        >>> one_step_training(0, 2)[0].shape
        (162, 2)
    """
    env, stream, settings = PoleBoxesEnv(), new_stream(seed), Settings(lambda_=0.0)
    alpha, gamma = settings.step_size, settings.gamma
    q, lengths = np.zeros((NUM_BOXES, 2)), np.zeros(num_failures, np.int64)
    acting = Table(q, np.zeros(q.shape, np.int64), np.full(NUM_BOXES, 2, np.uint64))
    greedy = acting_code("greedy")
    for trial in range(num_failures):
        start = [settings.start_spread * (2 * float(uniform(stream)) - 1) for _ in range(4)]
        s, _ = env.reset(options={"state": start})
        fallen = False
        while not fallen:
            a = int(choose(acting, np.uint64(s), 0, greedy, stream))
            s_t, reward, fallen, _, _ = env.step(a)
            target = reward if fallen else reward + gamma * max(q[s_t])
            q[s, a] += alpha * (target - q[s, a])
            s = s_t
            lengths[trial] += 1
    return q, lengths


def monte_carlo_difference(num_states: int = 12, alpha: float = 0.1, gamma: float = 0.9, seed: int = 0) -> float:
    """How far Q(1) is from Monte Carlo's ``Q(s, a) + α (G − Q(s, a))`` on a greedy episode that visits no state twice.

    Example:
        >>> monte_carlo_difference() < 1e-12
        True
    """
    rng = np.random.default_rng(seed)
    q, rewards = rng.normal(size=(num_states, 3)), rng.normal(size=num_states)
    path = rng.permutation(num_states)
    last = np.arange(num_states) == num_states - 1
    best = q[path].argmax(axis=1)
    episode = Experience(path, best, rewards, np.where(last, 0.0, gamma), np.append(path[1:], path[-1]), last)
    learned = apply_lambda(q, episode, lambda_=1.0, rule="peng", step_size=alpha).q
    expected, following = q.copy(), 0.0
    for s, a, r in zip(path[::-1], best[::-1], rewards[::-1], strict=True):
        following = r + gamma * following
        expected[s, a] += alpha * (following - expected[s, a])
    return float(np.abs(learned - expected).max())

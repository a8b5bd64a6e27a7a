"""The compiled ε-greedy choice equals the rule: `sample(epsilon_greedy(q, ε), u)`, action by action.

Mutants that these tests kill: the highest index on ties; ε spread over illegal actions, or over all but the greedy one;
the probability of the greedy action without its share of ε; a draw on the wrong side of a boundary; an illegal action
at u = 0 or u → 1; the greedy action where rounding leaves the sum below u; NaN, +∞ or an empty mask passed over in
silence; ε looked up once instead of at each step.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from neuralq import rules
from neuralq.runs.stream.acting import EpsilonGreedyPolicy, choose_epsilon_greedy, choose_greedy

INF = math.inf


@given(
    seed=st.integers(0, 2**32),
    num_actions=st.integers(1, 7),
    epsilon=st.sampled_from([0.0, 1e-3, 0.1, 0.5, 0.9, 1.0]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_equals_the_rule(seed: int, num_actions: int, epsilon: float, dtype: torch.dtype) -> None:
    """Few distinct values make ties common; u is drawn, and laid next to every boundary of the distribution."""
    rng = np.random.default_rng(seed)
    q = torch.from_numpy(rng.integers(-2, 3, (40, num_actions)).astype(np.float64))
    q[torch.from_numpy(rng.random((40, num_actions)) < 0.3)] = -INF
    q[:, int(rng.integers(num_actions))] = 1.0
    p = rules.epsilon_greedy(q, epsilon)
    boundaries = torch.cat([torch.zeros(40, 1, dtype=torch.float64), p.cumsum(-1)], -1)
    for shift in (1e-9, -1e-9):
        for column in range(num_actions + 1):
            u = (boundaries[:, column] + shift).clamp(0.0, 1.0 - 1e-12)
            _compare(q.to(dtype), epsilon, u, p)
    _compare(q.to(dtype), epsilon, torch.from_numpy(rng.random(40)), p)
    _compare(q.to(dtype), epsilon, torch.zeros(40, dtype=torch.float64), p)


def _compare(q: torch.Tensor, epsilon: float, u: torch.Tensor, p: torch.Tensor) -> None:
    a, mu = choose_epsilon_greedy(q, epsilon, u.numpy())
    assert torch.equal(a, rules.sample(p, u))
    assert a.dtype == torch.int64 and mu.dtype == torch.float32
    torch.testing.assert_close(mu.double(), p.gather(-1, a[:, None])[:, 0], atol=1e-7, rtol=1e-6)
    assert bool((mu > 0).all()) and not torch.isneginf(q.gather(-1, a[:, None])).any()


def test_by_hand() -> None:
    """q = (1, −∞, 3, 3), ε = 0.3: probabilities (0.1, 0, 0.8, 0.1)."""
    q = torch.tensor([[1.0, -INF, 3.0, 3.0]]).expand(6, 4)
    a, mu = choose_epsilon_greedy(q, 0.3, np.array([0.0, 0.0999, 0.1001, 0.8999, 0.9001, 1 - 1e-16]))
    assert a.tolist() == [0, 0, 2, 2, 3, 3]
    np.testing.assert_allclose(mu.numpy(), [0.1, 0.1, 0.8, 0.8, 0.1, 0.1], rtol=1e-6)
    halves = torch.tensor([[0.0, 2.0]])  # probabilities (1/4, 3/4), and u exactly on the boundary
    assert choose_epsilon_greedy(halves, 0.5, np.array([0.25]))[0].tolist() == [1]
    a, mu = choose_greedy(q)
    assert a.tolist() == [2] * 6 and mu.tolist() == [1.0] * 6


def test_frequencies_fit_the_rule() -> None:
    """χ² of 200,000 draws with 3 degrees of freedom; the seed is fixed, so this either holds or does not."""
    q = torch.tensor([0.3, 2.0, -INF, -1.0, 2.0])
    expected = rules.epsilon_greedy(q.double(), 0.4).numpy()
    n = 200_000
    a, mu = choose_epsilon_greedy(q.expand(n, 5), 0.4, np.random.default_rng(3).random(n))
    counts = np.bincount(a.numpy(), minlength=5)
    legal = expected > 0
    assert counts[~legal].sum() == 0
    assert chisquare(counts[legal], n * expected[legal]).pvalue > 1e-3
    np.testing.assert_allclose(mu.numpy(), expected[a.numpy()], rtol=1e-6)
    assert float((1 / mu.double()).mean()) == pytest.approx(4, rel=0.01)  # Σ_a p(a)/p(a) over the legal ones


def test_unusable_values_are_refused_with_their_row() -> None:
    u = np.zeros(3)
    for broken in ([0.0, math.nan], [math.nan, math.nan], [-INF, -INF], [0.0, INF]):
        q = torch.tensor([[0.0, 1.0], [2.0, -INF], broken])
        with pytest.raises(ValueError, match=r"environment 2 .*diverged.*mask allows nothing"):
            choose_epsilon_greedy(q, 0.1, u)
        with pytest.raises(ValueError, match="environment 2"):
            choose_greedy(q)
    for epsilon in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="epsilon must lie in"):
            choose_epsilon_greedy(torch.zeros(3, 2), epsilon, u)
    for q in (torch.zeros(2), torch.zeros(4, 2), torch.zeros(1, 3, 2)):
        with pytest.raises(ValueError, match=r"must be \[N, A\] with N uniform numbers"):
            choose_epsilon_greedy(q, 0.1, u)


def test_the_policy_draws_from_its_generator_and_looks_epsilon_up_at_each_step() -> None:
    epsilons = iter([0.0, 1.0])
    policy = EpsilonGreedyPolicy(lambda s: -s, lambda: next(epsilons), np.random.default_rng(5))
    s = torch.tensor([[0.0, 1.0, 2.0]]).expand(8, 3)
    own = np.random.default_rng(5)
    for epsilon in (0.0, 1.0):
        a, mu = policy(s)
        b, nu = choose_epsilon_greedy(-s, epsilon, own.random(8))
        assert torch.equal(a, b) and torch.equal(mu, nu)
    assert set(a.tolist()) == {0, 1, 2}

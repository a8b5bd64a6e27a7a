"""Quantile and categorical rules and Munchausen targets against the sums and loops that define them.

Mutants that were tried, and die: the levels i/K in place of the midpoints; τ and 1 − τ exchanged; the mean over targets
and the sum over quantiles exchanged; the projection without clipping, or with shares that grow with the distance; the
sign of the Munchausen bonus, its floor applied to log π and not to τ log π, the bonus from q_t; the maximum in place of
the soft value.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from neuralq import rules

RNG = np.random.default_rng(20)
F64 = torch.float64


def column(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def quantile_loss_by_definition(theta: list[float], targets: list[float], kappa: float) -> float:
    """Dabney et al. 2018, eq. 9 and 10, number by number."""
    total = 0.0
    for i, value in enumerate(theta):
        tau = (2 * i + 1) / (2 * len(theta))
        for target in targets:
            u = target - value
            size = 0.5 * u * u if abs(u) <= kappa else kappa * (abs(u) - 0.5 * kappa)
            total += abs(tau - (1.0 if u < 0 else 0.0)) * size / len(targets)
    return total


@pytest.mark.parametrize(("num", "num_targets", "kappa"), [(1, 1, 1.0), (4, 3, 1.0), (5, 5, 0.1), (3, 7, 2.0)])
def test_quantile_huber_is_its_double_sum(num: int, num_targets: int, kappa: float) -> None:
    theta, target = RNG.normal(size=(2, 6, num)), RNG.normal(size=(2, 6, num_targets))
    got = rules.quantile_huber(torch.from_numpy(theta), torch.from_numpy(target), kappa)
    for i in np.ndindex(2, 6):
        assert float(got[i]) == pytest.approx(quantile_loss_by_definition(list(theta[i]), list(target[i]), kappa))


def test_quantile_regression_finds_the_quantiles_of_a_sample() -> None:
    # With a small delta the minimum lies at the quantiles: of 0 … 99 at the levels 1/8, 3/8, 5/8, 7/8.
    sample = torch.arange(100, dtype=F64)
    theta = torch.full((4,), 50.0, dtype=F64, requires_grad=True)
    for k in range(300):
        (grad,) = torch.autograd.grad(rules.quantile_huber(theta, sample, 1e-3).sum() / 1e-3, [theta])
        with torch.no_grad():
            theta -= 40.0 / (1 + k / 50) * grad
    wanted = np.quantile(sample.numpy(), [1 / 8, 3 / 8, 5 / 8, 7 / 8])
    np.testing.assert_allclose(theta.detach().numpy(), wanted, atol=1.0)


def projected_by_algorithm_1(values: Any, mass: Any, low: float, high: float, num: int) -> list[float]:
    """Bellemare, Dabney & Munos 2017, algorithm 1, with the case of a value on the grid that it leaves out."""
    m, spacing = [0.0] * num, (high - low) / (num - 1)
    for z, p in zip(values, mass, strict=True):
        b = (min(max(float(z), low), high) - low) / spacing
        lower, upper = math.floor(b), math.ceil(b)
        if lower == upper:
            m[lower] += float(p)
        else:
            m[lower] += float(p) * (upper - b)
            m[upper] += float(p) * (b - lower)
    return m


@pytest.mark.parametrize(("low", "high", "num"), [(-2.0, 2.0, 5), (0.0, 1.0, 2), (-1.0, 4.0, 51)])
def test_the_projection_is_the_loop_of_the_paper(low: float, high: float, num: int) -> None:
    values = RNG.normal(scale=2, size=(3, 4, 7))
    values[0, 0, :2] = low, high
    mass = RNG.dirichlet(np.ones(7), size=(3, 4))
    grid = torch.linspace(low, high, num, dtype=F64)
    got = rules.categorical_projection(torch.from_numpy(values), torch.from_numpy(mass), grid)
    for i in np.ndindex(3, 4):
        np.testing.assert_allclose(
            got[i].numpy(), projected_by_algorithm_1(values[i], mass[i], low, high, num), atol=1e-12
        )
    torch.testing.assert_close(got.sum(-1), torch.ones(3, 4, dtype=F64))


@given(st.lists(st.floats(-3, 3), min_size=1, max_size=6), st.integers(2, 9))
def test_inside_its_range_the_projection_keeps_the_mean(values: list[float], num: int) -> None:
    grid, z = torch.linspace(-3, 3, num, dtype=F64), column(*values)
    m = rules.categorical_projection(z, torch.full_like(z, 1 / len(values)), grid)
    assert float(m @ grid) == pytest.approx(float(z.mean()), abs=1e-9)


def test_cross_entropy_pulls_the_probabilities_towards_the_target() -> None:
    logits = torch.from_numpy(RNG.normal(size=(3, 4))).requires_grad_()
    target = torch.from_numpy(RNG.dirichlet(np.ones(4), size=3))
    loss = rules.categorical_cross_entropy(logits, target)
    p = np.exp(logits.detach().numpy())
    p /= p.sum(-1, keepdims=True)
    np.testing.assert_allclose(loss.detach().numpy(), -(target.numpy() * np.log(p)).sum(-1))
    (grad,) = torch.autograd.grad(loss.sum(), [logits])
    np.testing.assert_allclose(grad.numpy(), p - target.numpy(), atol=1e-12)


def policy_of(q: list[float], tau: float) -> dict[int, float]:
    legal = [a for a, x in enumerate(q) if x > -math.inf]
    best = max(q[a] for a in legal)
    mass = {a: math.exp((q[a] - best) / tau) for a in legal}
    return {a: m / sum(mass.values()) for a, m in mass.items()}


def munchausen_by_definition(
    r: float, gamma: float, q: list[float], a: int, q_next: list[float], tau: float, alpha: float, floor: float
) -> float:
    """Vieillard, Pietquin & Geist 2020, eq. 2, with the clipped bonus."""
    bonus = alpha * max(tau * math.log(policy_of(q, tau)[a]), floor)
    after = policy_of(q_next, tau)
    return r + bonus + gamma * sum(p * (q_next[b] - tau * math.log(p)) for b, p in after.items())


@pytest.mark.parametrize("masked", [False, True])
def test_the_munchausen_target_is_its_definition(masked: bool) -> None:
    for _ in range(40):
        q, q_next = RNG.normal(size=3).tolist(), RNG.normal(size=3).tolist()
        if masked:
            q[1], q_next[0] = -math.inf, -math.inf
        a = int(RNG.choice([0, 2]))
        r, gamma, tau, alpha, floor = RNG.normal(), RNG.uniform(0.1, 1), RNG.uniform(0.2, 2), RNG.uniform(0, 1), -0.8
        got = rules.munchausen(
            column(r)[0], column(gamma)[0], column(*q), torch.tensor(a), column(*q_next), tau, alpha, floor
        )
        assert float(got) == pytest.approx(munchausen_by_definition(r, gamma, q, a, q_next, tau, alpha, floor))


def test_munchausen_is_published_with_a_temperature_of_3_percent_a_weight_of_90_and_a_floor_of_1() -> None:
    q, q_next = [0.5, 0.47, 0.1], [0.2, 0.21, -1.0]  # actions 0 and 1 are near each other, 2 is below the floor
    for a in range(3):
        got = rules.munchausen(column(1)[0], column(0.9)[0], column(*q), torch.tensor(a), column(*q_next))
        assert float(got) == pytest.approx(munchausen_by_definition(1, 0.9, q, a, q_next, 0.03, 0.9, -1.0))


def test_at_small_temperatures_munchausen_is_advantage_learning() -> None:
    # τ → 0: r + α (q[a] − max q) + γ max q'; here 1 + 0.9 · (1 − 1.5) + 0.5 · 4, nothing clipped.
    zero = torch.zeros((), dtype=F64)
    got = rules.munchausen(zero + 1, zero + 0.5, column(1, 1.5), torch.tensor(0), column(4, 2), 1e-6, 0.9, -10.0)
    assert float(got) == pytest.approx(1 - 0.45 + 2, abs=1e-5)
    assert float(rules.soft_value(column(4, 2), 1e-6)) == pytest.approx(4)
    assert float(rules.soft_value(column(1, 1, 1), 2.0)) == pytest.approx(1 + 2 * math.log(3))


def test_a_terminal_state_without_legal_actions_and_large_values_are_harmless() -> None:
    none = torch.full((2,), -math.inf, dtype=F64)
    zero = torch.zeros((), dtype=F64)
    assert float(rules.munchausen(zero + 3, zero, column(0, 0), torch.tensor(0), none, 0.03, 0.0)) == 3
    assert float(rules.soft_value(none, 0.03)) == -math.inf
    large = torch.tensor([1e6, 1e6 - 0.5], dtype=torch.float32)
    assert math.isfinite(float(rules.soft_value(large, 1e-4)))
    bonus = rules.munchausen_bonus(large, torch.tensor(1), 0.03, 1.0, -1.0)
    assert float(bonus) == pytest.approx(-0.5, abs=1e-3)


@pytest.mark.parametrize(
    ("call", "problem"),
    [
        (lambda: rules.quantile_levels(0), "num_quantiles"),
        (lambda: rules.quantile_huber(torch.zeros(2, 3), torch.zeros(3, 3)), "target"),
        (lambda: rules.quantile_huber(torch.zeros(3), torch.zeros(3), 0.0), "delta"),
        (lambda: rules.categorical_projection(torch.zeros(3), torch.zeros(2), torch.zeros(2)), "probabilities"),
        (lambda: rules.categorical_projection(torch.zeros(3), torch.zeros(3), torch.zeros(1)), "at least 2 points"),
        (lambda: rules.categorical_cross_entropy(torch.zeros(3), torch.zeros(2)), "target"),
        (lambda: rules.soft_value(torch.zeros(2), 0.0), "temperature"),
        (lambda: rules.munchausen_bonus(torch.zeros(2), torch.tensor(0), 1.0, 0.5, 0.0), "floor must be below 0"),
        (lambda: rules.munchausen_bonus(torch.zeros(2), torch.tensor(0), 1.0, 1.5, -1.0), "alpha"),
        (lambda: rules.munchausen_bonus(torch.zeros(2), torch.tensor(0.0), 1.0, 0.5, -1.0), "int64"),
    ],
)
def test_what_makes_no_sense_is_refused(call: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        call()

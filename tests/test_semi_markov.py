"""Actions that last: the discount, the step of a table and that of a network; and who comes to the elevators.

Mutants that die here: e^(+βτ), β/τ, a discount where the world has ended; the least value of a successor for the best
one, the value of the action taken; a step without its size, a gradient of another action's output, a slope of the
sigmoid without 1 − h, weights of the output changed before their gradient is taken, an error that is cut on one side
only; rates of the wrong five minutes or floor, a floor 0 among the origins, seconds at the door of another mean or
length.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners import new_smdp_network, smdp_network_update, smdp_network_values
from neuralq.rules import lambda_returns, q_learning, smdp_discount
from neuralq.tabular import smdp_q_update
from neuralq_envs.elevators.building import open_building
from neuralq_envs.elevators.environment import ElevatorsEnv
from neuralq_envs.elevators.passengers import DOWN_PEAK, MINI, draw_hour, given_passengers


def test_the_discount_is_that_of_continuous_time() -> None:
    tau = torch.tensor([0.0, 2.0, 50.0, 3.0], dtype=torch.float64)
    ends = torch.tensor([False, False, False, True])
    expected = [1.0, math.exp(-0.2), math.exp(-5.0), 0.0]
    assert smdp_discount(tau, ends, 0.1).tolist() == pytest.approx(expected, rel=1e-14)
    # A reward of 2 a second forever is worth 2/β whenever one looks: λ-returns over any durations say so.
    tau = torch.tensor([0.5, 1.7, 0.0, 9.0], dtype=torch.float64)
    discount_t = smdp_discount(tau, torch.zeros(4, dtype=torch.bool), 0.1)
    worth = torch.full((4,), 20.0, dtype=torch.float64)
    for lambda_ in (0.0, 0.7, 1.0):
        found = lambda_returns(
            2.0 * (1 - discount_t) / 0.1, discount_t, worth, lambda_, torch.zeros(4, dtype=torch.bool)
        )
        assert found.tolist() == pytest.approx([20.0] * 4, rel=1e-12)


def test_the_table_learns_the_values_of_a_machine_that_breaks_down() -> None:
    """It runs (3 a second) until it breaks; a quick repair of 2 s costs 2, a slow one of 6 s nothing. β = .1."""
    beta, rng = 0.1, np.random.default_rng(0)
    q = np.zeros((2, 2))
    for _ in range(20_000):
        s, a = int(rng.integers(2)), int(rng.integers(2))
        if s == 0:  # it runs for 4 s, or is stopped for good after 4 s
            duration, r, s_t, ends = 4.0, 3.0 * (1 - math.exp(-0.4)) / 0.1, 1, a == 1
        else:
            duration, r, s_t, ends = (2.0, -2.0, 0, False) if a == 0 else (6.0, 0.0, 0, False)
        smdp_q_update(q, s, a, r, duration, beta, -1 if ends else s_t, ends, 0.2)
    ran = 3.0 * (1 - math.exp(-0.4)) / 0.1
    # v(running) = ran + e^(−.4) v(broken); v(broken) = the better of −2 + e^(−.2) v(running) and e^(−.6) v(running)
    running = max((ran - 2.0 * math.exp(-0.4)) / (1 - math.exp(-0.6)), ran / (1 - math.exp(-1.0)))
    quick, slow = -2.0 + math.exp(-0.2) * running, math.exp(-0.6) * running
    assert q.ravel().tolist() == pytest.approx([running, ran, quick, slow], rel=1e-9) and quick > slow


def test_a_step_of_the_table_is_q_learning_with_that_discount() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        q = rng.normal(size=(4, 3))
        s, a, s_t, r, tau, ends = (
            int(rng.integers(4)),
            int(rng.integers(3)),
            int(rng.integers(4)),
            *rng.exponential(size=2),
            bool(rng.random() < 0.3),
        )
        discount_t = smdp_discount(torch.tensor([tau]), torch.tensor([ends]), 0.7)
        target = float(q_learning(torch.tensor([r]), discount_t, torch.tensor(q[None, s_t]))[0])
        expected = q.copy()
        expected[s, a] += 0.3 * (target - q[s, a])
        assert smdp_q_update(q, s, a, r, tau, 0.7, s_t, ends, 0.3) == pytest.approx(
            target - (expected[s, a] - 0.3 * target) / 0.7
        )
        assert np.allclose(q, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("max_error", [0.3, np.inf])
def test_a_step_of_the_network_is_gradient_descent_with_autograds_gradient(max_error: float) -> None:
    rng = np.random.default_rng(2)
    network = new_smdp_network(5, 4, 3, rng, scale=1.0)
    network.c[:] = rng.normal(size=3)
    clipped = set()
    for _ in range(40):
        x = rng.normal(size=5) * (rng.random(5) < 0.7)
        a, r, tau, v_t = int(rng.integers(3)), float(rng.normal()), float(rng.exponential()), float(rng.normal())
        parts = [torch.tensor(part, requires_grad=True) for part in (network.w, network.b, network.v, network.c)]
        w, b, v, c = parts
        q = v @ torch.sigmoid(torch.tensor(x) @ w + b) + c
        smdp_network_values(network, x)
        assert np.allclose(network.q, q.detach(), rtol=0, atol=1e-13)
        error = r + math.exp(-0.5 * tau) * v_t - float(q[a].detach())
        gradients = torch.autograd.grad(q[a], parts)
        expected = [
            part.detach() + 0.1 * max(-max_error, min(error, max_error)) * gradient
            for part, gradient in zip(parts, gradients, strict=True)
        ]
        assert smdp_network_update(network, x, a, r, tau, 0.5, v_t, 0.1, max_error) == pytest.approx(error, abs=1e-12)
        for ours, theirs in zip((network.w, network.b, network.v, network.c), expected, strict=True):
            assert np.allclose(ours, theirs, rtol=0, atol=1e-13) and np.shares_memory(ours, network.flat)
        clipped.add(0 if abs(error) <= max_error else math.copysign(1, error))
    assert clipped == ({-1, 0, 1} if max_error < 1 else {0})


def test_passengers_come_as_often_as_they_are_expected() -> None:
    rng = np.random.default_rng(0)
    hours = [draw_hour(rng, 6, DOWN_PEAK) for _ in range(200)]
    arrival, origin, boarding, leaving = (np.concatenate(columns) for columns in zip(*hours, strict=True))
    counts = np.histogram2d(arrival, origin, bins=(np.arange(0, 3601, 300), np.arange(0.5, 6)))[0] / 200
    expected = np.repeat(np.array(DOWN_PEAK)[:, None], 5, axis=1)
    assert counts.shape == expected.shape and (np.abs(counts - expected) < 5 * np.sqrt(expected / 200)).all()
    assert set(origin) == {1, 2, 3, 4, 5} and sum(DOWN_PEAK) * 9 == 756
    for seconds in (boarding, leaving):
        assert 0.6 == seconds.min() and seconds.max() < 6.0
        assert seconds.mean() == pytest.approx(1.0, abs=0.01) and seconds.std() == pytest.approx(
            1 / math.sqrt(20), abs=0.02
        )
    within = np.concatenate([hour.arrival for hour in hours]) % 300
    assert np.histogram(within, bins=10, range=(0, 300))[0].std() < 5 * math.sqrt(len(within) / 10)
    assert all((np.diff(hour.arrival) >= 0).all() for hour in hours)
    assert abs(np.corrcoef(arrival % 300, origin)[0, 1]) < 0.02  # no floor comes before another


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda: ElevatorsEnv(num_floors=1), "num_floors must be a whole number of at least 3, got 1"),
        (lambda: ElevatorsEnv(num_cars=0), "num_cars must be a whole number of at least 1, got 0"),
        (lambda: ElevatorsEnv(capacity=0), "capacity must be a whole number of at least 1, got 0"),
        (lambda: ElevatorsEnv(beta=0.0), "beta must be"),
        (lambda: ElevatorsEnv("human"), "render_mode must be one of"),
        (lambda: ElevatorsEnv(passengers_per_five_minutes=[1.0, -2.0]), "at least 0, one for each five minutes"),
        (lambda: ElevatorsEnv(passengers_per_five_minutes=[math.nan]), "must be finite numbers"),
        (lambda: ElevatorsEnv(passengers_per_five_minutes=[0.0]), "not all of them 0"),
        (lambda: ElevatorsEnv(passengers=[]), "pairs"),
        (lambda: ElevatorsEnv(passengers=[(2, 1), (1, 1)]), "ascending order"),
        (lambda: ElevatorsEnv(passengers=[(2, 1.5)]), "whole floors"),
        (lambda: ElevatorsEnv(num_floors=3, passengers=[(2, 3)]), "must wait on floors 1 to 2"),
        (lambda: open_building(MINI, num_floors=5), "must wait on floors 1 to 4, got floors 1 to 5"),
        (lambda: given_passengers([(0, 1)], seconds=-1.0), "seconds must be"),
        (
            lambda: new_smdp_network(0, 1, 2, np.random.default_rng(0)),
            "num_inputs must be a whole number of at least 1, got 0",
        ),
        (
            lambda: smdp_discount(torch.tensor([-1.0]), torch.tensor([False]), 1.0),
            "duration_t must be at least 0, got -1",
        ),
        (lambda: smdp_discount(torch.tensor([1.0]), torch.tensor([False]), 0.0), "rate must be"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(act: Callable[[], Any], said: str) -> None:
    with pytest.raises(ValueError, match=said) as refused:
        act()
    assert "\n" not in str(refused.value)

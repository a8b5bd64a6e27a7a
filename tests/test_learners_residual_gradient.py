"""Residual-gradient learners: the linear recursion by hand, known runs on Baird's star, the split chain, adaptive φ.

Mutants that were tried, and die: the second sample ignored, or not weighted; φ and 1 − φ exchanged; adaptive φ of the
single step instead of the averages; an error that is off by a thousandth; state dicts without either average.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuralq.learners import ResidualGradientLearner, ResidualGradientSettings
from neuralq.learners.gradient.residual import adaptive_phi
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, LinearQ, SeparateQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Engine, Loss, TorchEngine
from neuralq.types import Transition
from neuralq_envs.counterexamples import star

Array = NDArray[np.float64]
STAR = star()
X: Array = np.array(STAR.features)
START: Array = np.array(STAR.initial_weights)
GAMMA = 0.99
NETWORKS: dict[str, Any] = {"action-input": ActionInputQ, "separate": SeparateQ, "action-output": ActionOutputQ}


def column(values: Any) -> Tensor:
    return torch.as_tensor(np.asarray(values))


def star_engine() -> Engine:
    engine = TorchEngine(LinearQ(8, 1), Loss())
    engine.flat.values.copy_(column(START))
    return engine


def star_rows(s: Any, s_next: Any, gamma: float = GAMMA, r: Any = None) -> Transition:
    n = len(s)
    one, rewards = torch.ones(n, dtype=torch.float64), column(np.zeros(n) if r is None else r)
    return Transition(
        column(X[s]), torch.zeros(n, dtype=torch.int64), one, rewards, gamma * one, column(X[s_next]), one < 0
    )


def star_samples(num_steps: int, seed: int) -> list[tuple[int, int, float]]:
    """State, successor and ρ, drawn independently of one another."""
    rng = np.random.default_rng(seed)
    drawn = []
    for _ in range(num_steps):
        solid = rng.random() < 1 / 7
        drawn.append((int(rng.integers(7)), 6 if solid else int(rng.integers(6)), 7.0 if solid else 0.0))
    return drawn


@pytest.mark.parametrize("phi", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("double", [False, True])
def test_residual_learner_is_the_linear_recursion_update_for_update(phi: float, double: bool) -> None:
    engine = star_engine()
    learner = ResidualGradientLearner(engine, ResidualGradientSettings(phi, step_size=0.01))
    w, rng = START.copy(), np.random.default_rng(3)
    for s, s_next, rho in star_samples(100, seed=2):
        other = int(rng.integers(7)) if double else s_next
        second = star_rows([s], [other], 0.5) if double else None
        learner.update(star_rows([s], [s_next], r=[0.5]), column([rho]), second)
        delta = 0.5 + GAMMA * w @ X[s_next] - w @ X[s]
        w = w + 0.01 * rho * delta * (X[s] - phi * (0.5 if double else GAMMA) * X[other])
        np.testing.assert_allclose(engine.flat.values, w, rtol=1e-12, atol=1e-12)


def test_expected_residual_gradient_on_the_star() -> None:
    engine = star_engine()
    learner = ResidualGradientLearner(engine, ResidualGradientSettings(1.0, step_size=0.01))
    s = np.repeat(np.arange(7), 2)
    solid = np.tile([True, False], 7)  # every state with both actions: one batch is one expected update
    rows = star_rows(s, np.where(solid, 6, 0))  # the dashed successor does not matter: ρ = 0
    rho, weight = column(np.where(solid, 7.0, 0.0)), column(np.where(solid, 1 / 49, 6 / 49))
    for _ in range(1000):
        learner.update(rows, 14 * rho * weight)
    found = np.sqrt(np.mean((X @ engine.flat.values.numpy()) ** 2))
    assert found == pytest.approx(1.935014, rel=1e-6)  # an independent float64 matrix iteration


# Sutton & Barto 2018, example 11.2: A → B or C, B → end with reward 1, C → end with reward 0.
SPLIT = {"s": [0, 0, 1, 2], "r": [0.0, 0.0, 1.0, 0.0], "t": [1, 2, 0, 0], "discount": [1.0, 1.0, 0.0, 0.0]}


def split_rows(order: list[int]) -> Transition:
    s, r, t, discount = (column(np.array(SPLIT[k])[order]) for k in ("s", "r", "t", "discount"))
    one = torch.ones(len(order), dtype=torch.float64)
    return Transition(s, torch.zeros_like(s), one, r, discount, t, one < 0)


@pytest.mark.parametrize(("double", "values"), [(False, [0.5, 0.75, 0.25]), (True, [0.5, 1.0, 0.0])])
def test_one_sample_learns_the_wrong_values_of_the_split_chain_and_two_the_right_ones(
    double: bool, values: list[float]
) -> None:
    engine = TorchEngine(TableQ(3, 1), Loss())
    learner = ResidualGradientLearner(engine, ResidualGradientSettings(step_size=0.5))
    first = split_rows([0, 0, 1, 1, 2, 2, 3, 3])  # A twice as often as B and C, every pair of its successors once
    second = split_rows([0, 1, 0, 1, 2, 2, 3, 3]) if double else None
    for _ in range(800):
        learner.update(first, independent=second)
    np.testing.assert_allclose(engine.flat.values, values, atol=1e-6)


@pytest.mark.parametrize(("double", "values"), [(False, [0.5, 0.75, 0.25]), (True, [0.5, 1.0, 0.0])])
def test_sampled_episodes_of_the_split_chain(double: bool, values: list[float]) -> None:
    rng = np.random.default_rng(1)
    engine = TorchEngine(TableQ(3, 1), Loss())
    learner = ResidualGradientLearner(engine, ResidualGradientSettings(step_size=0.1))
    mean = torch.zeros(3, dtype=torch.float64)
    for _ in range(600):  # 8 episodes a batch; the average of the last 500 batches
        drawn, again = rng.integers(2, size=8), rng.integers(2, size=8)
        order = [*map(int, drawn), *(int(k) + 2 for k in drawn)]
        second = split_rows([*map(int, again), *order[8:]]) if double else None
        learner.update(split_rows(order), independent=second)
        mean += engine.flat.values * (learner.num_updates > 100) / 500
    np.testing.assert_allclose(mean, values, atol=0.04)


def test_adaptive_phi_by_hand() -> None:
    direct, residual = torch.tensor([-2.0, 1.0]), torch.tensor([1.0, 1.0])
    phi = adaptive_phi(direct, residual)  # W_d·W_rg = −1, |W_rg|² = 2: −1/−3
    assert phi == pytest.approx(1 / 3)
    assert float(((1 - phi) * direct + phi * residual) @ residual) == pytest.approx(0.0, abs=1e-6)
    assert adaptive_phi(torch.tensor([1.0, 0.0]), residual) == 0.0, "1 / (1 − 2) < 0: an acute angle"
    assert adaptive_phi(torch.tensor([3.0, 0.0]), residual) == 1.0, "3 / (3 − 2) > 1"
    assert adaptive_phi(residual, residual) == 0.0, "no denominator"
    with pytest.raises(ValueError, match="shape"):
        adaptive_phi(torch.zeros(1), residual)


def test_adaptive_learner_averages_the_directions() -> None:
    # Successors that dominate their predecessors, as in w → 2w, set the two directions against each other.
    engine = TorchEngine(LinearQ(2, 1), Loss())
    learner = ResidualGradientLearner(engine, ResidualGradientSettings("adaptive", 0.01, trace_rate=0.25))
    w, average, average_rg = np.zeros(2), np.zeros(2), np.zeros(2)
    seen, rng = set(), np.random.default_rng(5)
    for _ in range(100):
        x, x_t, r = rng.normal(size=2), rng.normal(size=2) * 1.5, rng.normal()
        one = torch.ones(1, dtype=torch.float64)
        zero = torch.zeros(1, dtype=torch.int64)
        learner.update(Transition(column(x[None]), zero, one, r * one, GAMMA * one, column(x_t[None]), one < 0))
        delta = r + GAMMA * w @ x_t - w @ x
        direct, residual = delta * x, delta * (x - GAMMA * x_t)
        average, average_rg = 0.75 * average + 0.25 * direct, 0.75 * average_rg + 0.25 * residual
        below = (average - average_rg) @ average_rg
        phi = float(np.clip(average @ average_rg / below, 0, 1)) if below else 0.0
        seen.add(0 if phi == 0 else 1 if phi == 1 else 0.5)
        w = w + 0.01 * ((1 - phi) * direct + phi * residual)
        np.testing.assert_allclose(engine.flat.values, w, rtol=1e-9, atol=1e-9)
    assert seen == {0, 0.5, 1}


def network(layout: str, seed: int) -> Any:
    return NETWORKS[layout]((4,), 3, MLP((5,), activation="tanh"), rng=seed, dtype=torch.float64)


def random_rows(num_rows: int, seed: int) -> Transition:
    rng = np.random.default_rng(seed)
    s, s_t = column(rng.normal(size=(num_rows, 4))), column(rng.normal(size=(num_rows, 4)))
    a, r = column(rng.integers(3, size=num_rows)), column(rng.normal(size=num_rows))
    discount = column(np.where(rng.random(num_rows) < 0.3, 0.0, 0.9))
    return Transition(s, a, torch.ones_like(r), r, discount, s_t, discount == 0)


@pytest.mark.parametrize("layout", list(NETWORKS))
def test_on_a_network_it_descends_the_squared_error_of_q_learning(layout: str) -> None:
    engine = make_engine(network(layout, 7), Loss())
    q: Any = engine.q
    t = random_rows(12, seed=1)
    learner = ResidualGradientLearner(engine, ResidualGradientSettings(step_size=0.1), reward_scale=2.0)
    error = 2.0 * t.r_t + t.discount_t * q.all(t.s_t).amax(-1) - q.at(t.s_tm1, t.a_tm1)
    slopes = torch.autograd.grad(0.5 * (error**2).mean(), list(q.parameters()))
    expected = engine.flat.values - 0.1 * torch.cat([g.reshape(-1) for g in slopes])
    seen = learner.update(t)
    torch.testing.assert_close(engine.flat.values, expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(seen.errors, error.detach())


def test_a_saved_learner_goes_on_bit_for_bit() -> None:
    def build() -> ResidualGradientLearner:
        chosen = ResidualGradientSettings("adaptive", 0.01, trace_rate=0.3)
        return ResidualGradientLearner(make_engine(LinearQ(4, 1), Loss()), chosen)

    def swelling(seed: int) -> Transition:
        """Successors twice their predecessors: the two directions disagree, unless the world ends."""
        t = random_rows(1, seed)
        return dataclasses.replace(t, s_t=2 * t.s_tm1)

    one, two = build(), build()
    for seed in range(8):
        one.update(swelling(seed))
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    mixtures = set()
    for seed in range(8, 30):
        one.update(swelling(seed))
        two.update(swelling(seed))
        mixtures.add(adaptive_phi(one.state_dict()["direct"], one.state_dict()["residual"]))
        assert torch.equal(one.engine.flat.values, two.engine.flat.values)
    assert one.num_updates == two.num_updates == 30
    assert len(mixtures) > 3, "the averages mattered"


def test_refusals_name_the_way_out() -> None:
    with pytest.raises(ValueError, match="phi must be one of 'adaptive'"):
        ResidualGradientSettings(phi="auto")
    with pytest.raises(ValueError, match="phi must lie in"):
        ResidualGradientSettings(phi=1.5)
    learner = ResidualGradientLearner(TorchEngine(TableQ(3, 1), Loss()), ResidualGradientSettings())
    with pytest.raises(ValueError, match="must leave the same states"):
        learner.update(split_rows([0]), independent=split_rows([2]))
    other = dataclasses.replace(split_rows([0]), a_tm1=torch.ones(1, dtype=torch.int64))
    learner.update(split_rows([0]), independent=other)  # the value of a state asks for no action
    of_actions = ResidualGradientLearner(TorchEngine(TableQ(3, 2), Loss()), ResidualGradientSettings())
    with pytest.raises(ValueError, match="by the same actions"):
        of_actions.update(split_rows([0]), independent=other)
    with pytest.raises(ValueError, match="weight must have the shape"):
        learner.update(split_rows([0]), weight=torch.ones(2))

"""What float32 cannot square is scaled, or becomes NaN and is reported: no norm, moment or variance overflows silently.

Mutants that die here: a norm taken as it comes; a second moment of infinity that stops its weight for ever; a layer
whose variance overflows and gives a constant; a bound of infinity that makes every further step 0.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.learners import ReplaySettings
from neuralq.learners.descent import Descent
from neuralq.learners.optim import FlatOptimiser, Optimiser, clip_norm_, clip_norm_on_device_
from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.learners.traces import streaming_kernels as kernels
from neuralq.learners.traces.streaming import StreamingLearner, StreamingSettings
from neuralq.q import MLP, ActionOutputQ, CategoricalQ, LinearQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.single_row import SingleRowNetwork
from neuralq.rules import categorical_projection
from neuralq.rules import streaming as rules
from neuralq.runs import RunConfig
from neuralq.runs.recipe import build
from neuralq.types import Transition

CLIPS = [clip_norm_, clip_norm_on_device_, lambda g, most: clip_norm_(g.numpy(), most)]


@pytest.mark.parametrize("clip", CLIPS)
def test_a_norm_whose_squares_overflow_or_vanish_is_taken_all_the_same(clip: Any) -> None:
    # 3-4-5 triangles: a norm of 5e19, whose square is 2.5e39, and one of 5e-25, whose square is 2.5e-49.
    for grad, most, right in [
        ([3e19, 4e19], 10.0, [6.0, 8.0]),
        ([-3e38, 0.0, 3e38], 1.0, [-math.sqrt(0.5), 0.0, math.sqrt(0.5)]),
        ([3e-25, 4e-25], 1e-25, [6e-26, 8e-26]),
        ([3e-25, 4e-25], 1.0, [3e-25, 4e-25]),
        ([0.0, 0.0], 1.0, [0.0, 0.0]),
    ]:
        g = torch.tensor(grad)
        clip(g, most)
        assert g.tolist() == pytest.approx(right, rel=1e-6)
    for size, most in ((1e200, 10.0), (1e-200, 1e-201)):
        g = torch.tensor([3 * size, 4 * size], dtype=torch.float64)
        clip(g, most)
        assert g.tolist() == pytest.approx([0.6 * most, 0.8 * most], rel=1e-12)
    for nothing in (math.inf, math.nan):
        g = torch.tensor([1.0, nothing])
        clip(g, 1.0)
        assert torch.isnan(g).all()


@pytest.mark.parametrize("scale", [1e-12, 1e-3, 1.0, 1e12])
def test_clipping_on_a_device_equals_that_of_the_cpu(scale: float) -> None:
    grad = scale * torch.from_numpy(np.random.default_rng(0).standard_normal(99)).float()
    here, there = grad.clone(), grad.clone()
    clip_norm_(here, 0.5)
    clip_norm_on_device_(there, 0.5)
    torch.testing.assert_close(here, there, rtol=1e-6, atol=0)


def test_a_penalty_that_float32_cannot_square_is_learned_from() -> None:
    engine = make_engine(ActionOutputQ((3,), 2, MLP((4,)), rng=0), Loss())
    before = engine.flat.values.clone()
    descent = Descent(engine, Optimiser("sgd"), 0.1, max_grad_norm=10.0)
    descent.fit(torch.ones(2, 3), torch.tensor([0, 1]), torch.tensor([-1e20, 0.0]), None)
    assert float((engine.flat.values - before).norm()) == pytest.approx(1.0, rel=1e-5)  # 0.1 · 10


def _torch_only(optimiser: Optimiser, values: Tensor) -> FlatOptimiser:
    made = FlatOptimiser(optimiser, values)
    made._arrays = None
    return made


@pytest.mark.parametrize("make", [FlatOptimiser, _torch_only])
@pytest.mark.parametrize("kind", ["adam", "radam"])
def test_a_second_moment_that_overflows_is_no_silence(kind: str, make: Any) -> None:
    values = torch.zeros(2)
    state = make(Optimiser(kind), values)
    for _ in range(8):
        state.step(torch.tensor([1e25, 1.0]), 1e-30)
    assert math.isnan(values[0]) and math.isfinite(values[1])  # which the run reports as divergence


@pytest.mark.parametrize("make", [FlatOptimiser, _torch_only])
def test_both_paths_of_an_optimiser_are_one(make: Any) -> None:
    # Adam's first step is the rate times the sign, its second by hand: m̂ = (.9 · .1 · 2 + .1 · 4)/.19, v̂ likewise.
    values = torch.zeros(1, dtype=torch.float64)
    state = make(Optimiser("adam", eps=1e-300), values)
    state.step(torch.tensor([2.0], dtype=torch.float64), 0.5)
    assert values.item() == pytest.approx(-0.5)
    state.step(torch.tensor([4.0], dtype=torch.float64), 0.5)
    m, v = (0.9 * 0.1 * 2 + 0.1 * 4) / 0.19, (0.999 * 0.001 * 4 + 0.001 * 16) / (1 - 0.999**2)
    assert values.item() == pytest.approx(-0.5 - 0.5 * m / math.sqrt(v))


@pytest.mark.parametrize("path", ["torch", "compiled", "single row"])
def test_a_normalised_layer_of_huge_observations_is_no_constant(path: str) -> None:
    # Normalisation takes the scale away: 10⁴ x and 10²² x give the same values where there is no bias.
    q = ActionOutputQ((3,), 2, MLP((8, 8), layer_norm=True), rng=0)
    with torch.no_grad():
        q.trunk.layers[0].bias.zero_()
    engine = make_engine(q, Loss(), "torch" if path == "torch" else "compiled")
    values = SingleRowNetwork(engine).values if path == "single row" else engine.all
    x = torch.from_numpy(np.random.default_rng(1).standard_normal((5, 3))).float()
    usual, huge = values(1e4 * x), values(1e22 * x)
    assert float(usual.std(0).min()) > 1e-3
    torch.testing.assert_close(huge, usual, rtol=1e-4, atol=1e-5)


def advanced(bound: int, z: list[float], delta: float) -> list[float]:
    grad = np.array(z, np.float32)
    values, trace, v = np.zeros_like(grad), np.zeros_like(grad), np.zeros_like(grad)
    means = np.array([0.0, 1.0])
    arguments: Any = (values, trace, v, grad, means, 0.0, delta, bound, 1.0, 2.0, 0.999, 0.5, 1)
    kernels.advance(*arguments)
    return values.tolist()


def test_a_bound_that_overflows_stops_no_learning() -> None:
    # ‖z‖₁ = 8e38 is more than float32 holds; M = 2 · 8e38, and Δθ = z / M = 1/8 for each of four.
    assert advanced(kernels.OBGD, [2e38] * 4, 1.0) == pytest.approx([0.125] * 4)
    z = torch.full((4,), 2e38)
    assert torch.isnan(rules.obgd(z, torch.tensor(1.0), 1.0, 2.0)).all()
    assert torch.isnan(rules.obgd(torch.full((4,), 1e20), torch.tensor(1e20), 1.0, 2.0)).all()
    # Running squares of infinity would make every later step 0 as well.
    one, zero, start = torch.tensor(1.0), torch.zeros(2), torch.tensor([0.0, 1.0], dtype=torch.float64)
    huge = torch.full((2,), 1e20)
    assert torch.isnan(rules.adaptive_obgd(huge, one, zero, 1, 1.0, 2.0, 0.999)[0]).all()
    assert torch.isnan(rules.intentional(huge, huge, one, zero, start, 1, 0.5, 0.25, 0.999)[0]).all()


@pytest.mark.parametrize("kind", ["torch", "compiled"])
@pytest.mark.parametrize("bound", ["adaptive-obgd", "intentional"])
def test_running_squares_that_overflow_are_no_silence(bound: str, kind: str) -> None:
    q = LinearQ(2, 1, bias=False, dtype=torch.float32)
    learner = StreamingLearner(TorchEngine(q, Loss()), StreamingSettings(bound=bound), kind=kind)
    x, one = torch.tensor([[1e25, 1.0]]), torch.ones(1)
    for _ in range(64):
        learner.update(Transition(x, torch.tensor([0]), one, one, one, x, torch.tensor([False])))
    assert torch.isnan(learner.engine.flat.values).any()  # which the run reports as divergence


def test_a_reward_that_float32_cannot_hold_is_refused_where_it_enters() -> None:
    buffer, x = ReplayBuffer(8, (2,), np.float32), np.zeros(2, np.float32)
    for reward in (1e39, -1e39, math.inf, math.nan):
        with pytest.raises(ValueError, match=r"rewards are stored in float32, up to 3\.4e\+38; scale it where the"):
            buffer.add_step(0, x, 1, 0.5, reward, 0.9, x, False)
        rows = (x[None], np.array([1]), np.ones(1), np.array([reward]), np.ones(1), x[None], np.array([False]))
        with pytest.raises(ValueError, match="rewards are stored in float32"):
            buffer.add(Transition(*rows))  # type: ignore[arg-type]
    assert len(buffer) == 0
    buffer.add_step(0, x, 1, 0.5, -3e38, 0.9, x, False)
    assert buffer.sample(1, np.random.default_rng(0)).transition.r_t.item() == pytest.approx(-3e38)


def test_a_grid_of_returns_finer_than_float32_is_refused() -> None:
    # Near 10⁸ float32 has every eighth whole number: 51 atoms from 10⁸ to 10⁸ + 128 would be 17.
    assert len(np.unique(np.linspace(1e8, 1e8 + 128, 51).astype(np.float32))) == 17
    for low, high in ((1e8, 1e8 + 128), (-1e6 - 5, -1e6), (1.0, 1.0 + 1e-6), (-3e38, 3e38)):
        with pytest.raises(ValueError, match=r"51 atoms from .* lie closer together than torch.float32 tells apart"):
            CategoricalQ(LinearQ(2, 102, dtype=torch.float32), 51, low, high)
    # What is accepted keeps the mass of what is moved onto it, and its mean.
    for low, high in ((0.0, 500.0), (1e4, 1.1e4), (-1e30, 1e30)):
        support = CategoricalQ(LinearQ(2, 102, dtype=torch.float32), 51, low, high).support
        values = torch.linspace(low, high, 999)
        moved = categorical_projection(values, torch.full((999,), 1 / 999), support)
        assert moved.sum().item() == pytest.approx(1.0, abs=0.01)
        assert (moved * support / high).sum().item() == pytest.approx((low + high) / 2 / high, abs=0.01)


def test_a_capacity_that_may_hold_no_block_is_refused_before_the_run() -> None:
    # Rows of 1200 bytes are stored once where a stream goes on; in episodes of one step each takes two of 8 + 2 rows.
    spec: Any = SimpleNamespace(shape=(300,), dtype=np.dtype(np.float32))
    blocks: dict[str, Any] = {"target_rule": "peng", "block_length": 8, "learning_starts": 8, "batch_size": 8}
    with pytest.raises(ValueError, match=r"capacity=8 may hold no block of block_length=8: .* take at least 16"):
        build._replay(ReplaySettings(capacity=8, **blocks), spec, np.random.default_rng(0))
    source = build._replay(ReplaySettings(capacity=16, **blocks), spec, np.random.default_rng(0))
    for t in range(100):
        x = np.full(300, t, np.float32)
        source.buffer.add_step(0, x, 0, 1.0, 0.0, 0.0, x + 0.5, True)  # type: ignore[attr-defined]
    assert source.buffer.sample_blocks(2, 8, np.random.default_rng(0)).r_t.shape == (8, 2)  # type: ignore[attr-defined]


def test_a_discount_or_scale_that_float32_takes_for_another_is_refused() -> None:
    with pytest.raises(ValueError, match=r"gamma=0.99999999 is 1 in float32"):
        RunConfig(gamma=0.99999999)
    with pytest.raises(ValueError, match=r"gamma=0.99999999 is 1 in float32"):
        RunConfig(env="FrozenLake-v1", layout="table", learner="replay", gamma=0.99999999)
    assert RunConfig(env="FrozenLake-v1", layout="table", gamma=0.99999999).gamma == 0.99999999  # tables are float64
    assert RunConfig(gamma=1.0).gamma == 1.0
    for scale in (1e-40, 1e39):
        with pytest.raises(ValueError, match=r"reward_scale=.* is beyond float32"):
            RunConfig(reward_scale=scale)

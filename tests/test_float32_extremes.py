"""What float32 cannot square is scaled, or becomes NaN and is reported: no norm, moment or variance overflows silently.

Mutants that die here: a norm taken as it comes; a second moment of infinity that stops its weight for ever; a layer
whose variance overflows and gives a constant; a bound of infinity that makes every further step 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.learners.descent import Descent
from neuralq.learners.optim import FlatOptimiser, Optimiser, clip_norm_, clip_norm_on_device_
from neuralq.learners.traces import streaming_kernels as kernels
from neuralq.learners.traces.streaming import StreamingLearner, StreamingSettings
from neuralq.q import MLP, ActionOutputQ, LinearQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.single_row import SingleRowNetwork
from neuralq.rules import streaming as rules
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

"""The flat optimisers equal `torch.optim`'s of the same name, step for step, and RAdam switches when it should.

Mutants that these tests kill: a bias correction left out or one step late; ε inside the root, or scaled by the
correction; RAdam's threshold at 4, or its rectification without the root; 1 − β computed in float32; a learning rate
that is remembered; a state that is saved without the step count; a norm clipped per entry, or gradients below the
bound scaled up.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.learners.optim import FlatOptimiser, Optimiser, clip_norm_

TORCH: dict[str, Any] = {"sgd": torch.optim.SGD, "adam": torch.optim.Adam, "radam": torch.optim.RAdam}
CONSTANTS = [(0.9, 0.999, 1e-8), (0.9, 0.99, 1e-5), (0.0, 0.5, 1e-3), (0.8, 0.0, 1e-2), (0.5, 0.9, 1.5e-4)]


def _vectors(dtype: torch.dtype, size: int = 50) -> tuple[Tensor, np.random.Generator]:
    rng = np.random.default_rng(1)
    return torch.from_numpy(rng.standard_normal(size)).to(dtype), rng


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("constants", CONSTANTS)
@pytest.mark.parametrize("kind", TORCH)
def test_equal_to_torch_step_for_step(kind: str, constants: tuple[float, float, float], dtype: torch.dtype) -> None:
    """60 steps with a learning rate that falls and gradients over eight orders of magnitude, some of them 0."""
    if kind == "sgd" and constants != CONSTANTS[0]:
        return
    beta1, beta2, eps = constants
    values, rng = _vectors(dtype)
    reference = torch.nn.Parameter(values.clone())
    options = {} if kind == "sgd" else {"betas": (beta1, beta2), "eps": eps}
    oracle = TORCH[kind]([reference], lr=1.0, **options)
    mine = FlatOptimiser(Optimiser(kind, beta1, beta2, eps), values)
    spread = 10.0 ** rng.uniform(-6, 2, 50)
    tolerance = 1e-12 if dtype == torch.float64 else 3e-6
    for t in range(60):
        grad = torch.from_numpy(spread * rng.standard_normal(50) * (rng.random(50) > 0.2)).to(dtype)
        rate = 0.05 / (1 + t)
        oracle.param_groups[0]["lr"] = rate
        reference.grad = grad.clone()
        oracle.step()
        mine.step(grad, rate)
        torch.testing.assert_close(values, reference.detach(), atol=tolerance, rtol=tolerance)


def test_radam_uses_the_variance_from_its_sixth_step() -> None:
    """β₂ = 0.999: ρ∞ = 1999 and ρ_t = t − (small), so ρ_t > 5 first at t = 6 (Liu et al., 2020).

    With a constant gradient 1 both corrected moments are 1: five steps of the full learning rate, then rectified ones.
    r² = (ρ−4)(ρ−2)ρ∞ / ((ρ∞−4)(ρ∞−2)ρ).
    """
    values = torch.zeros(1, dtype=torch.float64)
    optimiser = FlatOptimiser(Optimiser("radam", eps=1e-300), values)
    for t in range(1, 9):
        before = values.item()
        optimiser.step(torch.ones(1, dtype=torch.float64), 1.0)
        rho = 1999 - 2 * t * 0.999**t / (1 - 0.999**t)
        assert (rho > 5) == (t >= 6)
        rectified = 1.0 if t < 6 else math.sqrt((rho - 4) * (rho - 2) * 1999 / (1995 * 1997 * rho))
        assert before - values.item() == pytest.approx(rectified, rel=1e-10)


def test_adam_by_hand() -> None:
    """The first step has length η·g/(|g| + ε) whatever the gradient: g = 4, ε = 1, η = 0.5: 0.4."""
    values = torch.tensor([1.0], dtype=torch.float64)
    FlatOptimiser(Optimiser("adam", eps=1.0), values).step(torch.tensor([4.0], dtype=torch.float64), 0.5)
    assert values.item() == pytest.approx(0.6, abs=1e-12)
    single = torch.zeros(1)  # float32, whose 1 − 0.999 is off by 1.3e-5 of itself: half of that would show in the step
    FlatOptimiser(Optimiser("adam"), single).step(torch.ones(1), 1.0)
    assert single.item() == pytest.approx(-1.0, abs=1e-6)


@pytest.mark.parametrize("kind", TORCH)
def test_a_saved_state_continues_bit_for_bit(kind: str) -> None:
    straight, rng = _vectors(torch.float32)
    grads = [torch.from_numpy(rng.standard_normal(50)).float() for _ in range(20)]
    first = FlatOptimiser(Optimiser(kind), straight)
    for g in grads[:7]:
        first.step(g, 0.1)
    resumed_values = straight.clone()
    saved = {k: v.clone() if isinstance(v, Tensor) else v for k, v in first.state_dict().items()}
    resumed = FlatOptimiser(Optimiser(kind), resumed_values)
    resumed.load_state_dict(saved)
    for g in grads[7:]:
        first.step(g, 0.1)
        resumed.step(g, 0.1)
        assert torch.equal(straight, resumed_values)
    assert resumed.num_steps == 20


def test_the_state_of_another_optimiser_is_refused() -> None:
    sgd, adam = (FlatOptimiser(Optimiser(k), torch.zeros(2)) for k in ("sgd", "adam"))
    with pytest.raises(ValueError, match="not adam"):
        adam.load_state_dict(sgd.state_dict())
    with pytest.raises(ValueError, match="not sgd"):
        sgd.load_state_dict(adam.state_dict())


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"kind": "rmsprop"}, "optimiser must be one of"),
        ({"beta1": -0.1}, "beta1 must lie in"),
        ({"beta1": 1.0}, "beta1 must be below 1"),
        ({"beta2": 1.0}, "beta2 must be below 1"),
        ({"beta2": math.nan}, "beta2 must lie in"),
        ({"eps": 0.0}, "eps must be a finite number above 0"),
    ],
)
def test_constants_out_of_range_are_refused(constants: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Optimiser(**constants)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("scale", [0.0, 1e-6, 1.0, 1e6])
def test_clipping_equals_torch(scale: float, dtype: torch.dtype) -> None:
    """PyTorch divides by norm + 1e-6, so the two differ by that much of themselves at the most."""
    grad = scale * _vectors(dtype)[0]
    reference = torch.nn.Parameter(torch.zeros_like(grad))
    reference.grad = grad.clone()
    torch.nn.utils.clip_grad_norm_([reference], 0.7)
    before = grad.clone()
    clip_norm_(grad, 0.7)
    torch.testing.assert_close(grad, reference.grad, atol=0, rtol=3e-6)
    assert float(grad.norm()) <= 0.7 * (1 + 1e-6)
    if float(before.norm()) <= 0.7:
        assert torch.equal(grad, before)
    else:
        assert float(grad.norm()) == pytest.approx(0.7, rel=1e-6)

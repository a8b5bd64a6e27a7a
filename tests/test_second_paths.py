"""What is computed where the usual way does not apply is the same: not on the CPU, not of two axes, not without gaps.

An accelerator takes other paths than a CPU. Here each is taken on the CPU, by force, beside the one it stands in for.

Mutants that die here: rewards divided by their scale; an axis of actions taken for one of time; a vector that is only
scaled where it is an array; a moment decayed at another rate.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners.descent import Descent
from neuralq.learners.optim import FlatOptimiser, Optimiser
from neuralq.learners.replay import targets as replay_targets
from neuralq.learners.replay.buffer import Prioritised, ReplayBuffer
from neuralq.learners.replay.targets import q_learning_targets
from neuralq.q import MLP, ActionOutputQ, MaskedQ
from neuralq.q.engine import Loss, TorchEngine

DTYPES = (torch.float32, torch.float64)
SCALE = 0.25  # a power of two: rewards over it would be 16 times those times it


def by_hand(r_t: Any, discount_t: Any, q_t: Any, scale: float) -> Any:
    """r · scale + γ · max over the last axis, number by number; 0 · −∞ is 0."""
    out = np.empty(r_t.shape)
    for place in np.ndindex(r_t.shape):
        best = max(float(x) for x in q_t[place])
        ahead = 0.0 if float(discount_t[place]) == 0 else float(discount_t[place]) * best
        out[place] = float(r_t[place]) * scale + ahead
    return out


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(6,), (3, 4), (2, 3, 4), ()])
def test_one_step_targets_are_the_same_for_any_number_of_axes_and_with_gaps(
    shape: tuple[int, ...], dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(len(shape))
    q_t = torch.from_numpy(rng.normal(size=(*shape, 5))).to(dtype)
    q_t[..., 1] = -torch.inf
    r_t, discount_t = (torch.from_numpy(np.asarray(rng.normal(size=shape))).to(dtype) for _ in range(2))
    discount_t = torch.where(discount_t > 0.5, 0.0, discount_t)
    wanted = by_hand(r_t, discount_t, q_t, SCALE)
    gaps = torch.stack([q_t, q_t + 1], -1)[..., 0]  # every second number
    for q in (q_t, gaps, q_t.flip(-1).flip(-1), q_t.transpose(0, -1).contiguous().transpose(0, -1)):
        assert q_learning_targets(r_t, discount_t, q, SCALE).numpy() == pytest.approx(wanted, rel=1e-6, abs=1e-6)
    # The kernel and what stands in for it elsewhere: as on a device that is not the CPU.
    monkeypatch.setattr(replay_targets, "q_learning_array_targets", None)
    elsewhere: Any = SimpleNamespace(device=torch.device("meta"), dtype=dtype)
    monkeypatch.setattr(replay_targets.rules, "q_learning", lambda r, d, q: _rule(r, d, q_t if q is elsewhere else q))
    got = q_learning_targets(r_t, discount_t, elsewhere, SCALE)
    assert got.numpy() == pytest.approx(wanted, rel=1e-6, abs=1e-6)


_rule = replay_targets.rules.q_learning


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["sgd", "adam", "radam"])
def test_both_ways_of_an_optimiser_and_of_clipping_make_the_same_steps(kind: str, dtype: torch.dtype) -> None:
    rng = np.random.default_rng(1)
    engines = [TorchEngine(ActionOutputQ((3,), 2, MLP((8,)), rng=0, dtype=dtype), Loss()) for _ in range(2)]
    here, there = (Descent(engine, Optimiser(kind), 0.05, max_grad_norm=0.3) for engine in engines)
    engines[1].flat.grad_array = None  # as where the gradient is no array
    there._state._arrays = None
    with pytest.MonkeyPatch.context() as patch:
        for _ in range(30):
            s, a = torch.from_numpy(rng.normal(size=(6, 3))).to(dtype), torch.from_numpy(rng.integers(2, size=6))
            target = torch.from_numpy(rng.normal(size=6)).to(dtype)
            patch.undo()
            here.fit(s, a, target, None)
            patch.setattr("neuralq.learners.descent.clip_norm_", _clipped_on_device)
            there.fit(s, a, target, None)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    torch.testing.assert_close(engines[0].flat.values, engines[1].flat.values, rtol=tolerance, atol=tolerance)


def _clipped_on_device(grad: Any, max_norm: float) -> None:
    from neuralq.learners.optim import clip_norm_on_device_

    clip_norm_on_device_(grad, max_norm)


def test_an_optimiser_takes_tensors_and_arrays_alike() -> None:
    for kind in ("sgd", "adam", "radam"):
        moved = []
        for as_given in (lambda g: g, lambda g: g.numpy()):
            values = torch.zeros(4, dtype=torch.float64)
            state = FlatOptimiser(Optimiser(kind), values)
            for t in range(9):
                state.step(as_given(torch.tensor([1.0, -2.0, 0.5, t - 4.0], dtype=torch.float64)), 0.1)
            moved.append(values)
        assert torch.equal(*moved)


@pytest.mark.parametrize("prioritised", [None, Prioritised()])
def test_samples_that_are_sent_elsewhere_are_those_that_stay(prioritised: Prioritised | None) -> None:
    def filled() -> ReplayBuffer:
        buffer, rng = ReplayBuffer(64, (3,), np.float32, prioritised=prioritised), np.random.default_rng(0)
        for t in range(50):
            s, s_t = rng.normal(size=(2, 3)).astype(np.float32)
            buffer.add_step(0, s, t % 2, 0.5, float(t), 0.9, s_t, t % 7 == 6)
        return buffer

    stays, goes = filled(), filled()
    goes.device = SimpleNamespace(type="elsewhere")  # type: ignore[assignment]
    sent: list[torch.Tensor] = []
    goes._move = lambda value: sent.append(value) or value.clone()  # type: ignore[assignment, func-returns-value]
    one, other = (buffer.sample(8, np.random.default_rng(3)) for buffer in (stays, goes))
    _assert_same(one.transition, other.transition)
    assert len(sent) >= 7 and other.transition.s_tm1.data_ptr() != goes._sample_out.batch.transition.s_tm1.data_ptr()
    if prioritised is not None:
        assert torch.equal(one.weights, other.weights)
    _assert_same(*(buffer.sample_blocks(2, 4, np.random.default_rng(4)) for buffer in (stays, goes)))


def _assert_same(one: Any, other: Any) -> None:
    for name in ("s_tm1", "a_tm1", "mu_tm1", "r_t", "discount_t", "s_t", "last_t"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_an_illegal_action_is_looked_for_where_that_costs_nothing() -> None:
    q = MaskedQ(ActionOutputQ((3,), 2, MLP((4,)), rng=0), (3,))
    s = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0, 1.0]])
    q.check_legal(s, torch.tensor([0, 1]))
    with pytest.raises(ValueError, match="action 1 is illegal in row 0"):
        q.check_legal(s, torch.tensor([1, 1]))
    q.check_legal(s, torch.tensor([1, 1]), torch.tensor([0.0, 1.0]))  # a row of weight 0 is no experience
    q.check_legal(s.to("meta"), torch.tensor([1, 1], device="meta"))  # elsewhere nobody waits for the answer

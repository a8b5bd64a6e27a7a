"""The compiled engine equals autograd: values, errors and gradients, for every layout, body, loss and input.

Autograd on the same module is the oracle (tests/test_q.py holds the modules to plain PyTorch networks). float64 agrees
to 1e-12, float32 to 1e-5 of the largest entry, and a hundred updates stay within 1e-10 and 1e-5 of each other.

Mutants that these tests kill: the bias gradient added over calls instead of written; a stale workspace after the
batch grew or shrank; a weight applied twice, or to the neighbouring sample; the mean over the samples of one action
instead of all of them; Huber's clip at 1 instead of delta; an activation's derivative taken from the pre-activation;
either mean left out of the layer norm's gradient; the one-hot of the wrong action; weights transposed; the wrong copy
of `SeparateQ`; a copy whose gradient stays from the last call; target values computed with the live parameters; ``[T,
N]`` targets broadcast instead of paired.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from neuralq.learners.optim import FlatOptimiser, Optimiser
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, LinearQ, MaskedQ, SeparateQ, TableQ
from neuralq.q.compiled import MlpEngine, make_engine, runs_compiled
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.inputs import OneHot, Pixels

A, D = 3, 4
LAYOUTS: tuple[Any, ...] = (ActionInputQ, SeparateQ, ActionOutputQ)
HIDDEN = ((), (5,), (7, 6), (5, 4, 3), (41,), (33, 70))  # the last two wide enough for `products`
BODIES = [
    MLP(h, norm, act) for h, norm, act in itertools.product(HIDDEN, (False, True), ("relu", "tanh", "leaky_relu"))
]
BODIES += [MLP((7, 6), norm, "sigmoid") for norm in (False, True)]
DTYPES = (torch.float64, torch.float32)


def _pair(layout: Any, body: MLP, loss: Loss, dtype: torch.dtype, masked: bool = False, **inputs: Any) -> list[Any]:
    """Both engines on networks with the same weights; scales and shifts are moved away from 1 and 0."""
    engines = []
    for kind in (MlpEngine, TorchEngine):
        q: Any = layout((D,) if "shape" not in inputs else inputs["shape"], A, body,
                        features=inputs.get("features"), rng=1, dtype=dtype)  # fmt: skip
        rng = np.random.default_rng(2)
        for p in q.parameters():
            p.data.add_(torch.from_numpy(0.3 * rng.standard_normal(p.shape)).to(dtype))
        engines.append(kind(MaskedQ(q, q.input.input_shape) if masked else q, loss))
    return engines


def _close(x: Tensor, y: Tensor, dtype: torch.dtype, least: float = 1e-3) -> None:
    """Within 1e-12 (1e-5 in float32) of the largest entry or ``least``, and the same shape, type and infinities."""
    assert x.shape == y.shape and x.dtype == y.dtype == dtype
    finite = y[torch.isfinite(y)]
    largest = float(finite.abs().max()) if finite.numel() else 0.0
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    torch.testing.assert_close(x, y, atol=tolerance * max(largest, least), rtol=0)


def _samples(leading: tuple[int, ...], seed: int, dtype: torch.dtype) -> tuple[Tensor, ...]:
    rng = np.random.default_rng(seed)
    s, target = rng.standard_normal((*leading, D)), 3.0 * rng.standard_normal(leading)
    weight = rng.random(leading) * (rng.random(leading) > 0.3)  # about a third are 0
    a = torch.from_numpy(np.asarray(rng.integers(0, A, leading)))
    return (torch.from_numpy(s).to(dtype), a, *(torch.as_tensor(np.asarray(x)).to(dtype) for x in (target, weight)))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_values_and_gradients_equal_autograd(layout: Any, dtype: torch.dtype) -> None:
    """Bodies, losses in turn, with and without weights; batches grow, shrink and are empty on one engine."""
    bodies = BODIES if dtype == torch.float64 else BODIES[::5]  # with which each size, norm and activation is met
    for body, loss in zip(bodies, itertools.cycle((Loss(), Loss("huber", 0.8))), strict=False):
        fast, slow = _pair(layout, body, loss, dtype)
        for n, leading in enumerate(((9,), (1,), (12,), (0,), (4, 3), ())):
            s, a, target, weight = _samples(leading, n, dtype)
            _close(fast.all(s), slow.all(s), dtype)
            for given in (None, weight):
                errors = [e.loss_gradient(s, a, target, given) for e in (fast, slow)]
                _close(*errors, dtype, least=1.0)  # differences of numbers of that size may cancel
                _close(fast.flat.grad, slow.flat.grad, dtype)
        s, a, _, _ = _samples((), 9, dtype)
        _close(fast.value_gradient(s, a), slow.value_gradient(s, a), dtype, least=0.1)  # a sum of terms that cancel
        _close(fast.flat.grad, slow.flat.grad, dtype)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_gradient_is_the_difference_quotient(layout: Any) -> None:
    """Central differences of the value itself: an oracle without autograd. tanh is smooth, so the error is O(h²)."""
    fast, _ = _pair(layout, MLP((5, 4), True, "tanh"), Loss(), torch.float64)
    s, a, _, _ = _samples((), 3, torch.float64)
    fast.value_gradient(s, a)
    gradient, h = fast.flat.grad.clone(), 1e-5
    for i in range(len(gradient)):
        ends = []
        for step in (h, -h):
            fast.flat.values[i] += step
            ends.append(fast.all(s)[a].item())
            fast.flat.values[i] -= step
        assert float(gradient[i]) == pytest.approx((ends[0] - ends[1]) / (2 * h), abs=1e-8)


def test_huber_and_weights_by_hand() -> None:
    """Q = w·s + b with w = 2, b = 0; errors 3 − 2 = 1 and 0 − 4 = −4, delta 2.

    Mean of the weighted slopes: dw = −(½·1·1 + 3·(−2)·2)/2 = 5.75, db = −(½·1 + 3·(−2))/2 = 2.75.
    """
    for kind in (MlpEngine, TorchEngine):
        q = ActionOutputQ((1,), 1, MLP(()), dtype=torch.float64)
        q.trunk.layers[0].weight.data.fill_(2.0)
        q.trunk.layers[0].bias.data.fill_(0.0)
        engine = kind(q, Loss("huber", 2.0))
        s, a = torch.tensor([[1.0], [2.0]], dtype=torch.float64), torch.tensor([0, 0])
        error = engine.loss_gradient(s, a, torch.tensor([3.0, 0.0]), torch.tensor([0.5, 3.0]))
        assert error.tolist() == [1.0, -4.0]
        assert engine.flat.grad.tolist() == [5.75, 2.75]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_masks_and_features(layout: Any, dtype: torch.dtype) -> None:
    rng = np.random.default_rng(5)
    legal = torch.from_numpy(rng.integers(0, 2, (8, A)))
    legal[:, 0] = 1
    s, _, target, weight = _samples((8,), 4, dtype)
    a = torch.from_numpy(np.array([int(rng.choice(np.flatnonzero(row))) for row in legal.numpy()]))
    index = torch.from_numpy(rng.integers(0, 5, 8))
    bytes_ = torch.from_numpy(rng.integers(0, 256, (8, 2, 3), dtype=np.uint8))
    body = MLP((6,), True)
    for observations, inputs in (
        (s, {}),
        (index, {"shape": (5,), "features": OneHot(5)}),
        (bytes_, {"shape": (2, 3), "features": Pixels()}),
    ):
        fast, slow = _pair(layout, body, Loss(), dtype, **inputs)
        _close(fast.all(observations), slow.all(observations), dtype)
        _close(fast.loss_gradient(observations, a, target), slow.loss_gradient(observations, a, target), dtype)
        _close(fast.flat.grad, slow.flat.grad, dtype)
    fast, slow = _pair(layout, body, Loss(), dtype, masked=True)
    masked = torch.cat([s, legal.to(dtype)], -1)
    values = fast.all(masked)
    assert torch.equal(torch.isneginf(values), legal == 0)
    _close(values, slow.all(masked), dtype)
    _close(fast.loss_gradient(masked, a, target, weight), slow.loss_gradient(masked, a, target, weight), dtype)
    _close(fast.flat.grad, slow.flat.grad, dtype)
    indexed = torch.cat([index[:, None], legal], -1)
    fast, slow = (kind(MaskedQ(layout((5,), A, body, features=OneHot(5), rng=3, dtype=dtype), ()), Loss())
                  for kind in (MlpEngine, TorchEngine))  # fmt: skip
    _close(fast.all(indexed[0]), slow.all(indexed[0]), dtype)
    _close(fast.loss_gradient(indexed, a, target), slow.loss_gradient(indexed, a, target), dtype)
    _close(fast.flat.grad, slow.flat.grad, dtype)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_views_are_read_as_they_are(layout: Any) -> None:
    """Every second row, a transposed rollout, targets from a wider tensor, and observations of another type."""
    fast, slow = _pair(layout, MLP((6,)), Loss(), torch.float64)
    s, a, target, weight = _samples((10, 6), 7, torch.float64)
    for cut in (lambda x: x[::2, 1], lambda x: x.transpose(0, 1), lambda x: x[3:8, ::3], lambda x: x[1:1]):
        views = [cut(x) for x in (s, a, target, weight)]
        copies = [x.clone(memory_format=torch.contiguous_format) for x in views]
        _close(fast.all(views[0]), slow.all(copies[0]), torch.float64)
        error = fast.loss_gradient(*views)
        _close(error, slow.loss_gradient(*copies), torch.float64)
        _close(fast.flat.grad, slow.flat.grad, torch.float64)
    _close(fast.all(s.float()), slow.all(s.float().double()), torch.float64)
    stays = fast.all(s)
    kept = stays.clone()
    fast.all(s + 1)
    assert torch.equal(stays, kept), "values handed out must not be a workspace"


@pytest.mark.parametrize("kind", [MlpEngine, TorchEngine])
def test_the_target_copy_changes_when_synchronised_and_not_before(kind: Any) -> None:
    engine = kind(ActionOutputQ((D,), A, MLP((5,)), rng=1), Loss())
    s, a, target, _ = _samples((4,), 0, torch.float32)
    assert engine.target_values() is None
    with pytest.raises(ValueError, match="sync_target"):
        engine.all(s, target=True)
    engine.sync_target()
    before = engine.all(s)
    assert torch.equal(engine.all(s, target=True), before)
    engine.loss_gradient(s, a, target)
    engine.flat.values.sub_(engine.flat.grad)
    assert torch.equal(engine.all(s, target=True), before) and not torch.equal(engine.all(s), before)
    copied = engine.target_values()
    engine.sync_target()
    assert engine.target_values() is copied and torch.equal(copied, engine.flat.values)
    assert torch.equal(engine.all(s, target=True), engine.all(s))
    copied.zero_()
    assert float(engine.all(s, target=True).abs().max()) == 0.0


@pytest.mark.parametrize("optimiser", ["sgd", "adam", "radam"])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_hundred_updates_stay_together(layout: Any, dtype: torch.dtype, optimiser: str) -> None:
    body = MLP((16, 12), activation="tanh")
    engines = _pair(layout, body, Loss("huber"), dtype)
    steppers = [FlatOptimiser(Optimiser(optimiser, eps=1e-5), e.flat.values) for e in engines]
    start = engines[0].flat.values.clone()
    for step in range(100):
        batch = _samples((32,), step, dtype)
        for engine, stepper in zip(engines, steppers, strict=True):
            engine.loss_gradient(*batch)
            stepper.step(engine.flat.grad, 0.1 if optimiser == "sgd" else 1e-3)
    x, y = (e.flat.values for e in engines)
    assert float((x - y).norm() / y.norm()) <= (1e-10 if dtype == torch.float64 else 1e-5)
    assert float((y - start).norm() / y.norm()) > 1e-3


@pytest.mark.parametrize("kind", [MlpEngine, TorchEngine])
def test_samples_that_do_not_pair_up_are_refused(kind: Any) -> None:
    engine = kind(ActionOutputQ((D,), A, MLP((5,))), Loss())
    s, a, target, weight = _samples((4,), 0, torch.float32)
    for wrong in (-1, A):
        with pytest.raises(ValueError, match=r"actions must lie in 0\.\.2"):
            engine.loss_gradient(s, torch.full((4,), wrong), target)
        with pytest.raises(ValueError, match=r"actions must lie in 0\.\.2"):
            engine.value_gradient(s[0], torch.tensor(wrong))
    with pytest.raises(ValueError, match=r"must pair up; got shapes \(4,\), \(4, 1\)"):
        engine.loss_gradient(s, a, target[:, None])
    with pytest.raises(ValueError, match="must pair up"):
        engine.loss_gradient(s, a, target, weight[:1])
    with pytest.raises(ValueError, match="of one action"):
        engine.value_gradient(s, a)
    for bad in (torch.zeros(4, 3), torch.zeros(3)):
        with pytest.raises(ValueError, match=r"observations of shape \(4,\)"):
            engine.all(bad)
    with pytest.raises((ValueError, RuntimeError)):
        engine.loss_gradient(s[:3], a, target)


def test_the_compiled_engine_is_chosen_where_it_applies() -> None:
    class Own(ActionOutputQ):  # a user's change of the computation must not be overlooked
        def all(self, s: Tensor) -> Tensor:
            return 2 * super().all(s)

    class Learned(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.scale = nn.Parameter(torch.ones(1))

        def forward(self, s: Tensor) -> Tensor:
            return s * self.scale

    for layout in LAYOUTS:
        assert type(make_engine(layout((4,), 2), Loss())) is MlpEngine
        assert type(make_engine(MaskedQ(layout((4,), 2), (4,)), Loss())) is MlpEngine
        assert type(make_engine(layout((4,), 2), Loss(), "torch")) is TorchEngine
        assert type(make_engine(layout((4,), 2), Loss(), "compiled")) is MlpEngine
        assert not runs_compiled(layout((4,), 2, MLP((3,)), dtype=torch.bfloat16))
        assert not runs_compiled(layout((1, 5, 5), 2, Conv()))
    own = Own((4,), 2, MLP((3,)))
    for q in (TableQ(3, 2), LinearQ(4, 2), own, MaskedQ(own, (4,)), ActionOutputQ((4,), 2, features=Learned())):
        assert type(make_engine(q, Loss())) is TorchEngine
        with pytest.raises(ValueError, match=r"no compiled kernels for .*; use the torch engine"):
            make_engine(q, Loss(), "compiled")
    with pytest.raises(ValueError, match="engine must be one of 'auto', 'torch', 'compiled'"):
        make_engine(own, Loss(), "numba")
    with pytest.raises(ValueError, match="loss must be one of"):
        Loss("mse")
    with pytest.raises(ValueError, match="delta"):
        Loss("huber", 0.0)


def test_a_users_own_computation_is_what_is_learned() -> None:
    """A module that doubles its values goes through its own ``all``: twice the values, twice the gradient."""

    class Doubled(ActionOutputQ):
        def all(self, s: Tensor) -> Tensor:
            return 2 * super().all(s)

    s, a, _, _ = _samples((), 1, torch.float32)
    plain = make_engine(ActionOutputQ((D,), A, MLP((5,)), rng=1), Loss())
    doubled = make_engine(Doubled((D,), A, MLP((5,)), rng=1), Loss())
    torch.testing.assert_close(doubled.value_gradient(s, a), 2 * plain.value_gradient(s, a))
    torch.testing.assert_close(doubled.flat.grad, 2 * plain.flat.grad)

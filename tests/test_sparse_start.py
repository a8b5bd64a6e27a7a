"""Networks for streaming learners: sparse weights at the start, layer normalisation without scale and shift.

Mutants that must die here: ⌊·⌋ for ⌈·⌉ · zeros counted over the layer and not over each unit · the same inputs silenced
in every unit · biases drawn all the same · a scale learned although there should be none · draws moved for networks
that are not sparse.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, SeparateQ
from neuralq.q.compiled import MlpEngine
from neuralq.q.engine import Loss, TorchEngine


@pytest.mark.parametrize("sparsity", [0.5, 0.9, 0.01])
def test_every_unit_starts_with_so_many_silent_inputs(sparsity: float) -> None:
    q = SeparateQ((7,), 3, MLP((40, 5), sparsity=sparsity), rng=0)
    for layer in q.trunk.layers:
        weight: Any = layer.weight.detach().numpy()
        copies, fan_in, fan_out = weight.shape
        silent = math.ceil(sparsity * fan_in)
        assert ((weight == 0).sum(axis=1) == silent).all() and (weight == 0).sum(axis=1).shape == (copies, fan_out)
        assert (np.abs(weight) <= 1 / math.sqrt(fan_in)).all()
        assert not layer.bias.any()
    patterns = {column.tobytes() for column in (q.trunk.layers[1].weight.detach().numpy() == 0)[0].T}
    assert len(patterns) > 1 or sparsity == 0.01


def test_every_channel_of_a_convolution_does() -> None:
    q: Any = ActionOutputQ((4, 10, 10), 6, Conv((16, 8), (3, 2), (1, 2), sparsity=0.9), rng=0)
    for weight, bias in zip(q.input.stem.weights, q.input.stem.biases, strict=True):
        fan_in = weight[0].numel()
        assert ((weight == 0).flatten(1).sum(1) == math.ceil(0.9 * fan_in)).all()
        assert float(weight.detach().abs().max()) <= 1 / math.sqrt(fan_in) and not bias.any()


def test_the_inputs_that_speak_are_drawn_evenly() -> None:
    weight: Any = ActionOutputQ((10,), 4000, MLP((), sparsity=0.9), rng=1).trunk.layers[0].weight
    heard = (weight != 0).sum(-1).flatten().numpy()  # of 4000 units, one input each: 400 ± 19 per input
    assert heard.sum() == 4000 and (np.abs(heard - 400) < 5 * 19).all()


def test_networks_that_are_not_sparse_are_drawn_as_before() -> None:
    """weight, then bias, of each layer, from one generator: U(±1/√fan_in)."""
    rng = np.random.default_rng(3)
    q: Any = ActionOutputQ((4,), 2, MLP((5,)), rng=3)
    for layer, (fan_in, fan_out) in zip(q.trunk.layers, ((4, 5), (5, 2)), strict=True):
        bound = 1 / math.sqrt(fan_in)
        np.testing.assert_array_equal(
            layer.weight.detach()[0], rng.uniform(-bound, bound, (1, fan_in, fan_out))[0].astype(np.float32)
        )
        np.testing.assert_array_equal(layer.bias.detach(), rng.uniform(-bound, bound, (1, fan_out)).astype(np.float32))


def test_without_scale_there_is_nothing_to_learn_in_a_normalisation() -> None:
    bare, full = (
        ActionOutputQ((4,), 2, MLP((32, 32), layer_norm=True, affine=affine), rng=0) for affine in (False, True)
    )
    count = [sum(p.numel() for p in q.parameters()) for q in (bare, full)]
    assert count == [4 * 32 + 32 + 32 * 32 + 32 + 32 * 2 + 2, count[0] + 4 * 32]
    s = torch.randn(9, 4, generator=torch.Generator().manual_seed(0))
    # A fresh scale is 1 and a fresh shift 0: the two agree until they learn.
    full_weights: Any = dict(full.named_parameters())
    for name, p in bare.named_parameters():
        p.data.copy_(full_weights[name])
    torch.testing.assert_close(bare.all(s), full.all(s))


@pytest.mark.parametrize("layout", [ActionOutputQ, SeparateQ, ActionInputQ])
@pytest.mark.parametrize("activation", ["relu", "tanh", "leaky_relu"])
def test_the_compiled_engine_knows_both(layout: Any, activation: str) -> None:
    body = MLP((6, 5), layer_norm=True, activation=activation, affine=False, sparsity=0.3)
    one, other = (
        engine(layout((4,), 3, body, rng=2, dtype=torch.float64), Loss()) for engine in (MlpEngine, TorchEngine)
    )
    rng = np.random.default_rng(0)
    s, a = torch.from_numpy(rng.standard_normal((12, 4))), torch.from_numpy(rng.integers(0, 3, 12))
    target = torch.from_numpy(rng.standard_normal(12))
    torch.testing.assert_close(one.all(s), other.all(s), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(
        one.loss_gradient(s, a, target), other.loss_gradient(s, a, target), rtol=1e-12, atol=1e-12
    )
    torch.testing.assert_close(one.flat.grad, other.flat.grad, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"affine": False, "layer_norm": False}, "affine=False"),
        ({"sparsity": 1.0}, "sparsity"),
        ({"sparsity": -0.1}, "sparsity"),
    ],
)
@pytest.mark.parametrize("body", [MLP, Conv])
def test_bodies_that_make_no_sense_are_refused(body: Any, given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        body(**given)

"""Every representation keeps one contract, and each is what its name says: against plain PyTorch networks.

The contract: ``at(s, a)`` is ``all(s)`` gathered at ``a`` for any leading axes, gradients reach every parameter that
the layout says they reach and no other, and the initial weights come from the generator alone. The oracles are nets
built from `torch.nn` layers that share no code with the bodies, holding copied weights.

Mutants that these tests kill: ``at`` of the neighbouring action; the one-hot rotated by one, or repeated where it
should be interleaved; actions and states swapped when the leading axes come back; one network's weights used for
another action; layer normalisation across copies, or after the activation; an activation after the last layer;
grouped convolutions that mix copies; a bias shared by all actions; a mask that is inverted, or shifted by one; a
Python loop over the actions in `SeparateQ`; ``reshape(-1)`` on a batch of no observations.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from neuralq.learners.optim import FlatOptimiser, Optimiser
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, LinearQ, MaskedQ, SeparateQ, TableQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.inputs import OneHot, Pixels
from neuralq.types import QFunction

A = 3
IMAGE = (2, 5, 6)
BODIES: dict[str, tuple[tuple[int, ...], MLP | Conv]] = {
    "linear": ((4,), MLP(())),
    "mlp": ((4,), MLP((5, 6))),
    "mlp of a matrix": ((2, 2), MLP((5,), activation="tanh")),
    "layer norm": ((4,), MLP((5, 6), layer_norm=True, activation="leaky_relu")),
    "conv": (IMAGE, Conv((3,), (3,), (1,), (5,))),
    "two convs": ((2, 6, 7), Conv((3, 4), (2, 3), (2, 1), (5,), layer_norm=False, activation="tanh")),
}
LAYOUTS: tuple[Any, ...] = (ActionInputQ, SeparateQ, ActionOutputQ)


def _networks() -> dict[str, tuple[Callable[[], nn.Module], tuple[int, ...]]]:
    made: dict[str, tuple[Callable[[], nn.Module], tuple[int, ...]]] = {}
    for layout, (name, (shape, body)) in itertools.product(LAYOUTS, BODIES.items()):
        made[f"{layout.__name__}, {name}"] = (
            lambda layout=layout, shape=shape, body=body: layout(shape, A, body, rng=1),
            shape,
        )
    return made


def _linear(bias: bool) -> nn.Module:
    q = LinearQ(4, A, bias=bias)
    for p in q.parameters():
        p.data.copy_(torch.from_numpy(np.random.default_rng(2).standard_normal(p.shape)))
    return q


def _table() -> nn.Module:
    q = TableQ(7, A)
    q.weight.data.copy_(torch.arange(7.0 * A).reshape(7, A))
    return q


CASES = {
    "table": (_table, ()),
    "linear": (lambda: _linear(False), (4,)),
    "linear, bias": (lambda: _linear(True), (4,)),
    **_networks(),
}
PARAMETERS = [pytest.param(*case, masked, id=f"{name}{', masked' * masked}")
              for name, case in CASES.items() for masked in (False, True)]  # fmt: skip


def _observations(shape: tuple[int, ...], leading: tuple[int, ...], masked: bool, rng: np.random.Generator) -> Tensor:
    if shape == ():
        s = torch.from_numpy(rng.integers(0, 7, leading))
    else:
        s = torch.from_numpy(rng.standard_normal((*leading, *shape))).float()
    if not masked:
        return s
    legal = torch.from_numpy(rng.integers(0, 2, (*leading, A)))
    legal[..., 1] = 1
    return torch.cat([s.reshape(*leading, int(np.prod(shape))), legal.to(s.dtype)], -1)


@pytest.mark.parametrize(("make", "shape", "masked"), PARAMETERS)
def test_at_is_all_gathered(make: Callable[[], Any], shape: tuple[int, ...], masked: bool) -> None:
    inner = make()
    q: Any = MaskedQ(inner, shape) if masked else inner
    dtype = next(q.parameters()).dtype
    assert isinstance(q, QFunction) and q.num_actions == A
    for leading in ((), (5,), (3, 2), (0,), (2, 0), (1, 1, 1)):
        rng = np.random.default_rng(3)
        s = _observations(shape, leading, masked, rng)
        a = torch.from_numpy(np.asarray(rng.integers(0, A, leading)))
        everything, chosen = q.all(s), q.at(s, a)
        assert everything.shape == (*leading, A) and chosen.shape == leading
        assert everything.dtype == chosen.dtype == dtype
        tolerance = 1e-13 if dtype == torch.float64 else 1e-6
        torch.testing.assert_close(chosen, everything.gather(-1, a[..., None])[..., 0], atol=tolerance, rtol=tolerance)
        if leading == (3, 2):  # time and batch come back in their own places
            one_by_one = torch.stack([torch.stack([q.all(s[i, j]) for j in range(2)]) for i in range(3)])
            torch.testing.assert_close(everything, one_by_one, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("make", "shape", "masked"), PARAMETERS)
def test_masks_hide_exactly_the_illegal_actions(make: Callable[[], Any], shape: tuple[int, ...], masked: bool) -> None:
    if not masked:
        return
    inner = make()
    s = _observations(shape, (6,), True, np.random.default_rng(4))
    observation, legal = s[:, :-A].reshape(6, *shape), s[:, -A:] == 1
    expected = torch.where(legal, inner.all(observation), -torch.inf)
    torch.testing.assert_close(MaskedQ(inner, shape).all(s), expected, atol=0, rtol=0)


@pytest.mark.parametrize(("make", "shape", "masked"), PARAMETERS)
def test_gradients_reach_the_parameters(make: Callable[[], Any], shape: tuple[int, ...], masked: bool) -> None:
    inner = make()
    q = MaskedQ(inner, shape) if masked else inner
    s = _observations(shape, (40,), masked, np.random.default_rng(5))
    values = q.all(s)
    values[torch.isfinite(values)].square().sum().backward()
    for name, p in inner.named_parameters():
        assert p.grad is not None and bool(torch.isfinite(p.grad).all()), name
        assert float(p.grad.abs().max()) > 0, name


@pytest.mark.parametrize("name", [n for n in CASES if "Q" in n])
def test_weights_come_from_the_generator_alone(name: str) -> None:
    layout = {c.__name__: c for c in LAYOUTS}[name.split(", ")[0]]
    shape, body = BODIES[name.split(", ")[1]]

    def weights(rng: np.random.Generator | int) -> list[Tensor]:
        return [p.detach() for p in layout(shape, A, body, rng=rng).parameters()]

    torch.manual_seed(0)
    first = weights(7)
    torch.manual_seed(1)
    again, other = weights(np.random.default_rng(7)), weights(8)
    assert all(torch.equal(x, y) for x, y in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])


def test_initial_weights_are_uniform_within_one_over_root_fan_in() -> None:
    layer = ActionOutputQ((100,), 50, MLP((200,)), rng=0).trunk.layers[0]
    weight, bias = layer.weight.detach(), layer.bias.detach()
    assert float(bias.abs().max()) <= 0.1 and 0.0999 < float(weight.abs().max()) <= 0.1
    assert float(weight.var()) == pytest.approx(0.1**2 / 3, rel=0.02)  # variance of U(±b) is b²/3


def _plain_net(q: Any, copy: int) -> nn.Sequential:
    """One of the networks as torch's own layers, with its weights copied out."""
    stem, trunk = q.input.stem, q.trunk
    num_copies = trunk.copies
    layers: list[nn.Module] = []
    activations = {"relu": nn.ReLU, "tanh": nn.Tanh, "leaky_relu": nn.LeakyReLU, "sigmoid": nn.Sigmoid}
    act = activations[trunk.activation]
    if stem is not None:
        for i, weight in enumerate(stem.weights):
            fan_out = weight.shape[0] // num_copies
            conv = nn.Conv2d(weight.shape[1], fan_out, weight.shape[2], stride=stem.strides[i])
            own = slice(copy * fan_out, (copy + 1) * fan_out)
            conv.weight.data, conv.bias.data = weight.data[own], stem.biases[i].data[own]  # type: ignore[union-attr]
            layers.append(conv)
            if len(stem.norms):
                layers.append(_plain_norm(stem.norms[i], copy))
            layers.append(act())
    layers.append(nn.Flatten())
    for i, grouped in enumerate(trunk.layers):
        dense = nn.Linear(grouped.weight.shape[1], grouped.weight.shape[2])
        dense.weight.data, dense.bias.data = grouped.weight.data[copy].T, grouped.bias.data[copy]
        layers.append(dense)
        if i < len(trunk.layers) - 1:
            layers += [_plain_norm(trunk.norms[i], copy), act()] if len(trunk.norms) else [act()]
    return nn.Sequential(*layers)


def _plain_norm(grouped: Any, copy: int) -> nn.LayerNorm:
    norm = nn.LayerNorm(grouped.shape)
    norm.weight.data, norm.bias.data = grouped.weight.data[copy], grouped.bias.data[copy]
    return norm


def _shake(q: nn.Module) -> None:
    """Scales and shifts start at 1 and 0: make every parameter different, so that a mix-up shows."""
    rng = np.random.default_rng(6)
    for p in q.parameters():
        p.data.add_(torch.from_numpy(0.3 * rng.standard_normal(p.shape)).to(p.dtype))


@pytest.mark.parametrize("body", BODIES)
def test_separate_networks_are_separate_networks(body: str) -> None:
    shape, description = BODIES[body]
    q = SeparateQ(shape, A, description, rng=1)
    _shake(q)
    s = torch.from_numpy(np.random.default_rng(7).standard_normal((9, *shape))).float()
    expected = torch.cat([_plain_net(q, c)(s) for c in range(A)], -1)
    torch.testing.assert_close(q.all(s), expected, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("body", BODIES)
def test_action_output_is_one_network(body: str) -> None:
    shape, description = BODIES[body]
    q = ActionOutputQ(shape, A, description, rng=1)
    _shake(q)
    s = torch.from_numpy(np.random.default_rng(7).standard_normal((9, *shape))).float()
    torch.testing.assert_close(q.all(s), _plain_net(q, 0)(s), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("body", [b for b in BODIES if "conv" not in b])
def test_action_input_is_a_network_on_state_and_one_hot(body: str) -> None:
    shape, description = BODIES[body]
    q = ActionInputQ(shape, A, description, rng=1)
    _shake(q)
    s = torch.from_numpy(np.random.default_rng(7).standard_normal((9, *shape))).float()
    net = _plain_net(q, 0)
    expected = torch.cat([net(torch.cat([s.flatten(1), torch.eye(A)[[c] * 9]], -1)) for c in range(A)], -1)
    torch.testing.assert_close(q.all(s), expected, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("body", BODIES)
def test_an_update_of_one_action_moves_only_its_network(body: str) -> None:
    shape, description = BODIES[body]
    s = torch.from_numpy(np.random.default_rng(8).standard_normal((4, *shape))).float()
    for layout, others_move in ((SeparateQ, False), (ActionOutputQ, True), (ActionInputQ, True)):
        q = layout(shape, A, description, rng=1)
        engine = TorchEngine(q, Loss())
        before = q.all(s).detach()
        engine.loss_gradient(s, torch.full((4,), 1), torch.full((4,), 5.0))
        FlatOptimiser(Optimiser("sgd"), engine.flat.values).step(engine.flat.grad, 0.1)
        moved = (q.all(s).detach() != before).any(0)
        assert bool(moved[1])
        # A linear function of the state alone shares nothing between its outputs.
        shared = others_move and not (layout is ActionOutputQ and body == "linear")
        assert moved[[0, 2]].tolist() == [shared, shared], layout


class _Count(TorchDispatchMode):
    """How many operations run, and how many of them are products or convolutions."""

    def __init__(self) -> None:
        super().__init__()
        self.products = 0
        self.total = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.total += 1
        self.products += any(name in str(func) for name in ("mm", "addbmm", "convolution"))
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("body", BODIES)
def test_separate_networks_run_without_a_loop_over_actions(body: str) -> None:
    shape, description = BODIES[body]
    counts = []
    for num_actions in (2, 17):
        q = SeparateQ(shape, num_actions, description)
        with _Count() as count:
            q.all(torch.ones(3, *shape))
        counts.append((count.products, count.total))
    assert counts[0] == counts[1]
    assert counts[0][0] >= len(description.hidden) + 1


def test_linear_on_one_hot_is_the_table_update_for_update() -> None:
    """The same 300 updates of batches of 4, with repeats inside a batch, give the same entries to 1e-12."""
    rng = np.random.default_rng(9)
    table = TableQ(6, A)
    linear = LinearQ(6, A, features=OneHot(6, torch.float64))
    engines = [TorchEngine(q, Loss("huber", 0.7)) for q in (table, linear)]
    steppers = [FlatOptimiser(Optimiser("sgd"), e.flat.values) for e in engines]
    for _ in range(300):
        s, a = torch.from_numpy(rng.integers(0, 6, 4)), torch.from_numpy(rng.integers(0, A, 4))
        r, weight = torch.from_numpy(rng.standard_normal(4)), torch.from_numpy(rng.random(4))
        s_t = torch.from_numpy(rng.integers(0, 6, 4))
        for engine, stepper in zip(engines, steppers, strict=True):
            target = r + 0.9 * engine.all(s_t).amax(-1)
            engine.loss_gradient(s, a, target, weight)
            stepper.step(engine.flat.grad, 0.5)
        torch.testing.assert_close(linear.weight.T, table.weight, atol=1e-12, rtol=0)
    assert float(table.weight.detach().abs().min()) > 0  # every pair was updated


def test_linear_by_hand() -> None:
    """Q(s, a) = x·w_a + b_a."""
    q = LinearQ(2, 2, bias=True)
    q.weight.data.copy_(torch.tensor([[1.0, 2.0], [-1.0, 0.5]]))
    q.bias.data.copy_(torch.tensor([10.0, 20.0]))  # type: ignore[union-attr]
    assert q.all(torch.tensor([3.0, 4.0])).tolist() == [3 + 8 + 10, -3 + 2 + 20]


def test_features_come_first() -> None:
    pixels = torch.from_numpy(np.random.default_rng(1).integers(0, 256, (3, *IMAGE), dtype=np.uint8))
    for layout in LAYOUTS:
        with_features = layout(IMAGE, A, Conv(hidden=(4,)), features=Pixels(), rng=2)
        without = layout(IMAGE, A, Conv(hidden=(4,)), rng=2)
        assert torch.equal(with_features.all(pixels), without.all(pixels / 255.0))
        hot = layout((7,), A, MLP((4,)), features=OneHot(7), rng=2)
        assert torch.equal(hot.all(torch.tensor([2, 6])), layout((7,), A, MLP((4,)), rng=2).all(torch.eye(7)[[2, 6]]))


def test_bad_input_is_refused_clearly() -> None:
    for layout in LAYOUTS:
        with pytest.raises(ValueError, match=r"observations of shape \(4,\), got \(3, 5\)"):
            layout((4,), 2, MLP((3,))).all(torch.zeros(3, 5))
        with pytest.raises(ValueError, match=r"observations of shape \(2, 5, 6\), got \(5, 6\)"):
            layout(IMAGE, 2, Conv()).at(torch.zeros(5, 6), torch.tensor(0))
        with pytest.raises(ValueError, match="num_actions must be a whole number of at least 1, got 0"):
            layout((4,), 0)
        with pytest.raises(
            ValueError, match=r"Conv body needs frames \[height, width, channels\], .* got shape \(4,\)"
        ):
            layout((4,), 2, Conv())
        with pytest.raises(ValueError, match="does not fit"):
            layout((1, 2, 2), 2, Conv())
    for linear_input in (torch.zeros(3, 5), torch.zeros(3, 1)):
        with pytest.raises(ValueError, match="takes 4 features"):
            LinearQ(4, 2).at(linear_input, torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ValueError, match="num_features"):
        LinearQ(0, 2)
    with pytest.raises(ValueError, match="num_states"):
        TableQ(0, 2)
    with pytest.raises(ValueError, match="4 entries and 3 for the mask"):
        MaskedQ(LinearQ(4, 3), (4,)).all(torch.zeros(2, 5))
    for broken in ({"hidden": (0,)}, {"activation": "gelu"}):
        with pytest.raises(ValueError, match=r"hidden width|activation must be one of 'relu', 'tanh', 'leaky_relu'"):
            MLP(**broken)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="one entry per convolution, got 2, 1 and 1"):
        Conv(channels=(1, 2))

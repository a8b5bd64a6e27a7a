"""DQRC: the linear recursion by hand, the update direction sample by sample, the shared hidden units, Baird's star.

Mutants that were tried, and die: the sign of the correction; the target not
detached; the twin's features not detached, or its layer not from 0; β left out; weights on one loss only; state dicts
without h or the second optimiser.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neuralq.learners import DQRCLearner, ReplaySettings, TwinHead
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, MaskedQ, SeparateQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss
from neuralq.types import Transition

Array = NDArray[np.float64]
NETWORKS: dict[str, Any] = {"action-input": ActionInputQ, "separate": SeparateQ, "action-output": ActionOutputQ}


def settings(learning_rate: float = 1e-3, rate_h: float = 1e-3, beta: float = 1.0, **given: Any) -> ReplaySettings:
    named = {"learning_rate": learning_rate, "dqrc_learning_rate": rate_h, "dqrc_beta": beta}
    return ReplaySettings(**{"target_rule": "dqrc", "max_grad_norm": None, **named, **given})


def column(values: Any) -> Tensor:
    return torch.as_tensor(np.asarray(values))


class FeatureQ(nn.Module):
    """Q(s, a) = Φ[s, a]·θ on state indices."""

    def __init__(self, phi: Array) -> None:
        super().__init__()
        self.phi = column(phi)
        self.num_actions = phi.shape[1]
        self.theta = nn.Parameter(torch.zeros(phi.shape[2], dtype=torch.float64))

    def all(self, s: Tensor) -> Tensor:
        return self.phi[s] @ self.theta

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        return self.phi[s, a] @ self.theta


def network(layout: str, seed: int, layer_norm: bool = False) -> Any:
    body = MLP((6, 5), layer_norm=layer_norm, activation="tanh")
    return NETWORKS[layout]((4,), 3, body, rng=seed, dtype=torch.float64)


def random_rows(num_rows: int, seed: int) -> Transition:
    rng = np.random.default_rng(seed)
    s, s_t = column(rng.normal(size=(num_rows, 4))), column(rng.normal(size=(num_rows, 4)))
    a, r = column(rng.integers(3, size=num_rows)), column(rng.normal(size=num_rows))
    discount = column(np.where(rng.random(num_rows) < 0.3, 0.0, 0.9))
    return Transition(s, a, torch.ones_like(r), r, discount, s_t, discount == 0)


def randomise(values: Tensor, seed: int) -> None:
    values.copy_(column(np.random.default_rng(seed).normal(size=values.shape)))


def test_with_linear_features_it_is_tdrc_on_the_mean_of_the_batch() -> None:
    rng = np.random.default_rng(1)
    phi = rng.normal(size=(5, 2, 4))
    engine = make_engine(FeatureQ(phi), Loss())
    chosen = settings(learning_rate=0.05, rate_h=0.1, beta=0.5, optimiser="sgd")
    learner = DQRCLearner(engine, FeatureQ(phi), chosen, reward_scale=2.0)
    theta, h = np.zeros(4), np.zeros(4)
    for _ in range(60):
        s, a, t, r = rng.integers(5, size=6), rng.integers(2, size=6), rng.integers(5, size=6), rng.normal(size=6)
        gamma, weight = rng.uniform(0, 0.95, size=6), rng.uniform(0.2, 2, size=6)
        rows = Transition(column(s), column(a), column(r), column(r), column(gamma), column(t), column(r) < 9)
        learner.update(rows, column(weight))
        change, change_h = np.zeros(4), -0.5 * h
        for i in range(6):
            x, x_t = phi[s[i], a[i]], phi[t[i], np.argmax(phi[t[i]] @ theta)]
            delta = 2 * r[i] + gamma[i] * theta @ x_t - theta @ x
            change += weight[i] * (delta * x - gamma[i] * (x @ h) * x_t) / 6
            change_h += weight[i] * (delta - x @ h) * x / 6
        theta, h = theta + 0.05 * change, h + 0.1 * change_h
        np.testing.assert_allclose(engine.flat.values, theta, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(learner.state_dict()["h"], h, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("layout", list(NETWORKS))
def test_the_direction_on_a_network_sample_by_sample(layout: str) -> None:
    engine = make_engine(network(layout, 1), Loss())
    q: Any = engine.q
    head = TwinHead(q)
    learner = DQRCLearner(engine, head, settings(1.0, 1.0, beta=0.5, optimiser="sgd"))
    h: Tensor = learner.state_dict()["h"]
    randomise(h, 2)
    t = random_rows(7, seed=3)
    before, before_h = engine.flat.values.clone(), h.clone()
    total, total_h = torch.zeros_like(before), -0.5 * before_h
    for i in range(7):
        pair = (t.s_tm1[i], t.a_tm1[i])
        own, ahead, second = q.at(*pair), q.all(t.s_t[i]).amax(), head.at(*pair)
        fixed = float(second.detach())
        delta = float((t.r_t[i] + t.discount_t[i] * ahead - own).detach())
        near, far = (torch.cat([g.reshape(-1) for g in torch.autograd.grad(v, list(q.parameters()))])
                     for v in (own, ahead))  # fmt: skip
        by_head = torch.cat([g.reshape(-1) for g in torch.autograd.grad(second, list(head.parameters()))])
        total += (delta * near - fixed * float(t.discount_t[i]) * far) / 7
        total_h += (delta - fixed) * by_head / 7
    learner.update(t)
    torch.testing.assert_close(engine.flat.values - before, total, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(h - before_h, total_h, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("layout", list(NETWORKS))
def test_the_twin_is_the_network_with_another_last_layer(layout: str, layer_norm: bool) -> None:
    q = network(layout, 4, layer_norm)
    head, s, a = (
        TwinHead(q),
        torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0)).double(),
        torch.ones(2, 5),
    )
    assert not head.all(s).any(), "from 0"
    for p in head.parameters():
        randomise(p.data, 5)
    swapped = copy.deepcopy(q)
    swapped.trunk.layers[-1].load_state_dict(head.layer.state_dict())
    torch.testing.assert_close(head.all(s), swapped.all(s), rtol=0, atol=0)
    torch.testing.assert_close(head.at(s, a.long()), swapped.at(s, a.long()), rtol=0, atol=0)
    assert sum(p.numel() for p in head.parameters()) == sum(p.numel() for p in q.trunk.layers[-1].parameters())
    untouched = torch.autograd.grad(head.all(s).sum(), list(q.parameters()), allow_unused=True)
    assert all(g is None for g in untouched), "its gradient does not reach the hidden units"
    assert q.all(s).equal(q.all(s)), "and Q is as before"


def test_the_twin_of_a_masked_or_convolutional_network_and_of_none() -> None:
    body = Conv(channels=(2,), kernel_sizes=(2,), strides=(1,), hidden=(3,))
    head = TwinHead(MaskedQ(ActionOutputQ((1, 3, 3), 2, body, rng=0), (1, 3, 3)))
    s = torch.cat([torch.zeros(9), torch.tensor([1.0, 0.0])])
    assert head.all(s).tolist() == [0.0, -np.inf]
    with pytest.raises(ValueError, match="such as another TableQ"):
        TwinHead(TableQ(2, 2))


def test_a_saved_learner_goes_on_bit_for_bit() -> None:
    def build(seed: int) -> DQRCLearner:
        engine = make_engine(network("action-output", seed), Loss())
        return DQRCLearner(engine, TwinHead(engine.q), settings(0.01, 0.02, max_grad_norm=0.5))

    one, two = build(1), build(2)
    for seed in range(5):
        one.update(random_rows(8, seed))
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    for seed in range(5, 10):
        one.update(random_rows(8, seed))
        two.update(random_rows(8, seed))
    one.begin_streams()
    assert one.num_updates == two.num_updates == 10
    assert torch.equal(one.engine.flat.values, two.engine.flat.values)
    assert torch.equal(one.state_dict()["h"], two.state_dict()["h"])


def test_on_bairds_control_star_q_learning_diverges_and_dqrc_does_not() -> None:
    # Features of Maei 2010, every pair updated equally often; expected Q-learning has the eigenvalue −.1196 (an
    # independent computation), so at step size .1 it grows by 1.2% an update.
    phi = np.zeros((7, 2, 15))
    phi[:, 0, 0] = [1.0] * 6 + [2.0]
    phi[range(7), 0, range(1, 8)] = [2.0] * 6 + [1.0]
    phi[range(7), 1, range(8, 15)] = 1.0
    start = np.ones(15)
    start[7] = 10.0
    s, a, t = np.array([(s, a, t) for s in range(7) for a in range(2) for t in ([6] * 6 if a == 0 else range(6))]).T
    one = torch.ones(len(s), dtype=torch.float64)
    rows = Transition(column(s), column(a), one, 0 * one, 0.99 * one, column(t), one < 0)
    worst = {}
    for rate_h in (1e-12, 0.1):
        engine = make_engine(FeatureQ(phi), Loss())
        engine.flat.values.copy_(column(start))
        learner = DQRCLearner(engine, FeatureQ(phi), settings(0.1, rate_h, optimiser="sgd"))
        for _ in range(600):
            learner.update(rows)
        worst[rate_h] = float(np.abs(phi @ engine.flat.values.numpy()).max())
    assert worst[1e-12] > 1000
    assert worst[0.1] < 12, "where it started"


def test_refusals() -> None:
    with pytest.raises(ValueError, match="dqrc_learning_rate"):
        settings(rate_h=0.0)
    with pytest.raises(ValueError, match="dqrc_beta"):
        settings(beta=-1.0)
    with pytest.raises(ValueError, match="learns by target_rule='dqrc', got 'double'; use ReplayLearner"):
        DQRCLearner(make_engine(TableQ(2, 2), Loss()), TableQ(2, 2), ReplaySettings(target_rule="double"))
    with pytest.raises(ValueError, match="max_grad_norm"):
        settings(max_grad_norm=0.0)
    engine = make_engine(network("separate", 1), Loss())
    with pytest.raises(ValueError, match="weight must have the shape"):
        DQRCLearner(engine, TwinHead(engine.q), settings()).update(random_rows(3, 0), torch.ones(2))

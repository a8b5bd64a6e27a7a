"""Noisy layers, soft target updates and the average that plays, against what is written by hand.

Mutants that these tests kill: noise that is not rooted, or not signed · the outer product the wrong way round · σ₀ or
its 1/√p left out · one noise for all copies of a layer · a bias with the input's noise · noise left on for evaluation ·
the same noise for two actions, two updates, or for network and target · noise outside the checkpoint · τ taken for
1 − τ · a target that moves before the update · the average left out of greedy play.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from neuralq.learners import ReplayLearner, ReplaySettings
from neuralq.learners.averaging import evaluating_with
from neuralq.learners.replay.noisy import NoisyLearner
from neuralq.q import MLP, ActionOutputQ, SeparateQ, TableQ
from neuralq.q.compiled import MlpEngine, make_engine, runs_compiled
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.noisy import NoisyLinear, draw_noise, made_noisy, noisy_layers, remove_noise
from neuralq.runs import RunConfig, load, resume, train
from neuralq.runs.recipe.presets import with_preset
from neuralq.types import Transition


def batch(seed: int = 0, size: int = 6) -> Transition:
    rng = np.random.default_rng(seed)
    s, t = (torch.from_numpy(rng.normal(size=(size, 3))) for _ in range(2))
    a, r = torch.from_numpy(rng.integers(2, size=size)), torch.from_numpy(rng.normal(size=size))
    one = torch.ones(size, dtype=torch.float64)
    return Transition(s, a, one, r, 0.9 * one, t, one < 0)


def noisy_net(kind: Any = ActionOutputQ) -> Any:
    q = kind((3,), 2, MLP((4,), activation="tanh"), rng=0, dtype=torch.float64)
    return made_noisy(q, np.random.default_rng(1))


@pytest.mark.parametrize("copies", [1, 3])
def test_a_noisy_layer_is_the_one_written_by_hand(copies: int) -> None:
    fan_in, fan_out = 5, 4
    layer = NoisyLinear(copies, fan_in, fan_out, np.random.default_rng(0), torch.float64)
    for parameter in (layer.weight_sigma, layer.bias_sigma):
        assert torch.equal(parameter, torch.full_like(parameter, 0.5 / math.sqrt(fan_in)))
    assert 0.9 / math.sqrt(fan_in) < float(layer.weight.detach().abs().max()) <= 1 / math.sqrt(fan_in)
    x = torch.from_numpy(np.random.default_rng(3).normal(size=(copies, 2, fan_in)))
    draw_noise([layer], np.random.default_rng(7))
    rng = np.random.default_rng(7)  # the same draws: those of all inputs, then those of all outputs
    below, above = rng.standard_normal((copies, fan_in)), rng.standard_normal((copies, fan_out))
    mine: list[Tensor] = []
    for c in range(copies):
        y = torch.zeros(2, fan_out, dtype=torch.float64)
        for j in range(fan_out):
            e_out = math.copysign(math.sqrt(abs(above[c, j])), above[c, j])
            y[:, j] = layer.bias[c, j] + layer.bias_sigma[c, j] * e_out
            for i in range(fan_in):
                e_in = math.copysign(math.sqrt(abs(below[c, i])), below[c, i])
                y[:, j] = y[:, j] + (layer.weight[c, i, j] + layer.weight_sigma[c, i, j] * e_in * e_out) * x[c, :, i]
        mine.append(y)
    weight = torch.from_numpy(np.random.default_rng(4).normal(size=(copies, 2, fan_out)))
    found = layer(x)
    torch.testing.assert_close(found, torch.stack(mine), rtol=1e-12, atol=1e-12)
    parameters = list(layer.parameters())
    for ours, theirs in zip(
        torch.autograd.grad((found * weight).sum(), parameters),
        torch.autograd.grad((torch.stack(mine) * weight).sum(), parameters), strict=True,
    ):  # fmt: skip
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    remove_noise([layer])
    torch.testing.assert_close(layer(x)[0], x[0] @ layer.weight[0] + layer.bias[0], rtol=1e-12, atol=1e-12)


def test_every_dense_layer_becomes_noisy_and_kernels_leave_them_alone() -> None:
    for kind in (ActionOutputQ, SeparateQ):
        q = noisy_net(kind)
        assert len(noisy_layers(q)) == 2 and not runs_compiled(q)
        assert type(make_engine(q, Loss())) is TorchEngine
    with pytest.raises(ValueError, match="noisy layers take the place of dense ones, and TableQ has none"):
        made_noisy(TableQ(2, 2), np.random.default_rng(0))


def test_an_update_is_autograds_step_under_the_noise_of_the_update() -> None:
    """The gradient by hand: both networks rebuilt with the weights that their noise makes of them."""
    settings = ReplaySettings(noisy=True, optimiser="sgd", learning_rate=0.1, max_grad_norm=None, loss="squared")
    engine = TorchEngine(noisy_net(), Loss("squared"))
    learner = NoisyLearner(ReplayLearner(engine, settings), np.random.default_rng(5))
    before, data = engine.flat.values.clone(), batch()
    learner.update(data)
    rng = np.random.default_rng(5)
    twin, target = noisy_net(), noisy_net()
    draw_noise([*noisy_layers(twin), *noisy_layers(target)], rng)  # the network first, then its target
    with torch.no_grad():
        aim = data.r_t + data.discount_t * target.all(data.s_t).amax(-1)
    loss = 0.5 * (aim - twin.at(data.s_tm1, data.a_tm1)).square().mean()
    gradient = torch.cat([g.reshape(-1) for g in torch.autograd.grad(loss, list(twin.parameters()))])
    torch.testing.assert_close(engine.flat.values, before - 0.1 * gradient, rtol=1e-10, atol=1e-12)
    assert bool((gradient != 0).all()), "σ learns, too"


def test_noise_is_new_for_every_action_and_gone_for_evaluation() -> None:
    engine = TorchEngine(noisy_net(), Loss())
    learner = NoisyLearner(ReplayLearner(engine, ReplaySettings(noisy=True)), np.random.default_rng(5))
    s = batch().s_tm1
    drawn = [learner.values(s) for _ in range(3)]
    assert not torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[1], drawn[2])
    trunk: Any = engine.q
    layers: Any = trunk.trunk.layers
    plain = torch.tanh(s @ layers[0].weight[0] + layers[0].bias[0]) @ layers[1].weight[0] + layers[1].bias[0]
    with evaluating_with(learner):
        torch.testing.assert_close(engine.all(s), plain.detach(), rtol=1e-12, atol=1e-12)
    learner.update(batch())
    assert torch.equal(engine.all(s), engine.all(s))
    assert all(layer.noise is None for layer in noisy_layers(engine.q))


QUICK = {"total_steps": 240, "evaluate_every": 120, "evaluation_episodes": 2, "checkpoint_every": 80, "log_every": 60}
RAINBOW = {
    "noisy": True, "target_rule": "double", "num_steps": 3, "prioritised": True, "distribution": "categorical",
    "num_atoms": 11, "value_min": 0.0, "value_max": 100.0,
}  # fmt: skip


class Stopped(BaseException):
    """Ends a run in the middle as a kill would."""


def stop(row: Any) -> None:
    if row["kind"] == "train" and row["env_steps"] >= 120:
        raise Stopped


@pytest.mark.parametrize(
    "given", [{"noisy": True, "target_rate": 0.01, "average_updates": 20.0}, RAINBOW], ids=["noisy", "all six"]
)
def test_a_run_by_noise_stopped_on_the_way_ends_with_the_same_bits(given: dict[str, Any], tmp_path: Path) -> None:
    learner = {"learning_starts": 40, "batch_size": 8, "capacity": 200, "train_period": 2, **given}
    body = {"class": "MLP", "hidden": [8, 8]}
    config = with_preset(
        {"env": "CartPole-v1", "learner": "replay", "dueling": given is RAINBOW, "body": body, "replay": learner,
         "epsilon_start": 0.0, "epsilon_end": 0.0, **QUICK}
    )  # fmt: skip
    whole = train(config, tmp_path / "whole")
    with pytest.raises(Stopped):
        train(config, tmp_path / "parts", [stop])
    parts = resume(tmp_path / "parts")
    assert (parts.parameters_sha256, parts.greedy_return) == (whole.parameters_sha256, whole.greedy_return)
    agent = load(tmp_path / "whole")
    assert agent.values(np.zeros(4, np.float32)).tolist() == agent.values(np.zeros(4, np.float32)).tolist()


@pytest.mark.parametrize("kind", [MlpEngine, TorchEngine])
def test_a_soft_target_is_the_exponential_average_of_the_parameters(kind: Any) -> None:
    """θ⁻ₙ = (1 − τ)ⁿ θ₀ + τ Σₖ (1 − τ)ⁿ⁻ᵏ θₖ, the closed form of Lillicrap et al. (2016)."""
    tau, q = 0.2, ActionOutputQ((3,), 2, MLP((4,)), rng=0, dtype=torch.float64)
    engine = kind(q, Loss())
    settings = ReplaySettings(target_rate=tau, optimiser="sgd", learning_rate=0.5, max_grad_norm=None)
    learner = ReplayLearner(engine, settings)
    seen = [engine.flat.values.clone()]
    for seed in range(5):
        learner.update(batch(seed))
        seen.append(engine.flat.values.clone())
    n = len(seen) - 1
    closed = (1 - tau) ** n * seen[0] + tau * sum((1 - tau) ** (n - k) * seen[k] for k in range(1, n + 1))
    target = engine.target_values()
    assert target is not None
    torch.testing.assert_close(target, closed, rtol=1e-12, atol=1e-14)
    assert float((seen[0] - seen[-1]).abs().max()) > 1e-3


def test_greedy_play_is_by_the_average_where_one_is_kept() -> None:
    engine = TorchEngine(ActionOutputQ((3,), 2, MLP((4,)), rng=0, dtype=torch.float64), Loss())
    settings = ReplaySettings(average_updates=2.0, optimiser="sgd", learning_rate=0.5, max_grad_norm=None)
    learner = ReplayLearner(engine, settings)
    seen = []
    for seed in range(2):
        learner.update(batch(seed))
        seen.append(engine.flat.values.clone())
    with evaluating_with(learner):  # weights ½ and 1
        torch.testing.assert_close(engine.flat.values, (0.5 * seen[0] + seen[1]) / 1.5, rtol=1e-12, atol=1e-14)
    assert torch.equal(engine.flat.values, seen[1])


@pytest.mark.parametrize(
    ("given", "said", "way_out"),
    [
        (
            {"replay": {"noisy": True}, "layout": "table", "env": "FrozenLake-v1"}, "layout='table' has none",
            {"layout": "action-output"},
        ),
        ({"replay": {"noisy": True}, "engine": "compiled"}, "no kernels for noisy layers", {"engine": "auto"}),
        ({"replay": {"target_rate": 0.0}}, "target_rate must lie in", {"replay": {"target_rate": 0.005}}),
        (
            {"replay": {"target_rate": 0.1, "target_period_updates": 5}}, "leave target_period_updates out",
            {"replay": {"target_rate": 0.1}},
        ),
        ({"replay": {"average_updates": 0.5}}, "average_updates must be", {"replay": {"average_updates": 1.0}}),
        ({"replay": {"noisy": True, "target_rule": "dqrc"}}, "leave noisy out", {"replay": {"target_rule": "dqrc"}}),
        (
            {"replay": {"target_rate": 0.1, "target_rule": "dqrc"}}, "leave target_rate out",
            {"replay": {"target_rule": "dqrc"}},
        ),
        (
            {"replay": {"noisy": True}, "body": {"class": "MLP", "sparsity": 0.5}}, "leave sparsity out",
            {"body": {"class": "MLP"}},
        ),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_refused_with_a_way_out(
    given: dict[str, Any], said: str, way_out: dict[str, Any]
) -> None:
    from neuralq.runs.recipe.config import config_from_dict

    plain = {"env": "CartPole-v1", "learner": "replay", **given}
    with pytest.raises(ValueError, match=said):
        config_from_dict(plain)
    assert isinstance(config_from_dict({**plain, **way_out}), RunConfig)


def test_a_noisy_network_is_a_module_like_any_other() -> None:
    q: nn.Module = noisy_net()
    names = [name for name, _ in q.named_parameters()]
    assert "trunk.layers.0.weight_sigma" in names and len(names) == 8

"""IQN: the quantile function against one written here with loops, known distributions, and all that a run asks of it.

Mutants that were tried, and die: cosines from 1 in place of 0, or without π; the embedding added and not multiplied,
without its ReLU or its bias, shared by separate networks, or joined one layer too high or too low; levels of one row
given to another; one draw of levels for both sides; fixed levels in the loss; 1 − τ for τ; the sum over the target's
levels in place of their mean; the successor's action chosen by the drawn levels; drawn levels while acting; levels from
a generator of their own, which no checkpoint holds.
"""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.apps.cli import main
from neuralq.learners import DistributionalLearner, ReplaySettings
from neuralq.q import (
    MLP,
    ActionInputQ,
    ActionOutputQ,
    Conv,
    DuelingQ,
    ImplicitQuantileQ,
    LinearQ,
    MaskedQ,
    SeparateQ,
    TableQ,
)
from neuralq.q.engine import Loss, TorchEngine
from neuralq.runs import RunConfig, load
from neuralq.runs.recipe.build import build_session
from neuralq.types import Transition

F64 = torch.float64
NUM_ACTIONS, NUM_LEVELS, BATCH, SCALE, RATE = 3, 4, 7, 0.5, 0.3
LAYOUTS: dict[str, Any] = {"action-output": ActionOutputQ, "separate": SeparateQ, "action-input": ActionInputQ}
BODIES: dict[str, Any] = {
    "one hidden layer": MLP((6,), activation="tanh"),
    "two, normalised": MLP((5, 6), layer_norm=True),
    "three": MLP((5, 4, 6), activation="leaky_relu"),
    "convolution": Conv((2,), (2,), (1,), (6,), layer_norm=False),
    "convolution alone": Conv((2,), (2,), (1,), (), layer_norm=False),
}
SHAPES = {name: (1, 3, 3) if "conv" in name else (4,) for name in BODIES}
JOINED_AFTER = {"one hidden layer": 1, "two, normalised": 1, "three": 2, "convolution": 0, "convolution alone": 0}
ACTIVATIONS = {"tanh": torch.tanh, "relu": torch.relu, "leaky_relu": torch.nn.functional.leaky_relu}


def network(layout: str, body: str, dtype: torch.dtype = F64) -> Any:
    inner = LAYOUTS[layout](SHAPES[body], NUM_ACTIONS, BODIES[body], rng=1, dtype=dtype)
    return ImplicitQuantileQ(inner, rng=2)


def in_double(q: Any, layout: str, body: str) -> Any:
    """A copy in double precision."""
    twin = network(layout, body)
    for mine, its in zip(twin.parameters(), q.parameters(), strict=True):
        mine.data.copy_(its.data)
    return twin


def by_hand(q: Any, body: str, s: Tensor, tau: Tensor) -> Tensor:
    """Z_τ(s, a) of every row, action and level, ``[B, A, K]``, one by one, from Dabney et al. 2018, eq. 4."""
    inner, trunk, last = q.inner, q.inner.trunk, len(q.inner.trunk.layers) - 1

    def through(x: Tensor, layers: range, c: int) -> Tensor:
        for i in layers:
            x = x @ trunk.layers[i].weight[c] + trunk.layers[i].bias[c]
            if i < last and BODIES[body].layer_norm:
                x = (x - x.mean()) / (x.var(unbiased=False) + 1e-5).sqrt() * trunk.norms[i].weight[c] + trunk.norms[
                    i
                ].bias[c]
            x = ACTIVATIONS[BODIES[body].activation](x) if i < last else x
        return x

    rows = []
    for b, a in np.ndindex(len(s), NUM_ACTIONS):
        c = a if isinstance(inner, SeparateQ) else 0
        x = s[b].reshape(-1)
        if inner.input.stem is not None:
            w = inner.input.stem.weights[0].reshape(-1, 2, 1, 2, 2)[c]
            bias = inner.input.stem.biases[0].reshape(-1, 2)[c]
            x = torch.relu(torch.nn.functional.conv2d(s[b][None], w, bias)).reshape(-1)
        if isinstance(inner, ActionInputQ):
            x = torch.cat([x, torch.eye(NUM_ACTIONS, dtype=x.dtype)[a]])
        x = through(x, range(JOINED_AFTER[body]), c)
        for level in tau[b].tolist():
            cosines = torch.tensor([math.cos(math.pi * i * level) for i in range(64)], dtype=x.dtype)
            phi = torch.relu(cosines @ q.embedding.weight[c] + q.embedding.bias[c])
            out = through(x * phi, range(JOINED_AFTER[body], last + 1), c)
            rows.append(out[a] if len(out) > 1 else out[0])
    return torch.stack(rows).reshape(len(s), NUM_ACTIONS, tau.shape[1])


def batch(shape: tuple[int, ...], dtype: torch.dtype = F64) -> Transition:
    rng = np.random.default_rng(4)
    s, s_t = (torch.from_numpy(rng.normal(size=(BATCH, *shape))).to(dtype) for _ in range(2))
    a, last = torch.from_numpy(rng.integers(NUM_ACTIONS, size=BATCH)), torch.from_numpy(rng.random(BATCH) < 0.3)
    r = torch.from_numpy(2 * rng.normal(size=BATCH))
    return Transition(s, a, torch.ones(BATCH), r, 0.9 * (~last).to(F64), s_t, last)


def learner_of(q: Any, **given: Any) -> DistributionalLearner:
    plain: dict[str, Any] = {"optimiser": "sgd", "learning_rate": RATE, "max_grad_norm": None, "num_atoms": NUM_LEVELS}
    settings = ReplaySettings(**{**plain, "distribution": "iqn", **given})
    return DistributionalLearner(TorchEngine(q, Loss()), settings, SCALE, np.random.default_rng(5))


def levels_drawn() -> tuple[Tensor, Tensor]:
    """Those of the target's side and of the other, as a learner with a fresh generator draws them."""
    rng = np.random.default_rng(5)
    return tuple(torch.from_numpy(rng.random((BATCH, NUM_LEVELS))) for _ in range(2))  # type: ignore[return-value]


CELLS = [
    (layout, body) for layout in LAYOUTS for body in BODIES if layout != "action-input" or body != "convolution alone"
]


@pytest.mark.parametrize(("layout", "body"), CELLS)
@torch.no_grad()
def test_the_quantile_function_is_the_published_one(layout: str, body: str) -> None:
    q, s, tau = network(layout, body), batch(SHAPES[body]).s_tm1, levels_drawn()[0]
    torch.testing.assert_close(q.outputs(s, tau), by_hand(q, body, s, tau), rtol=0, atol=1e-12)
    midpoints = torch.tensor([[(2 * k + 1) / 64 for k in range(32)]] * BATCH, dtype=F64)
    torch.testing.assert_close(q.all(s), by_hand(q, body, s, midpoints).mean(-1), rtol=0, atol=1e-12)
    a = torch.arange(BATCH) % NUM_ACTIONS
    torch.testing.assert_close(q.at(s, a), q.all(s).gather(-1, a[:, None])[:, 0], rtol=0, atol=0)
    torch.testing.assert_close(q.all(s.reshape(1, BATCH, *SHAPES[body]))[0], q.all(s), rtol=0, atol=1e-12)
    assert q.all(s[0]).shape == (NUM_ACTIONS,) and q.all(s[:0]).shape == (0, NUM_ACTIONS)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
@pytest.mark.parametrize(("layout", "body"), [("action-output", "two, normalised"), ("separate", "one hidden layer"),
                                              ("action-input", "convolution")])  # fmt: skip
def test_an_update_is_the_published_loss_by_the_same_levels(
    layout: str, body: str, dtype: torch.dtype, weighted: bool
) -> None:
    learner = learner_of(network(layout, body, dtype))
    flat, noise = learner.engine.flat.values, np.random.default_rng(7)
    target = in_double(learner.engine.q, layout, body)
    flat.add_(torch.from_numpy(noise.normal(size=flat.shape, scale=0.3)).to(dtype))
    online, t = in_double(learner.engine.q, layout, body), batch(SHAPES[body], dtype)
    weight = torch.from_numpy(noise.uniform(0, 2, BATCH)) if weighted else torch.ones(BATCH, dtype=F64)
    tau_t, tau = levels_drawn()
    with torch.no_grad():
        best = target.all(t.s_t.double()).argmax(-1)
        z_t = by_hand(target, body, t.s_t.double(), tau_t)
    z = by_hand(online, body, t.s_tm1.double(), tau)
    total: Any = 0
    for b in range(BATCH):
        for i, level in enumerate(tau[b].tolist()):
            for j in range(NUM_LEVELS):  # eq. 3, κ = 1: the sum over i, the mean over j
                delta = SCALE * t.r_t[b] + t.discount_t[b] * z_t[b, best[b], j] - z[b, t.a_tm1[b], i]
                huber = 0.5 * delta**2 if abs(delta.item()) <= 1 else delta.abs() - 0.5
                total = total + weight[b] * abs(level - float(delta.item() < 0)) * huber / NUM_LEVELS / BATCH
    grad = torch.cat([g.reshape(-1) for g in torch.autograd.grad(total, list(online.parameters()))])
    wanted = torch.cat([p.reshape(-1) for p in online.parameters()]).detach() - RATE * grad
    near = {"rtol": 0.0, "atol": 1e-10 if dtype == F64 else 1e-6}
    update = learner.update(t, weight if weighted else None)
    torch.testing.assert_close(flat.double(), wanted, **near)
    aim = SCALE * t.r_t + t.discount_t * z_t[torch.arange(BATCH), best].mean(-1)
    torch.testing.assert_close(update.targets.double(), aim, **near)
    torch.testing.assert_close(
        update.errors.double(), aim - z[torch.arange(BATCH), t.a_tm1].mean(-1).detach(), **near
    )  # fmt: skip


def test_a_table_and_a_linear_function_hold_a_series_of_cosines_whose_first_term_is_the_mean() -> None:
    rng = np.random.default_rng(0)
    table, linear = (ImplicitQuantileQ(x, num_cosines=6) for x in (TableQ(5, 12), LinearQ(5, 12)))
    numbers = torch.from_numpy(rng.normal(size=(5, 12)))
    table.inner.weight.data.copy_(numbers)  # type: ignore[attr-defined]
    linear.inner.weight.data.copy_(numbers.T)  # type: ignore[attr-defined]
    s, tau = torch.tensor([4, 0, 3]), torch.from_numpy(rng.random((3, 7)))
    got = table.outputs(s, tau).detach()
    for b, a, k in np.ndindex(3, 2, 7):
        series = sum(float(numbers[s[b], 6 * a + i]) * math.cos(math.pi * i * float(tau[b, k])) for i in range(6))
        assert float(got[b, a, k]) == pytest.approx(series, abs=1e-12)
    torch.testing.assert_close(linear.outputs(torch.eye(5, dtype=F64)[s], tau), table.outputs(s, tau))
    torch.testing.assert_close(table.all(s), numbers[s].reshape(3, 2, 6)[..., 0], rtol=0, atol=1e-12)


# A bandit whose returns are known: 0 pays evenly between 0 and 40, 1 pays 4 three times in four, else 24.


def bandit(q: Any, dtype: torch.dtype, s_of: Any, **given: Any) -> Any:
    rng = np.random.default_rng(1)
    settings = ReplaySettings(distribution="iqn", num_atoms=16, max_grad_norm=None, **given)
    learner = DistributionalLearner(TorchEngine(q, Loss()), settings, 1.0, rng)
    for step in range(1500):
        learner._descent.learning_rate = settings.learning_rate * (1 - step / 1500)
        a = rng.integers(2, size=64)
        r = np.where(a == 0, 40 * rng.random(64), np.where(rng.random(64) < 0.75, 4.0, 24.0))
        s = s_of(64)
        learner.update(Transition(s, torch.from_numpy(a), torch.ones(64), torch.from_numpy(r).to(dtype),
                                  torch.zeros(64), s, torch.ones(64) > 0))  # fmt: skip
    return q


@pytest.mark.parametrize("kind", ["table", "network"])
@pytest.mark.slow
def test_the_quantiles_of_known_distributions_are_learned(kind: str) -> None:
    if kind == "table":
        q = bandit(ImplicitQuantileQ(TableQ(1, 32), num_cosines=16), F64, lambda n: torch.zeros(n, dtype=torch.int64),
                   learning_rate=0.3)  # fmt: skip
        s: Tensor = torch.tensor([0])
    else:
        inner = ActionOutputQ((1,), 2, MLP((32, 32)), rng=0)
        q = bandit(ImplicitQuantileQ(inner, rng=0), torch.float32, lambda n: torch.ones(n, 1), learning_rate=5e-3)
        s = torch.ones(1, 1)
    tau = torch.tensor([[0.1, 0.25, 0.5, 0.6, 0.9]], dtype=F64)
    with torch.no_grad():
        even, coin = q.outputs(s, tau)[0].numpy()
        means = q.all(s)[0].numpy()
    np.testing.assert_allclose(even, [4, 10, 20, 24, 36], atol=2.5)
    np.testing.assert_allclose(coin[[0, 1, 2, 4]], [4, 4, 4, 24], atol=3)
    np.testing.assert_allclose(means, [20, 9], atol=1.5)


# What a run asks.


def config(layout: str = "action-output", engine: str = "auto", **given: Any) -> RunConfig:
    settings = ReplaySettings(**{"distribution": "iqn", "learning_starts": 20, "batch_size": 8, **given})  # type: ignore[arg-type]
    body = None if layout in ("table", "linear") else MLP((8,))
    return RunConfig(learner="replay", layout=layout, replay=settings, body=body, engine=engine, evaluation_episodes=1)


def test_acting_and_evaluating_draw_no_levels() -> None:
    session = build_session(config(learning_starts=10_000))
    try:
        before = copy.deepcopy(session.generators["samples"].bit_generator.state)
        for _ in range(30):
            session.experience.add(session.stream.step(session.policy))
        s = torch.zeros(1, 4)
        assert torch.equal(session.learner.engine.all(s), session.learner.engine.all(s))
        session.evaluate(seed=0)
        assert session.generators["samples"].bit_generator.state == before
        assert session.learner.rng is session.generators["samples"]  # type: ignore[attr-defined]
    finally:
        session.close()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: RunConfig(learner="replay", dueling=True, replay=ReplaySettings(distribution="iqn")), "two streams"),
        (
            lambda: RunConfig(learner="replay", engine="compiled", replay=ReplaySettings(distribution="iqn")),
            "no kernels",
        ),
        (lambda: ReplaySettings(distribution="iqn", loss="squared"), "does not go with distribution='iqn'"),
        (lambda: ReplaySettings(distribution="iqn", value_min=0.0), "distribution='iqn' needs no range of returns"),
        (lambda: ReplaySettings(distribution="iqn", target_rule="dqrc"), "use distribution='none'"),
        (lambda: ReplaySettings(distribution="iqn", target_rule="peng", block_length=4), "needs whole distributions"),
        (lambda: ReplaySettings(distribution="iqn", num_atoms=0), "num_atoms must be"),
        (lambda: ImplicitQuantileQ(ActionOutputQ((4,), 2, MLP(()))), "hidden=.*; give it a width"),
        (lambda: ImplicitQuantileQ(TableQ(2, 65)), "no multiple of 64 per action"),
        (lambda: ImplicitQuantileQ(DuelingQ((4,), 2, MLP((8,)))), "DuelingQ has no one place"),
        (lambda: learner_of(ImplicitQuantileQ(TableQ(2, 64)), distribution="quantile"), "do not go with a iqn repr"),
    ],
)
def test_what_does_not_go_together_is_refused(call: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        call()
    assert ReplaySettings(distribution="iqn").num_atoms == 8


def test_masks_and_nets_of_every_kind_go_through_one_learner() -> None:
    q = MaskedQ(network("action-output", "one hidden layer"), (4,))
    t = batch((4,))
    legal = torch.ones(BATCH, NUM_ACTIONS, dtype=F64)
    legal[:, 2] = 0
    masked = Transition(torch.cat([t.s_tm1, torch.ones_like(legal)], -1), t.a_tm1, t.mu_tm1, t.r_t, t.discount_t,
                        torch.cat([t.s_t, legal], -1), t.last_t)  # fmt: skip
    learner = learner_of(q)
    z_t = by_hand(q.inner, "one hidden layer", t.s_t, levels_drawn()[0]).detach()
    best = q.inner.all(t.s_t)[:, :2].argmax(-1)
    wanted = SCALE * t.r_t[:, None] + t.discount_t[:, None] * z_t[torch.arange(BATCH), best]
    torch.testing.assert_close(learner.targets(masked), wanted, rtol=0, atol=1e-12)


def test_a_run_is_compared_loaded_exported_and_stored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["train", "CartPole-v1", "--learner", "replay", "--replay.distribution", "iqn", "--hidden", "8", "--json"]
    argv += ["--replay.learning-starts", "20", "--total-steps", "60", "--evaluation-episodes", "1"]
    for seed in ("0", "1"):
        assert main([*argv, "--seed", seed, "--run-dir", str(tmp_path / seed)]) == 0
    capsys.readouterr()
    assert json.loads((tmp_path / "0" / "config.json").read_text())["replay"]["num_atoms"] == 8
    agent = load(tmp_path / "0")
    assert isinstance(agent.q, ImplicitQuantileQ) and agent.values(np.zeros(4, np.float32)).shape == (2,)
    assert main(["compare", str(tmp_path / "0"), str(tmp_path / "1")]) == 0
    pytest.importorskip("onnx")
    assert main(["export", str(tmp_path / "0"), "--onnx", str(tmp_path / "policy.onnx")]) == 0

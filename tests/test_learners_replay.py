"""The replay learner against targets written from their definitions and gradients taken by autograd.

Mutants that these tests kill: double Q-learning with the two networks exchanged; the bootstrap from the online instead
of the target network; importance weights dropped under Huber's loss, or squared; a discount that is applied twice to
n-step samples; λ cut in the wrong row of a block; the target copy renewed one update late.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.learners import ReplayLearner, ReplaySettings
from neuralq.learners.replay.buffer import Prioritised, ReplayBuffer
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, LinearQ, SeparateQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Engine, Loss
from neuralq.types import Transition

LAYOUTS = ["table", "linear", "action-input", "separate", "action-output"]
NETWORKS = {"action-input": ActionInputQ, "separate": SeparateQ, "action-output": ActionOutputQ}
NUM_STATES, NUM_ACTIONS, BATCH = 7, 3, 11
FEATURES = torch.from_numpy(np.random.default_rng(5).normal(size=(NUM_STATES, 4)))


def engine_of(layout: str, loss: str = "squared", kind: str = "auto") -> Engine:
    rng = np.random.default_rng(1)
    q: Any
    if layout == "table":
        q = TableQ(NUM_STATES, NUM_ACTIONS)
    elif layout == "linear":
        q = LinearQ(4, NUM_ACTIONS)
    else:
        q = NETWORKS[layout]((4,), NUM_ACTIONS, MLP((6,), activation="tanh"), rng=rng, dtype=torch.float64)
    engine = make_engine(q, Loss(loss), kind)
    engine.flat.values.copy_(torch.from_numpy(rng.normal(size=engine.flat.values.shape)))
    return engine


def batch(layout: str, *lead: int) -> Transition:
    rng = np.random.default_rng(len(lead))
    s_tm1, s_t = (torch.from_numpy(rng.integers(NUM_STATES, size=lead)) for _ in range(2))
    last = torch.from_numpy(rng.random(lead) < 0.3)
    discount = torch.from_numpy(np.where(last.numpy() & (rng.random(lead) < 0.5), 0.0, rng.uniform(0.5, 1, lead)))
    if len(lead) == 2:
        s_t[:-1] = torch.where(last[:-1], s_t[:-1], s_tm1[1:])
    a = torch.from_numpy(rng.integers(NUM_ACTIONS, size=lead))
    r = torch.from_numpy(rng.normal(size=lead))
    x, y = (s_tm1, s_t) if layout == "table" else (FEATURES[s_tm1], FEATURES[s_t])
    return Transition(x, a, torch.ones(lead), r, discount, y, last)


def learner_of(engine: Engine, **given: Any) -> ReplayLearner:
    values: dict[str, Any] = {"optimiser": "sgd", "learning_rate": 0.3, "max_grad_norm": None, "loss": "squared"}
    return ReplayLearner(engine, ReplaySettings(**(values | given)))


def two_networks(learner: ReplayLearner) -> tuple[Any, Any]:
    """Copies of the online and the target network, made different from each other."""
    target = copy.deepcopy(learner.engine.q)
    noise = np.random.default_rng(7).normal(size=learner.engine.flat.values.shape)
    learner.engine.flat.values.add_(torch.from_numpy(noise))
    return copy.deepcopy(learner.engine.q), target


@pytest.mark.parametrize("rule", ["q_learning", "double"])
@pytest.mark.parametrize("layout", LAYOUTS)
@torch.no_grad()
def test_single_samples_get_the_target_of_their_rule(layout: str, rule: str) -> None:
    learner = learner_of(engine_of(layout), target_rule=rule)
    online, target = two_networks(learner)
    t = batch(layout, BATCH)
    got = learner.targets(t)
    for i in range(BATCH):
        chooser = target if rule == "q_learning" else online
        best = max(range(NUM_ACTIONS), key=lambda a, i=i: float(chooser.all(t.s_t[i])[a]))  # type: ignore[misc]
        wanted = float(t.r_t[i]) + float(t.discount_t[i]) * float(target.all(t.s_t[i])[best])
        assert float(got[i]) == pytest.approx(wanted, abs=1e-12)


@torch.no_grad()
def defined_block_return(t: Transition, q: Any, lambda_: float, watkins: bool, row: int, env_index: int) -> float:
    """λ-return of one row of a block, from the n-step returns and their weights."""
    total, so_far, factor, weight = 0.0, 0.0, 1.0, 1.0
    for k in range(row, len(t.r_t)):
        so_far += factor * float(t.r_t[k, env_index])
        factor *= float(t.discount_t[k, env_index])
        n_step = so_far + factor * float(q.all(t.s_t[k, env_index]).max())
        cut = k == len(t.r_t) - 1 or bool(t.last_t[k, env_index])
        if watkins and not cut:
            values = q.all(t.s_tm1[k + 1, env_index])
            cut = bool(values[t.a_tm1[k + 1, env_index]] < values.max())
        if cut:
            return total + weight * n_step
        total, weight = total + weight * (1 - lambda_) * n_step, weight * lambda_
    raise AssertionError("the last row always cuts")


@pytest.mark.parametrize("rule", ["peng", "watkins"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_blocks_get_lambda_returns_from_the_target_network(layout: str, rule: str) -> None:
    learner = learner_of(engine_of(layout), target_rule=rule, block_length=6, lambda_=0.7)
    _, target = two_networks(learner)
    t = batch(layout, 6, 5)
    wanted = [[defined_block_return(t, target, 0.7, rule == "watkins", i, j) for j in range(5)] for i in range(6)]
    torch.testing.assert_close(learner.targets(t), torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=1e-10)


def test_n_step_samples_bootstrap_once_from_the_end_of_their_stretch() -> None:
    # Two episodes of a corridor: 0 → 1 → 2 → 3 (terminated) and 0 → 1 → 2 (truncated), γ = 0.5, rewards 1, 2, 4, …
    buffer = ReplayBuffer(50, (), np.int64, num_steps=3)
    ends = {2: (True, 0.0), 4: (True, 0.5)}
    for k, (s, s_next) in enumerate([(0, 1), (1, 2), (2, 3), (0, 1), (1, 2)]):
        last, discount = ends.get(k, (False, 0.5))
        buffer.add_step(0, np.int64(s), 0, 1.0, 2.0**k, discount, np.int64(s_next), last)  # type: ignore[arg-type]
    engine = make_engine(TableQ(4, 1), Loss())
    engine.flat.values.copy_(torch.tensor([10.0, 20.0, 40.0, 80.0], dtype=torch.float64))
    sample = buffer.sample(64, np.random.default_rng(0))
    targets = learner_of(engine, num_steps=3).targets(sample.transition)
    wanted = {
        0: 1 + 2 / 2 + 4 / 4,  # runs into the terminal state
        1: 2 + 4 / 2,
        2: 4.0,
        3: 8 + 16 / 2 + 40 / 4,  # runs into the time limit, which keeps the bootstrap
        4: 16 + 40 / 2,
    }
    assert set(sample.indices.tolist()) == set(wanted)
    assert targets.tolist() == pytest.approx([wanted[i] for i in sample.indices.tolist()], abs=1e-5)


def gradient_by_hand(q: Any, s: Tensor, a: Tensor, targets: Tensor, weight: Tensor, loss: str) -> Tensor:
    error = q.all(s).gather(-1, a[:, None])[:, 0] - targets
    size = error.abs()
    each = 0.5 * error**2 if loss == "squared" else torch.where(size <= 1, 0.5 * error**2, size - 0.5)
    grads = torch.autograd.grad((weight * each).sum() / len(targets), list(q.parameters()))
    return torch.cat([g.reshape(-1) for g in grads])


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("loss", ["squared", "huber"])
@pytest.mark.parametrize("kind", ["auto", "torch"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_update_is_the_weighted_gradient_step(layout: str, kind: str, loss: str, weighted: bool) -> None:
    learner = learner_of(engine_of(layout, loss, kind), loss=loss)
    online, _ = two_networks(learner)
    t, before = batch(layout, BATCH), learner.engine.flat.values.clone()
    targets = learner.targets(t)
    weight = torch.from_numpy(np.random.default_rng(3).uniform(0, 2, BATCH)) if weighted else None
    seen = learner.update(t, weight)
    grad = gradient_by_hand(online, t.s_tm1, t.a_tm1, targets, torch.ones(BATCH) if weight is None else weight, loss)
    torch.testing.assert_close(learner.engine.flat.values, before - 0.3 * grad, rtol=0, atol=1e-12)
    predicted = online.at(t.s_tm1, t.a_tm1).detach()
    torch.testing.assert_close(seen.errors, targets - predicted, rtol=0, atol=1e-12)
    assert float(seen.errors.abs().max()) > 1  # Huber's line is reached


@pytest.mark.parametrize("layout", ["table", "action-output"])
def test_a_block_update_is_the_gradient_step_over_all_its_rows(layout: str) -> None:
    learner = learner_of(engine_of(layout), target_rule="peng", block_length=4)
    q, before = copy.deepcopy(learner.engine.q), learner.engine.flat.values.clone()
    t = batch(layout, 4, 3)
    targets = learner.targets(t).reshape(-1)
    weight = torch.arange(12.0, dtype=torch.float64).reshape(4, 3)
    learner.update(t, weight)
    grad = gradient_by_hand(q, t.s_tm1.flatten(0, 1), t.a_tm1.reshape(-1), targets, weight.reshape(-1), "squared")
    torch.testing.assert_close(learner.engine.flat.values, before - 0.3 * grad, rtol=0, atol=1e-12)


@pytest.mark.parametrize("layout", ["table", "separate"])
def test_the_target_network_is_renewed_at_its_period(layout: str) -> None:
    learner = learner_of(engine_of(layout), target_period_updates=3)
    t = batch(layout, BATCH)
    old = copy.deepcopy(learner.engine.q)
    for count in range(1, 8):
        with torch.no_grad():
            wanted = t.r_t + t.discount_t * old.all(t.s_t).amax(-1)
        torch.testing.assert_close(learner.targets(t), wanted, rtol=0, atol=1e-12)
        learner.update(t)
        if count % 3 == 0:
            old = copy.deepcopy(learner.engine.q)


def test_prioritised_samples_bring_weights_that_shrink_their_gradient() -> None:
    # A table with one row per pair: an entry moves by α · weight · error / B, summed over the times it was drawn.
    buffer = ReplayBuffer(8, (), np.int64, prioritised=Prioritised(alpha=1.0, beta=1.0, epsilon=1e-12))
    for s in range(4):
        buffer.add_step(0, np.int64(s), 0, 1.0, float(s), 0.0, np.int64(s), True)  # type: ignore[arg-type]
    buffer.update_priorities(np.arange(4), np.array([1.0, 1.0, 1.0, 5.0]))
    sample = buffer.sample(64, np.random.default_rng(0))
    engine = make_engine(TableQ(4, 1), Loss())
    learner_of(engine, prioritised=True, learning_rate=1.0).update(sample.transition, sample.weights)
    weight = {0: 1.0, 1: 1.0, 2: 1.0, 3: 0.2}  # (N · p)^-1 relative to the largest
    counts = np.bincount(sample.indices, minlength=4)
    wanted = [counts[s] * weight[s] * s / 64 for s in range(4)]
    np.testing.assert_allclose(engine.flat.values.numpy(), wanted, atol=1e-6)
    assert counts[3] > 30


def test_a_saved_learner_goes_on_bit_for_bit() -> None:
    one = learner_of(engine_of("action-input"), optimiser="adam", target_period_updates=4)
    t = batch("action-input", BATCH)
    for _ in range(3):
        one.update(t)
    two = learner_of(engine_of("action-input"), optimiser="adam", target_period_updates=4)
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    for _ in range(3):
        one.update(t)
        two.update(t)
    assert torch.equal(one.engine.flat.values, two.engine.flat.values)
    assert torch.equal(one.targets(t), two.targets(t))


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"target_rule": "peng"}, "need blocks of at least 2 rows"),
        ({"block_length": 4}, "need blocks of at least 2 rows"),
        ({"target_rule": "peng", "block_length": 4, "num_steps": 2}, "leave num_steps=1"),
        ({"target_rule": "peng", "block_length": 4, "prioritised": True}, "prioritised=False"),
        ({"target_rule": "peng", "block_length": 65}, "holds no block of block_length=65"),
        ({"target_rule": "peng", "block_length": 8, "learning_starts": 7}, "learning_starts=7 steps .* hold no block"),
        ({"target_rule": "peng", "block_length": 8, "num_envs": 4, "capacity": 31}, "capacity=31 steps .* at least 32"),
        ({"loss": "log-cosh"}, "loss"),
        ({"lambda_": -0.5}, "lambda_"),
        ({"batch_size": 0}, "batch_size"),
    ],
)
def test_contradictions_are_refused(given: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        ReplaySettings(**given)

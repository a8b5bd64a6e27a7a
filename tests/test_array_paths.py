"""What goes from arrays to arrays gives the bits of what goes through tensors, and refuses what that would refuse.

Acting, targets and gradients have a way of their own for compiled networks on plain observations, because tensors of a
few numbers cost more than the arithmetic. The way through tensors is the oracle.

Mutants that die here, each tried: target values from the live parameters; another draw, ε or order of draws; the weight
left out; arrays of an earlier batch learned from; an update that is not counted, so that the target copy is late;
samples that do not pair up; observations read as they lie when they have gaps or another type.
"""

from __future__ import annotations

import copy
from dataclasses import fields, replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from neuralq.learners import ReplayLearner, ReplaySettings, RolloutLearner, RolloutSettings
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, MaskedQ, SeparateQ, TableQ
from neuralq.q.compiled import MlpEngine, array_values, make_engine, on_arrays
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.inputs import OneHot
from neuralq.runs.stream import Interaction
from neuralq.runs.stream.acting import EpsilonGreedyPolicy
from neuralq.types import Transition

DTYPES = (torch.float32, torch.float64)
D, A, B = 4, 3, 9


def _engine(layout: Any = ActionOutputQ, dtype: torch.dtype = torch.float32, hidden: Any = (40, 7)) -> MlpEngine:
    return MlpEngine(layout((D,), A, MLP(hidden, True), rng=1, dtype=dtype), Loss("huber"))


def _batch(seed: int, *lead: int, dtype: torch.dtype = torch.float32) -> Transition:
    rng = np.random.default_rng(seed)
    s, s_t, r, discount = (torch.from_numpy(rng.standard_normal((*lead, *x))).to(dtype) for x in ((D,), (D,), (), ()))
    a, last = torch.from_numpy(rng.integers(A, size=lead)), torch.from_numpy(rng.random(lead) < 0.2)
    return Transition(s, a, torch.ones(lead, dtype=dtype), r, discount.abs().clamp(max=1), s_t, last)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("layout", [ActionInputQ, SeparateQ, ActionOutputQ])
@pytest.mark.slow
def test_values_and_gradients_are_those_of_tensors(layout: Any, dtype: torch.dtype) -> None:
    engine, t = _engine(layout, dtype), _batch(0, B, dtype=dtype)
    engine.sync_target()
    engine.flat.values.mul_(1.1)
    s, a, r = t.s_tm1.numpy(), t.a_tm1.numpy(), t.r_t.numpy()
    values = array_values(engine)
    assert values is not None
    for given in (s, s[::2], np.asfortranarray(s), s.astype(np.float16), s[:0], np.broadcast_to(s[0], (3, D))):
        assert values(given).tobytes() == engine.all(torch.from_numpy(given.copy())).numpy().tobytes()
        same = engine.all(torch.from_numpy(given.copy()), target=True).numpy()
        assert engine.all_arrays(given, target=True).tobytes() == same.tobytes()
    for weight in (None, np.linspace(0, 2, B).astype(r.dtype)):
        errors = engine.loss_gradient_arrays(s, a, r, weight)
        gradient = engine.flat.grad.clone()
        wanted = engine.loss_gradient(t.s_tm1, t.a_tm1, t.r_t, None if weight is None else torch.from_numpy(weight))
        assert errors.tobytes() == wanted.numpy().tobytes() and torch.equal(gradient, engine.flat.grad)


def test_wrong_arrays_are_refused() -> None:
    engine, t = _engine(), _batch(0, B)
    s, a, r = t.s_tm1.numpy(), t.a_tm1.numpy(), t.r_t.numpy()
    with pytest.raises(ValueError, match="sync_target"):
        engine.all_arrays(s, target=True)
    for wrong in (s[:, :3], s[0, :3], np.zeros((B, D, 1), np.float32)):
        with pytest.raises(ValueError, match=r"observations of shape \(4,\)"):
            engine.all_arrays(np.ascontiguousarray(wrong))
    for arrays in ((s, a[:3], r), (s, a, r[:3]), (s[:3], a, r), (s, a, r, r[:3])):
        with pytest.raises(ValueError, match="must pair up"):
            engine.loss_gradient_arrays(*arrays)
    with pytest.raises(ValueError, match=r"actions must lie in 0\.\.2, got 3"):
        engine.loss_gradient_arrays(s, a * 0 + 3, r)


def test_only_compiled_networks_on_plain_observations_have_the_quick_way() -> None:
    plain = ActionOutputQ((D,), A, MLP((5,)))
    coded = ActionOutputQ((5,), A, MLP((5,)), features=OneHot(5))
    for q in (TableQ(3, 2), MaskedQ(ActionOutputQ((D,), A, MLP((5,))), (D,)), coded):
        engine = make_engine(q, Loss())
        assert on_arrays(engine) is None and array_values(engine) is None
    assert on_arrays(TorchEngine(copy.deepcopy(plain), Loss())) is None
    compiled = make_engine(plain, Loss())
    assert on_arrays(compiled) is compiled


def test_a_policy_on_arrays_takes_the_actions_of_the_one_on_tensors() -> None:
    engine = MlpEngine(ActionOutputQ((4,), 2, MLP((40,)), rng=3), Loss())
    seen = []
    for values in (None, array_values(engine)):
        epsilons = iter(np.linspace(1, 0, 300))
        policy = EpsilonGreedyPolicy(engine.all, lambda e=epsilons: next(e), np.random.default_rng(7), values)
        assert (policy.on_arrays is None) == (values is None)
        stream = Interaction(gymnasium.make_vec("CartPole-v1", num_envs=3), 0.9, seed=5)
        seen.append([stream.step(policy) for _ in range(300)])
    for ours, theirs in zip(*seen, strict=True):
        assert ours.episodes == theirs.episodes
        assert [row.tobytes() for row in ours.rows] == [row.tobytes() for row in theirs.rows]
        assert [row.dtype for row in ours.rows] == [row.dtype for row in theirs.rows]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("weighted", [False, True])
def test_a_replay_learner_learns_the_same(weighted: bool, dtype: torch.dtype) -> None:
    settings = ReplaySettings(target_period_updates=3, max_grad_norm=0.1)
    quick, slow = (ReplayLearner(_engine(dtype=dtype), settings, reward_scale=0.5) for _ in range(2))
    slow._descent.on_arrays = None
    reused = _batch(99, B, dtype=dtype)
    for step in range(8):
        fresh = _batch(step, B, dtype=dtype)
        if step % 4 == 3:  # new tensors; else those of before with other numbers in them, as a replay buffer does
            reused = fresh
        for one in fields(Transition):
            getattr(reused, one.name).copy_(getattr(fresh, one.name))
        weight = torch.linspace(0, 1, B) if weighted else None
        ours, theirs = quick.update(reused, weight), slow.update(fresh, weight)
        assert torch.equal(ours.errors, theirs.errors) and torch.equal(ours.targets, theirs.targets)
        assert torch.equal(quick.engine.flat.values, slow.engine.flat.values)
        assert torch.equal(quick.engine.target_values(), slow.engine.target_values())
    assert quick.num_updates == slow.num_updates == 8 and quick._seen_arrays is not None and slow._seen_arrays is None


def test_batches_that_do_not_pair_up_are_refused_as_before() -> None:
    learner, t = ReplayLearner(_engine(), ReplaySettings()), _batch(0, B)
    for name in ("a_tm1", "s_tm1", "s_t", "r_t", "discount_t"):
        with pytest.raises((ValueError, RuntimeError)):
            learner.update(replace(t, **{name: getattr(t, name)[:3]}))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_rollout_learner_learns_the_same(dtype: torch.dtype) -> None:
    settings = RolloutSettings(
        num_envs=3, num_steps=7, num_epochs=2, num_minibatches=4, refresh_targets=True, average_updates=2.0,
        target_period_updates=2,
    )  # fmt: skip
    learners = [RolloutLearner(_engine(dtype=dtype), settings, np.random.default_rng(0)) for _ in range(2)]
    learners[1]._descent.on_arrays = None
    for step in range(4):
        held = torch.ones(7, 3)
        if step == 2:
            held[1, 2] = held[6, 0] = 0
        updates = [learner.update(_batch(step, 7, 3, dtype=dtype), held if step > 1 else None) for learner in learners]
        assert torch.equal(updates[0].errors, updates[1].errors) and torch.equal(updates[0].targets, updates[1].targets)
        assert torch.equal(learners[0].evaluation_parameters(), learners[1].evaluation_parameters())
        assert torch.equal(learners[0].engine.flat.values, learners[1].engine.flat.values)
    nothing = learners[0].update(_batch(9, 7, 3, dtype=dtype), torch.zeros(7, 3))
    assert len(nothing.errors) == 21  # no row is experience: nothing is learned
    assert torch.equal(learners[0].engine.flat.values, learners[1].engine.flat.values)

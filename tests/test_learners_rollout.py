"""The rollout learner against sums written from the chapter's definition, for every representation.

Mutants that these tests kill: the bootstrap of the second-to-last row read from the last state; λ cut in the row of the
exploring action instead of the row before; truncation treated as termination; λ mixed across `last_t`; the rollout's
edge not bootstrapped; rows of weight 0 in the mean; targets recomputed with the new parameters; the target copy synced
one rollout late. `test_planted_mistakes_are_told_from_the_definition` plants the first five.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.learners import RolloutLearner, RolloutSettings
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, LinearQ, SeparateQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Engine, Loss
from neuralq.types import Transition

LAYOUTS = ["table", "linear", "action-input", "separate", "action-output"]
NETWORKS = {"action-input": ActionInputQ, "separate": SeparateQ, "action-output": ActionOutputQ}
NUM_STATES, NUM_ACTIONS = 7, 3
T, N = 9, 3
FEATURES = torch.from_numpy(np.random.default_rng(5).normal(size=(NUM_STATES, 4)))
SCENARIOS = ["edge", "termination", "truncation", "exploring", "everything"]


def engine_of(layout: str, kind: str = "auto") -> Engine:
    rng = np.random.default_rng(1)
    q: Any
    if layout == "table":
        q = TableQ(NUM_STATES, NUM_ACTIONS)
    elif layout == "linear":
        q = LinearQ(4, NUM_ACTIONS)
    else:
        q = NETWORKS[layout]((4,), NUM_ACTIONS, MLP((6,), activation="tanh"), rng=rng, dtype=torch.float64)
    engine = make_engine(q, Loss(), kind)
    engine.flat.values.copy_(torch.from_numpy(rng.normal(size=engine.flat.values.shape)))
    return engine


def observe(layout: str, states: Tensor) -> Tensor:
    return states if layout == "table" else FEATURES[states]


def rollout(layout: str, engine: Engine, scenario: str) -> Transition:
    """A rollout in which only the named thing happens; discounts vary from row to row."""
    rng = np.random.default_rng(SCENARIOS.index(scenario))
    everything = scenario == "everything"
    states = rng.integers(NUM_STATES, size=(T + 1, N))
    s_tm1, s_t = torch.from_numpy(states[:-1]), torch.from_numpy(rng.integers(NUM_STATES, size=(T, N)))
    last = np.zeros((T, N), bool)
    discount = rng.uniform(0.5, 1.0, (T, N))
    if scenario == "termination" or everything:
        last[2, 0] = last[T - 1, 1] = True
        discount[last] = 0
    if scenario == "truncation" or everything:
        last[4, 0] = last[4, 2] = last[5, 2] = True
    goes_on = torch.from_numpy(~last[:-1])
    s_t[:-1] = torch.where(goes_on, s_tm1[1:], s_t[:-1])
    a = engine.all(observe(layout, s_tm1)).argmax(-1)
    if scenario == "exploring" or everything:
        explores = torch.zeros(T, N, dtype=torch.bool)
        for t, env_index in ((0, 1), (3, 0), (3, 1), (7, 2), (8, 2)):
            explores[t, env_index] = True
        a = torch.where(explores, (a + 1) % NUM_ACTIONS, a)
    r = torch.from_numpy(rng.normal(size=(T, N)))
    one = torch.ones(T, N, dtype=torch.float64)
    d, end = torch.from_numpy(discount), torch.from_numpy(last)
    return Transition(observe(layout, s_tm1), a, one, r, d, observe(layout, s_t), end)


def defined_return(
    t: Transition, q: Any, lambda_: float, watkins: bool, row: int, env_index: int, plant: str = ""
) -> float:
    """(1-λ) Σ λⁿ⁻¹ Q⁽ⁿ⁾ + λᴺ⁻¹ Q⁽ᴺ⁾, N where the stream breaks, an exploring action follows or the rollout ends."""

    def value(k: int) -> float:
        source = min(k + 1, T - 1) if plant == "wrong bootstrap" and k == T - 2 else k
        return float(q.all(t.s_t[source, env_index]).max())

    def explores(k: int) -> bool:
        values = q.all(t.s_tm1[k, env_index])
        return bool(values[t.a_tm1[k, env_index]] < values.max())

    total, so_far, factor, weight, k = 0.0, 0.0, 1.0, 1.0, row
    while True:
        discount, last = float(t.discount_t[k, env_index]), bool(t.last_t[k, env_index])
        if plant == "truncation as termination" and last:
            discount = 0.0
        so_far += factor * float(t.r_t[k, env_index])
        factor *= discount
        n_step = so_far + factor * value(k)
        cut = k == T - 1 or (last and plant != "across last")
        if watkins and not cut:
            cut = explores(k + 1) if plant != "late cut" else explores(k) and k > row
        if cut:
            edge = plant == "edge not bootstrapped" and k == T - 1
            return total + weight * (so_far if edge else n_step)
        total += weight * (1 - lambda_) * n_step
        weight *= lambda_
        k += 1


@torch.no_grad()
def defined_returns(t: Transition, q: Any, lambda_: float, watkins: bool, plant: str = "") -> Tensor:
    rows = [[defined_return(t, q, lambda_, watkins, i, j, plant) for j in range(N)] for i in range(T)]
    return torch.tensor(rows, dtype=torch.float64)


def settings_with(**given: Any) -> RolloutSettings:
    values: dict[str, Any] = {
        "lambda_": 0.7, "num_envs": N, "num_steps": T, "num_epochs": 1, "num_minibatches": 1,
        "optimiser": "sgd", "learning_rate": 0.3, "max_grad_norm": None,
    }  # fmt: skip
    return RolloutSettings(**(values | given))


def learner_of(engine: Engine, **given: Any) -> RolloutLearner:
    return RolloutLearner(engine, settings_with(**given), np.random.default_rng(0))


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("returns", ["peng", "watkins"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_targets_equal_the_definition(layout: str, returns: str, scenario: str) -> None:
    engine = engine_of(layout)
    t = rollout(layout, engine, scenario)
    targets = learner_of(engine, returns=returns).targets(t)
    wanted = defined_returns(t, copy.deepcopy(engine.q), 0.7, returns == "watkins")
    torch.testing.assert_close(targets, wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("plant", "scenario"),
    [
        ("wrong bootstrap", "edge"),
        ("edge not bootstrapped", "edge"),
        ("late cut", "exploring"),
        ("truncation as termination", "truncation"),
        ("across last", "truncation"),
    ],
)
def test_planted_mistakes_are_told_from_the_definition(plant: str, scenario: str) -> None:
    engine = engine_of("action-output")
    t = rollout("action-output", engine, scenario)
    targets = learner_of(engine, returns="watkins").targets(t)
    wrong = defined_returns(t, engine.q, 0.7, True, plant)
    assert float((targets - wrong).abs().max()) > 1e-3


def test_peng_and_watkins_differ_only_where_an_action_explored() -> None:
    engine = engine_of("linear")
    greedy, exploring = rollout("linear", engine, "edge"), rollout("linear", engine, "exploring")
    for t, same in ((greedy, True), (exploring, False)):
        peng, watkins = (learner_of(engine, returns=x).targets(t) for x in ("peng", "watkins"))
        assert torch.equal(peng, watkins) == same


def gradient_by_hand(q: Any, s: Tensor, a: Tensor, targets: Tensor, weight: Tensor | None = None) -> Tensor:
    weight = torch.ones_like(targets) if weight is None else weight
    loss = (weight * 0.5 * (q.all(s).gather(-1, a[:, None])[:, 0] - targets) ** 2).sum() / len(targets)
    parameters = list(q.parameters())
    return torch.cat([g.reshape(-1) for g in torch.autograd.grad(loss, parameters)])


@pytest.mark.parametrize("kind", ["auto", "torch"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_epoch_of_one_minibatch_is_one_gradient_step(layout: str, kind: str) -> None:
    engine = engine_of(layout, kind)
    t = rollout(layout, engine, "everything")
    q, before = copy.deepcopy(engine.q), engine.flat.values.clone()
    targets = defined_returns(t, q, 0.7, False).reshape(-1)
    learner_of(engine).update(t)
    grad = gradient_by_hand(q, t.s_tm1.flatten(0, 1), t.a_tm1.reshape(-1), targets)
    torch.testing.assert_close(engine.flat.values, before - 0.3 * grad, rtol=0, atol=1e-12)


@pytest.mark.parametrize("layout", ["table", "action-output"])
def test_targets_stay_those_of_the_collecting_parameters_through_all_epochs(layout: str) -> None:
    engine = engine_of(layout)
    t = rollout(layout, engine, "everything")
    q = copy.deepcopy(engine.q)
    targets = defined_returns(t, q, 0.7, False).reshape(-1)
    learner_of(engine, num_epochs=3).update(t)
    flat = torch.cat([p.detach().reshape(-1) for p in q.parameters()])
    for _ in range(3):
        torch.nn.utils.vector_to_parameters(flat, q.parameters())  # type: ignore[attr-defined]
        flat = flat - 0.3 * gradient_by_hand(q, t.s_tm1.flatten(0, 1), t.a_tm1.reshape(-1), targets)
    torch.testing.assert_close(engine.flat.values, flat, rtol=0, atol=1e-11)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_rows_of_weight_zero_have_no_influence(layout: str) -> None:
    # Rows (5, 0) and (6, 2) follow a break and are no experience, as in NEXT_STEP's restarts.
    ends = []
    for garbage in (0.0, 1e6):
        engine = engine_of(layout)
        t = rollout(layout, engine, "everything")
        weight = torch.ones(T, N)
        for row, env_index in ((5, 0), (6, 2)):
            weight[row, env_index] = 0
            t.r_t[row, env_index] = garbage
            t.discount_t[row, env_index], t.last_t[row, env_index] = 0.0, True
            t.s_tm1[row, env_index] = t.s_tm1[row, env_index] * (0 if garbage else 1)
        q, before = copy.deepcopy(engine.q), engine.flat.values.clone()
        targets = defined_returns(t, q, 0.7, False)
        learner_of(engine).update(t, weight)
        held = weight.reshape(-1) > 0
        rows = t.s_tm1.flatten(0, 1)[held], t.a_tm1.reshape(-1)[held], targets.reshape(-1)[held]
        torch.testing.assert_close(engine.flat.values, before - 0.3 * gradient_by_hand(q, *rows), rtol=0, atol=1e-12)
        ends.append(engine.flat.values.clone())
    assert torch.equal(*ends)


def test_every_row_is_used_once_per_epoch_whatever_the_minibatches() -> None:
    # On a table with one row per pair, an epoch moves each entry once by α/size of its minibatch.
    engine = make_engine(TableQ(T * N, 1), Loss())
    s = torch.arange(T * N).reshape(T, N)
    one = torch.ones(T, N, dtype=torch.float64)
    t = Transition(s, 0 * s, one, one, 0 * one, s, one > 0)
    learner_of(engine, num_minibatches=3, learning_rate=1.0).update(t)
    torch.testing.assert_close(engine.flat.values, torch.full((T * N,), 1 / 9, dtype=torch.float64))


@pytest.mark.parametrize("layout", ["table", "linear", "separate"])
def test_the_target_copy_is_renewed_at_its_period(layout: str) -> None:
    engine = engine_of(layout)
    t = rollout(layout, engine, "everything")
    learner = learner_of(engine, target_period_updates=2, returns="peng")
    old = copy.deepcopy(engine.q)
    for count in range(1, 6):
        wanted = defined_returns(t, old, 0.7, False)
        torch.testing.assert_close(learner.targets(t), wanted, rtol=0, atol=1e-10)
        learner.update(t)
        if count % 2 == 0:
            old = copy.deepcopy(engine.q)
    assert learner.num_updates == 5


def test_reward_scale_and_annealing() -> None:
    engine = make_engine(TableQ(2, 1), Loss())
    one = torch.ones(1, 1, dtype=torch.float64)
    t = Transition(torch.tensor([[0]]), torch.tensor([[0]]), one, 8 * one, 0 * one, torch.tensor([[1]]), one > 0)
    settings = settings_with(num_envs=1, num_steps=1, learning_rate=0.5)
    learner = RolloutLearner(engine, settings, np.random.default_rng(0), reward_scale=0.25, total_updates=2)
    learner.update(t)
    assert engine.flat.values.tolist() == [1.0, 0.0]  # half way to 8 · 0.25
    learner.update(t)
    assert engine.flat.values.tolist() == [1.25, 0.0]  # the rate has fallen to a half
    learner.update(t)
    assert engine.flat.values.tolist() == [1.25, 0.0]  # and to nothing


def rates_of(learner: RolloutLearner, t: Transition, weights: list[Tensor | None]) -> list[float]:
    """The share of the learning rate with which each rollout is fitted."""
    seen: list[float] = []
    fit = learner._descent.fit
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learner._descent, "fit", lambda s, a, y, w, scale: seen.append(scale) or fit(s, a, y, w, scale))
        for weight in weights:
            learner.update(t, weight)
    return seen


def test_a_schedule_of_steps_counts_steps_and_not_the_rows_in_which_an_environment_waits() -> None:
    t = rollout("action-output", engine_of("action-output"), "everything")
    held = torch.zeros_like(t.r_t, dtype=torch.float32).flatten()
    held[: len(held) // 3] = 1  # 9 of 27 rows, as where most environments wait for their reset
    settings = settings_with(num_envs=t.r_t.shape[1], num_steps=t.r_t.shape[0])

    def fresh() -> RolloutLearner:
        return RolloutLearner(engine_of("action-output"), settings, np.random.default_rng(0), total_updates=2)

    thin = held.view_as(t.r_t)
    assert rates_of(fresh(), t, [thin] * 7) == pytest.approx([1, 5 / 6, 4 / 6, 3 / 6, 2 / 6, 1 / 6, 0], abs=1e-12)
    assert rates_of(fresh(), t, [None, thin, thin, None]) == pytest.approx([1, 1 / 2, 1 / 3, 1 / 6], abs=1e-12)
    # A run goes on where it was; one of before steps were counted had no rows without them.
    one, old = fresh(), fresh()
    rates_of(one, t, [None, thin])
    state = one.state_dict()
    old.load_state_dict(copy.deepcopy(state))
    assert rates_of(old, t, [thin]) == pytest.approx([1 / 3])
    del state["num_steps"]
    state["num_updates"] = 1
    older = fresh()
    older.load_state_dict(state)
    assert rates_of(older, t, [thin]) == [0.5]


@pytest.mark.parametrize("optimiser", ["sgd", "adam", "radam"])
def test_a_saved_learner_goes_on_bit_for_bit(optimiser: str) -> None:
    def fresh() -> RolloutLearner:
        return learner_of(engine_of("action-output"), optimiser=optimiser, target_period_updates=2, num_minibatches=2)

    one, two = fresh(), fresh()
    t = rollout("action-output", one.engine, "everything")
    for _ in range(3):
        one.update(t)
    state = copy.deepcopy(one.state_dict())
    two.load_state_dict(state)
    two.rng.bit_generator.state = one.rng.bit_generator.state
    for learner in (one, two):
        for _ in range(3):
            learner.update(t)
    assert torch.equal(one.engine.flat.values, two.engine.flat.values)
    assert one.num_updates == two.num_updates == 6


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"lambda_": 1.5}, "lambda_"),
        ({"returns": "retrace"}, "returns"),
        ({"num_minibatches": 1000}, "exceeds the 27 samples"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"optimiser": "lion"}, "optimiser"),
        ({"target_period_updates": 0}, "target_period_updates"),
    ],
)
def test_contradictions_are_refused(given: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        settings_with(**given)

"""QR-DQN, C51 and dueling networks: outputs, targets and gradients by hand, and the exact answer on a chain.

Mutants that were tried, and die: the successor's action chosen by the first atom and not by the mean; targets from the
online network; the reward scale left out; weights dropped; the target copy renewed at
another update; illegal actions let through; V − A, or V + A without the mean, in the dueling heads; atoms and actions
exchanged in the order of the outputs.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq import rules
from neuralq.learners import DistributionalLearner, ReplayLearner, ReplaySettings
from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.q import MLP, ActionOutputQ, CategoricalQ, Conv, DuelingQ, LinearQ, MaskedQ, QuantileQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.distributional import atoms, distribution_of
from neuralq.q.engine import Loss, TorchEngine
from neuralq.types import Transition

F64 = torch.float64
NUM_STATES, NUM_ACTIONS, NUM_ATOMS, BATCH = 6, 3, 5, 9
RANGE = {"value_min": -2.0, "value_max": 3.0}
SETTINGS: dict[str, dict[str, Any]] = {
    "quantile": {"distribution": "quantile", "num_atoms": NUM_ATOMS},
    "categorical": {"distribution": "categorical", "num_atoms": NUM_ATOMS, **RANGE},
}


def wrapped(kind: str, inner: Any) -> Any:
    return QuantileQ(inner, NUM_ATOMS) if kind == "quantile" else CategoricalQ(inner, NUM_ATOMS, **RANGE)


def network(kind: str, masked: bool = False) -> Any:
    inner = ActionOutputQ((4,), NUM_ACTIONS * NUM_ATOMS, MLP((6,), activation="tanh"), rng=1, dtype=F64)
    q = wrapped(kind, inner)
    return MaskedQ(q, (4,)) if masked else q


def learner_of(q: Any, kind: str, **given: Any) -> DistributionalLearner:
    values: dict[str, Any] = {"optimiser": "sgd", "learning_rate": 0.3, "max_grad_norm": None}
    return DistributionalLearner(TorchEngine(q, Loss()), ReplaySettings(**(values | SETTINGS[kind] | given)), 0.5)


def batch(masked: bool = False) -> Transition:
    rng = np.random.default_rng(4)
    s, s_t = (torch.from_numpy(rng.normal(size=(BATCH, 4))) for _ in range(2))
    a = torch.from_numpy(rng.integers(NUM_ACTIONS, size=BATCH))
    r, last = torch.from_numpy(2 * rng.normal(size=BATCH)), torch.from_numpy(rng.random(BATCH) < 0.3)
    if masked:
        legal = torch.from_numpy(rng.random((2, BATCH, NUM_ACTIONS)) < 0.5).to(F64)
        legal[0].scatter_(-1, a[:, None], 1.0)
        legal[1, :, 0] = 1.0
        legal[1, last] = 0.0  # nothing can be done in a terminal state
        s, s_t = torch.cat([s, legal[0]], -1), torch.cat([s_t, legal[1]], -1)
    return Transition(s, a, torch.ones(BATCH), r, torch.where(last, 0.0, 0.9), s_t, last)


def two_networks(learner: DistributionalLearner) -> tuple[Any, Any]:
    target = copy.deepcopy(learner.engine.q)
    noise = np.random.default_rng(7).normal(size=learner.engine.flat.values.shape)
    learner.engine.flat.values.add_(torch.from_numpy(noise))
    return copy.deepcopy(learner.engine.q), target


@pytest.mark.parametrize("kind", SETTINGS)
@torch.no_grad()
def test_the_outputs_are_the_inner_functions_action_by_action_and_the_value_is_their_mean(kind: str) -> None:
    q = network(kind)
    s = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 3, 4)))
    raw, values, outputs = q.inner.all(s).numpy(), q.all(s), q.outputs(s).numpy()
    for i in np.ndindex(2, 3):
        for a in range(NUM_ACTIONS):
            numbers = raw[i][a * NUM_ATOMS : (a + 1) * NUM_ATOMS]
            np.testing.assert_array_equal(outputs[i][a], numbers)
            weight = np.full(5, 0.2) if kind == "quantile" else np.exp(numbers) / np.exp(numbers).sum()
            support = numbers if kind == "quantile" else np.array([-2.0, -0.75, 0.5, 1.75, 3.0])
            assert float(values[i][a]) == pytest.approx(float(weight @ support))
    action = torch.from_numpy(np.random.default_rng(1).integers(NUM_ACTIONS, size=(2, 3)))
    torch.testing.assert_close(q.at(s, action), values.gather(-1, action[..., None])[..., 0])


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("rule", ["q_learning", "double"])
@pytest.mark.parametrize("kind", SETTINGS)
@torch.no_grad()
def test_targets_follow_the_action_with_the_best_mean(kind: str, rule: str, masked: bool) -> None:
    learner = learner_of(network(kind, masked), kind, target_rule=rule)
    online, target = two_networks(learner)
    t = batch(masked)
    got = learner.targets(t).numpy()
    for i in range(BATCH):
        chooser = online if rule == "double" else target
        best = int(np.argmax(chooser.all(t.s_t[i]).numpy()))
        numbers = atoms(target, t.s_t[i]).numpy()[best]
        r, gamma = 0.5 * float(t.r_t[i]), float(t.discount_t[i])
        if kind == "quantile":
            np.testing.assert_allclose(got[i], r + gamma * numbers, atol=1e-12)
        else:
            support = torch.linspace(-2, 3, NUM_ATOMS, dtype=F64)
            mass = torch.softmax(torch.from_numpy(numbers), -1)
            wanted = rules.categorical_projection(r + gamma * support, mass, support)
            np.testing.assert_allclose(got[i], wanted.numpy(), atol=1e-12)


@pytest.mark.parametrize("masked", [False, True])
@torch.no_grad()
def test_munchausen_quantiles_have_the_munchausen_target_for_their_mean(masked: bool) -> None:
    numbers = {"temperature": 0.4, "munchausen_alpha": 0.7, "munchausen_floor": -0.6}
    learner = learner_of(network("quantile", masked), "quantile", target_rule="munchausen", **numbers)
    _, target = two_networks(learner)
    t = batch(masked)
    got = learner.targets(t)
    q_tm1, q_t = target.all(t.s_tm1), target.all(t.s_t)
    wanted = rules.munchausen(0.5 * t.r_t, t.discount_t, q_tm1, t.a_tm1, q_t, 0.4, 0.7, -0.6)
    torch.testing.assert_close(got.mean(-1), wanted, rtol=0, atol=1e-12)
    mixed = torch.einsum("ba,bak->bk", rules.softmax(q_t, 0.4), atoms(target, t.s_t))
    spread = t.discount_t[:, None] * (mixed - mixed.mean(-1, keepdim=True))
    torch.testing.assert_close(got - got.mean(-1, keepdim=True), spread, rtol=0, atol=1e-12)


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("kind", SETTINGS)
def test_an_update_is_the_weighted_gradient_step(kind: str, weighted: bool) -> None:
    learner = learner_of(network(kind), kind)
    online, _ = two_networks(learner)
    t, before = batch(), learner.engine.flat.values.clone()
    targets = learner.targets(t)
    weight = torch.from_numpy(np.random.default_rng(3).uniform(0, 2, BATCH)) if weighted else None
    total: Any = 0
    for i in range(BATCH):
        numbers = online.inner.all(t.s_tm1[i]).reshape(NUM_ACTIONS, NUM_ATOMS)[t.a_tm1[i]]
        if kind == "quantile":
            each = rules.quantile_huber(numbers, targets[i])
        else:
            each = -(targets[i] * torch.log_softmax(numbers, -1)).sum()
        total = total + each * (1.0 if weight is None else weight[i]) / BATCH
    grad = torch.cat([g.reshape(-1) for g in torch.autograd.grad(total, list(online.parameters()))])
    seen = learner.update(t, weight)
    torch.testing.assert_close(learner.engine.flat.values, before - 0.3 * grad, rtol=0, atol=1e-12)
    aim = targets.mean(-1) if kind == "quantile" else targets @ torch.linspace(-2, 3, NUM_ATOMS, dtype=F64)
    torch.testing.assert_close(seen.errors, aim - online.at(t.s_tm1, t.a_tm1).detach(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", SETTINGS)
def test_the_target_network_is_renewed_at_its_period_and_a_saved_learner_goes_on(kind: str) -> None:
    one, two = (learner_of(network(kind), kind, optimiser="adam", target_period_updates=3) for _ in range(2))
    t, old = batch(), copy.deepcopy(one.engine.q)
    for count in range(1, 8):
        with torch.no_grad():
            used = learner_of(copy.deepcopy(old), kind).targets(t)
        torch.testing.assert_close(one.targets(t), used, rtol=0, atol=1e-12)
        one.update(t)
        if count % 3 == 0:
            old = copy.deepcopy(one.engine.q)
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    for learner in (one, two):
        for _ in range(3):
            learner.update(t)
    assert torch.equal(one.engine.flat.values, two.engine.flat.values)
    assert torch.equal(one.targets(t), two.targets(t))


# The exact answer on a chain: 0 … 4, left and right, 1 for reaching 4, where it ends.

LENGTH, GAMMA = 5, 0.9
EXACT = np.array([[GAMMA ** (LENGTH - 1 - max(s - 1, 0)), GAMMA ** (LENGTH - 2 - s)] for s in range(LENGTH - 1)])


def chain_buffer(seed: int, wrong: bool = False) -> ReplayBuffer:
    """600 random steps; ``wrong`` gives every step the discount of the step before it."""
    rng = np.random.default_rng(seed)
    buffer, s, before = ReplayBuffer(600, (), np.int64), 0, GAMMA
    for _ in range(600):
        a = int(rng.integers(2))
        s_next = max(s - 1, 0) if a == 0 else s + 1
        end = s_next == LENGTH - 1
        discount = 0.0 if end else GAMMA
        given = before if wrong else discount
        buffer.add_step(0, np.int64(s), a, 0.5, float(end), given, np.int64(s_next), end)  # type: ignore[arg-type]
        s, before = (0 if end else s_next), discount
    return buffer


def learned(kind: str, seed: int, wrong: bool = False) -> Any:
    inner = TableQ(LENGTH, 2 * 5)
    if kind == "quantile":
        q: Any = QuantileQ(inner, 5)
        given: dict[str, Any] = {"learning_rate": 8.0, "optimiser": "sgd"}
    else:
        q = CategoricalQ(inner, 5, 0.0, 1.0)
        given = {"learning_rate": 0.1, "value_min": 0.0, "value_max": 1.0}
    given |= {"distribution": kind, "num_atoms": 5, "target_period_updates": 10, "max_grad_norm": None}
    learner = DistributionalLearner(TorchEngine(q, Loss()), ReplaySettings(**given))
    buffer, rng = chain_buffer(seed, wrong), np.random.default_rng(seed)
    for _ in range(400):
        learner.update(buffer.sample(64, rng).transition)
    return learner.engine.all(torch.arange(LENGTH - 1)).numpy()


BOUND = {"quantile": 1e-5, "categorical": 0.01}  # a logit of −∞ is only approached


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.parametrize("kind", SETTINGS)
def test_the_means_come_to_the_exact_values(kind: str, seed: int) -> None:
    assert np.abs(learned(kind, seed) - EXACT).max() < BOUND[kind]


@pytest.mark.parametrize("kind", SETTINGS)
def test_the_discount_of_the_step_before_is_noticed(kind: str) -> None:
    assert np.abs(learned(kind, 0, wrong=True) - EXACT).max() > 0.1


@pytest.mark.parametrize("kind", SETTINGS)
def test_the_distribution_of_a_coin_is_learned_and_not_its_mean_alone(kind: str) -> None:
    # One state, one action, 0 or 1 with equal chances: half of the quantiles at 0 and half at 1.
    coins, zero = torch.tensor([0.0, 1.0], dtype=torch.float64), torch.zeros(2, dtype=torch.int64)
    t = Transition(zero, zero, torch.ones(2), coins, 0 * coins, zero, coins < 9)
    given: dict[str, Any] = {"distribution": kind, "num_atoms": 4, "optimiser": "sgd", "learning_rate": 1.0}
    inner = TableQ(1, 4)
    if kind == "categorical":
        given |= {"value_min": -1.0, "value_max": 2.0}
    q: Any = QuantileQ(inner, 4) if kind == "quantile" else CategoricalQ(inner, 4, -1.0, 2.0)
    learner = DistributionalLearner(TorchEngine(q, Loss()), ReplaySettings(**given))
    for _ in range(600):
        learner.update(t)
    numbers = atoms(q, torch.tensor(0))[0].detach()
    if kind == "quantile":
        # Huber's parabola leaves expectiles of the coin: level τ lies at τ p / (τ p + (1 − τ)(1 − p)), p = ½: at τ.
        np.testing.assert_allclose(numbers.numpy(), [1 / 8, 3 / 8, 5 / 8, 7 / 8], atol=0.05)
    else:
        np.testing.assert_allclose(torch.softmax(numbers, -1).numpy(), [0, 0.5, 0.5, 0], atol=0.05)


@torch.no_grad()
def by_hand(q: DuelingQ, hidden: Tensor) -> Tensor:
    value, advantage = q.value(hidden)[0], q.advantage(hidden)[0]
    return torch.stack([value[:, 0] + advantage[:, a] - advantage.mean(-1) for a in range(NUM_ACTIONS)], -1)


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("hidden", [(7,), (6, 7), (5, 6, 7)])
@torch.no_grad()
def test_dueling_values_are_v_plus_a_minus_its_mean(hidden: tuple[int, ...], layer_norm: bool) -> None:
    q = DuelingQ((4,), NUM_ACTIONS, MLP(hidden, layer_norm=layer_norm, activation="tanh"), rng=2, dtype=F64)
    s = torch.from_numpy(np.random.default_rng(0).normal(size=(8, 4)))
    x = s[None]
    if q.shared is not None:
        assert q.shared.sizes == (4, *hidden[:-1])
        x = q.shared(x)
        x = torch.tanh(torch.nn.functional.layer_norm(x, x.shape[-1:]) if layer_norm else x)
    torch.testing.assert_close(q.all(s), by_hand(q, x), rtol=0, atol=1e-12)
    assert q.value.sizes[-2:] == (7, 1) and q.advantage.sizes[-2:] == (7, NUM_ACTIONS)
    a = torch.zeros(8, dtype=torch.int64)
    assert torch.equal(q.at(s, a), q.all(s)[:, 0])


@torch.no_grad()
def test_every_atom_duels_by_itself_and_convolutions_are_shared() -> None:
    q = DuelingQ((1, 5, 5), NUM_ACTIONS, Conv((3,), (3,), (1,), (7,)), rng=2, dtype=F64, num_atoms=NUM_ATOMS)
    s = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 1, 5, 5)))
    out = q.all(s).reshape(2, NUM_ACTIONS, NUM_ATOMS)
    value = q.value(q.input(s))[0]
    torch.testing.assert_close(out.mean(1), value)
    assert distribution_of(QuantileQ(q, NUM_ATOMS)).num_actions == NUM_ACTIONS


def test_a_dueling_network_learns_like_any_other_and_refuses_to_have_no_hidden_layer() -> None:
    engine = make_engine(DuelingQ((4,), NUM_ACTIONS, MLP((8, 8)), rng=2, dtype=F64), Loss("squared"))
    learner = ReplayLearner(engine, ReplaySettings(loss="squared", learning_rate=0.01))
    t = batch()
    first = float(learner.update(t).errors.abs().mean())
    for _ in range(300):
        last = float(learner.update(t).errors.abs().mean())
    assert last < 0.05 * first
    with pytest.raises(ValueError, match="need a hidden layer"):
        DuelingQ((4,), NUM_ACTIONS, MLP(()))


@pytest.mark.parametrize(
    ("call", "problem"),
    [
        (lambda: QuantileQ(TableQ(2, 5), 2), "no multiple of 2"),
        (lambda: CategoricalQ(TableQ(2, 5), 1, 0.0, 1.0), "num_atoms"),
        (lambda: CategoricalQ(TableQ(2, 4), 2, 1.0, 1.0), "value_min must lie below value_max"),
        (lambda: learner_of(network("quantile"), "categorical"), "do not go with a quantile representation"),
        (lambda: learner_of(network("quantile"), "quantile", num_atoms=4), "num_atoms=4 do not go"),
        (lambda: learner_of(LinearQ(4, 3), "quantile"), "LinearQ has no distribution"),
        (lambda: ReplayLearner(TorchEngine(TableQ(2, 2), Loss()), ReplaySettings(**SETTINGS["quantile"])), "frozen"),
    ],
)
def test_what_does_not_go_together_is_refused(call: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        call()


def test_an_illegal_action_in_experience_is_refused() -> None:
    learner = learner_of(network("quantile", masked=True), "quantile")
    t = batch(masked=True)
    t.s_tm1[2, 4 + int(t.a_tm1[2])] = 0
    with pytest.raises(ValueError, match="is illegal in row 2 of 9"):
        learner.update(t)

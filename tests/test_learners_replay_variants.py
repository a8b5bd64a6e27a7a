"""Munchausen, Retrace, tree backup, Q(λ) and DQRC from replay: targets, exact answers, refusals, recipes and resuming.

Mutants that were tried, and die: Munchausen's bonus or the corrected returns from the online network; π for μ in
Retrace; the maximum in place of the target policy's value; a target policy that is greedy for the coefficients and
ε-greedy for the values; DQRC's second function left out of a checkpoint, or begun from the values instead of 0 (in
tests/test_learners_dqrc.py); an illegal action with weight 0 whose error is infinite.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners import (
    DistributionalLearner,
    DQRCLearner,
    Parts,
    ReplayLearner,
    ReplaySettings,
    learner_kinds,
)
from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.q import (
    MLP,
    ActionOutputQ,
    CategoricalQ,
    DuelingQ,
    ImplicitQuantileQ,
    LinearQ,
    MaskedQ,
    QuantileQ,
    TableQ,
)
from neuralq.q.compiled import MlpEngine, make_engine
from neuralq.q.engine import Loss, TorchEngine
from neuralq.runs import Run, RunConfig, load, resume, train
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.recipe.build import build_session
from neuralq.runs.recipe.config import config_from_dict, config_to_dict
from neuralq.types import Transition

F64 = torch.float64
NUM_STATES, NUM_ACTIONS, T, B = 6, 3, 5, 4
SGD = {"optimiser": "sgd", "max_grad_norm": None, "loss": "squared"}


def learner_of(q: Any, **given: Any) -> ReplayLearner:
    engine = make_engine(q, Loss("squared"))
    return ReplayLearner(engine, ReplaySettings(**(SGD | given)), reward_scale=0.5)


def rows(*lead: int) -> Transition:
    rng = np.random.default_rng(3)
    s, s_t = (torch.from_numpy(rng.integers(NUM_STATES, size=lead)) for _ in range(2))
    last = torch.from_numpy(rng.random(lead) < 0.2)
    if len(lead) == 2:
        s_t[:-1] = torch.where(last[:-1], s_t[:-1], s[1:])
    discount = torch.where(last, 0.0, torch.from_numpy(rng.uniform(0.5, 1, lead)))
    a, mu = torch.from_numpy(rng.integers(NUM_ACTIONS, size=lead)), torch.from_numpy(rng.uniform(0.1, 1, lead))
    return Transition(s, a, mu, torch.from_numpy(rng.normal(size=lead)), discount, s_t, last)


def differing(learner: ReplayLearner) -> tuple[Any, Any]:
    """Tables of the online and of the target network, made different from each other."""
    rng = np.random.default_rng(7)
    learner.engine.flat.values.copy_(torch.from_numpy(rng.normal(size=NUM_STATES * NUM_ACTIONS)))
    learner.engine.sync_target()
    target = learner.engine.q.all(torch.arange(NUM_STATES)).detach().clone().numpy()
    learner.engine.flat.values.copy_(torch.from_numpy(rng.normal(size=NUM_STATES * NUM_ACTIONS)))
    return learner.engine.q.all(torch.arange(NUM_STATES)).detach().numpy(), target


def test_munchausen_targets_come_from_the_target_network_with_scaled_rewards() -> None:
    learner = learner_of(
        TableQ(NUM_STATES, NUM_ACTIONS), target_rule="munchausen", temperature=0.5, munchausen_floor=-0.7
    )
    _, target = differing(learner)
    t = rows(12)
    got = learner.targets(t)
    for i in range(12):
        s, a, s_next = int(t.s_tm1[i]), int(t.a_tm1[i]), int(t.s_t[i])
        p, after = (np.exp(target[x] / 0.5) / np.exp(target[x] / 0.5).sum() for x in (s, s_next))
        soft = float(after @ (target[s_next] - 0.5 * np.log(after)))
        wanted = 0.5 * float(t.r_t[i]) + 0.9 * max(0.5 * np.log(p[a]), -0.7) + float(t.discount_t[i]) * soft
        assert float(got[i]) == pytest.approx(wanted, abs=1e-10)


@pytest.mark.parametrize("rule", ["retrace", "tree_backup", "harutyunyan"])
def test_corrected_returns_come_from_the_target_network_and_the_stored_probabilities(rule: str) -> None:
    epsilon, lambda_ = 0.3, 0.8
    table = TableQ(NUM_STATES, NUM_ACTIONS)
    learner = learner_of(table, target_rule=rule, block_length=T, lambda_=lambda_, target_epsilon=epsilon)
    _, target = differing(learner)
    policy = np.full((NUM_STATES, NUM_ACTIONS), epsilon / NUM_ACTIONS)
    policy[np.arange(NUM_STATES), target.argmax(1)] += 1 - epsilon
    t = rows(T, B)
    got = learner.targets(t).numpy()
    for n in range(B):
        ahead = 0.0  # c Δ of the row behind, backwards
        for k in reversed(range(T)):
            s, a, s_next = int(t.s_tm1[k, n]), int(t.a_tm1[k, n]), int(t.s_t[k, n])
            v = float(policy[s_next] @ target[s_next])
            delta = 0.5 * float(t.r_t[k, n]) + float(t.discount_t[k, n]) * v - target[s, a]
            delta += 0.0 if bool(t.last_t[k, n]) else float(t.discount_t[k, n]) * ahead
            assert got[k, n] == pytest.approx(target[s, a] + delta, abs=1e-10)
            ratio = {"retrace": min(1.0, policy[s, a] / float(t.mu_tm1[k, n])), "tree_backup": policy[s, a]}
            ahead = lambda_ * ratio.get(rule, 1.0) * delta


# Exact answers on a chain 0 … 4 with left and right: 1 for reaching 4, where it ends.

LENGTH, GAMMA = 5, 0.9


def exact(rule: str, epsilon: float) -> Any:
    """The fixed point of each rule by iteration of its operator in NumPy."""
    q = np.zeros((LENGTH, 2))
    for _ in range(3000):
        new, previous = q.copy(), q.copy()
        for s in range(LENGTH - 1):
            for a in (0, 1):
                s_next = max(s - 1, 0) if a == 0 else s + 1
                gamma = 0.0 if s_next == LENGTH - 1 else GAMMA
                r, after = float(gamma == 0), q[s_next]
                if rule == "munchausen":
                    best, tau = after.max(), 0.03
                    soft = best + tau * np.log(np.exp((after - best) / tau).sum())
                    own = q[s] - q[s].max()
                    log_pi = own[a] - tau * np.log(np.exp(own / tau).sum())
                    new[s, a] = r + 0.9 * max(log_pi, -1.0) + gamma * soft
                elif rule == "expected_sarsa":
                    pi = np.exp((after - after.max()) / 0.2)
                    new[s, a] = r + gamma * (pi / pi.sum()) @ after
                else:
                    new[s, a] = r + gamma * ((1 - epsilon) * after.max() + epsilon * after.mean())
        q = new
        if np.abs(q - previous).max() < 1e-13:
            break
    return q[: LENGTH - 1]


def chain_buffer(seed: int, wrong: bool) -> ReplayBuffer:
    """600 steps of a random policy; ``wrong`` gives every step the discount of the step before it."""
    rng = np.random.default_rng(seed)
    buffer, s, before = ReplayBuffer(600, (), np.int64), 0, GAMMA
    for _ in range(600):
        a = int(rng.random() < 0.6)
        mu = 0.6 if a else 0.4
        s_next = max(s - 1, 0) if a == 0 else s + 1
        end = s_next == LENGTH - 1
        discount = 0.0 if end else GAMMA
        given = before if wrong else discount
        buffer.add_step(0, np.int64(s), a, mu, float(end), given, np.int64(s_next), end)  # type: ignore[arg-type]
        s, before = (0 if end else s_next), discount
    return buffer


VARIANTS: dict[str, dict[str, Any]] = {
    "munchausen": {},
    "expected_sarsa": {"temperature": 0.2},
    "retrace": {"block_length": 4, "lambda_": 0.9, "target_epsilon": 0.1},
    "tree_backup": {"block_length": 4, "lambda_": 0.9, "target_epsilon": 0.1},
    # Safe for λ below (1 − γ) / (γ max ‖π − μ‖₁) = 0.1 / (0.9 · 1.1).
    "harutyunyan": {"block_length": 4, "lambda_": 0.1, "target_epsilon": 0.1},
    "dqrc": {"dqrc_beta": 0.2, "dqrc_learning_rate": 1.0, "learning_rate": 3.0},
}
BOUND = 1e-5  # rewards and discounts are stored in single precision


def learned(rule: str, seed: int, wrong: bool = False) -> Any:
    given: dict[str, Any] = SGD | {"target_rule": rule, "learning_rate": 4.0} | VARIANTS[rule]
    if rule != "dqrc":
        given["target_period_updates"] = 5
    settings = ReplaySettings(**given)
    engine = TorchEngine(TableQ(LENGTH, 2), Loss("squared"))
    parts = Parts(engine, settings, np.random.default_rng(0), GAMMA, 1.0, 500, "auto", lambda: TableQ(LENGTH, 2))
    learner = learner_kinds()["replay"].build(parts)
    assert isinstance(learner, DQRCLearner) == (rule == "dqrc")
    buffer, rng = chain_buffer(seed, wrong), np.random.default_rng(seed)
    for _ in range(500):
        if settings.block_length > 1:
            learner.update(buffer.sample_blocks(16, settings.block_length, rng))
        else:
            learner.update(buffer.sample(64, rng).transition)
    return learner.engine.all(torch.arange(LENGTH - 1)).numpy()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.parametrize("rule", VARIANTS)
def test_each_rule_comes_to_its_exact_fixed_point(rule: str, seed: int) -> None:
    values = learned(rule, seed)
    assert np.abs(values - exact(rule, VARIANTS[rule].get("target_epsilon", 0.0))).max() < BOUND
    assert (values.argmax(1) == 1).all()


@pytest.mark.parametrize("rule", VARIANTS)
def test_the_discount_of_the_step_before_is_noticed(rule: str) -> None:
    wanted = exact(rule, VARIANTS[rule].get("target_epsilon", 0.0))
    assert np.abs(learned(rule, 0, wrong=True) - wanted).max() > 0.1


# Recipes.


def replay(layout: str = "action-output", **settings: Any) -> dict[str, Any]:
    sizes = {"learning_starts": 60, "batch_size": 16, "capacity": 200, "train_period": 4}
    body = None if layout in ("table", "linear") else MLP((8, 8))
    return {"learner": "replay", "layout": layout, "replay": ReplaySettings(**{**sizes, **settings}), "body": body}


C51 = {"distribution": "categorical", "value_min": 0.0, "value_max": 50.0}
CASES: dict[str, dict[str, Any]] = {
    "munchausen": replay(target_rule="munchausen", target_period_updates=9),
    "expected sarsa": replay(target_rule="expected_sarsa", num_steps=2),
    "quantile": replay(distribution="quantile", target_rule="double", prioritised=True),
    "iqn, prioritised": replay(distribution="iqn", num_atoms=4, prioritised=True, num_steps=2),
    "iqn, separate": replay("separate", distribution="iqn", target_rule="double"),
    "iqn, table": replay("table", distribution="iqn", target_rule="expected_sarsa") | {"env": "FrozenLake-v1"},
    "munchausen iqn": replay("action-input", distribution="iqn", target_rule="munchausen"),
    "munchausen quantile, dueling": replay(distribution="quantile", target_rule="munchausen") | {"dueling": True},
    "categorical, n-step": replay(**C51, num_steps=3),
    "quantile, linear": replay("linear", distribution="quantile"),
    "categorical, table": replay("table", **C51) | {"env": "FrozenLake-v1"},
    "retrace": replay("separate", target_rule="retrace", block_length=4),
    "tree backup": replay(target_rule="tree_backup", block_length=4, num_envs=2),
    "dqrc": replay("action-input", target_rule="dqrc"),
    "dqrc, table": replay("table", target_rule="dqrc", optimiser="sgd", learning_rate=0.1) | {"env": "FrozenLake-v1"},
    "dueling": replay() | {"dueling": True},
}


class Stopped(BaseException):
    """Ends a run in the middle as a kill would."""


def stop(row: Mapping[str, Any]) -> None:
    if row["kind"] == "train" and row["env_steps"] >= 200:
        raise Stopped


def outcome(run: Run) -> tuple[Any, ...]:
    return run.parameters_sha256, run.env_steps, run.greedy_return


QUICK = ("quantile", "iqn, prioritised", "categorical, n-step", "dqrc")


@pytest.mark.parametrize("name", [pytest.param(x, marks=[] if x in QUICK else pytest.mark.slow) for x in CASES])
def test_a_run_stopped_on_the_way_ends_with_the_same_bits(name: str, tmp_path: Path) -> None:
    periods = {"total_steps": 300, "evaluate_every": 150, "evaluation_episodes": 1, "checkpoint_every": 100}
    config = RunConfig(**(periods | {"log_every": 50, "env": "CartPole-v1"} | CASES[name]))
    assert config_from_dict(config_to_dict(config)) == config
    whole = train(config, tmp_path / "whole")
    with pytest.raises(Stopped):
        train(config, tmp_path / "parts", [stop])
    assert 0 < checkpoint.load_newest(tmp_path / "parts" / "checkpoints").step <= 201
    assert outcome(resume(tmp_path / "parts")) == outcome(whole)
    errors = [row["abs_td_error"] for row in read_metrics(tmp_path / "parts") if "abs_td_error" in row]
    assert errors and np.isfinite(errors).all()
    agent = load(tmp_path / "parts")
    observation: Any = 0 if config.layout == "table" else np.zeros(4, np.float32)
    assert agent.values(observation).shape == ((4,) if config.layout == "table" else (2,))


@pytest.mark.parametrize(
    ("name", "learner", "kind"),
    [
        ("munchausen", ReplayLearner, ActionOutputQ),
        ("munchausen quantile, dueling", DistributionalLearner, QuantileQ),
        ("iqn, prioritised", DistributionalLearner, ImplicitQuantileQ),
        ("categorical, table", DistributionalLearner, CategoricalQ),
        ("dqrc", DQRCLearner, None),
        ("dueling", ReplayLearner, DuelingQ),
    ],
)
def test_the_settings_decide_who_learns_what(name: str, learner: type, kind: type | None) -> None:
    session = build_session(RunConfig(**({"evaluation_episodes": 1, "reward_scale": 0.5} | CASES[name])))
    try:
        assert type(session.learner) is learner and (kind is None or type(session.learner.engine.q) is kind)
        if kind is CategoricalQ:
            assert session.learner.engine.q.support.tolist()[-1] == 25.0  # type: ignore[attr-defined]
    finally:
        session.close()


def test_what_is_left_out_is_filled_in_and_stored() -> None:
    one = ReplaySettings(target_rule="munchausen")
    assert (one.temperature, one.munchausen_alpha, one.munchausen_floor, one.loss) == (0.03, 0.9, -1.0, "huber")
    two = ReplaySettings(**C51)
    assert (two.num_atoms, two.loss, two.target_period_updates, two.temperature) == (51, "cross_entropy", 500, None)
    three = ReplaySettings(target_rule="dqrc", learning_rate=0.25)
    assert (three.dqrc_beta, three.dqrc_learning_rate, three.loss) == (1.0, 0.25, "squared")
    assert three.target_period_updates is None
    assert ReplaySettings(target_rule="retrace", block_length=4).target_epsilon == 0.05


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"target_rule": "munchausen", "block_length": 4}, "need blocks"),
        ({"target_rule": "munchausen", "num_steps": 3}, "n-step sample holds only their sum"),
        ({"target_rule": "munchausen", **C51}, "outside the grid"),
        ({"target_rule": "retrace"}, "need blocks"),
        ({"target_rule": "retrace", "block_length": 4, "target_epsilon": 0.0}, "is Watkins' Q"),
        ({"target_rule": "tree_backup", "block_length": 4, "target_epsilon": 0.0}, "is Watkins' Q"),
        ({"target_rule": "peng", "block_length": 4, "target_epsilon": 0.1}, "target_epsilon=0.1 would be ignored"),
        ({"target_rule": "peng", "block_length": 4, "temperature": 0.1}, "temperature=0.1 would be ignored"),
        ({"target_rule": "retrace", "block_length": 4, "distribution": "quantile"}, "needs whole distributions"),
        ({"target_rule": "dqrc", "distribution": "quantile"}, "does not have"),
        ({"target_rule": "dqrc", "target_period_updates": 9}, "target_period_updates=9 would be ignored"),
        ({"target_rule": "dqrc", "loss": "huber"}, "does not go with target_rule='dqrc'"),
        ({"dqrc_beta": 1.0}, "no second function"),
        ({"dqrc_learning_rate": 1.0}, "no second function"),
        ({"num_atoms": 9}, "no atoms"),
        ({"value_min": 0.0}, "no range"),
        ({"distribution": "quantile", "value_max": 0.0}, "needs no range"),
        ({"distribution": "quantile", "loss": "squared"}, "does not go with distribution='quantile'"),
        ({"distribution": "categorical"}, "needs value_min below value_max, got None"),
        ({"distribution": "categorical", "value_min": 1.0, "value_max": 1.0}, "value_min below value_max"),
        ({**C51, "num_atoms": 1}, "num_atoms"),
        ({**C51, "loss": "huber"}, "does not go with distribution='categorical'"),
        ({"loss": "cross_entropy"}, "does not go with distribution='none'"),
        ({"distribution": "gaussian"}, "distribution must be one of"),
        ({"target_rule": "munchausen", "temperature": 0.0}, "temperature"),
        ({"target_rule": "munchausen", "munchausen_alpha": 1.5}, "munchausen_alpha"),
        ({"target_rule": "munchausen", "munchausen_floor": 0.0}, "munchausen_floor must be below 0"),
        ({"target_rule": "dqrc", "dqrc_beta": -1.0}, "dqrc_beta"),
        ({"target_period_updates": 0}, "target_period_updates"),
    ],
)
def test_contradictions_are_refused_with_the_reason(given: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        ReplaySettings(**given)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"dueling": True, "layout": "action-input"}, "sees one action at a time"),
        ({"dueling": True, "layout": "separate"}, "share nothing"),
        ({"dueling": True, "layout": "table"}, "adds nothing"),
        ({"dueling": True, "layout": "linear"}, "adds nothing"),
        ({"dueling": True, "body": MLP(())}, "need a hidden layer"),
        ({"dueling": True, "engine": "compiled"}, "no kernels for dueling"),
        (replay(target_rule="dqrc") | {"dueling": True}, "two such layers"),
        (replay("separate", distribution="quantile"), "several outputs per action"),
        (replay("action-input", **C51), "several outputs per action"),
        (replay(distribution="quantile") | {"engine": "compiled"}, "no kernels for dueling streams or distributions"),
    ],
)
def test_layouts_that_cannot_are_refused_with_the_reason(given: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        RunConfig(**given)


# Illegal actions.


def masked_engine(kind: type[MlpEngine] | type[TorchEngine]) -> Any:
    return kind(MaskedQ(ActionOutputQ((2,), 3, MLP((4,)), rng=1, dtype=F64), (2,)), Loss())


@pytest.mark.parametrize("kind", [MlpEngine, TorchEngine])
def test_an_illegal_action_is_refused_where_it_counts_and_harmless_where_it_does_not(kind: Any) -> None:
    engine = masked_engine(kind)
    s = torch.tensor([[0.5, 1.0, 1, 0, 1], [1.0, 0.0, 0, 0, 0], [1.0, 2.0, 1, 1, 1]], dtype=F64)
    a, target = torch.tensor([2, 1, 0]), torch.ones(3, dtype=F64)
    for weight in (None, torch.tensor([0.0, 0.5, 1.0])):
        with pytest.raises(ValueError, match="action 1 is illegal in row 1 of 3"):
            engine.loss_gradient(s, a, target, weight)
    with pytest.raises(ValueError, match="action 1 is illegal in row 0 of 1"):
        engine.value_gradient(s[1], a[1])
    errors = engine.loss_gradient(s, a, target, torch.tensor([1.0, 0.0, 1.0]))
    assert torch.isfinite(errors).all()
    grad = engine.flat.grad.clone()
    engine.loss_gradient(s[[0, 2]], a[[0, 2]], target[:2])
    torch.testing.assert_close(grad, engine.flat.grad * 2 / 3)


def test_dqrc_and_linear_functions_refuse_illegal_actions_too() -> None:
    q = MaskedQ(LinearQ(2, 3), (2,))
    learner = DQRCLearner(TorchEngine(q, Loss()), copy.deepcopy(q), ReplaySettings(target_rule="dqrc"))
    s = torch.tensor([[0.5, 1.0, 1, 0, 1]], dtype=F64)
    one = torch.ones(1, dtype=F64)
    with pytest.raises(ValueError, match="action 1 is illegal"):
        learner.update(Transition(s, torch.tensor([1]), one, one, one, s, one < 0))


def test_numbers_of_target_rules_are_those_of_their_papers_where_nobody_names_others() -> None:
    # QRC: β = 1 and one rate for both functions (Patterson et al. 2022). Munchausen: .03, .9, −1 (Vieillard et al.).
    given = {rule: ReplaySettings(target_rule=rule, learning_rate=0.25).options for rule in ("dqrc", "munchausen")}
    assert given["dqrc"] == {"dqrc_beta": 1.0, "dqrc_learning_rate": 0.25}
    assert given["munchausen"] == {"temperature": 0.03, "munchausen_alpha": 0.9, "munchausen_floor": -1.0}
    for rule in ("retrace", "tree_backup", "harutyunyan"):
        assert ReplaySettings(target_rule=rule, block_length=8).options == {"target_epsilon": 0.05}

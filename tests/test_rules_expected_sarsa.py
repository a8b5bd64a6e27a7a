"""Expected Sarsa with a softmax policy as a target rule: by hand, and by brute force over the actions that it averages.

Mutants that were tried, and die: the policy or the values of the online network; 1/τ for τ; a policy that gives weight
to illegal actions; the bootstrap of a terminal state; quantiles averaged in place of mixed; all quantiles of the
mixture equally likely; categories of the best action alone; the mixture's mean without its probabilities; the discount
of the first step in place of that of n steps.
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

from neuralq import rules
from neuralq.apps.cli import main
from neuralq.learners import DistributionalLearner, ReplayLearner, ReplaySettings
from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.q import CategoricalQ, MaskedQ, QuantileQ, TableQ
from neuralq.q.distributional import atoms
from neuralq.q.engine import Loss, TorchEngine
from neuralq.rules import Seen, target_rules
from neuralq.types import Transition

F64 = torch.float64
RULE = target_rules()["expected_sarsa"]
NUM_STATES, NUM_ACTIONS, NUM_ATOMS, BATCH, TAU, SCALE = 5, 3, 4, 12, 0.4, 0.5
SETTINGS: dict[str, Any] = {
    "target_rule": "expected_sarsa", "temperature": TAU, "optimiser": "sgd", "learning_rate": 0.3,
    "max_grad_norm": None,
}  # fmt: skip
DISTRIBUTIONS: dict[str, dict[str, Any]] = {
    "quantile": {"num_atoms": NUM_ATOMS},
    "categorical": {"num_atoms": NUM_ATOMS, "value_min": -1.0, "value_max": 2.0},
}


def rows(masked: bool = False) -> Transition:
    """Single rows, some of them terminal, where with masks nothing is legal."""
    rng = np.random.default_rng(2)
    s, s_t = (torch.from_numpy(rng.integers(NUM_STATES, size=BATCH)) for _ in range(2))
    a, last = torch.from_numpy(rng.integers(NUM_ACTIONS, size=BATCH)), torch.from_numpy(rng.random(BATCH) < 0.3)
    if masked:
        legal = torch.from_numpy(rng.random((2, BATCH, NUM_ACTIONS)) < 0.5).long()
        legal[0].scatter_(-1, a[:, None], 1)
        legal[1, :, 1] = 1
        legal[1, last] = 0
        s, s_t = torch.cat([s[:, None], legal[0]], -1), torch.cat([s_t[:, None], legal[1]], -1)
    r = torch.from_numpy(rng.normal(size=BATCH))
    return Transition(s, a, torch.ones(BATCH), r, 0.8 * (~last).to(F64), s_t, last)


def weights_of(q: Any) -> list[float]:
    """The policy's probabilities by the definition, 0 for illegal actions."""
    each = [math.exp(x / TAU) if x > -math.inf else 0.0 for x in q.tolist()]
    return [x / max(sum(each), 1e-300) for x in each]


def differing(learner: Any) -> Any:
    """A copy of the target network, from which the online network is then moved away."""
    rng, flat = np.random.default_rng(7), learner.engine.flat.values
    flat.copy_(torch.from_numpy(rng.normal(size=flat.shape)))
    learner.engine.sync_target()
    target = copy.deepcopy(learner.engine.q)
    flat.copy_(torch.from_numpy(rng.normal(size=flat.shape)))
    return target


def test_by_hand() -> None:
    # τ = ½ and q = (0, ½ ln 3): the policy is (1, 3)/4, the average ⅜ ln 3, the target 1 + 0.8 · ⅜ ln 3.
    step = rows().map(lambda x: x[:1])
    q_t = torch.tensor([[0.0, 0.5 * math.log(3), -math.inf]], dtype=F64)
    step = Transition(step.s_tm1, step.a_tm1, step.mu_tm1, 0 * step.r_t + 2, 0 * step.r_t + 0.8, step.s_t, step.last_t)
    seen = Seen(step, lambda s, target: q_t if target else 1 / q_t, SCALE, options={"temperature": 0.5})
    assert float(RULE.target(seen)[0]) == pytest.approx(1 + 0.8 * 0.375 * math.log(3), abs=1e-15)


@pytest.mark.parametrize("masked", [False, True])
def test_means_are_the_policys_average_over_the_target_networks_values(masked: bool) -> None:
    table = TableQ(NUM_STATES, NUM_ACTIONS)
    q: Any = MaskedQ(table, ()) if masked else table
    learner = ReplayLearner(TorchEngine(q, Loss()), ReplaySettings(**SETTINGS, loss="squared"), SCALE)
    target, t = differing(learner), rows(masked)
    got = learner.targets(t)
    for i in range(BATCH):
        q_t = target.all(t.s_t[i]).detach()
        v = sum(w * float(x) for w, x in zip(weights_of(q_t), q_t, strict=True) if w > 0)
        wanted = SCALE * float(t.r_t[i]) + (0.0 if bool(t.last_t[i]) else 0.8 * v)
        assert float(got[i]) == pytest.approx(wanted, abs=1e-12)


def test_it_lies_between_q_learning_and_the_average_of_all_actions() -> None:
    q_t = torch.from_numpy(np.random.default_rng(0).normal(size=(BATCH, NUM_ACTIONS)))
    t = rows()
    cold, warm = (RULE.target(Seen(t, lambda s, target: q_t, options={"temperature": x})) for x in (1e-6, 1e9))
    torch.testing.assert_close(cold, rules.q_learning(t.r_t, t.discount_t, q_t), rtol=0, atol=1e-9)
    torch.testing.assert_close(warm, t.r_t + t.discount_t * q_t.mean(-1), rtol=0, atol=1e-6)


def described(kind: str, masked: bool) -> tuple[Any, DistributionalLearner]:
    inner = TableQ(NUM_STATES, NUM_ACTIONS * NUM_ATOMS)
    q: Any = QuantileQ(inner, NUM_ATOMS) if kind == "quantile" else CategoricalQ(inner, NUM_ATOMS, -1.0, 2.0)
    engine = TorchEngine(MaskedQ(q, ()) if masked else q, Loss())
    return q, DistributionalLearner(engine, ReplaySettings(**SETTINGS, **DISTRIBUTIONS[kind], distribution=kind), SCALE)


def loss_against(kind: str, numbers: Tensor, after: Tensor, r: float, discount: float) -> Tensor:
    """The loss of one pair, were the successor's action the one with these numbers."""
    if kind == "quantile":
        return rules.quantile_huber(numbers, r + discount * after)
    grid = torch.linspace(-1, 2, NUM_ATOMS, dtype=F64)
    moved = rules.categorical_projection(r + discount * grid, torch.softmax(after, -1), grid)
    return -(moved * torch.log_softmax(numbers, -1)).sum()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("kind", DISTRIBUTIONS)
def test_distributions_are_mixed_so_that_the_loss_is_the_average_over_drawn_actions(kind: str, masked: bool) -> None:
    q, learner = described(kind, masked)
    target, t = differing(learner), rows(masked)
    before, online, total = learner.engine.flat.values.clone(), copy.deepcopy(q), torch.zeros((), dtype=F64)
    aims = []
    for i in range(BATCH):
        inner = t.s_tm1[i, 0] if masked else t.s_tm1[i]
        numbers = online.outputs(inner)[t.a_tm1[i]]
        after, pi = atoms(target, t.s_t[i]).detach(), weights_of(target.all(t.s_t[i]).detach())
        if bool(t.last_t[i]) and not sum(pi):
            pi = [1.0, 0.0, 0.0]  # nothing is legal and nothing comes after: any action will do
        r, discount = SCALE * float(t.r_t[i]), float(t.discount_t[i])
        for a in range(NUM_ACTIONS):
            total = total + pi[a] * loss_against(kind, numbers, after[a], r, discount) / BATCH
        if kind == "quantile":
            aims.append(sum(pi[a] * float((r + discount * after[a]).mean()) for a in range(NUM_ACTIONS)))
    grad = torch.autograd.grad(total, online.inner.weight)[0].reshape(-1)
    seen = learner.update(t)
    torch.testing.assert_close(learner.engine.flat.values, before - 0.3 * grad, rtol=0, atol=1e-12)
    if kind == "quantile":
        torch.testing.assert_close(seen.targets, torch.tensor(aims, dtype=F64), rtol=0, atol=1e-12)


def test_a_drawn_action_makes_the_return_random_and_that_is_learned() -> None:
    # 0 -> 1 -> end; in 1 one action pays 0 and the other 1, and at τ = 1e9 both are as likely: a coin, not its mean.
    given = {**SETTINGS, "temperature": 1e9, "distribution": "quantile", "num_atoms": 4, "learning_rate": 1.0}
    q = QuantileQ(TableQ(2, 2 * 4), 4)
    learner = DistributionalLearner(TorchEngine(q, Loss()), ReplaySettings(**given, target_period_updates=1))
    row = torch.tensor
    t = Transition(row([0, 1, 1]), row([0, 0, 1]), torch.ones(3), row([0.0, 0.0, 1.0]), row([1.0, 0.0, 0.0]),
                   row([1, 0, 0]), row([False, True, True]))  # fmt: skip
    for _ in range(600):
        learner.update(t)
    # Huber's parabola leaves expectiles: level τ of a fair coin lies at τ.
    np.testing.assert_allclose(atoms(q, row(0))[0].detach().numpy(), [1 / 8, 3 / 8, 5 / 8, 7 / 8], atol=0.02)


def test_n_steps_are_summed_and_the_policy_averages_what_follows() -> None:
    buffer = ReplayBuffer(50, (), np.int64, num_steps=3)
    for s, r in enumerate([1.0, 2.0, 4.0, 8.0]):
        buffer.add_step(0, np.int64(s), 0, 1.0, r, 0.5, np.int64(s + 1), False)  # type: ignore[arg-type]
    settings = ReplaySettings(**SETTINGS, loss="squared", num_steps=3)
    learner = ReplayLearner(TorchEngine(TableQ(NUM_STATES, NUM_ACTIONS), Loss()), settings)
    target, rng = differing(learner), np.random.default_rng(0)
    for _ in range(20):
        t = buffer.sample(1, rng).transition
        first, last = int(t.s_tm1[0]), int(t.s_t[0])
        q_t = target.all(t.s_t[0]).detach()
        v = sum(w * float(x) for w, x in zip(weights_of(q_t), q_t, strict=True))
        wanted = sum(0.5**k * 2.0 ** (first + k) for k in range(last - first)) + 0.5 ** (last - first) * v
        assert float(learner.targets(t)[0]) == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("distribution", ["none", "quantile", "categorical"])
def test_it_trains_from_the_command_line(distribution: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = {"learning-starts": 20, "batch-size": 8, "temperature": 0.25, "target-rule": "expected_sarsa"}
    given |= {"distribution": distribution} | (
        {"value-min": 0, "value-max": 9} if distribution == "categorical" else {}
    )
    argv = ["train", "CartPole-v1", "--learner", "replay", "--hidden", "8", "--total-steps", "40", "--json"]
    argv += ["--evaluation-episodes", "1", "--run-dir", str(tmp_path / "run")]
    assert main([*argv, *(f"--replay.{name}={value}" for name, value in given.items())]) == 0
    capsys.readouterr()
    stored = json.loads((tmp_path / "run" / "config.json").read_text())["replay"]
    assert stored["target_rule"] == "expected_sarsa" and stored["temperature"] == 0.25
    assert stored["munchausen_alpha"] is None


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"temperature": 0.0}, "temperature must be a finite number above 0"),
        ({"munchausen_alpha": 0.5}, "munchausen_alpha=0.5 would be ignored: .*has no Munchausen bonus; leave"),
        ({"target_epsilon": 0.1}, "has the greedy target policy"),
        ({"block_length": 4}, "need blocks"),
    ],
)
def test_what_it_has_no_use_for_is_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ReplaySettings(target_rule="expected_sarsa", **given)
    assert ReplaySettings(target_rule="expected_sarsa").temperature == 0.03

"""The doctor's hook: what it measures of a learner is what is there, is said once, and changes nothing learned."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.doctor import VitalSigns
from neuralq.doctor.exam.signs import dormant_share, moved, rank_of
from neuralq.doctor.vital_signs import VitalSignWarning
from neuralq.learners import ReplaySettings, RolloutSettings
from neuralq.q import MLP, ActionOutputQ, TableQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.runs import RunConfig, resume, train
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.hooks import own_hook
from neuralq.runs.stream.experience import Sample
from neuralq.types import Transition

CONFIG = RunConfig(
    learner="replay", gamma=0.9, total_steps=10_000, monitor=False, replay=ReplaySettings(target_period_updates=50)
)  # fmt: skip


def learner_of(q: Any) -> Any:
    return SimpleNamespace(engine=TorchEngine(q, Loss()))


def network(units: int = 50) -> ActionOutputQ:
    return ActionOutputQ((2,), 2, MLP((units,)), rng=3)


def sample(rows: int = 64, reward: float = 1.0) -> Sample:
    rng = np.random.default_rng(0)
    s, s_t = (torch.from_numpy(rng.standard_normal((rows, 2))).float() for _ in range(2))
    a, ones = torch.from_numpy(rng.integers(2, size=rows)), torch.ones(rows)
    return Sample(Transition(s, a, ones, reward * ones, 0.9 * ones, s_t, ones < 0))


def looked(hook: VitalSigns, learner: Any, times: int = 1, **columns: Any) -> list[str]:
    """Evaluations of one learner; what was said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for k in range(times):
            hook.observe(learner, sample())
            hook({"kind": "evaluation", "env_steps": 100 * (k + 1), "lengths": [200], **columns})
    assert all(one.category is VitalSignWarning for one in caught)
    return [str(one.message) for one in caught]


def silenced(q: ActionOutputQ, units: int = 40) -> ActionOutputQ:
    first = q.trunk.layers[0]
    with torch.no_grad():
        first.weight[..., :units], first.bias[..., :units] = 0.0, -1.0
        first.bias[..., units:] = 1.0
    return q


def test_silent_units_are_said_once_and_after_two_evaluations_and_not_of_a_fresh_network() -> None:
    hook = VitalSigns(CONFIG, share=None)
    sick = learner_of(silenced(network()))
    assert looked(hook, sick) == [] and hook.columns()["dormant_excess"] > 0.6
    said = looked(hook, sick, 3)
    assert len(said) == 1 and said[0].startswith("after 100 steps: R1: ") and hook.said == {"dormant_excess": said[0]}
    healthy = VitalSigns(CONFIG, share=None)
    assert looked(healthy, learner_of(network()), 3) == [] and healthy.columns()["dormant_excess"] < 0.2
    again = VitalSigns(CONFIG, share=None)
    again.load_state_dict(hook.state_dict())
    assert looked(again, sick, 3) == [] and again.state_dict()["fresh"] == hook.state_dict()["fresh"]
    same = learner_of(network())
    with torch.no_grad():
        first = same.engine.q.trunk.layers[0]
        first.weight[:], first.bias[:] = first.weight[..., :1], first.bias[..., :1]
    assert "R2" in looked(flat := VitalSigns(CONFIG, share=None), same, 2)[0] and flat.columns()["effective_rank"] == 1


def test_the_lag_is_that_of_the_learners_target_and_looking_changes_nothing() -> None:
    learner = learner_of(network())
    learner.engine.sync_target()
    with torch.no_grad():
        for p in learner.engine.q.trunk.layers[-1].parameters():
            p.mul_(4.0)  # the target keeps a quarter of the values
    before = learner.engine.flat.values.clone()
    hook = VitalSigns(CONFIG, share=None)
    assert "R6" in looked(hook, learner, 2)[0] and hook.columns()["target_lag"] == pytest.approx(0.75)
    assert torch.equal(before, learner.engine.flat.values) and not learner.engine.flat.grad.any()
    learner.engine.sync_target()
    assert looked(hook, learner) == [] and hook.columns()["target_lag"] == 0


def test_values_are_held_to_their_bound_and_tables_are_looked_at_as_far_as_they_go() -> None:
    """Rewards of 1 at γ = 0.9 are worth 10 at most."""
    hook = VitalSigns(CONFIG, share=None)
    table = learner_of(TableQ(3, 2))
    s, ones = torch.tensor([0, 1, 2]), torch.ones(3)
    hook.observe(table, Sample(Transition(s, s % 2, ones, ones, 0.9 * ones, s, ones < 0)))
    hook({"kind": "train", "max_abs_q": 15.0})
    assert hook.columns() == {}
    hook({"kind": "evaluation", "max_abs_q": None})
    assert hook.columns() == {"value_ratio": pytest.approx(1.5)}
    for monitor, said in ((False, 1), (True, 0)):  # the monitor says it as well
        hook = VitalSigns(dataclasses.replace(CONFIG, monitor=monitor), share=None)
        assert len([line for line in looked(hook, learner_of(network()), 2, max_abs_q=12.0) if "V4" in line]) == said
    assert not looked(hook, learner_of(network()), 2, max_abs_q=10.5)


@pytest.mark.parametrize(("period", "num_steps", "said"), [(2000, 1, True), (100, 1, False), (2000, 12, False)])
def test_how_far_values_will_see_is_said_at_the_first_evaluation(period: int, num_steps: int, said: bool) -> None:
    """(10,000 − 1,000) / 4 updates make two copies of 2,000, of which the second is begun, and 23 of 100."""
    own = ReplaySettings(target_period_updates=period, num_steps=num_steps, learning_starts=1000, train_period=4)
    hook = VitalSigns(dataclasses.replace(CONFIG, replay=own), share=None)
    lines = looked(hook, learner_of(network()))
    ahead = 23 if period == 100 else 2 * num_steps
    assert hook.columns()["reach"] == pytest.approx((1 - 0.9**ahead) / (1 - 0.9**200))
    assert [line.split(": ")[1] for line in lines] == (["V5"] if said else [])


def test_churn_is_what_adams_first_step_does() -> None:
    q, x = network(), torch.randn(100, 2, generator=torch.Generator().manual_seed(1))
    rows = dataclasses.replace(sample(reward=50.0).transition, a_tm1=torch.zeros(64, dtype=torch.int64))
    share, change = moved(q, lambda one, x: one.all(x), rows, 0.05, x)  # type: ignore[operator]
    target = (rows.r_t + 0.9 * q.all(rows.s_t).amax(1)).detach()
    before = q.all(x).detach()
    loss = ((q.at(rows.s_tm1, rows.a_tm1) - target) ** 2).mean()
    with torch.no_grad():  # m/(1 − β₁) = g and v/(1 − β₂) = g² after one step: each weight moves by the step size
        for p, g in zip(q.parameters(), torch.autograd.grad(loss, list(q.parameters())), strict=True):
            p -= 0.05 * torch.sign(g)
        after = q.all(x)
    assert change == pytest.approx(float((after - before).abs().mean()), rel=1e-4)
    assert share == float((after.argmax(1) != before.argmax(1)).float().mean()) > 0


def test_ranks_and_silent_units_by_hand() -> None:
    assert rank_of(torch.diag(torch.tensor([98.0, 1.0, 0.9, 0.1]))) == 2  # 99 of 100
    assert rank_of(torch.diag(torch.tensor([97.9, 1.0, 1.0, 0.1]))) == 3  # 98.9, then 99.9
    assert dormant_share([torch.tensor([[1.0, 0.02, 3.0, 0.026]]), torch.zeros(1, 4)]) == 5 / 8  # 0.025 of 1.01


def test_it_keeps_to_its_share_of_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that only its own looks move, 0.05 s each, beside runs of 1 s and then 100 s."""
    now = [0.0]
    monkeypatch.setattr("neuralq.doctor.vital_signs.time.process_time", lambda: now[0])
    hook = VitalSigns(CONFIG)

    def look(*_: Any) -> dict[str, float]:
        now[0] += 0.05
        return {"churn": 0.0}

    monkeypatch.setattr(hook, "_looked", look)
    for k, trained in enumerate((0.5, 1.0, 2.0, 5.0, *range(6, 106))):
        looked(hook, learner_of(network()), cpu_seconds=trained)
        assert hook.cpu_seconds <= max(0.02 * trained, 0.05) and (k > 0) == ("churn" in hook.columns() or k > 1)
    assert 35 <= round(hook.cpu_seconds / 0.05) <= 42  # of 104 evaluations; 2 % of 105 s


def test_a_run_learns_the_same_with_it_and_goes_on_with_it(tmp_path: Path) -> None:
    config = RunConfig(
        total_steps=1024, epsilon_decay_steps=400, evaluate_every=512, evaluation_episodes=1, checkpoint_every=512,
        rollout=RolloutSettings(num_envs=4, num_steps=16),
    )  # fmt: skip
    hook = own_hook("neuralq.doctor:VitalSigns", config)
    assert isinstance(hook, VitalSigns)
    hook._share = None
    half = train(dataclasses.replace(config, total_steps=512), tmp_path / "watched", [hook])
    again = VitalSigns(config, share=None)
    watched = resume(half, total_steps=1024, hooks=[again])
    alone = train(config, tmp_path / "alone")
    assert watched.parameters_sha256 == alone.parameters_sha256
    assert again.state_dict()["fresh"] == hook.state_dict()["fresh"] and again.cpu_seconds > hook.cpu_seconds
    rows = read_metrics(tmp_path / "watched")
    assert [("churn" in row, "reach" in row) for row in rows if row["kind"] == "evaluation"] == [(True, True)] * 2
    assert not any("churn" in row for row in rows if row["kind"] == "train")

"""The doctor's experiments: what they name is what was changed, and where nothing is wrong nothing is named."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from torch import nn

from neuralq.doctor import Settings, examine
from neuralq.doctor.exam.capacity import capacity, t_interval
from neuralq.doctor.exam.case import CannotMeasure, Case, begin
from neuralq.doctor.exam.seeds import luck_of, seeds_needed
from neuralq.doctor.exam.signs import fresh
from neuralq.doctor.experiments import (
    Experiments,
    _difference,
    _factorial,
    _Plan,
    _Repair,
    _repaired,
    fit,
    run_experiments,
    separating,
)
from neuralq.doctor.findings import Finding
from neuralq.doctor.loading import load_subject
from neuralq.doctor.play import Clock
from neuralq.doctor.subject import of_network
from neuralq.doctor.tree import decide
from neuralq.doctor.worlds import open_world
from neuralq.types import Array


class Wavy(gym.Env[Any, Any]):
    """Episodes of one step that pay sin(3x) of a uniform x: linear in nothing, and easy for a wide body."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.x, {}

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        return self.x, math.sin(6 * float(self.x[0])), True, False, {}


def case_of(net: nn.Module, settings: Settings | None = None, budget_s: float = 60.0) -> Case:
    subject = of_network(net, "x", settings=settings)
    return begin(subject, open_world(Wavy), 0.9, subject.settings, None, 0, Clock(budget_s), lambda text: None)


@pytest.mark.slow
def test_a_body_that_is_too_small_is_told_from_one_that_is_not() -> None:
    rng = np.random.default_rng(0)
    one = fresh(nn.Sequential(nn.Linear(1, 1), nn.Tanh(), nn.Linear(1, 2)), rng)
    wide = fresh(
        nn.Sequential(
            nn.Linear(1, 256), nn.LayerNorm(256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 2)
        ),
        rng,
    )
    small, large = (fit(case_of(net), 3) for net in (one, wide))
    assert small.flagged and small.value > 0.1 and small.cause == "representation" and small.grade == "A"
    assert not large.flagged and abs(large.value) < 0.1


def test_intervals_are_students_and_those_of_every_resample() -> None:
    from scipy.stats import ttest_1samp

    a, b = [1.0, 2.0, 4.0], [0.0, 0.5, 0.2]
    assert t_interval(a) == pytest.approx(tuple(ttest_1samp(a, 0).confidence_interval()))
    means = [np.array([np.mean(one) for one in product(v, repeat=3)]) for v in (a, b)]  # 27 each; of 3 none is cut off
    every = np.subtract.outer(*means)
    assert _difference(a, b) == pytest.approx(np.percentile(every, [2.5, 97.5]), abs=0.1)
    assert _difference(a, b)[0] > 0 > _difference(a, [0.0, 3.0, 0.2])[0]


def named(name: str) -> Finding:
    return Finding(name, name, "algorithm", "B", 1.0, flagged=True, remedy="r", confirm="c")


def test_a_repair_is_confirmed_by_what_runs_return_and_by_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """The runs are stood in for: what is held here is which settings are compared and what is concluded."""
    asked: list[tuple[dict[str, Any], int]] = []

    def run(self: _Plan, settings: Any, seed: int, steps: int, make: Any) -> float:
        asked.append((dict(settings), seed))
        return seed + (10.0 if settings.get("learning_rate") == 0.005 else 0.0)

    monkeypatch.setattr(_Plan, "run", run)
    known = Settings(learning_rate=0.05, capacity=500, updates=1000, env_steps=4000, target_period_updates=20)
    case = case_of(nn.Sequential(nn.Linear(1, 7), nn.ReLU(), nn.Linear(7, 2)), known)
    plan = _Plan(case, 3)
    helps = _repaired(plan, _Repair("lr", "algorithm", named("R1"), {"learning_rate": 0.005}))
    assert helps.flagged and helps.value == 10 and helps.grade == "A" and helps.interval is not None
    idle = _repaired(plan, _Repair("x", "algorithm", named("R1"), {"num_steps": 2}))
    assert not idle.flagged and idle.value == 0
    before, _ = next(one for one in asked if one[0]["learning_rate"] == 0.05)
    assert before == {
        "learner": "replay", "learning_rate": 0.05, "capacity": 500, "learning_starts": 500, "batch_size": 64,
        "target_period_updates": 20, "train_period": 4, "hidden": (7,),
    }  # fmt: skip
    assert [seed for settings, seed in asked if settings["learning_rate"] == 0.005] == [0, 1, 2]


@pytest.mark.parametrize("better", ["algorithm", "representation", "nothing"])
def test_a_main_effect_is_that_of_what_was_changed_and_of_nothing_else(
    failed: Case, monkeypatch: pytest.MonkeyPatch, better: str
) -> None:
    """The runs are stood in for: another algorithm, another body, or nothing is worth 10 more."""

    def run(self: _Plan, settings: Any, seed: int, steps: int, make: Any) -> float:
        gains = {"algorithm": settings["learner"] == "rollout", "representation": make is not None}
        assert (make is not None) == (settings["hidden"] == (256, 256))
        return seed + 10.0 * gains.get(better, False)

    monkeypatch.setattr(_Plan, "run", run)
    found, plan = Experiments(), _Plan(failed, 3)
    effects = {one.cause: one for one in _factorial(plan, found)}
    assert {cause for cause, one in effects.items() if one.flagged} == {better} - {"nothing"}
    assert {cause: one.value for cause, one in effects.items()} == {
        cause: 10.0 * (cause == better) for cause in ("algorithm", "representation")
    }
    bodies = {"algorithm": [[101, 111], [101, 111]], "representation": [[101, 101], [111, 111]]}
    assert found.factorial is not None and found.factorial.tolist() == bodies.get(better, [[101, 101], [101, 101]])
    assert plan.same["theirs"] == [100, 101, 102] and len(plan.same["ours"]) == 3


def test_pictures_are_compared_with_no_body_of_ours(failed: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Case, "width", 84 * 84)
    for compare in (lambda: fit(failed), lambda: _factorial(_Plan(failed, 3), Experiments())):
        with pytest.raises(CannotMeasure, match="pictures"):
            compare()
    with pytest.raises(CannotMeasure, match="one of this size"):
        capacity(failed)


def test_a_budget_that_is_too_small_for_runs_is_said() -> None:
    plan = _Plan(case_of(nn.Linear(1, 2), budget_s=0.01), 3)
    plan._rate = 1000.0
    with pytest.raises(CannotMeasure, match="more with --budget"):
        plan.steps_for(6)


class Beat(gym.Env[Any, Any]):
    """Pays where the action is the one that the observation shows, 20 times."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self._draw(), {}

    def _draw(self) -> Array:
        self.x = float(self.np_random.choice([-1.0, 1.0]))
        return np.array([self.x], np.float32)

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        paid = float((self.x > 0) == bool(action))
        self.t += 1
        return self._draw(), paid, self.t == 20, False, {}


def beat(subject: Any) -> Case:
    loaded = load_subject(subject)
    return begin(loaded, open_world(Beat), 0.5, loaded.settings, None, 0, Clock(600.0), lambda text: None)


@pytest.fixture(scope="module")
def failed() -> Case:
    """A net whose greedy policy is one action, and so is right half of the time: 10 of 20."""
    net = nn.Sequential(nn.Linear(1, 8), nn.ReLU(), nn.Linear(8, 2))
    for p in net.parameters():
        nn.init.zeros_(p)
    return beat(net)


@pytest.mark.parametrize(
    ("returns", "share", "needed", "interval"),
    [
        ([20.0, 10.0, 19.0, 9.0], 0.5, 5, (0.0676, 0.9324)),  # Clopper and Pearson's, of a table
        ([10.0, 11.0, 9.0, 10.5], 0.0, 0, (0.0, 0.6024)),  # none: 1 − 0.025^(1/4)
        ([20.0, 20.0, 19.0, 18.5], 1.0, 1, (0.3976, 1.0)),  # all: it was not the seed
    ],
)
def test_it_was_luck_where_the_same_settings_succeed_with_some_seeds_and_only_there(
    failed: Case, returns: list[float], share: float, needed: int, interval: tuple[float, float]
) -> None:
    found = luck_of(failed, returns, "their settings")
    assert found.value == share and found.flagged == (0 < share < 1) and found.cause == "luck"
    assert found.interval == pytest.approx(interval, abs=1e-4)
    assert seeds_needed(share) == needed and f"train {needed} seeds" in found.remedy


def test_where_the_subject_is_one_of_those_that_succeed_there_is_nothing_to_explain() -> None:
    well = beat(lambda s: np.eye(2)[(s[:, 0] > 0).astype(int)])
    assert not luck_of(well, [20.0, 10.0, 19.0, 9.0], "their settings").flagged


def test_how_many_seeds_it_takes() -> None:
    for share in (0.05, 0.3, 0.5, 0.9):
        n = seeds_needed(share)
        assert 1 - (1 - share) ** n >= 0.95 > 1 - (1 - share) ** (n - 1)


def of(name: str, cause: Any) -> Finding:
    return Finding(name, name, cause, "B", 1.0, flagged=True)


LEADING: dict[str, tuple[list[Finding], Any, str]] = {
    "its settings or its data": ([named("R1"), of("D3", "data")], "algorithm", "X3 X2 X1"),
    "its network or its learner": ([of("R7", "representation"), named("V5")], "algorithm", "X2 X3 X1"),
    "nothing but a bad policy": ([named("V1")], None, "X2 X1"),
    "a learner or the environment": ([named("V3"), of("E6", "environment")], None, "X1 X2"),
    "the environment or luck": ([of("E6", "environment"), of("X5", "luck")], "algorithm", "X1 X2 X3"),
    "what neither can tell": ([named("V3"), of("D5", "data")], None, "X2 X1"),
}


@pytest.mark.parametrize("name", LEADING)
def test_the_experiment_that_tells_the_leading_causes_apart_comes_first(name: str) -> None:
    findings, repairs, order = LEADING[name]
    names, why = separating(findings, repairs)
    assert names == order.split() and why.startswith(", ".join(names))
    assert ("none tells" in why) == (name == "what neither can tell")


@pytest.mark.parametrize("half", [True, False])
def test_experiments_keep_to_that_order_say_why_and_find_luck_in_their_runs(
    failed: Case, monkeypatch: pytest.MonkeyPatch, half: bool
) -> None:
    """The runs are stood in for: whatever is changed, every other seed succeeds, or none does."""

    def run(self: _Plan, settings: Any, seed: int, steps: int, make: Any) -> float:
        return 20.0 if half and seed % 2 == 0 else 10.0

    monkeypatch.setattr(_Plan, "run", run)
    monkeypatch.setattr("neuralq.doctor.experiments.fit", lambda case, seeds: replace(of("X2", "data"), flagged=False))
    said: list[str] = []
    found = run_experiments(failed, [named("R1"), of("D3", "data")], 4, said.append)
    assert [text.split()[1].rstrip(":") for text in said] == ["X3", "X2", "X1"]
    assert "X3 first" in found.why and "algorithm a gain, data none" in found.why
    luck = next(one for one in found.findings if one.id == "X5")
    assert luck.flagged == half and luck.value == 0.5 * half
    findings, headline = decide([named("V1"), named("V2"), named("V5"), *found.findings])
    assert headline.startswith("Luck") == half and (findings[0].id == "X5") == half
    if half:
        first, second = decide([luck, of("E3", "environment")])[0]
        assert (first.id, second.id, second.grade) == ("E3", "X5", "B")


@pytest.mark.slow
def test_experiments_confirm_a_step_size_that_is_far_too_small() -> None:
    """With 1e-7 nothing is learned in 3,000 steps, with 5e-4 all of it."""
    net = fresh(nn.Sequential(nn.Linear(1, 64), nn.ReLU(), nn.Linear(64, 2)), np.random.default_rng(0))
    known = {"learning_rate": 1e-7, "updates": 3000, "env_steps": 3000, "target_period_updates": 100}
    report = examine(net, Beat, gamma=0.5, settings=known, level="experiments", budget_s=150)
    first = report.findings[0]
    assert (first.id, first.grade, report.cause) == ("X3", "A", "algorithm") and first.value > 5
    assert report.drawn["factorial"].shape == (2, 2) and report.drawn["factorial"][0, 1] > 15

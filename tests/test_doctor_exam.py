"""Every measurement of the doctor on a case whose right value is known in closed form, and on its healthy twin."""

from __future__ import annotations

import math
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from torch import nn

from neuralq.doctor import hidden
from neuralq.doctor.estimates import td_against_monte_carlo
from neuralq.doctor.exam import aliasing, capacity, environment, exactly, hypotheses, network, signs, stored, values
from neuralq.doctor.exam.case import CannotMeasure, Case, begin
from neuralq.doctor.findings import Finding
from neuralq.doctor.loading import load_subject
from neuralq.doctor.origins.neuralq_run import settings_of_run
from neuralq.doctor.play import Clock
from neuralq.doctor.subject import Settings, of_network
from neuralq.doctor.tree import decide
from neuralq.doctor.worlds import open_world
from neuralq.exact import solve
from neuralq.mdp import FiniteMDP
from neuralq.runs.recipe.config import config_from_dict
from neuralq.types import Array


@pytest.fixture(autouse=True, scope="module")
def few_episodes() -> Iterator[None]:
    """What is measured here is known exactly or nearly; a fifth of the episodes say it as well."""
    with pytest.MonkeyPatch.context() as patch:
        for name, number in (("NUM_GREEDY", 20), ("NUM_EXPLORED", 9), ("NUM_OTHER", 9)):
            patch.setattr(f"neuralq.doctor.exam.case.{name}", number)
        patch.setattr(values, "_NUM_STATES", 10)
        patch.setattr(network, "_FEW_WEIGHTS", 0)  # no kernels of fresh networks
        patch.setattr(hidden, "_MOST_ROWS", 2000)
        yield


GAMMA = 0.9
ENDS = 30  # steps after which the world ends

Values = Callable[[Array], Any]


class Counting(gym.Env[Any, Any]):
    """Shows how many steps were made; ``pays(t, a)`` is the reward; ends, is cut or goes on as it is told."""

    def __init__(
        self,
        pays: Callable[[int, int], float] = lambda t, a: 1.0,
        ends: int | None = ENDS,
        cuts: int | None = None,
        shows: Callable[[int, np.random.Generator], list[float]] = lambda t, rng: [float(t)],
    ) -> None:
        self.pays, self.ends, self.cuts, self.shows = pays, ends, cuts, shows
        width = len(shows(0, np.random.default_rng(0)))
        self.observation_space = spaces.Box(-np.inf, np.inf, (width,), np.float64)
        self.action_space = spaces.Discrete(2)

    def _seen(self) -> Array:
        return np.array(self.shows(self.t, self.np_random))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        paid = self.pays(self.t, int(action))
        self.t += 1
        return self._seen(), paid, self.t == self.ends, self.t == self.cuts, {}


def case_of(
    make: Callable[[], gym.Env[Any, Any]] | str,
    subject: Any,
    gamma: float = GAMMA,
    settings: Settings | None = None,
    data: Mapping[str, Array] | None = None,
) -> Case:
    world = open_world(make)
    columns = None if data is None else stored.check_columns(data)
    loaded = load_subject(subject)
    return begin(loaded, world, gamma, settings or loaded.settings, columns, 0, Clock(60.0), lambda text: None)


def both(value: Callable[[Array], Array]) -> Values:
    """The same value for both actions."""
    return lambda s: np.repeat(value(s[:, 0])[:, None], 2, axis=1)


def worth(left: Array, gamma: float = GAMMA) -> Array:
    """1 for ``left`` more steps."""
    return np.asarray((1 - gamma ** np.maximum(left, 0)) / (1 - gamma))


def ending(value: Callable[[Array], Array], **settings: Any) -> Case:
    return case_of(lambda: Counting(**settings), both(value))


def limited(value: Callable[[Array], Array], limit: int = 40) -> Case:
    return case_of(lambda: TimeLimit(Counting(ends=None), limit), both(value))


# V2, V4: values that are right, and a known share too high or too low.


@pytest.mark.parametrize("factor", [1.0, 1.09, 1.11, 0.91, 0.89])
def test_bias_is_the_share_by_which_values_are_too_high(factor: float) -> None:
    case = ending(lambda t: factor * worth(ENDS - t))
    g = worth(ENDS - np.arange(ENDS))
    found = values.bias(case)
    assert found.value == pytest.approx((factor - 1) * g.mean() / max(g.mean(), g.std()))
    assert found.flagged == (abs(factor - 1) > 0.1)
    share = f"{100 * abs(found.value):.3g} % {'over' if factor >= 1 else 'under'}"
    told = f"values average {factor * g.mean():.4g} where {g.mean():.4g} was returned, {share}"
    assert factor == 1.0 or found.evidence == told
    assert factor == 1.0 or ("over" in found.title) == (factor > 1) == ("--target-rule double" in found.confirm)
    assert len(values.on_policy(case, case.greedy[:5])) == 5
    with pytest.raises(CannotMeasure, match="4 episodes"):
        values.on_policy(case, case.greedy[:4])


def test_bias_is_beside_the_spread_of_returns_where_their_mean_is_small() -> None:
    """Rewards of 1 and −1 in turn: returns of ±1 / 1.9 average about 0."""
    pays = lambda t, a: 1.0 - 2.0 * (t % 2)  # noqa: E731
    g = summed(np.arange(ENDS), lambda i: pays(i, 0))
    found = values.bias(ending(lambda t: 0.1 + summed(t, lambda i: pays(i, 0)), pays=pays))
    assert found.value == pytest.approx(0.1 / g.std()) and g.std() > 3 * abs(g.mean()) and found.flagged
    nothing = values.bias(ending(lambda t: np.full(len(t), 0.1), pays=lambda t, a: 0.0))
    assert nothing.value > 1e9 and nothing.flagged


def test_returns_go_past_a_limit_that_can_be_lifted() -> None:
    case = limited(lambda t: np.full(len(t), 1 / (1 - GAMMA)))
    assert abs(values.bias(case).value) < 0.01  # what is missing is at most 1 % of the value
    assert {one.within for one in case.greedy} == {40} and case.greedy[0].length > 40 and case.greedy[0].score == 40


def test_without_lifting_only_steps_a_horizon_before_the_cut_count() -> None:
    case = case_of(lambda: Counting(ends=None, cuts=60), both(lambda t: np.full(len(t), 10.0)))
    found = values.bias(case)
    assert -0.01 < found.value < 0.06 and not found.flagged  # 0.9^29 < 0.05
    assert [len(g) for _, g in values.on_policy(case)] == [60 - 29] * 20
    short = case_of(lambda: Counting(ends=None, cuts=20), both(lambda t: np.full(len(t), 10.0)))
    with pytest.raises(CannotMeasure, match="cannot be lifted"):
        values.bias(short)


def test_no_value_may_exceed_what_any_return_can_be() -> None:
    right, wrong = (limited(lambda t, f=f: np.full(len(t), f / (1 - GAMMA))) for f in (1.0, 3.0))  # type: ignore[misc]
    assert values.soft_divergence(right).value == pytest.approx(1.0)
    assert values.soft_divergence(wrong).value == pytest.approx(3.0)
    assert not values.soft_divergence(right).flagged and values.soft_divergence(wrong).flagged
    for times, flagged in ((1.09, False), (1.11, True)):
        case = ending(lambda t, times=times: np.where(t == 3, 10 * times, 1.0))  # type: ignore[misc]
        assert values.soft_divergence(case).flagged == flagged
    undiscounted = values.soft_divergence(case_of(Counting, both(lambda t: ENDS - t), gamma=1.0))
    assert undiscounted.value == pytest.approx(1.0)  # 1 a step, as many as there are
    broken = values.soft_divergence(ending(lambda t: np.where(t == 3, np.nan, 1.0)))
    assert broken.flagged and math.isnan(broken.value) and broken.threshold is None and broken.grade == "B"
    assert values.soft_divergence(case_of(Counting, both(np.ones_like), gamma=0.0)).value == 1
    with pytest.raises(CannotMeasure, match="no reward"):
        values.soft_divergence(ending(np.ones_like, pays=lambda t, a: 0.0))


# V1, V6a: an environment that pays for the action t mod 2.


def alternating() -> gym.Env[Any, Any]:
    return Counting(pays=lambda t, a: float(a == t % 2), ends=20)


def on_the_beat(s: Array) -> Array:
    return np.eye(2)[s[:, 0].astype(int) % 2]


def test_a_policy_that_is_no_better_than_one_action_has_not_learned() -> None:
    good, bad = (case_of(alternating, subject) for subject in (on_the_beat, lambda s: np.eye(2)[[0] * len(s)]))
    assert values.has_learned(good).value == 20 and not values.has_learned(good).flagged
    assert values.has_learned(bad).value == 10 and values.has_learned(bad).flagged
    assert values.better_actions(good).value == 0 and not values.better_actions(good).flagged
    wrong = case_of(alternating, lambda s: 1 - on_the_beat(s))
    assert values.better_actions(wrong).value == 1 and values.better_actions(wrong).flagged


def test_a_policy_is_held_against_the_best_that_needs_no_skill_and_its_luck() -> None:
    one = values.has_learned(case_of(lambda: Counting(pays=lambda t, a: float(a)), lambda s: np.eye(2)[[1] * len(s)]))
    assert one.flagged and (one.value, one.threshold, one.source) == (ENDS, ENDS, "the upper bound of action 1 alone")
    case = case_of(alternating, on_the_beat)
    chance = values.has_learned(case)  # which earns half of 20 on the average, and more with some luck
    mean = np.mean([one.score for one in case.chance])
    drawn = values.has_learned(case_of(Drawing, lambda s: np.eye(2)[[1] * len(s)]))
    assert drawn.source == "the upper bound of action 1 alone" and drawn.threshold is not None
    assert drawn.flagged and drawn.interval is not None and drawn.interval[0] < drawn.value < drawn.interval[1]
    assert 15.1 < drawn.threshold < 20  # 15 on the average, and what three of them may miss
    assert chance.source == "the upper bound of random" and chance.threshold is not None
    assert mean + 0.5 < chance.threshold < mean + 3 and chance.interval == (20, 20)


def test_means_have_an_interval_where_there_are_two_that_differ() -> None:
    rng = np.random.default_rng(0)
    given = ([3.0], [2.0, 2.0, 2.0], [1.0, 3.0])
    assert [values._mean_bounds(np.array(one), rng) for one in given] == [(3, 3), (2, 2), (1, 3)]


class Drawing(Counting):
    """Action 1 pays 1 or nothing, with equal chances."""

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        s, _, terminated, truncated, told = super().step(action)
        return s, float(action * self.np_random.integers(2)), terminated, truncated, told


GAINS = [  # of the other action over the greedy one, in three tries
    ([1.0, 1.0, 1.0], True),
    ([0.1, 0.5, 0.3], True),  # 0.3 ± 0.115
    ([0.0, 0.5, 0.3], False),  # 0.267 ± 0.145: less than two standard errors
    ([0.021, 0.021, 0.021], True),
    ([0.019, 0.019, 0.019], False),  # next to nothing, beside the largest
    ([-1.0, -1.0, -1.0], False),
]


def test_an_action_is_better_where_it_gains_more_than_two_standard_errors_and_more_than_next_to_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = case_of(alternating, on_the_beat)
    gains = np.array([[[0.0] * 3, gain] for gain, _ in GAINS])
    monkeypatch.setattr(values, "_gains", lambda case, states: gains)
    found = values.better_actions(case)
    assert found.value == pytest.approx(np.mean([better for _, better in GAINS])) and found.flagged == (
        found.interval is not None and found.interval[0] > 0.2
    )
    gains = 1e-12 * gains
    assert values.better_actions(case).value == 0  # of rounding
    gains = 1e9 * gains  # a thousandth of what they were
    assert values.better_actions(case).value == found.value
    for num, flagged in ((8, False), (14, True)):  # of 24: about 0.17 and 0.38 at least
        gains = np.zeros((24, 2, 3))
        gains[:num, 1] = 1.0
        found = values.better_actions(case)
        assert found.value == num / 24 and found.flagged == flagged
    case.clock.began -= 0.8 * case.clock.budget_s
    with pytest.raises(CannotMeasure, match="too little of the budget"):
        values.better_actions(case)


class Late(Counting):
    """Pays for action 1 two steps later; does not go on past its end."""

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        assert self.t < 40
        self.taken = [*(getattr(self, "taken", ()) if self.t else ()), int(action)]
        s, _, terminated, truncated, told = super().step(action)
        return s, float(self.taken[-3]) if self.t > 2 else 0.0, terminated, truncated, told


def test_what_an_action_gains_is_discounted_and_cannot_be_told_of_what_cannot_be_copied(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = case_of(lambda: Late(ends=40), lambda s: np.eye(2)[[1] * len(s)])
    states = values._snapshots(case)
    assert values._gains(case, states)[:, 0] == pytest.approx(-(GAMMA**2)) and len(states) == 10
    seen = {float(s[0]) for _, s, _ in states}  # at all times of an episode's first half
    assert len(seen) > 5 and 13 < max(seen) < 20
    taken = np.concatenate([env.unwrapped.taken for env, s, _ in states if s[0] > 0])
    assert set(taken) == {0, 1} and taken.mean() > 0.85
    asked: list[int] = []
    counted = replace(case, subject=load_subject(lambda s: [asked.append(len(s)), np.tile(s, 2)][1]))  # type: ignore[func-returns-value]
    same = values._values(counted, [np.array([3.0]), np.array([5.0]), np.array([3.0])])
    assert same.tolist() == [[3, 3], [5, 5], [3, 3]] and asked == [2]  # copies that see the same are asked once
    brief = replace(case, world=open_world(lambda: Counting(ends=5)))
    assert max(float(s[0]) for _, s, _ in values._snapshots(brief)) < 5  # begun anew
    monkeypatch.setattr(values, "_LARGE", 1)
    assert len(values._snapshots(case)) == 8
    spent = replace(case, clock=Clock(1e-9))
    assert (values._gains(spent, states) == 0).all()  # after the first step, before anything is paid
    monkeypatch.setattr(Counting, "__deepcopy__", lambda env, memo: 1 / 0, raising=False)
    with pytest.raises(CannotMeasure, match="cannot be copied"):
        values.better_actions(case)


def test_values_that_order_states_as_their_returns_do_are_told_from_those_that_do_not() -> None:
    right, reversed_, none = (
        values.rank(ending(value)) for value in (lambda t: worth(ENDS - t), lambda t: t, lambda t: np.zeros(len(t)))
    )
    assert right.value == 1 and not right.flagged  # though a third of them were enough
    assert reversed_.value == -1 and reversed_.flagged and none.value == 0 and none.flagged
    with pytest.raises(CannotMeasure, match="hardly differ"):
        values.rank(limited(lambda t: t))  # of which every state is worth the same


# V5: reach.


@pytest.mark.parametrize(("copies", "flagged"), [(21, True), (22, False)])
def test_reach_is_the_share_that_so_many_copies_can_carry(copies: int, flagged: bool) -> None:
    known = Settings(updates=100.0 * copies, target_period_updates=100.0)
    case = case_of(lambda: TimeLimit(Counting(ends=None), 40), both(lambda t: t), settings=known)
    assert values.reach(case).value == pytest.approx(1 - GAMMA**copies)
    assert f"see {100 * (1 - GAMMA**copies):.3g} % of what" in values.reach(case).evidence
    assert values.reach(case).flagged == flagged
    ended = case_of(lambda: Counting(ends=4), both(lambda t: t), settings=known)  # 4 steps are all there is to see
    assert values.reach(ended).value == pytest.approx(1.0) and not values.reach(ended).flagged


def test_reach_without_a_discount_is_the_share_of_the_longest_episode() -> None:
    def undiscounted(copies: float | None, **settings: Any) -> Finding:
        known = Settings(updates=copies, target_period_updates=1.0)
        return values.reach(case_of(lambda: Counting(**settings), both(np.abs), gamma=1.0, settings=known))

    assert undiscounted(15.0).value == 0.5 and undiscounted(15.0).flagged and undiscounted(99.0).value == 1
    with pytest.raises(CannotMeasure, match="no number of copies"):
        undiscounted(15.0, ends=None, cuts=30)
    with pytest.raises(CannotMeasure, match="--set target_period_updates=N"):
        undiscounted(None)


def test_reach_counts_steps_of_targets_and_shares_of_copies() -> None:
    assert Settings(updates=1000, target_period_updates=100, num_steps=3).steps_of_reach == 30
    assert Settings(updates=1000, target_period_updates=1, tau=0.01).steps_of_reach == pytest.approx(10)
    assert Settings(updates=1000, target_period_updates=100, lambda_=0.8).steps_of_reach == pytest.approx(50)
    assert Settings(updates=1000).steps_of_reach is None


# V3: values as a learner with each mistake would have them.


def waves(t: int, a: int) -> float:
    return float([3, 0, 1, 0, 0][t % 5])


def summed(t: Array, pays: Callable[[int], float], steps: int = ENDS, gamma: float = GAMMA) -> Array:
    """Σ γᵏ pays(t + k) up to the end, written out."""
    return np.array([sum(gamma**k * pays(i + k) for k in range(max(steps - i, 0))) for i in t.astype(int).tolist()])


MISTAKES: dict[str, Callable[[], Case]] = {
    "γ = 0.5": lambda: ending(lambda t: worth(ENDS - t, 0.5)),
    "the sign of rewards reversed": lambda: ending(lambda t: -worth(ENDS - t)),
    "rewards times 0.1": lambda: ending(lambda t: 0.1 * worth(ENDS - t)),
    "no end of episodes in the target": lambda: ending(lambda t: np.full(len(t), 1 / (1 - GAMMA))),
    "the time limit taken for the end of the world": lambda: limited(lambda t: worth(40 - t)),
    "rewards one step late": lambda: ending(lambda t: summed(t, lambda i: waves(i - 1, 0) if i else 0.0), pays=waves),
    "rewards one step early": lambda: ending(
        lambda t: summed(t, lambda i: waves(i + 1, 0) if i + 1 < ENDS else 0.0), pays=waves
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_each_mistake_is_named_by_the_values_it_makes(name: str) -> None:
    found = hypotheses.hypotheses(MISTAKES[name]())
    assert found.title.endswith(f"a learner with {name}") and found.flagged and found.value < 0.2


def test_right_values_are_no_mistake_and_two_that_agree_are_not_told_apart() -> None:
    assert not hypotheses.hypotheses(ending(lambda t: worth(ENDS - t))).flagged
    assert not hypotheses.hypotheses(ending(lambda t: summed(t, lambda i: waves(i, 0)), pays=waves)).flagged
    flat = hypotheses.hypotheses(limited(lambda t: np.full(len(t), 2.0)))  # γ = 0.5, or a fifth of every reward
    assert not flat.flagged and "cannot tell" in flat.evidence


def test_a_mistake_has_to_fit_clearly_better_and_lines_are_drawn_in_the_order_of_returns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = MISTAKES["no end of episodes in the target"]()
    found = hypotheses.lines(case)
    assert next(iter(found)) == "no end of episodes in the target" and len(found) == 2
    line = found["no end of episodes in the target"]
    assert (np.diff(line[:, 0]) > 0).all() and line[:, 1] == pytest.approx(np.full(20, 10.0))
    monkeypatch.setattr(hypotheses, "_BETTER", 0.0)
    assert not hypotheses.hypotheses(case).flagged


def test_too_few_copies_are_not_taken_for_a_mistake() -> None:
    known = Settings(updates=10, target_period_updates=10)
    case = case_of(lambda: Counting(), both(lambda t: worth(ENDS - t, 0.5)), settings=known)
    assert not hypotheses.hypotheses(case).flagged


@pytest.mark.parametrize(("alpha", "beta"), [(1, 0.86), (-1, GAMMA), (1, 0.84), (1, 0.94), (1, 0.96)])
def test_the_equation_of_one_step_gives_the_scale_of_rewards_and_the_discount(alpha: float, beta: float) -> None:
    found = hypotheses.one_step(ending(lambda t: alpha * summed(t, lambda i: waves(i, 0), gamma=beta), pays=waves))
    assert found.value == pytest.approx(beta, abs=1e-6) and f"{alpha:.3f} r" in found.evidence
    assert found.flagged == (alpha < 0 or abs(beta - GAMMA) > 0.05)


def test_the_equation_needs_five_episodes_whose_rewards_and_values_vary_apart() -> None:
    case = ending(lambda t: summed(t, lambda i: waves(i, 0)), pays=waves)
    few = replace(case, explored=case.explored[:2], chance=case.chance[:2])
    with pytest.raises(CannotMeasure, match="fewer than 5"):
        hypotheses.one_step(few)
    assert hypotheses.one_step(replace(few, chance=case.chance[:3])).value == pytest.approx(GAMMA, abs=1e-6)
    with pytest.raises(CannotMeasure, match="vary apart"):
        hypotheses.one_step(limited(lambda t: np.full(len(t), 10.0)))


@pytest.mark.parametrize("gamma", [0.0, 0.8, 0.95, 0.98, 0.99, 0.995])
def test_every_other_discount_is_told(gamma: float) -> None:
    found = hypotheses.hypotheses(ending(lambda t: summed(t, lambda i: waves(i, 0), gamma=gamma), pays=waves))
    assert found.flagged and found.title.endswith(f"a learner with γ = {gamma:g}")


# E1–E6: environments with a fault, and without.


def test_a_broken_contract_is_said_in_words() -> None:
    broken = Counting(shows=lambda t, rng: [math.nan if t == 3 else 0.0])
    found = environment.contract(case_of(lambda: broken, both(lambda t: t)))
    assert found.flagged and "NaN" in found.evidence
    assert not environment.contract(ending(lambda t: t)).flagged


def test_the_checker_of_stable_baselines_is_asked_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def check_env(env: Any, warn: bool, skip_render_check: bool) -> None:
        asked.append(env)
        assert not isinstance(env, Turning), "turning is forbidden"

    name = "stable_baselines3.common.env_checker"
    for part in ("stable_baselines3", "stable_baselines3.common", name):
        monkeypatch.setitem(sys.modules, part, types.SimpleNamespace(check_env=check_env))  # type: ignore[arg-type]
    found = environment.contract(case_of(lambda: Turning(2), both(np.abs)))
    assert found.flagged and found.evidence == "Stable-Baselines3's check_env says: turning is forbidden"
    assert not environment.contract(ending(lambda t: t)).flagged and len(asked) == 2
    monkeypatch.setitem(sys.modules, name, None)  # type: ignore[arg-type]  # as if it were not installed
    assert not environment.contract(case_of(lambda: Turning(2), both(np.abs))).flagged


@pytest.mark.slow
def test_the_real_checker_of_stable_baselines_finds_nothing_in_a_sound_environment() -> None:
    pytest.importorskip("stable_baselines3")
    found = environment.contract(case_of("CartPole-v1", lambda s: np.zeros((len(s), 2))))
    assert not found.flagged and "Stable-Baselines3" in found.evidence


def test_a_seed_that_decides_nothing_is_found() -> None:
    unseeded = np.random.default_rng()
    found = environment.determinism(case_of(lambda: Counting(shows=lambda t, rng: [unseeded.random()]), both(np.abs)))
    assert found.flagged
    seeded = case_of(lambda: Counting(shows=lambda t, rng: [rng.random()]), both(np.abs))
    assert not environment.determinism(seeded).flagged


def test_a_time_limit_reported_as_termination_is_told_from_a_real_end() -> None:
    def noise(t: int, rng: np.random.Generator) -> list[float]:
        return [rng.normal(), rng.normal()]

    disguised = case_of(lambda: Counting(ends=30, shows=noise), both(np.abs))
    honest = case_of(lambda: Counting(ends=None, cuts=30, shows=noise), both(np.abs))
    shown = ending(lambda t: t)  # the last observation is told apart: it is the 30th
    assert environment.disguised_limit(disguised).flagged
    assert not environment.disguised_limit(honest).flagged
    assert environment.disguised_limit(shown).value == 1 and not environment.disguised_limit(shown).flagged
    drifts = case_of(lambda: Counting(ends=30, shows=lambda t, rng: [t + rng.normal()]), both(np.abs))
    found = environment.disguised_limit(drifts)  # told from those before it, but no better than the 29th from its own
    assert found.flagged and 0.85 < found.value < 0.95 and found.threshold is not None and found.threshold > 0.85


def test_scales_of_observations_and_rewards_are_measured() -> None:
    uniform = case_of(lambda: Counting(shows=lambda t, rng: [100 * rng.random(), rng.random()]), both(np.abs))
    found = environment.observation_scale(uniform)
    assert found.value == pytest.approx(98, abs=1.5) and found.flagged  # 99 % of both entries: 98 % of the large one
    small = case_of(lambda: Counting(shows=lambda t, rng: [rng.random()]), both(np.abs))
    assert not environment.observation_scale(small).flagged and not environment.reward_scale(small).flagged
    large = environment.reward_scale(ending(lambda t: t, pays=lambda t, a: -1000.0))
    assert large.value == pytest.approx(1000 / (1 - GAMMA)) and large.flagged
    never = environment.reward_scale(ending(lambda t: t, pays=lambda t, a: 0.0))
    assert never.flagged and "sparse" in never.title


ANGLE = 0.3


class Turning(Counting):
    """A point on a circle, turned by `ANGLE` each step; with one coordinate of two shown it hides where it goes."""

    def __init__(self, entries: int) -> None:
        super().__init__(shows=lambda t, rng: [0.0] * entries)
        self.entries = entries

    def _seen(self) -> Array:
        if self.t == 0:
            self.phase = self.np_random.uniform(0, 2 * math.pi)
        at = self.phase + ANGLE * self.t
        return np.array([math.cos(at), math.sin(at)][: self.entries])


def test_what_is_hidden_is_what_the_past_tells_more() -> None:
    """Var Δx = 1 − cos θ, of which x alone explains (1 − cos θ)² / 2, and with the step before all: (1 + cos θ) / 2."""
    hides = aliasing.aliasing(case_of(lambda: Turning(1), both(np.abs)))
    shows = aliasing.aliasing(case_of(lambda: Turning(2), both(np.abs)))
    assert hides.value == pytest.approx((1 + math.cos(ANGLE)) / 2, abs=0.05) and hides.flagged
    assert abs(shows.value) < 0.02 and not shows.flagged and "TD(0) and Monte Carlo differ by" in shows.evidence


def test_temporal_differences_and_monte_carlo_disagree_where_states_look_alike() -> None:
    """Two steps that pay 0 and 1, seen as one: returns γ and 1 average .95; V = .5 + γ V / 2 says .5 / .55."""
    x, r, ended = np.zeros((40, 1)), np.tile([0.0, 1.0], 20), np.tile([False, True], 20)
    g = np.tile([0.9, 1.0], 20)
    alike = td_against_monte_carlo(x, r, x, ended, g, 0.9, np.random.default_rng(0))
    assert alike == pytest.approx((0.95 - 0.5 / 0.55) / 0.05, rel=1e-3)
    told = np.tile([[0.0], [1.0]], (20, 1))
    assert td_against_monte_carlo(told, r, 1 - told, ended, g, 0.9, np.random.default_rng(0)) < 1e-3


# R1–R6: networks with a known share of dead units, of known rank, fresh or moved.


def two_layers(units: int, seed: int = 0) -> nn.Sequential:
    net = nn.Sequential(nn.Linear(2, units), nn.ReLU(), nn.Linear(units, 2))
    return signs.fresh(net, np.random.default_rng(seed))  # type: ignore[return-value]


def noisy() -> gym.Env[Any, Any]:
    return Counting(shows=lambda t, rng: [rng.normal(), rng.normal()])


def test_dormant_units_are_counted_and_fresh_networks_are_not_flagged() -> None:
    net = two_layers(50)
    healthy = network.dormant(case_of(noisy, net))
    assert not healthy.flagged and abs(healthy.value) < 0.2
    with torch.no_grad():
        net[0].weight[:40] = 0.0  # type: ignore[index]
        net[0].bias[:40] = -1.0  # type: ignore[index]
        net[0].bias[40:] = 1.0  # type: ignore[index]
    dead = network.dormant(case_of(noisy, net))
    assert dead.flagged and "80 % of hidden units" in dead.evidence
    assert dead.fresh == healthy.fresh and sum(healthy.fresh) == pytest.approx(0, abs=1e-9)  # about their mean
    assert max(dead.fresh) < 0.2 < dead.value and healthy.interval is not None
    assert healthy.interval[0] == pytest.approx(healthy.value - max(healthy.fresh))


def test_effective_rank_of_units_that_all_say_the_same_is_one() -> None:
    net = two_layers(50)
    assert not network.effective_rank(case_of(noisy, net)).flagged
    with torch.no_grad():
        net[0].weight[:] = net[0].weight[0]  # type: ignore[index]
        net[0].bias[:] = net[0].bias[0]  # type: ignore[index]
    same = network.effective_rank(case_of(noisy, net))
    assert same.value == 1 and same.flagged and (min(same.fresh), max(same.fresh)) == same.interval


def test_weights_that_never_moved_are_known() -> None:
    net = two_layers(50, seed=5)
    assert network.untouched(case_of(noisy, net)).flagged
    with torch.no_grad():
        net[2].weight *= 3  # a third of them stays where all were
    moved = network.untouched(case_of(noisy, net))
    assert not moved.flagged and moved.value > 2
    assert moved.threshold == 1.5 * max(moved.fresh) and len(moved.fresh) == 8


def test_lag_is_relative_and_weights_that_are_not_finite_are_named() -> None:
    net, late = two_layers(10), two_layers(10)
    with torch.no_grad():
        late[2].weight *= 0.25
        late[2].bias *= 0.25
    case = case_of(noisy, of_network(net, "x", target=late))
    assert network.lag(case).value == pytest.approx(0.75) and network.lag(case).flagged
    level = case_of(noisy, of_network(net, "x", target=two_layers(10)))
    assert network.lag(level).value == 0 and not network.lag(level).flagged
    with torch.no_grad():
        net[2].bias[0] = math.nan
    assert math.isnan(network.lag(case).value) and network.lag(case).flagged


def test_churn_grows_with_the_step_and_leaves_the_subject_alone() -> None:
    net = nn.Linear(2, 2)
    with torch.no_grad():
        net.weight[:], net.bias[:] = torch.tensor([[0.01, 0.0], [-0.01, 0.0]]), 0.0
    before = [p.clone() for p in net.parameters()]
    pays = lambda: Counting(pays=lambda t, a: 1.0 - 2.0 * a, shows=lambda t, rng: [rng.normal(), rng.normal()])  # noqa: E731
    tiny, huge = (case_of(pays, net, settings=Settings(learning_rate=rate)) for rate in (1e-9, 1.0))
    assert network.churn(tiny).value == 0 and not network.churn(tiny).flagged
    assert network.churn(huge).value > 0.1 and network.churn(huge).flagged
    assert all(torch.equal(a, b) for a, b in zip(before, net.parameters(), strict=True))


def test_the_kernel_says_of_w_to_2w_that_errors_grow() -> None:
    """Tsitsiklis and Van Roy's: one weight, features 1 and 2; A = (…) is negative where 2 leads to 2 and γ > 5/6."""
    net = nn.Linear(1, 2, bias=False)
    with torch.no_grad():
        net.weight[:] = 1.0

    def steps(t: int, rng: np.random.Generator) -> list[float]:
        return [1.0 if t == 0 else 2.0]

    grows = network.kernel(case_of(lambda: Counting(ends=None, cuts=2, shows=steps), net, gamma=0.99))
    shrinks = network.kernel(case_of(lambda: Counting(ends=None, cuts=2, shows=steps), net, gamma=0.5))
    assert grows.flagged and grows.value < 0 and "target network" in grows.remedy
    assert not shrinks.flagged and shrinks.value > 0


@pytest.mark.slow
def test_plasticity_of_a_fresh_network_is_that_of_a_fresh_network() -> None:
    net = two_layers(600)
    assert network.plasticity(case_of(noisy, net)).value == pytest.approx(1.0, abs=0.3)
    with torch.no_grad():
        net[0].weight[:] = 0.0  # type: ignore[index]
        net[0].bias[:] = -1.0  # type: ignore[index]
    assert network.plasticity(case_of(noisy, net)).flagged  # no unit of it can move any more


@pytest.mark.parametrize("trains", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_network_that_is_too_small_is_told_from_one_that_is_not(
    trains: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Returns rise, fall and rise again along an episode, and one unit bends a line once, however it is trained."""
    monkeypatch.setattr(capacity, "_SEEDS", 4)
    if not trains:
        monkeypatch.setattr(capacity, "regressed", lambda *given: 0.0)  # no better than the mean

    def waving() -> gym.Env[Any, Any]:
        return Counting(pays=lambda t, a: 3 * math.cos(t / 3), shows=lambda t, rng: [t / 15 - 1, 0.0])

    narrow, wide = (capacity.capacity(case_of(waving, two_layers(units))) for units in (1, 64))
    assert narrow.flagged and narrow.cause == "representation" and narrow.grade == "B"
    assert not wide.flagged and wide.value < 0.1


# Action masks: what is illegal is never tried, and what is said of it counts nowhere.


class Strict(Counting):
    """Of three actions one is legal, t mod 3 (of the first two also the next); the others raise."""

    def __init__(self, legal: Callable[[int], list[int]] = lambda t: [t % 3], **settings: Any) -> None:
        super().__init__(**settings)
        self.allows, self.action_space = legal, spaces.Discrete(3)

    def _info(self) -> dict[str, Any]:
        return {"action_mask": np.isin(np.arange(3), self.allows(self.t)).astype(np.int8)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        return super().reset(seed=seed)[0], self._info()

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        assert int(action) in self.allows(self.t), "an illegal action"
        return *super().step(action)[:4], self._info()


class Asked(Strict):
    """The same, which tells by a method what is legal."""

    def _info(self) -> dict[str, Any]:
        return {}

    def action_masks(self) -> Array:
        return np.isin(np.arange(3), self.allows(self.t))


def tempting(value: Callable[[Array], Array]) -> Values:
    """The same value for the legal action t mod 3, and a million for the others."""
    return lambda s: np.where(np.arange(3) == s[:, :1] % 3, value(s[:, 0])[:, None], 1e6)


def test_only_legal_actions_are_played_and_only_their_values_count() -> None:
    case = case_of(lambda: Strict(pays=waves), tempting(lambda t: summed(t, lambda i: waves(i, 0))))
    assert len(case.greedy) == 20 and all(one.length == ENDS for one in case.episodes)
    assert values.bias(case).value == pytest.approx(0, abs=1e-9) and not values.soft_divergence(case).flagged
    assert values.soft_divergence(case).value < 1
    assert hypotheses.one_step(case).value == pytest.approx(GAMMA, abs=1e-6)
    assert not environment.contract(case).flagged and not environment.determinism(case).flagged
    assert values.better_actions(case).value == 0
    assert {int(a) for one in case.constant[0] for a in one.actions} == {0, 1, 2}  # the others where it is illegal
    asked = case_of(lambda: Asked(pays=waves), tempting(lambda t: summed(t, lambda i: waves(i, 0))))
    assert asked.masked and len(asked.greedy) == 20 and values.better_actions(asked).value == 0
    pays = lambda t, a: float(a == (t + 1) % 3)  # noqa: E731
    second = lambda s: np.where(np.arange(3) == (s[:, :1] + 1) % 3, 0.0, tempting(np.ones_like)(s))  # noqa: E731
    wrong = values.better_actions(case_of(lambda: Strict(lambda t: [t % 3, (t + 1) % 3], pays=pays), second))
    assert wrong.value == 1 and wrong.flagged  # the first is chosen, the second pays, the third counts for nothing


def test_a_step_changes_no_policy_where_there_is_no_choice() -> None:
    net = signs.fresh(nn.Linear(2, 3), np.random.default_rng(0))
    shows = lambda t, rng: [rng.normal(), rng.normal()]  # noqa: E731
    known = Settings(learning_rate=1.0)
    masked, free = (
        case_of(lambda allows=allows: Strict(allows, shows=shows, pays=lambda t, a: t % 2), net, settings=known)  # type: ignore[misc]
        for allows in (lambda t: [t % 3], lambda t: [0, 1, 2])
    )
    assert {network.churn(masked).value, *network.churn(masked).fresh} == {0.0} and max(network.churn(free).fresh) > 0.2
    assert math.isfinite(network.kernel(masked).value)


class Walled(gym.Wrapper[Any, Any, Any, Any]):
    """FrozenLake whose masks forbid what bumps into a wall."""

    def _info(self) -> dict[str, Any]:
        row, column = divmod(int(self.env.unwrapped.s), 4)  # type: ignore[attr-defined]
        return {"action_mask": np.array([column > 0, row < 3, column < 3, row > 0])}

    def reset(self, **given: Any) -> Any:
        return self.env.reset(**given)[0], self._info()

    def step(self, action: Any) -> Any:
        return *self.env.step(action)[:4], self._info()


def test_exact_regret_knows_the_masks_that_were_met() -> None:
    lake = gym.make("FrozenLake-v1", is_slippery=False)
    q = np.nan_to_num(solve(FiniteMDP.from_gymnasium(lake), GAMMA).q)
    at = np.arange(16)
    q = np.where(np.stack([at % 4 > 0, at < 12, at % 4 < 3, at > 3], axis=1), q, 1e3)
    case = case_of(lambda: Walled(gym.make("FrozenLake-v1", is_slippery=False)), lambda s: q[s])
    assert exactly.regret(case).value == pytest.approx(0, abs=1e-9)
    assert exactly.against_optimum(case).value == pytest.approx(0, abs=1e-9)


@pytest.mark.slow
def test_exact_regret_asks_the_masks_of_an_environment_whose_model_has_none() -> None:
    taxi = gym.make("Taxi-v4").unwrapped
    legal = np.stack([taxi.action_mask(s) for s in range(500)]) != 0  # type: ignore[attr-defined]
    q = np.where(legal, solve(FiniteMDP.from_gymnasium(taxi), GAMMA).q, 1e3)
    case = case_of("Taxi-v4", lambda s: q[s])
    assert exactly.regret(case).value == pytest.approx(0, abs=1e-9)
    assert exactly.against_optimum(case).value == pytest.approx(0, abs=1e-9)
    assert not values.has_learned(case).flagged


# D1–D5: stored experience.


def experience(num_episodes: int = 12, length: int = 50) -> dict[str, Array]:
    t = np.tile(np.arange(length), num_episodes)
    last = t == length - 1
    rows = {"obs": t[:, None] * 1.0, "next_obs": t[:, None] + 1.0, "action": t % 2, "reward": t % 3 == 0}
    return {**rows, "terminated": np.zeros(len(t), bool), "truncated": last}


def stored_case(**changes: Array) -> Case:
    make = lambda: TimeLimit(Counting(ends=None), 50)  # noqa: E731
    return case_of(make, both(lambda t: t), data={**experience(), **changes})


FAULTS: dict[str, tuple[Callable[[Case], Finding], dict[str, Array], float]] = {
    "D1 both": (stored.merged_ends, {"terminated": experience()["truncated"]}, 12),
    "D1 at the limit": (
        stored.merged_ends,
        {"terminated": experience()["truncated"], "truncated": np.zeros(600, bool)},
        12,
    ),
    "D2": (stored.reset_leak, {"next_obs": np.roll(experience()["obs"], -1, axis=0)}, 11),
    "D4": (stored.actions_taken, {"action": np.zeros(600, int)}, 1.0),
    "D5": (stored.rewards_seen, {"reward": np.zeros(600)}, 0.0),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_of_stored_data_is_counted_and_sound_data_are_not_flagged(name: str) -> None:
    measure, changes, value = FAULTS[name]
    found = measure(stored_case(**changes))
    assert found.flagged and found.grade == "B" and found.value == pytest.approx(value)
    assert not measure(stored_case()).flagged


def test_a_buffer_that_holds_too_little_is_named_with_and_without_the_data() -> None:
    assert not stored.window(stored_case()).flagged
    few = {name: column[:60] for name, column in experience().items()}
    assert stored.window(stored_case(**few)).flagged
    small, large = (
        case_of(lambda: Counting(), both(lambda t: t), settings=Settings(capacity=n)) for n in (60.0, 6000.0)
    )
    assert stored.window(small).flagged and not stored.window(large).flagged


@pytest.mark.parametrize(
    ("measure", "ill", "well", "value"),
    [
        (
            stored.few_batches,
            {"capacity": 639.0, "batch_size": 64.0},
            {"capacity": 640.0, "batch_size": 64.0},
            639 / 64,
        ),
        (stored.greedy_only, {"epsilon_start": 0.0, "epsilon_end": 0.0}, {"epsilon_start": 0.1, "epsilon_end": 0.0}, 0),
    ],
)
def test_a_setting_that_is_a_mistake_is_named_though_all_went_well(
    measure: Any, ill: dict[str, float], well: dict[str, float], value: float
) -> None:
    found, twin = (measure(case_of(lambda: Counting(), both(lambda t: t), settings=Settings(**s))) for s in (ill, well))
    assert found.flagged and found.value == pytest.approx(value) and not twin.flagged
    assert decide([calm("V1"), calm("V2"), found])[0][0].grade == "B"
    for name in ill:
        with pytest.raises(CannotMeasure, match=f"--set .*{name}="):
            measure(case_of(lambda: Counting(), both(lambda t: t), settings=Settings(**{**ill, name: None})))


def test_noisy_layers_explore_without_epsilon() -> None:
    settings = [
        settings_of_run(
            config_from_dict({"learner": "replay", "epsilon_start": 0.0, "epsilon_end": 0.0, "replay": own}), None
        )
        for own in ({}, {"noisy": True})
    ]
    assert [s.epsilon_start for s in settings] == [0.0, None] and [s.epsilon_end for s in settings] == [0.0, None]


def test_stored_actions_are_those_that_the_environment_names() -> None:
    """Numbered from 3, and worth t and t + 100: read from another number they would be each other's, or none."""

    class Shifted(gym.ActionWrapper[Any, Any, Any]):
        def __init__(self) -> None:
            super().__init__(Counting(ends=None, cuts=50))
            self.action_space = spaces.Discrete(2, start=3)

        def action(self, action: Any) -> int:
            assert self.action_space.contains(int(action))
            return int(action) - 3

    rows = {**experience(), "reward": np.ones(600), "action": experience()["action"] + 3}
    case = case_of(Shifted, lambda s: np.stack([s[:, 0], 100 + s[:, 0]], axis=1), data=rows)
    s, a = rows["obs"][:, 0], rows["action"] - 3
    errors = 1 + GAMMA * (101 + s) - (s + 100 * a)
    got = values._td_error(case, None, *(case.stored[k] for k in ("obs", "action", "reward", "next_obs", "terminated")))  # type: ignore[index]
    assert got == pytest.approx((errors**2).mean())
    assert 0.01 < values.generalisation(case).value < 1  # the same, of a policy that prefers action 1
    assert values.better_actions(case).value == 0 and values.has_learned(case).value == 50


def test_a_missing_column_is_named_with_the_line_that_writes_it() -> None:
    rows = experience()
    del rows["truncated"]
    with pytest.raises(ValueError, match=r"'truncated'.*numpy\.savez"):
        stored.check_columns(rows)


def test_errors_on_fresh_experience_are_compared_with_those_on_the_data() -> None:
    """Q = t and reward 1: δ = 1 + γ(t + 1) − t on the data as on fresh steps; with values fitted to the data, more."""
    case = stored_case(reward=np.ones(600))
    assert values.generalisation(case).value == pytest.approx(1.0, abs=0.35)
    learned = stored_case(reward=np.array([i - GAMMA * (i + 1) + 0.01 for i in experience()["obs"][:, 0]]))
    assert values.generalisation(learned).flagged


@pytest.mark.parametrize(("reward", "flagged"), [(0.5, True), (0.70, True), (0.72, False), (0.0, True)])
def test_the_ratio_of_errors_is_that_of_squares_within_the_limit(reward: float, flagged: bool) -> None:
    """Values of 0: errors are rewards, 1 in the first 50 steps, which is all that was ever learned from, then 9."""
    make = lambda: TimeLimit(Counting(ends=None, pays=lambda t, a: 1.0 if t < 50 else 9.0), 50)  # noqa: E731
    data = {**experience(), "reward": np.full(600, reward)}
    found = values.generalisation(case_of(make, both(lambda t: np.zeros(len(t))), data=data))
    assert found.value == pytest.approx(1 / max(reward**2, 1e-12)) and found.flagged == flagged


# V7: exactly.


def test_exact_regret_is_nothing_for_the_best_values_and_what_it_is_for_others() -> None:
    model = FiniteMDP.from_gymnasium(gym.make("FrozenLake-v1", is_slippery=False))
    best = solve(model, GAMMA)
    q = np.nan_to_num(best.q)
    good = case_of(lambda: gym.make("FrozenLake-v1", is_slippery=False), lambda s: q[s])
    assert exactly.regret(good).value == pytest.approx(0, abs=1e-9) and not exactly.regret(good).flagged
    assert exactly.against_optimum(good).value == pytest.approx(0, abs=1e-6)
    stays = case_of(lambda: gym.make("FrozenLake-v1", is_slippery=False), lambda s: np.eye(4)[[0] * len(s)] * 5)
    start = float(model.start_distribution @ best.v)
    assert exactly.regret(stays).value == pytest.approx(start / float(np.ptp(best.v))) and exactly.regret(stays).flagged
    assert exactly.against_optimum(stays).value > 1 and exactly.against_optimum(stays).flagged


@pytest.mark.slow
def test_states_that_are_seen_as_features_are_answered_exactly_too() -> None:
    """FrozenLake one-hot, twice as large: the values of a row are those of the state behind it."""

    def make() -> gym.Env[Any, Any]:
        flat = gym.wrappers.FlattenObservation(gym.make("FrozenLake-v1", is_slippery=False))
        return gym.wrappers.TransformObservation(flat, lambda s: 2.0 * s, spaces.Box(0, 2, (16,), np.float64))

    q = np.nan_to_num(solve(FiniteMDP.from_gymnasium(gym.make("FrozenLake-v1", is_slippery=False)), GAMMA).q)
    good, wrong = (case_of(make, lambda s, by=by: by + (s / 2) @ q) for by in (0.0, 2.0))
    assert exactly.regret(good).value == pytest.approx(0, abs=1e-9)
    assert exactly.against_optimum(good).value == pytest.approx(0, abs=1e-6)
    assert exactly.regret(wrong).value == pytest.approx(0, abs=1e-9)
    assert exactly.against_optimum(wrong).value == pytest.approx(2.0 / q.max())
    path = good.greedy[0].observations
    assert exactly._states(good, path).tolist() == sorted(set(path.argmax(1).tolist()))


# The decision.


def flagged(name: str, cause: Any, grade: Any = "B", value: float = 1.0) -> Finding:
    return Finding(name, name, cause, grade, value, flagged=True)


def calm(name: str) -> Finding:
    return Finding(name, name, "algorithm", "B", 0.0)


def test_the_first_cause_comes_first() -> None:
    def first(*found: Finding) -> str:
        return decide(found)[0][0].id

    wrong = flagged("V2", "algorithm")
    assert first(wrong, flagged("V5", "algorithm"), flagged("E6", "environment")) == "E6"
    assert first(wrong, flagged("V3", "algorithm"), flagged("V5", "algorithm")) == "V5"
    assert first(wrong, flagged("D3", "data"), flagged("R1", "algorithm")) == "D3"
    assert first(wrong, flagged("R7", "representation"), flagged("V6a", "algorithm")) == "R7"
    assert first(flagged("V4", "algorithm", value=5.0), flagged("R7", "representation"), calm("R1")) == "R7"
    assert first(flagged("E4", "representation", "C", 1e4), wrong) == "E4"
    assert first(flagged("E4", "representation", "C", 50.0), wrong) == "V2"  # beyond the threshold, not far beyond
    assert first(flagged("X3", "algorithm", "A"), flagged("E6", "environment")) == "X3"


def test_a_policy_that_has_learned_right_values_is_healthy_whatever_its_vital_signs_say() -> None:
    found, headline = decide(
        [calm("V1"), calm("V2"), calm("V4"), flagged("R1", "algorithm"), flagged("V5", "algorithm")]
    )
    assert {one.grade for one in found} == {"C"} and headline.startswith("Healthy")
    for name, value, grade in (("V4", 1.2, "C"), ("V4", 1.5, "B"), ("V4", math.nan, "B"), ("V6a", 0.7, "C")):
        found, _ = decide([calm("V1"), calm("V2"), flagged(name, "algorithm", value=value)])
        assert [one.grade for one in found] == [grade]
    found, headline = decide([calm("V1"), calm("V2"), flagged("D1", "data")])
    assert found[0].grade == "B" and headline.startswith("Data")


def test_values_that_are_only_too_low_are_a_vital_sign() -> None:
    low, high = flagged("V2", "algorithm", value=-0.4), flagged("V2", "algorithm", value=0.4)
    found, headline = decide([calm("V1"), low, calm("V6"), flagged("V6a", "algorithm")])
    assert [one.grade for one in found] == ["C", "C"] and "lower than what it returns" in headline
    for ill in (
        "V1",
        "V3",
        "V5",
        "V6",
    ):  # a policy that has not learned, a mistake that explains it, order that is lost
        assert decide([calm("V1"), low, flagged(ill, "algorithm")])[0][0].grade == "B", ill
    assert decide([calm("V1"), high, calm("V6")])[0][0].grade == "B"
    assert decide([calm("V1"), low, flagged("V4", "algorithm", value=2.0)])[0][0].grade == "B"


def test_what_no_measurement_explains_is_not_explained_away() -> None:
    assert decide([flagged("V1", "algorithm"), calm("V2")])[1].startswith("Cannot tell the cause")
    assert decide([])[1].startswith("Cannot tell")

"""Statistics of a stream against NumPy's, and where they stand between environment, learner and agent.

Mutants that must die here: the population variance for the sample variance · the statistics of one observation or
reward divided by a spread of 0 · the discounted sum carried over an episode's end · an evaluation that teaches · a
state normalised anew when it is left · returns reported in scaled rewards · the action mask normalised with the rest.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from neuralq.runs.stream import Interaction, Normalisation, make_vector_env
from neuralq.runs.stream.normalisation import CLIP

ALWAYS = np.ones(1, bool)


def test_observations_are_normalised_by_what_was_seen_so_far() -> None:
    x = (np.random.default_rng(0).standard_normal((200, 5)) * [1, 100, 1e-3, 5, 0] + [0, 1e4, 3, -7, 2]).astype(
        np.float32
    )
    seen = Normalisation((5,), 0.9, 1)
    for t in range(len(x)):
        got = seen.observe(x[t : t + 1])
        past = x[: t + 1].astype(np.float64)
        var = past.var(0, ddof=1) if t else np.ones(5)
        np.testing.assert_allclose(got[0], (x[t] - past.mean(0)) / np.sqrt(var + 1e-8), rtol=1e-4, atol=1e-5)
    assert got.dtype == np.float32 and got[0, 4] == 0


def test_rewards_are_divided_by_the_spread_of_their_discounted_sum() -> None:
    rng = np.random.default_rng(1)
    r, last = rng.normal(3, 2, 100), rng.random(100) < 0.1
    seen, sums, u = Normalisation((1,), 0.9, 1), [], 0.0
    for t in range(100):
        got = seen.reward(r[t : t + 1], last[t : t + 1], ALWAYS)
        u = 0.9 * u * (1 - last[t]) + r[t]
        sums.append(u)
        var = np.var(sums, ddof=1) if t else 1.0
        assert got[0] == pytest.approx(r[t] / np.sqrt(var + 1e-8), rel=1e-12)
        assert seen.reward_scale == pytest.approx(1.0 if t == 0 else 1 / np.sqrt(var + 1e-8), rel=1e-12)


def test_several_environments_are_learned_from_one_after_another_and_only_those_that_moved() -> None:
    x = np.random.default_rng(2).standard_normal((3, 2)).astype(np.float32)
    batch, single = Normalisation((2,), 0.9, 3), Normalisation((2,), 0.9, 1)
    batch.observe(x, np.array([0, 2]))
    single.observe(x[:1])
    single.observe(x[2:])
    for name in ("observation_count", "observation_mean", "observation_squares"):
        np.testing.assert_array_equal(batch.state_dict()[name], single.state_dict()[name])
    batch.reward(np.array([1.0, 50.0, 3.0]), np.zeros(3, bool), np.array([True, False, True]))
    assert batch.reward_scale == pytest.approx(1 / np.sqrt(2.0))  # variance of 1 and 3


def test_a_frozen_view_follows_and_does_not_teach() -> None:
    seen = Normalisation((2,), 0.9, 1)
    view = seen.frozen()
    for x in np.random.default_rng(3).standard_normal((20, 1, 2)).astype(np.float32):
        seen.observe(x)
        seen.reward(np.ones(1), ~ALWAYS, ALWAYS)
    before = {name: value.copy() for name, value in seen.state_dict().items()}
    x = np.ones((4, 2), np.float32)
    out = view.observe(x)
    view.reward(np.full(1, 100.0), ~ALWAYS, ALWAYS)
    for name, value in seen.state_dict().items():
        np.testing.assert_array_equal(value, before[name])
    again = Normalisation((2,), 0.9, 1)
    again.load_state_dict(seen.state_dict())
    np.testing.assert_array_equal(again.frozen().observe(x), out)
    mean, inverse = seen.scaling() or (0.0, 0.0)
    np.testing.assert_allclose((x - mean) * inverse, out, rtol=1e-6)
    assert again.reward_scale == view.reward_scale == seen.reward_scale
    assert (out != x).all()


@pytest.mark.parametrize("which", ["observations", "rewards"])
def test_each_half_can_be_left_out(which: str) -> None:
    seen = Normalisation((1,), 0.9, 1, observations=which != "observations", rewards=which != "rewards")
    for x in (3.0, 5.0):
        got_s = seen.observe(np.full((1, 1), x, np.float32))
        got_r = seen.reward(np.full(1, x), ~ALWAYS, ALWAYS)
    assert (got_s[0, 0] == 5.0) == (which == "observations") == (seen.scaling() is None)
    assert (got_r[0] == 5.0) == (which == "rewards")


class Counter(gym.Env[Any, Any]):
    """Counts its steps; ends after three. Rewards are 10."""

    observation_space = spaces.Box(-100, 100, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {"action_mask": np.array([1, 0])}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        return np.full(1, self.t, np.float32), 10.0, self.t == 3, False, {"action_mask": np.array([1, 0])}


def first(s: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.zeros(len(s), dtype=torch.int64), torch.ones(len(s))


@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_stream_is_seen_through_its_statistics(mode: AutoresetMode) -> None:
    envs = (
        make_vector_env(Counter, 1) if mode is AutoresetMode.DISABLED else SyncVectorEnv([Counter], autoreset_mode=mode)
    )
    seen = Normalisation((1,), 0.9, 1)
    stream = Interaction(envs, 0.9, 0, normalisation=seen)
    arrived = [0.0]

    def expected() -> float:
        var = np.var(arrived, ddof=1) if len(arrived) > 1 else 1.0
        return float((arrived[-1] - np.mean(arrived)) / np.sqrt(var + 1e-8))

    left, taken = expected(), 0
    while taken < 8:
        step = stream.step(first)
        if not len(step.env_indices):  # NEXT_STEP restarts
            continue
        taken += 1
        s_tm1, _, _, r_t, _, s_t, last = step.rows
        assert s_tm1[0, 0] == pytest.approx(left, abs=1e-6), "as it was seen when it arrived"
        assert s_tm1[0, 1:].tolist() == s_t[0, 1:].tolist() == [1.0, 0.0], "masks stay masks"
        arrived.append((taken - 1) % 3 + 1.0)
        here = expected()
        if last[0]:
            assert step.episodes[0].episode_return == 30.0 and taken % 3 == 0
            arrived.append(0.0)
            left = expected()
            arrived_here = here
            assert s_t[0, 0] == pytest.approx(arrived_here, abs=1e-6)
        else:
            assert s_t[0, 0] == pytest.approx(here, abs=1e-6)
            left = here
        assert r_t[0] != 10.0 or taken == 1
    assert seen.state_dict()["observation_count"][0] == len(arrived)


def test_a_spread_that_was_never_seen_divides_nothing() -> None:
    seen = Normalisation((1,), 0.9, 1)
    for _ in range(100):
        seen.observe(np.full((1, 1), 0.1))
    view = seen.frozen()
    assert view.observe(np.full((1, 1), 0.2))[0, 0] == pytest.approx(0.1), "(0.2 − 0.1) / 1, not / 1e-4"
    mean, inverse = seen.scaling() or (0.0, 0.0)
    assert (0.2 - mean) * inverse == pytest.approx(0.1)


def test_rewards_whose_sums_are_all_alike_are_not_divided_by_nothing() -> None:
    seen = Normalisation((1,), 0.9, 1)
    for _ in range(5):  # episodes of one step
        assert seen.reward(np.array([3.0]), ALWAYS, ALWAYS)[0] == pytest.approx(3.0)
    assert seen.reward_scale == pytest.approx(1.0)


def test_what_was_as_good_as_constant_is_clipped_when_it_moves() -> None:
    seen = Normalisation((2,), 0.9, 1)
    for x in (0.1, 0.1000001, 0.1, 0.1000001):
        seen.observe(np.array([[x, x]]))
    out = seen.frozen().observe(np.array([[5.0, -5.0]]))
    assert out.tolist() == [[CLIP, -CLIP]]


def test_a_large_offset_is_subtracted_before_float32_rounds_it_away() -> None:
    space, ticks = spaces.Box(-np.inf, np.inf, (1,), np.float64), 1e9 + np.arange(5.0)

    class Clock(Counter):
        observation_space = space

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
            super().reset(seed=seed)
            return ticks[:1].copy(), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            self.t += 1
            return ticks[self.t : self.t + 1].copy(), 0.0, False, False, {}

    stream = Interaction(make_vector_env(Clock, 1), 0.9, 0, normalisation=Normalisation((1,), 0.9, 1))
    for t in range(1, 5):
        here = stream.step(first).rows[5][0, 0]
        # 0..t have mean t/2 and sample variance (t + 1)(t + 2)/12.
        assert here == pytest.approx((t / 2) / np.sqrt((t + 1) * (t + 2) / 12), rel=1e-5)
    assert here.dtype == np.float32


@pytest.mark.parametrize("num_envs", [1, 3])
def test_episodes_that_restart_in_the_same_step_teach_in_the_order_of_all_others(num_envs: int) -> None:
    def streamed(mode: AutoresetMode) -> tuple[list[Any], dict[str, Any]]:
        made = [lambda i=i: Late(i) for i in range(num_envs)]
        envs: Any = SyncVectorEnv(made, autoreset_mode=mode)  # type: ignore[arg-type]
        seen = Normalisation((1,), 0.9, num_envs)
        stream = Interaction(envs, 0.9, 0, normalisation=seen)
        return [stream.step(first).rows for _ in range(12)], seen.state_dict()

    (one, in_one), (two, in_two) = streamed(AutoresetMode.SAME_STEP), streamed(AutoresetMode.DISABLED)
    for rows in zip(one, two, strict=True):
        for mine, theirs in zip(*rows, strict=True):
            np.testing.assert_array_equal(mine, theirs)
    for name, value in in_one.items():
        np.testing.assert_array_equal(value, in_two[name])


class Late(Counter):
    """A counter that starts at its index, so that environments end at different times."""

    def __init__(self, index: int) -> None:
        self.index = index

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        _, info = super().reset(seed=seed)
        self.t, self.index = self.index % 3, 0
        return np.full(1, self.t - 7.0, np.float32), info


def test_one_sum_divides_nothing_and_the_state_is_one_number_of_each_kind() -> None:
    seen = Normalisation((3,), 0.5, 2)
    assert seen.reward_scale == 1.0
    assert seen.reward(np.array([4.0, 6.0]), np.zeros(2, bool), np.array([True, False])).tolist() == pytest.approx(
        [4, 6]
    )
    assert seen.reward_scale == 1.0  # exactly: one sum has no spread
    seen.reward(np.array([8.0, 0.0]), np.zeros(2, bool), np.array([True, False]))  # 4, then 2 + 8: a variance of 18
    assert seen.reward_scale == pytest.approx(18**-0.5)
    shapes = {name: value.shape for name, value in seen.state_dict().items()}
    assert shapes["observation_mean"] == shapes["observation_squares"] == (3,) and shapes["returns"] == (2,)
    assert {shapes[name] for name in shapes.keys() - {"observation_mean", "observation_squares", "returns"}} == {(1,)}

"""Environments of which a part is hidden, and the test that tells."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from neuralq.doctor import hidden_state
from neuralq_envs.hidden import Shown


def shown(*entries: int) -> gym.Env:
    return Shown(gym.make("CartPole-v1"), entries)


def test_entries_are_shown_in_their_order() -> None:
    env, whole = shown(3, 0), gym.make("CartPole-v1")
    seen, all_ = env.reset(seed=3)[0], whole.reset(seed=3)[0]
    assert env.observation_space.contains(seen) and seen.tolist() == [all_[3], all_[0]]
    assert env.step(1)[0].tolist() == whole.step(1)[0][[3, 0]].tolist()


@pytest.mark.parametrize("entries", [(), (4,), (-1,), (0.5,)])
def test_entries_that_there_are_not_are_refused(entries: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="whole numbers from 0 to 3, at least one, got"):
        shown(*entries)
    with pytest.raises(ValueError, match="entries are hidden of vectors of numbers"):
        Shown(gym.make("FrozenLake-v1"), [0])


def test_hidden_velocities_are_found_and_shown_ones_are_not() -> None:
    hides, shows = hidden_state(lambda: shown(0, 2), num_episodes=30), hidden_state("CartPole-v1", num_episodes=30)
    assert hides.hides and hides.gain > 0.5 and hides.entry in (0, 1)
    assert not shows.hides and abs(shows.gain) < 0.01
    assert hides.discrepancy is not None and shows.discrepancy is not None and hides.discrepancy > shows.discrepancy
    assert hidden_state("CartPole-v1", num_episodes=30) == shows


@pytest.mark.parametrize(
    ("given", "message"), [({"num_episodes": 4}, "8 episodes of at least 3 steps"), ({"gamma": 2}, "gamma")]
)
def test_what_cannot_be_told_is_said(given: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hidden_state("CartPole-v1", **given)


def test_wide_observations_are_refused() -> None:
    wide = gym.spaces.Box(0, 1, (300,), np.float64)
    with pytest.raises(ValueError, match="up to 200 are regressed on"):
        hidden_state(
            lambda: gym.wrappers.TransformObservation(gym.make("CartPole-v1"), lambda o: np.zeros(300), wide), 10
        )

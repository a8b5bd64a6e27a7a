"""Greedy evaluation: the first episode of every environment, each once, on episodes that the seed decides.

Mutants that these tests kill: whichever episodes end first are taken (short ones win); a second episode of an
environment counted while another is still in its first; an episode that never ends dropped instead of counted as cut;
rounds that repeat their seeds; the action of the lowest instead of the highest value.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor

from neuralq.runs.evaluation import evaluate_greedy
from neuralq.runs.stream import Interaction


class Countdown(gym.Env[Any, Any]):
    """The seed of the reset sets the episode's length, 1 + seed mod 5; action 1 pays the length, action 0 nothing."""

    def __init__(self, endless: bool = False) -> None:
        self.observation_space = spaces.Box(-1, 1000, (1,), np.float32)
        self.action_space = spaces.Discrete(2)
        self.endless, self.length, self.t = endless, 1, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self.length = 1 + seed % 5
        self.t = 0
        return np.array([self.length], np.float32), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        ends = self.t == self.length and not self.endless
        return np.array([self.length], np.float32), float(self.length * action), ends, False, {}


def prefer_one(s: Tensor) -> Tensor:
    return torch.stack([torch.zeros(len(s)), torch.ones(len(s))], -1)


def stream_of(mode: AutoresetMode, num_envs: int, endless: bool = False) -> Interaction:
    return Interaction(SyncVectorEnv([lambda: Countdown(endless)] * num_envs, autoreset_mode=mode), 0.9, 0)


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("num_envs", [1, 3, 8])
def test_every_episode_counts_once_in_the_order_of_the_lanes(mode: AutoresetMode, num_envs: int) -> None:
    result = evaluate_greedy(prefer_one, stream_of(mode, num_envs), 7, seed=10)
    lengths = [1 + (10 + i) % 5 for i in range(7)]  # one environment or eight: the seeds go on from round to round
    assert result.lengths == tuple(lengths)
    assert result.returns == tuple(float(n * n) for n in lengths)
    assert result.mean == np.mean([n * n for n in lengths])
    assert result.num_cut == 0


def test_the_same_seed_meets_the_same_episodes_and_another_seed_others() -> None:
    stream = stream_of(AutoresetMode.DISABLED, 4)
    first, again, other = (evaluate_greedy(prefer_one, stream, 4, seed) for seed in (3, 3, 4))
    assert first == again != other


def test_episodes_without_an_end_are_cut_and_counted() -> None:
    result = evaluate_greedy(prefer_one, stream_of(AutoresetMode.NEXT_STEP, 3, endless=True), 3, 0, max_steps=6)
    assert result.num_cut == 3
    assert result.lengths == (6, 6, 6) and result.returns == (6.0, 12.0, 18.0)


def test_the_greedy_action_is_taken() -> None:
    stream = stream_of(AutoresetMode.DISABLED, 2)
    assert evaluate_greedy(lambda s: -prefer_one(s), stream, 2, 0).returns == (0.0, 0.0)


def test_no_episodes_are_refused() -> None:
    with pytest.raises(ValueError, match="num_episodes"):
        evaluate_greedy(prefer_one, stream_of(AutoresetMode.DISABLED, 2), 0, 0)

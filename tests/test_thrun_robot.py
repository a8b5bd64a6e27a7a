"""Thrun's robot against a pose that is moved on the ground; nothing is compiled here.

Mutants that die here: a turn to the other side or about the target, a stride backwards, a target behind that counts as
reached, the two distances exchanged, an end that does not end, a text that is mirrored.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from neuralq_envs.thrun_robot import FORWARD, LEFT, ThrunRobotEnv, by_geometry, outcomes, successors


@pytest.mark.parametrize("num_steps", [400, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_robot_is_a_pose_on_the_ground_for_many_random_steps(num_steps: int) -> None:
    env, rng = gymnasium.make("neuralq/ThrunRobot-v0"), np.random.default_rng(0)
    check_env(gymnasium.make("neuralq/ThrunRobot-v0", render_mode="rgb_array").unwrapped)
    s, _ = env.reset(seed=0)
    starts, ends, steps = [s], {1.0: 0, -1.0: 0, 0.0: 0}, 0
    target, robot, heading = complex(*s), 0j, 1 + 0j
    for _ in range(num_steps):
        steering = by_geometry(s) if rng.random() < 0.5 else rng.integers(3)
        move = int(steering)
        s, reward, terminated, truncated, extra = env.step(move)
        steps += 1
        robot += 0.35 * heading if move == 0 else 0
        heading *= cmath.exp(1j * math.radians((0, 25, -25)[move]))
        expected = (target - robot) / heading
        assert abs(expected - complex(*s)) < 1e-12 and s in env.observation_space
        lost = expected.real < 0 or abs(expected) > 4.2
        reached = abs(expected) < 0.45 and not lost
        assert reward == reached - lost and terminated == (reached or lost) and extra["is_success"] == reached
        assert truncated == (steps == 30) or terminated
        if terminated or truncated:
            ends[reward] += 1
            s, _ = env.reset()
            starts.append(s)
            target, robot, heading, steps = complex(*s), 0j, 1 + 0j, 0
    distance, bearing = np.linalg.norm(starts, axis=1), np.arctan2(*np.array(starts).T[::-1])
    assert 1 <= distance.min() and distance.max() <= 4 and np.abs(bearing).max() <= math.radians(60)
    assert ends[1.0] and ends[-1.0] and (num_steps < 1000 or ends[0.0])


def test_moves_and_ends_by_hand() -> None:
    assert successors([1.0, 0.5], FORWARD).tolist() == pytest.approx([0.65, 0.5])
    side = math.sin(math.radians(25))
    assert successors([2.0, 0.0], LEFT)[1] == pytest.approx(-2 * side)  # who turns left has what was ahead on the right
    seen = [[0.44, 0.0], [0.46, 0.0], [0.0, 0.3], [-0.01, 0.3], [4.19, 0.0], [0.5, 4.2]]
    assert outcomes(seen).tolist() == [1, 0, 1, -1, 0, -1]
    assert by_geometry([[1.0, math.tan(math.radians(degrees))] for degrees in (12, 13, -12, -13)]).tolist() == [
        0,
        1,
        0,
        2,
    ]


def test_the_robot_can_be_looked_at() -> None:
    env = ThrunRobotEnv("ansi")
    assert env.render() is None
    env.reset(options={"target": (2.1, 1.5)})
    *ground, said = env.render().splitlines()
    assert ground[7].index("X") == 18 and ground[14].index("^") == 28 and len(ground) == 15
    assert said == "target +2.10 m ahead, 1.50 m to the left"
    env.reset(options={"target": (0.7, 0.0)})
    env.step(FORWARD)
    assert env.render().endswith("target +0.35 m ahead, 0.00 m to the left, reached\n")
    picture = ThrunRobotEnv("rgb_array")
    picture.reset(options={"target": (2.0, -1.0)})
    row, column = np.argwhere((picture.render() == (235, 170, 160)).all(axis=2)).mean(axis=0)
    assert abs(row - (4.4 - 2.0) * 40) < 1.5 and abs(column - (4.6 + 1.0) * 40) < 1.5


@pytest.mark.parametrize(
    ("act", "error", "said"),
    [
        (lambda: ThrunRobotEnv("human"), ValueError, "render_mode must be one of"),
        (lambda: ThrunRobotEnv().step(0), ResetNeeded, "call reset"),
        (lambda: ThrunRobotEnv().reset(options={"target": (0.1, 0.1)}), ValueError, "0.45 to 4.2 m away"),
        (lambda: ThrunRobotEnv().reset(options={"target": (1.0,)}), ValueError, "must be metres ahead"),
        (lambda: ThrunRobotEnv().reset(options={"target": (np.nan, 0.0)}), ValueError, "must be metres ahead"),
        (lambda: successors([1.0, 0.0], 3), ValueError, "a must be one of 0, 1, 2"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        act()


def test_an_episode_that_has_ended_wants_a_reset() -> None:
    env = ThrunRobotEnv()
    env.reset(options={"target": (0.7, 0.0)})
    with pytest.raises(ValueError, match="action must be 0"):
        env.step(3)
    env.step(FORWARD)
    with pytest.raises(ResetNeeded, match="reached or lost"):
        env.step(FORWARD)

"""Random walks, Boyan's chain and maximization bias: values in closed form, noise by its moments.

Mutants that die here: rewards of the two ends swapped; a walk that starts beside the middle; −3 for Boyan's last move;
noise on the moves out of A, on illegal ones, or by the state of the episode before; the same noise for all copies.
"""

from __future__ import annotations

from fractions import Fraction

import gymnasium
import numpy as np
import pytest

from neuralq.mdp import FiniteMDP
from neuralq_envs import boyan, maximization_bias, random_walk
from neuralq_envs.graphs import GraphScene
from neuralq_envs.rendering import RenderedEnv


def values(model: FiniteMDP) -> np.ndarray:
    """V of a model with one action and γ = 1, by dense linear algebra over the states that go on."""
    P, lively = np.zeros((model.num_states, model.num_states)), np.flatnonzero(~model.is_terminal)
    reward = np.zeros(model.num_states)
    P[lively], reward[lively] = model.transition.toarray(), model.reward
    return np.linalg.solve(np.eye(model.num_states) - P, reward)


def test_the_walks_have_the_values_of_the_literature() -> None:
    five = gymnasium.make("neuralq/RandomWalk-v0").unwrapped.mdp()
    assert values(five)[1:-1] == pytest.approx([i / 6 for i in range(1, 6)], abs=1e-12)
    nineteen = gymnasium.make("neuralq/RandomWalk19-v0").unwrapped.mdp()
    assert values(nineteen)[1:-1] == pytest.approx([i / 10 for i in range(-9, 10)], abs=1e-12)
    assert values(five)[[0, -1]].tolist() == values(nineteen)[[0, -1]].tolist() == [0.0, 0.0]
    assert np.flatnonzero(five.start_distribution).tolist() == [3]
    assert np.flatnonzero(nineteen.start_distribution).tolist() == [10]
    other = values(random_walk.mdp(num_states=4, left_reward=3.0, right_reward=-2.0))
    assert other[1:-1] == pytest.approx([float(3 - Fraction(5 * i, 5)) for i in range(1, 5)], abs=1e-12)


def test_a_walk_ends_at_either_end_with_that_ends_reward() -> None:
    env, ends = gymnasium.make("neuralq/RandomWalk-v0", left_reward=-4.0, right_reward=6.0), []
    for episode in range(30):
        s, terminated = env.reset(seed=episode)[0], False
        assert s == 3
        while not terminated:
            s_tm1 = s
            s, reward, terminated, _, _ = env.step(0)
            assert abs(s - s_tm1) == 1 and terminated == (s in (0, 6)) and (terminated or reward == 0)
        ends.append((s, reward))
    assert set(ends) == {(0, -4.0), (6, 6.0)}
    with pytest.raises(ValueError, match="num_states"):
        random_walk.mdp(num_states=0)
    with pytest.raises(ValueError, match="not a valid reward"):
        random_walk.mdp(left_reward=float("nan"))


def test_boyans_chain_is_worth_two_a_state_and_linear_in_its_features() -> None:
    model = gymnasium.make("neuralq/BoyanChain-v0").unwrapped.mdp()
    assert values(model) == pytest.approx(-2.0 * np.arange(13), abs=1e-12)
    assert boyan.features() @ [-24.0, -16.0, -8.0, 0.0] == pytest.approx(-2.0 * np.arange(13), abs=1e-12)
    assert boyan.features()[7].tolist() == [0, 0.75, 0.25, 0] and np.linalg.matrix_rank(boyan.features()) == 4
    assert model.start_distribution[12] == 1.0


def test_going_left_costs_a_tenth_on_average() -> None:
    model = maximization_bias.mdp()
    assert model.reward.tolist() == [0.0, 0.0] + [-0.1] * 10
    assert model.legal.sum(axis=1).tolist() == [2, 10, 0]
    assert model.termination.tolist() == [0.0] + [1.0] * 11
    for wrong in ({"num_actions": 1}, {"mean": float("inf")}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            maximization_bias.make(**wrong)


def test_only_rewards_from_b_are_noisy_and_they_are_normal() -> None:
    env = gymnasium.make("neuralq/MaximizationBias-v0", num_actions=3, mean=0.5, standard_deviation=2.0).unwrapped
    env.reset(seed=0)
    rewards = []
    for i in range(4000):
        env.reset()
        assert env.step(2)[:3] == (0, 0.0, False)  # not legal in A
        assert env.step(maximization_bias.LEFT)[:3] == (1, 0.0, False)
        rewards.append(env.step(i % 3)[1])
    # Standard errors: 2/√4000 = .032 of the mean, 2/√8000 = .022 of the standard deviation.
    assert np.mean(rewards) == pytest.approx(0.5, abs=0.13) and np.std(rewards) == pytest.approx(2.0, abs=0.09)
    assert np.mean(np.abs(np.array(rewards) - 0.5) < 2.0) == pytest.approx(0.6827, abs=0.03)
    env.reset()
    assert env.step(maximization_bias.RIGHT)[:3] == (2, 0.0, True)


def test_copies_draw_their_own_noise() -> None:
    envs = gymnasium.make_vec("neuralq/MaximizationBias-v0", num_envs=4000, vectorization_mode="vector_entry_point")
    left = np.zeros(4000, dtype=np.int64)
    runs = []
    for _ in range(2):
        envs.reset(seed=5)
        assert envs.step(left)[1].tolist() == [0.0] * 4000
        _, reward, terminations, _, _ = envs.step(left)
        assert terminations.all()
        runs.append(reward)
    assert (runs[0] == runs[1]).all()  # the seed decides
    assert len(np.unique(runs[0])) == 4000
    assert np.mean(runs[0]) == pytest.approx(-0.1, abs=0.064) and np.std(runs[0]) == pytest.approx(1.0, abs=0.045)
    mask = np.arange(4000) < 2
    assert envs.reset(options={"reset_mask": np.ones(4000, dtype=bool)})[0].sum() == 0
    envs.step(np.where(mask, maximization_bias.RIGHT, maximization_bias.LEFT))
    envs.reset(options={"reset_mask": mask})
    reward = envs.step(left)[1]
    assert reward[:2].tolist() == [0.0, 0.0] and (reward[2:] != 0).all()
    envs.reset()
    envs.step(left)
    envs.reset()  # away from B
    assert envs.step(left)[1].tolist() == [0.0] * 4000


def test_an_illegal_action_pays_nothing_not_even_noise() -> None:
    scene = GraphScene(("A", "B", "END"), ((0, 0), (0, 1), (0, 2)))
    env = RenderedEnv(maximization_bias.mdp(num_actions=3), scene, None, np.ones((3, 3)))
    env.reset(seed=0)
    assert env.step(2)[:2] == (0, 0.0) and env.step(maximization_bias.LEFT)[1] != 0


def test_noise_must_fit_the_model() -> None:
    scene = GraphScene(("A",) * 13, tuple((0, s) for s in range(13)))
    for wrong in (np.zeros(13), np.full((13, 1), -1.0), np.full((13, 1), np.nan)):
        with pytest.raises(ValueError, match=r"reward_noise must be \(13, 1\) numbers"):
            RenderedEnv(boyan.mdp(), scene, None, wrong)
    with pytest.raises(ValueError, match="each of the 2 states needs a place"):
        GraphScene(("A", "B"), ((0, 0),))


def test_a_line_that_would_pass_over_a_state_is_an_arc() -> None:
    places = ((0, 0), (0, 1), (0, 2))
    straight = GraphScene(("", "", ""), places, ((0, 1), (1, 2))).pixels(None).astype(int)
    arc = GraphScene(("", "", ""), places, ((0, 2),)).pixels(None).astype(int)
    assert (straight[28, 50:62] < 255).all() and (arc[28, 50:62] == 255).all()
    assert (straight[:9] == 255).all() and (arc[:9, 80:88] < 255).any()

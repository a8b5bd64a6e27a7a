"""Recording: the steps of an agent that explores a little, as a data set."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from neuralq.checks import check_fraction, check_whole
from neuralq.runs.agent import Agent
from neuralq.runs.loop import seed_for
from neuralq.runs.offline.recorded import Recorded
from neuralq.runs.stream import faults_of, legal_actions
from neuralq.runs.stream.acting import choose_among

__all__ = ["record_steps"]


def record_steps(
    env: gym.Env[Any, Any], agent: Agent, num_episodes: int, epsilon: float, seed: int, max_steps: int
) -> Recorded:
    """Whole episodes of an ε-greedy agent, with the probability of each action.

    Args:
        env: a single environment; it is reset.
        agent: whose greedy actions are taken but for ε.
        num_episodes: how many.
        epsilon: ε in [0, 1], with which each action is drawn from all instead.
        seed: of episodes and exploration.
        max_steps: after so many an episode is cut.

    Raises:
        ValueError: for an environment whose observations are no arrays, or that masks actions.
        EnvironmentFault: if its own code fails.
    """
    check_fraction("epsilon", epsilon)
    check_whole("num_episodes", num_episodes)
    if isinstance(env.observation_space, gym.spaces.Dict | gym.spaces.Tuple):
        raise ValueError(
            "a data set holds arrays of observations, and this environment observes several parts; flatten it"
        )
    rng = np.random.default_rng(seed_for(seed, 14))
    rows: list[tuple[Any, ...]] = []
    for episode in range(num_episodes):
        with faults_of("at reset"):
            observation, info = env.reset(seed=seed_for(seed, 10, episode))
        if legal_actions(env, info) is not None:
            raise ValueError("a data set says nothing of illegal actions, and this environment masks some")
        memory = agent.first_memory()
        for step in range(1, max_steps + 1):
            q = np.asarray(agent.values(observation, memory=memory))[None]
            memory = agent.next_memory(observation, memory)
            action, mu = choose_among(q, epsilon, rng.random(1))
            before = np.array(observation)
            with faults_of(f"in step {step} of episode {episode + 1}"):
                observation, reward, terminated, truncated, info = env.step(int(action[0]) + agent.first_action)
            truncated = bool(truncated) or (step == max_steps and not terminated)
            rows.append((before, action[0], float(reward), bool(terminated), truncated, np.array(observation), mu[0]))
            if terminated or truncated:
                break
    s, a, r, ended, cut, s_t, probabilities = (np.array(column) for column in zip(*rows, strict=True))
    return Recorded(s, a + agent.first_action, r, ended, cut, s_t, probabilities)

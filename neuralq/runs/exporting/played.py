"""What an environment hands out in random play, and what an agent says of it: what exported networks are held to."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from neuralq.runs import RunConfig
from neuralq.runs.agent import Agent
from neuralq.runs.recipe.environments import make_one
from neuralq.runs.stream import faults_of, legal_actions
from neuralq.types import Array

__all__ = ["Played", "played"]

_NUM_OBSERVATIONS = 256


@dataclass(frozen=True, eq=False)
class Played:
    """Observations of random play.

    Args:
        observations: as the environment gave them.
        masks: of legal actions, None where it gave none.
        space: of the observations.
        memories: what the agent remembers before each, ``[n, M]``.
        values: the agent's ``[n, A]``, in units of the environment's return.
    """

    observations: list[Any]
    masks: list[Any]
    space: gym.Space[Any]
    memories: Array
    values: Array


def played(config: RunConfig, agent: Agent) -> Played:
    """A few hundred observations of the environment of a configuration, some episodes long.

    Raises:
        EnvironmentFault: if the environment's own code fails.
    """
    env = make_one(config)
    rng = np.random.default_rng(0)
    observations, masks, values = list[Any](), list[Any](), []
    memories, memory = [], agent.first_memory()
    try:
        with faults_of("at reset"):
            observation, info = env.reset(seed=0)
        for _ in range(_NUM_OBSERVATIONS):
            mask = legal_actions(env, info)
            observations.append(copy.deepcopy(observation))  # environments may reuse theirs
            masks.append(copy.deepcopy(mask))
            memories.append(memory)
            values.append(agent.values(observation, mask, memory))
            memory = agent.next_memory(observation, memory)
            legal = np.flatnonzero(np.isfinite(values[-1]))
            action = int(rng.choice(legal)) + agent.first_action
            with faults_of("in a step of random play"):
                observation, _, terminated, truncated, info = env.step(action)
                if terminated or truncated:
                    observation, info = env.reset()
                    memory = agent.first_memory()
    finally:
        env.close()
    return Played(observations, masks, env.observation_space, np.stack(memories), np.stack(values))

"""Episodes of a policy, played side by side, with everything that measurements need to know of them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from neuralq.doctor.worlds import World
from neuralq.runs.stream import legal_actions
from neuralq.types import Array, Floats, Indices

__all__ = ["Clock", "EnvironmentRaised", "Episode", "horizon", "legal_in", "play", "returns_from"]

Policy = Callable[[Array, Array, np.random.Generator], tuple[Indices, Floats]]
"""Observations ``[N, *obs]`` and which actions are legal ``[N, A]`` to actions ``[N]`` and the action values ``[N, A]``
that they were chosen by (or NaN)."""

_MOST_BYTES = 256 * 2**20
"""Of observations kept of one policy; where they are pictures, there are fewer episodes, of two at least."""


class EnvironmentRaised(RuntimeError):
    """The environment's own code raised an error."""


class Clock:
    """How much of the budget is left.

    Args:
        budget_s: seconds.
    """

    def __init__(self, budget_s: float) -> None:
        self.began, self.budget_s = time.monotonic(), budget_s

    @property
    def spent(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self.began

    @property
    def left(self) -> float:
        """Seconds, never below 0."""
        return max(self.budget_s - self.spent, 0.0)


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode.

    Args:
        observations: ``[T + 1, *obs]``.
        actions: by number from 0, ``[T]``.
        rewards: ``[T]``.
        values: action values of the observations that were acted on, ``[T, A]``; NaN of policies that have none.
        terminated: whether the world ended it.
        truncated: whether the environment cut it short.
        within: steps that lie within the environment's own limit, T where there is none.
        legal: which actions are legal, ``[T + 1, A]`` bool; None where the environment has no masks.
    """

    observations: Array
    actions: Indices
    rewards: Floats
    values: Floats
    terminated: bool
    truncated: bool
    within: int
    legal: Array | None = None

    @property
    def legal_values(self) -> Floats:
        """The values, −∞ of illegal actions, which are never learned: ``[T, A]``."""
        return self.values if self.legal is None else np.where(self.legal[:-1], self.values, -np.inf)

    @property
    def score(self) -> float:
        """The undiscounted return within the limit."""
        return float(self.rewards[: self.within].sum())

    @property
    def length(self) -> int:
        """T."""
        return len(self.actions)


def horizon(gamma: float, rest: float = 0.05) -> int:
    """Steps after which a discounted return is known but for the share ``rest``: ⌈ln rest / ln γ⌉.

    Example:
        >>> horizon(0.99), horizon(0.5), horizon(0.0)
        (299, 5, 1)
    """
    if gamma <= 0:
        return 1
    return 10**9 if gamma >= 1 else math.ceil(math.log(rest) / math.log(gamma))


def returns_from(episode: Episode, gamma: float, rest: float = 0.05) -> Floats:
    """G_t = Σ_k γᵏ r_{t+k} of the steps within the limit whose return is known, from the first on: ``[n]``, n ≤ T.

    Where the world ended the episode every return is known; else those that lie a `horizon` before the last step.

    Example:
        >>> steps = np.ones(3)
        >>> ended = Episode(np.zeros((4, 1)), np.zeros(3, np.int64), steps, np.zeros((3, 2)), True, False, 3)
        >>> returns_from(ended, 0.5).tolist()
        [1.75, 1.5, 1.0]
    """
    returns = np.empty(episode.length)
    ahead = 0.0
    for t in range(episode.length - 1, -1, -1):
        ahead = returns[t] = episode.rewards[t] + gamma * ahead
    known = episode.length if episode.terminated else max(episode.length - horizon(gamma, rest), 0)
    return returns[: min(known, episode.within)]


def legal_in(env: gym.Env[Any, Any], info: Mapping[str, Any], num_actions: int) -> Array:
    """Which actions ``info["action_mask"]``, or a method, allows, ``[A]`` bool; all where neither allows any.

    Raises:
        EnvironmentRaised: the mask is not of this length.

    Example:
        >>> env = gym.make("CartPole-v1")
        >>> legal_in(env, {"action_mask": [1, 0]}, 2).tolist(), legal_in(env, {}, 2).tolist()
        ([True, False], [True, True])
    """
    told = legal_actions(env, info)
    if told is None:
        return np.ones(num_actions, bool)
    legal: Array = np.asarray(told) != 0
    if legal.shape != (num_actions,):
        shape = list(legal.shape)
        raise EnvironmentRaised(f"the action mask has the shape {shape}, and there are {num_actions} actions")
    return legal if legal.any() else ~legal


def play(
    world: World,
    policy: Policy,
    num_episodes: int,
    seed: int,
    *,
    seconds: float,
    past_limit: int = 0,
    most_steps: int = 1000,
    most_in_all: int = 400_000,
    share: float = 1.0,
) -> list[Episode]:
    """Play episodes side by side; the first of each environment and no other, so that short ones are not favoured.

    Args:
        world: of which environments are made.
        policy: chooses actions.
        num_episodes: how many, begun all at once.
        seed: of environments (``seed + i``) and of the policy's draws.
        seconds: after which running episodes are left as they are.
        past_limit: steps that are played past the environment's limit where it can be lifted.
        most_steps: of an episode where the environment has no limit.
        most_in_all: steps of all episodes together.
        share: of the memory that the observations of one policy may take.

    Raises:
        EnvironmentRaised: its code raised an error.
    """
    lift = world.liftable and past_limit > 0
    limit = world.limit or most_steps
    size = (
        int(np.prod(world.observation_space.shape or (1,)))
        * (world.observation_space.dtype or np.dtype(float)).itemsize
    )
    most = limit + (past_limit if lift else 0)
    num_episodes = min(num_episodes, max(int(share * _MOST_BYTES / size / most), 2))
    envs = [world.lifted() if lift else world.make() for _ in range(num_episodes)]
    rng, until = np.random.default_rng(seed), time.monotonic() + seconds
    try:
        runs = [_Running(env, seed + i, world.num_actions) for i, env in enumerate(envs)]
        going, steps = list(runs), 0
        while going and time.monotonic() < until and steps < most_in_all:
            observations = np.stack([run.observations[-1] for run in going])
            actions, values = policy(observations, np.stack([run.legal[-1] for run in going]), rng)
            for run, action, row in zip(going, actions.tolist(), values, strict=True):
                run.step(action, row, world.first_action)
            steps += len(going)
            going = [run for run in going if not run.ended and len(run.actions) < most]
        return [run.episode(limit) for run in runs if run.actions]
    finally:
        for env in envs:
            env.close()


class _Running:
    """An episode that is being played."""

    def __init__(self, env: gym.Env[Any, Any], seed: int, num_actions: int) -> None:
        self.env, self.num_actions = env, num_actions
        try:
            first, info = env.reset(seed=seed)
        except Exception as error:
            raise EnvironmentRaised(f"reset raised {type(error).__name__}: {error}") from error
        self.masked = legal_actions(env, info) is not None
        self.legal: list[Array] = [legal_in(env, info, num_actions)]
        self.observations: list[Array] = [np.array(first)]
        self.actions: list[int] = []
        self.rewards: list[float] = []
        self.values: list[Array] = []
        self.terminated = self.truncated = False

    @property
    def ended(self) -> bool:
        return self.terminated or self.truncated

    def step(self, action: int, values: Array, first_action: int) -> None:
        try:
            observation, reward, terminated, truncated, info = self.env.step(action + first_action)
        except Exception as error:
            raise EnvironmentRaised(f"step({action + first_action}) raised {type(error).__name__}: {error}") from error
        self.legal.append(legal_in(self.env, info, self.num_actions) if self.masked else self.legal[-1])
        self.observations.append(np.array(observation))
        self.actions.append(action)
        self.rewards.append(float(reward))
        self.values.append(values)
        self.terminated, self.truncated = bool(terminated), bool(truncated)

    def episode(self, limit: int) -> Episode:
        return Episode(
            np.stack(self.observations), np.array(self.actions, np.int64), np.array(self.rewards),
            np.stack(self.values),
            self.terminated, self.truncated, min(len(self.actions), limit),
            np.stack(self.legal) if self.masked else None,
        )  # fmt: skip


def scores(episodes: Sequence[Episode]) -> Floats:
    """Undiscounted returns within the limit."""
    return np.array([one.score for one in episodes])

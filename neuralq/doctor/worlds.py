"""The environment of an examination: copies of it, its limit of steps, and its model where it has one."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, TimeLimit

from neuralq.mdp import FiniteMDP
from neuralq.runs.recipe.games import make_single, refusals_name
from neuralq.runs.recipe.handed import Handed, handed_over
from neuralq.runs.recipe.stand_in import Maker, standing_in
from neuralq.runs.recipe.wrapping import wrapped
from neuralq.runs.stream.encoding import discrete_actions
from neuralq.types import Array

__all__ = ["World", "open_world"]

_FOREVER = 10**9
_COMPOSITE = (spaces.Dict, spaces.Tuple)


@dataclass(frozen=True, eq=False)
class World:
    """What is known of an environment, and a way to make more of it.

    Args:
        name: in words.
        make: makes one.
        num_actions: A.
        first_action: the environment's name of action 0.
        observation_space: a Box or a finite space; composite ones (Dict, Tuple) are flattened, as
            `gymnasium.spaces.flatten` does it.
        limit: steps after which `TimeLimit` truncates; None without one.
        liftable: whether that limit can be lifted, so that episodes go on past it.
        model: the exact model; None where there is none.
        seen_as: the observation of each state of the model, ``[S, *obs]``; None without one.
        named: how `neuralq train` is told of it, in words of a command line.
    """

    name: str
    make: Maker
    num_actions: int
    first_action: int
    observation_space: spaces.Space[Any]
    limit: int | None
    liftable: bool
    model: FiniteMDP | None
    seen_as: Array | None
    named: tuple[str, ...]

    def lifted(self) -> gym.Env[Any, Any]:
        """One whose episodes go on past the limit."""
        env = self.make()
        found = _limit_of(env)
        if found is not None:
            found._max_episode_steps = _FOREVER
        return env

    @property
    def is_discrete(self) -> bool:
        """Whether observations are numbers of states."""
        return isinstance(self.observation_space, spaces.Discrete)

    def as_rows(self, observations: Array) -> Array:
        """Observations as rows of numbers, for regressions: ``[N, d]`` float64; states become one-hot."""
        if isinstance(self.observation_space, spaces.Discrete):
            first, size = int(self.observation_space.start), int(self.observation_space.n)
            return np.eye(size)[np.asarray(observations, np.int64).reshape(-1) - first]
        return np.asarray(observations, np.float64).reshape(len(observations), -1)


def _limit_of(env: gym.Env[Any, Any]) -> TimeLimit[Any, Any] | None:
    inner: Any = env
    while isinstance(inner, gym.Wrapper):
        if isinstance(inner, TimeLimit):
            return inner
        inner = inner.env
    return None


def open_world(env: Any) -> World:
    """The world of an environment.

    Args:
        env: a Gymnasium id, "module:id", an environment, a class or function that makes one, a `FiniteMDP`, or the
            mapping of a run: ``env``, ``env_kwargs``, ``wrappers`` and ``frame_stack``.

    Raises:
        ValueError: it cannot be made, its actions are not `Discrete`, or its observations are of no known space.

    Example:
        >>> world = open_world("CartPole-v1")
        >>> world.limit, world.liftable, world.num_actions, world.model is None
        (500, True, 2, True)
    """
    named = isinstance(env, Mapping)
    handed = Handed(env["env"], dict(env.get("env_kwargs") or {})) if named else handed_over(env)
    around = (env.get("wrappers", ()), env.get("frame_stack", 1)) if named else ((), 1)

    def make() -> gym.Env[Any, Any]:
        with standing_in(handed.make), refusals_name(handed.env), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = wrapped(make_single(handed.env, handed.env_kwargs), *around)
            return FlattenObservation(made) if isinstance(made.observation_space, _COMPOSITE) else made

    first = make()
    try:
        num_actions, first_action = discrete_actions(first.action_space)
        space = first.observation_space
        if not isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
            raise ValueError(
                f"observations must be of a Box, a finite or a composite space, got {type(space).__name__}; wrap the "
                "environment with gymnasium.wrappers.TransformObservation"
            )
        found, spec = _limit_of(first), first.spec
        limit = found._max_episode_steps if found is not None else None if spec is None else spec.max_episode_steps
        model, seen_as = _model(env, first)
        return World(
            name=handed.env, make=make, num_actions=num_actions, first_action=first_action, observation_space=space,
            limit=limit, liftable=found is not None, model=model, seen_as=seen_as, named=_named(env, handed),
        )  # fmt: skip
    finally:
        first.close()


def _named(env: Any, handed: Handed) -> tuple[str, ...]:
    told: dict[str, Any] = {"env_kwargs": dict(handed.env_kwargs)}
    if isinstance(env, Mapping):
        told |= {"wrappers": list(env.get("wrappers") or ()), "frame_stack": env.get("frame_stack", 1)}
    usual: dict[str, Any] = {"env_kwargs": {}, "wrappers": [], "frame_stack": 1}
    changed = {name: value for name, value in told.items() if value != usual[name]}
    return (handed.env, *(word for n, v in changed.items() for word in (f"--{n.replace('_', '-')}", json.dumps(v))))


def _model(env: Any, made: gym.Env[Any, Any]) -> tuple[FiniteMDP | None, Array | None]:
    """The model, and what its states look like: their numbers, or what wrappers of observations make of them."""
    wrappers: list[gym.ObservationWrapper[Any, Any, Any]] = []
    inner: Any = made
    while isinstance(inner, gym.Wrapper) and not isinstance(inner.observation_space, spaces.Discrete):
        if isinstance(inner, gym.ObservationWrapper):
            wrappers.insert(0, inner)
        inner = inner.env
    with contextlib.suppress(Exception):  # there is none, or it is not this environment's
        model = env if isinstance(env, FiniteMDP) else FiniteMDP.from_gymnasium(inner)
        if not isinstance(inner.observation_space, spaces.Discrete):
            return model, None
        seen = list(range(int(inner.observation_space.start), int(inner.observation_space.start) + model.num_states))
        for wrapper in wrappers:
            seen = [wrapper.observation(s) for s in seen]
        return model, np.stack([np.asarray(s) for s in seen])
    return None, None

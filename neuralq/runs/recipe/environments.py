"""The environments of a run: side by side, to train in and to evaluate."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from neuralq.runs.recipe.config import RunConfig
from neuralq.runs.recipe.games import ATARI, make_single, own_maker, refusals_name, register_games
from neuralq.runs.recipe.stand_in import Maker, stand_in, standing_in
from neuralq.runs.recipe.wrapping import wrapped
from neuralq.runs.stream import make_vector_env
from neuralq.runs.stream.workers import make_worker_env
from neuralq_envs import vector_twin

__all__ = ["has_time_limit", "make_envs", "make_evaluation_envs", "make_one"]

_MOST_IN_TURN = 1000
"""Episodes of evaluation that are played one after another where their environments cannot exist side by side."""


def make_envs(config: RunConfig, num_envs: int, training: bool = False) -> VectorEnv[Any, Any, Any]:
    """Parallel environments: the registered vectorised implementation where there is one, else one after another.

    Gymnasium's Mountain Car and Acrobot are vectorised by `neuralq_envs.classic`, which repeats them to the bit.
    Elsewhere a single environment is stepped directly, which is quicker than a batch of one.

    Args:
        config: says which environment.
        num_envs: how many.
        training: whether rewards are clipped, and lives counted for episodes, where the configuration wants that.

    Raises:
        ValueError: if the environment is not registered or cannot be made, with what to do about it.
    """
    register_games(config.env.rpartition(":")[2])
    with refusals_name(config.env):
        plain = not config.wrappers and config.frame_stack == 1 and stand_in() is None
        if plain and own_maker(config.env) is None:  # which imports the module
            vectorised = None if _in_processes(config, num_envs) else _vectorised(config, num_envs)
            if vectorised is not None:
                return vectorised
        make = partial(_single, config, training, stand_in())
        return make_worker_env(make, num_envs) if _in_processes(config, num_envs) else make_vector_env(make, num_envs)


def _in_processes(config: RunConfig, num_envs: int) -> bool:
    return config.vectorization == "async" and num_envs > 1


def _single(config: RunConfig, training: bool, given: Maker | None) -> gym.Env[Any, Any]:
    """One environment in its wrappers, in whichever process."""
    with standing_in(given):
        return make_one(config, training=training)


def _vectorised(config: RunConfig, num_envs: int) -> VectorEnv[Any, Any, Any] | None:
    """An implementation of many at once, where there is one."""
    env_id = config.env.rpartition(":")[2]
    spec = gym.spec(env_id)
    limit = config.env_kwargs.get("max_episode_steps")
    twin = vector_twin(spec, config.env_kwargs) if limit in (None, -1) or _is_limit(limit) else None
    if twin is not None:
        return gym.make_vec(twin[0], num_envs=num_envs, vectorization_mode="vector_entry_point", **twin[1])
    if (num_envs > 1 or spec.entry_point is None) and not env_id.startswith(ATARI):
        return _own_vectorised(spec, config.env_kwargs, num_envs)
    return None


def make_one(config: RunConfig, render_mode: str | None = None, training: bool = False) -> gym.Env[Any, Any]:
    """A single environment in its wrappers.

    Args:
        config: says which environment.
        render_mode: how it is to be drawn, if at all.
        training: as for `make_envs`.

    Raises:
        ValueError: as `make_envs`.

    Example:
        >>> make_one(RunConfig(env="FrozenLake-v1", learner="tabular")).observation_space
        Discrete(16)
    """
    env_id = config.env.rpartition(":")[2]
    register_games(env_id)
    with refusals_name(config.env):
        own = stand_in() is not None or own_maker(config.env) is not None  # which imports the module
        clip, lives = (training and config.clip_rewards, training and config.end_on_life_loss)
        env = make_single(config.env if own else env_id, config.env_kwargs, render_mode, clip, lives)
        return wrapped(env, config.wrappers, config.frame_stack)


def _is_limit(limit: Any) -> bool:
    return isinstance(limit, int) and not isinstance(limit, bool) and limit > 0


def _own_vectorised(spec: EnvSpec, env_kwargs: Mapping[str, Any], num_envs: int) -> VectorEnv[Any, Any, Any] | None:
    """The environment's own vectorised implementation, where it means what `gymnasium.make` makes of these arguments.

    It does not where there are wrappers, where episodes shall have no limit, which such a class takes for a limit of
    −1, where it knows less arguments than the single environment, or does not say how it restarts episodes.
    """
    given = {name: value for name, value in env_kwargs.items() if name != "disable_env_checker"}
    limit = given.get("max_episode_steps")
    if limit is None:
        given.pop("max_episode_steps", None)
    elif not _is_limit(limit):
        return None
    if spec.vector_entry_point is None or spec.additional_wrappers:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if spec.entry_point is not None else "default")
        try:
            envs = gym.make_vec(spec.id, num_envs=num_envs, vectorization_mode="vector_entry_point", **given)
        except TypeError:
            if spec.entry_point is None:
                raise
            return None
    if spec.entry_point is None or isinstance((envs.metadata or {}).get("autoreset_mode"), AutoresetMode):
        return envs
    envs.close()
    return None


def make_evaluation_envs(config: RunConfig, num_envs: int) -> VectorEnv[Any, Any, Any]:
    """As many environments as there are episodes, or one where there cannot be so many at a time.

    Raises:
        ValueError: if there cannot be even one.
    """
    try:
        return make_envs(config, num_envs)
    except ValueError:
        if not 1 < num_envs <= _MOST_IN_TURN:
            raise
        return make_envs(config, 1)


def has_time_limit(envs: VectorEnv[Any, Any, Any]) -> bool:
    """Whether Gymnasium, or the environment's own vectorised implementation, ends every episode some time.

    Example:
        >>> has_time_limit(make_envs(RunConfig(), 2)), has_time_limit(make_envs(RunConfig(env="CliffWalking-v1"), 1))
        (True, False)
    """
    inner = envs.unwrapped
    spec = inner.envs[0].spec if isinstance(inner, SyncVectorEnv) else inner.spec
    limit = None if spec is None else spec.kwargs.get("max_episode_steps", spec.max_episode_steps)
    return limit is not None and limit > 0

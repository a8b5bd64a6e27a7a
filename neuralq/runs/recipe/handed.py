"""Environments that are handed over as objects, classes or functions, and how a run folder names them.

What another process can find again is named: a registered id, or the "module:Class" of an environment that can be
imported. Anything else (a class of a notebook, a function within a function, an object that was changed after it was
made) has only the name ``<Class>``, which no process can follow; it is used within `standing_in`, and has to be handed
over again by whoever resumes or loads the run.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv

from neuralq.mdp import FiniteMDP
from neuralq.runs.folder.env_encode import NotCopyable, difference, encode_env
from neuralq.runs.recipe.games import make_single
from neuralq.runs.recipe.stand_in import Maker

__all__ = ["Handed", "handed_over"]

_OF_THEIR_OWN = ("gymnasium.", "neuralq_envs.", "minatar.", "ale_py.", "shimmy.")
"""Packages whose ids are known to every process that neuralq runs in."""


@dataclass(frozen=True)
class Handed:
    """An environment as a configuration names it.

    Args:
        env: its name.
        env_kwargs: what it is made with.
        make: makes one where the name leads nowhere; None where it can be followed.
    """

    env: str
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    make: Maker | None = None


def handed_over(env: Any) -> Handed:
    """How a configuration names what was handed over.

    Args:
        env: a registered id or "module:id", an environment, its spec, a class or function that makes one, or a model.

    Raises:
        ValueError: for anything else; it says what is accepted.

    Example:
        >>> handed_over(gym.make("FrozenLake-v1", is_slippery=False)).env_kwargs["is_slippery"]
        False
        >>> handed_over(lambda: gym.make("CartPole-v1")).env
        '<CartPoleEnv>'
    """
    if isinstance(env, str):
        return Handed(env)
    if isinstance(env, VectorEnv):
        raise ValueError(
            f"got {type(env).__name__}, which is {env.num_envs} environments at once: hand over one of them, or its "
            "name; how many are stepped together is a setting (num_envs of the learner)"
        )
    if isinstance(env, FiniteMDP):
        return Handed("<FiniteMDP>", make=env.as_env)
    if isinstance(env, EnvSpec):
        return _of_object(gym.make(env))
    if isinstance(env, gym.Env):
        return _of_object(env)
    if callable(env):
        return _of_maker(env)
    raise ValueError(
        f"an environment must be a Gymnasium id, 'module:id', a gymnasium.Env, a class or function that makes one, or "
        f"a FiniteMDP, got {_short(env)}"
    )


def _short(value: Any) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."


def _of_maker(maker: Callable[..., Any]) -> Handed:
    """A class or function by where it is imported from; without a name, by what it makes."""
    inner, kwargs = maker, {}
    if isinstance(maker, functools.partial) and not maker.args:
        inner, kwargs = maker.func, dict(maker.keywords)
    name = _importable(inner)
    if name is not None and _is_plain(kwargs):
        return Handed(name, kwargs)
    try:
        made = maker()
    except Exception as error:
        raise ValueError(
            f"{_short(maker)} made no environment: {type(error).__name__}: {error}; it is called without arguments, "
            "which functools.partial or a lambda can give it"
        ) from error
    _require_env(made, maker)
    called = type(made.unwrapped).__name__
    with contextlib.suppress(Exception):
        made.close()
    return Handed(f"<{called}>", make=maker)


def _require_env(made: Any, maker: Any) -> None:
    if not isinstance(made, gym.Env):
        raise ValueError(f"{_short(maker)} must make a gymnasium.Env, and made {_short(made)}")


def _importable(value: Any) -> str | None:
    """Where a class or function is found by any process, as "module:name"; None if it is not."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", "<")
    if module in (None, "__main__", "builtins") or not all(part.isidentifier() for part in name.split(".")):
        return None
    found: Any = sys.modules.get(str(module))
    for part in name.split("."):
        found = getattr(found, part, None)
    return f"{module}:{name}" if found is value else None


def _is_plain(kwargs: dict[str, Any]) -> bool:
    """Whether a configuration can hold them: what JSON makes of them is they themselves."""
    try:
        return bool(json.loads(json.dumps(kwargs, allow_nan=False)) == kwargs)
    except (TypeError, ValueError):
        return False


def _of_object(env: gym.Env[Any, Any]) -> Handed:
    """By its id where making that gives such an environment again, else by copying it."""
    named = _named(env)
    if named is not None and _makes_again(named, env):
        return named
    return Handed(f"<{type(env.unwrapped).__name__}>", make=_copier(env))


def _named(env: gym.Env[Any, Any]) -> Handed | None:
    spec = env.spec
    usual = None if spec is None else gym.registry.get(spec.id)
    if spec is None or usual is None or spec.additional_wrappers != usual.additional_wrappers:
        return None
    kwargs = {name: value for name, value in spec.kwargs.items() if usual.kwargs.get(name) != value}
    kwargs.pop("render_mode", None)  # a window for each of the run's environments; films ask for what they need
    if spec.max_episode_steps != usual.max_episode_steps:
        kwargs["max_episode_steps"] = -1 if spec.max_episode_steps is None else spec.max_episode_steps
    name: str | None = spec.id
    if not str(spec.entry_point).startswith(_OF_THEIR_OWN):  # who registered it is not known, but what it makes
        kwargs = {**usual.kwargs, **kwargs}
        if "max_episode_steps" not in kwargs and spec.max_episode_steps is not None:
            kwargs["max_episode_steps"] = spec.max_episode_steps
        name = None if usual.additional_wrappers else _importable(type(env.unwrapped))
    return Handed(name, kwargs) if name is not None and _is_plain(kwargs) else None


def _makes_again(named: Handed, env: gym.Env[Any, Any]) -> bool:
    """Whether one that is made by name is what was handed over, as far as its state can be read."""
    if env.render_mode == "human":  # a copy would open a window, if it could be had
        return True
    try:
        given = copy.deepcopy(env)
        made = make_single(named.env, named.env_kwargs, env.render_mode)
    except Exception:
        return False
    try:
        for one in (given, made):
            one.reset(seed=0)
        return difference(encode_env(given.unwrapped), encode_env(made.unwrapped)) is None
    except NotCopyable:
        return True
    except Exception:
        return False
    finally:
        for one in (given, made):
            with contextlib.suppress(Exception):
                one.close()


def _copier(env: gym.Env[Any, Any]) -> Maker:
    """What makes copies of an environment as it is now."""
    try:
        kept = copy.deepcopy(env)
    except Exception as error:
        raise ValueError(
            f"{env} cannot be copied ({type(error).__name__}: {error}), and a run needs several, to train and to "
            "evaluate: hand over a class or a function that makes one"
        ) from error
    return lambda: copy.deepcopy(kept)

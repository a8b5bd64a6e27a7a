"""Wrappers by their names, and frames that are seen together."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import FrameStackObservation

from neuralq.checks import check_module_name

__all__ = ["check_wrappers", "named_wrappers", "wrapped"]


def named_wrappers(wrappers: Sequence[str | Mapping[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    """Each wrapper's name and its arguments.

    Example:
        >>> named_wrappers(["a:B", {"c:D": {"size": 3}}])
        [('a:B', {}), ('c:D', {'size': 3})]
    """
    return [
        (one, {}) if isinstance(one, str) else (str(name), dict(arguments or {}))
        for one in wrappers
        for name, arguments in ([(one, {})] if isinstance(one, str) else one.items())
    ]


def check_wrappers(wrappers: Sequence[str | Mapping[str, Any]]) -> None:
    """Refuse what cannot name a wrapper.

    Raises:
        ValueError: with how one is named.
    """
    for one in wrappers:
        if not isinstance(one, str) and (len(one) != 1 or not isinstance(next(iter(one.values())), Mapping | None)):
            raise ValueError(
                "a wrapper is named 'module:Wrapper', or with arguments {'module:Wrapper': {'size': 3}}, got "
                f"{one!r}"
            )
    for name, _ in named_wrappers(wrappers):
        module, _, found = name.rpartition(":")
        if not module or not found.isidentifier():
            raise ValueError(
                f"a wrapper is named 'module:Wrapper', as 'gymnasium.wrappers:FlattenObservation', got {name!r}"
            )
        check_module_name("the wrapper", module, name)


def wrapped(env: gym.Env[Any, Any], wrappers: Sequence[str | Mapping[str, Any]], frame_stack: int) -> gym.Env[Any, Any]:
    """The environment in its wrappers, the first innermost, and its last observations together, outermost.

    Raises:
        ValueError: if there is no such wrapper; what it raises itself is left as it is.

    Example:
        >>> pole = wrapped(gym.make("CartPole-v1"), [{"gymnasium.wrappers:ClipReward": {"min_reward": 0}}], 3)
        >>> pole.observation_space.shape
        (3, 4)
    """
    for name, arguments in named_wrappers(wrappers):
        module, _, attribute = name.rpartition(":")
        try:
            found = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"cannot import the wrapper {name!r}: {error}; it is named 'module:Wrapper'") from error
        env = found(env, **arguments)
    return env if frame_stack == 1 else FrameStackObservation(env, frame_stack)

"""What makes the environments of a run that cannot be found by the name in its configuration."""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym

__all__ = ["nameless", "stand_in", "standing_in"]

Maker = Callable[[], gym.Env[Any, Any]]

_standing_in: contextvars.ContextVar[Maker | None] = contextvars.ContextVar("_standing_in", default=None)


def stand_in() -> Maker | None:
    """What makes environments in place of the name in the configuration, if anything does."""
    return _standing_in.get()


@contextlib.contextmanager
def standing_in(make: Maker | None) -> Iterator[None]:
    """Within the block environments are made by ``make``; by their names if it is None.

    Example:
        >>> with standing_in(lambda: gym.make("CartPole-v1")):
        ...     stand_in()().spec.id
        'CartPole-v1'
    """
    token = _standing_in.set(make)
    try:
        yield
    finally:
        _standing_in.reset(token)


def nameless(env: str) -> bool:
    """Whether a configuration's environment has no name that could be followed.

    Example:
        >>> nameless("<MyEnv>"), nameless("my_package:MyEnv")
        (True, False)
    """
    return env.startswith("<") and env.endswith(">")

"""What somebody else's environment does wrong, in a sentence."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import gymnasium as gym

from neuralq.runs.stream.encoding import ObservationError
from neuralq.runs.stream.vector_env import SubEnvFault, what_it_did

__all__ = ["EnvironmentFault", "describe_error", "faults_of"]


class EnvironmentFault(RuntimeError):
    """An environment broke its contract; says which one, when and in which field."""


@contextlib.contextmanager
def faults_of(doing: str) -> Iterator[None]:
    """Whatever an environment's own code raises in the block becomes an `EnvironmentFault`.

    Example:
        >>> with faults_of("resetting"):
        ...     {}["speed"]
        Traceback (most recent call last):
        neuralq.runs.stream.faults.EnvironmentFault: resetting, the environment raised KeyError: 'speed'
    """
    try:
        yield
    except gym.error.DependencyNotInstalled:  # for which there is a way out
        raise
    except Exception as error:
        raise EnvironmentFault(f"{doing}, the environment {what_it_did(error)}") from error


def describe_error(error: BaseException) -> str:
    """What an environment raised."""
    if isinstance(error, SubEnvFault | ObservationError):
        return str(error)
    return f"an environment {what_it_did(error)}"

"""Environments in processes of their own, for those that are slow: they step at once where others take turns.

Gymnasium's `AsyncVectorEnv` does it; here it is made so that what goes wrong in a process is told as it is without
one, signals meant for the run do not reach its environments, and no process outlives the run: each waits on a pipe
that ends with it. Processes are forked by a server that has loaded what they need, once.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import traceback
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.async_vector_env import AsyncState

from neuralq.checks import check_whole
from neuralq.runs.children import safe_path, without_main
from neuralq.runs.stream.vector_env import SubEnv, SubEnvFault

__all__ = ["WorkerVectorEnv", "make_worker_env"]

_PATIENCE = 5.0
"""Seconds that a process has to end by itself."""
_FRAME = re.compile(r'^  File "(.+)", line (\d+), in (.+)\n(?:    (.+)\n)?', re.MULTILINE)


class WorkerFault(RuntimeError):
    """What went wrong in a process, in words that survive the way between processes."""


class RemoteTrace(Exception):
    """The traceback of another process.

    Args:
        text: as Python prints it.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.remote_frames = [
            traceback.FrameSummary(m[1], int(m[2]), m[3], lookup_line=False, line=m[4] or "")
            for m in _FRAME.finditer(text)
        ]

    def __str__(self) -> str:
        """The traceback."""
        return f"\n{self.args[0]}"


class _Telling(gym.Wrapper[Any, Any, Any, Any]):
    """What the environment raises is raised as a `WorkerFault`: kinds of the user's own may not survive the way."""

    def step(self, action: Any) -> Any:
        with _telling():
            return self.env.step(action)

    def reset(self, **arguments: Any) -> Any:
        with _telling():
            return self.env.reset(**arguments)


@contextlib.contextmanager
def _telling() -> Iterator[None]:
    try:
        yield
    except SubEnvFault as error:
        raise WorkerFault(error.problem) from error


def _made(make: Callable[[], gym.Env[Any, Any]], index: int, parent: int) -> gym.Env[Any, Any]:
    if os.getpid() != parent:
        os.setpgrp()  # a signal to the group of the run is the run's to answer
    return _Telling(SubEnv(make(), index))


class WorkerVectorEnv(AsyncVectorEnv):
    """As Gymnasium's, but that faults are told as by environments of this process."""

    def reset(self, **arguments: Any) -> Any:
        """As `AsyncVectorEnv.reset`."""
        with self._living():
            return super().reset(**arguments)

    def step(self, actions: Any) -> Any:
        """As `AsyncVectorEnv.step`."""
        with self._living():
            return super().step(actions)

    def _raise_if_errors(self, successes: Iterable[bool]) -> None:
        faults = [self.error_queue.get() for succeeded in successes if not succeeded]
        for index, *_ in faults:
            self.parent_pipes[index].close()
            self.parent_pipes[index] = None  # type: ignore[call-overload]  # as Gymnasium does
        if faults:
            self._state = AsyncState.DEFAULT
            index, _, error, trace = min(faults, key=lambda fault: fault[0])
            told = str(error) if isinstance(error, WorkerFault) else f" raised {type(error).__name__}: {error}"
            raise SubEnvFault(index, told) from RemoteTrace(trace)

    @contextlib.contextmanager
    def _living(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, BrokenPipeError, ConnectionResetError) as error:
            for process in self.processes:
                process.join(0.2)
            ended = [i for i, process in enumerate(self.processes) if process.exitcode is not None]
            index = ended[0] if ended else 0
            self._state = AsyncState.DEFAULT
            told = f": its process ended, with exit status {self.processes[index].exitcode}"
            raise SubEnvFault(index, told) from error

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """End every process; what has not ended within some seconds is made to."""
        if any(process.exitcode is not None for process in self.processes) or self._state != AsyncState.DEFAULT:
            terminate = True  # who waits for one that is gone waits for ever
        with contextlib.suppress(EOFError, OSError):
            super().close_extras(_PATIENCE if timeout is None else timeout, terminate)
        for process in self.processes:
            if process.is_alive():
                process.kill()
            process.join()


def make_worker_env(make: Callable[[], gym.Env[Any, Any]], num_envs: int) -> WorkerVectorEnv:
    """``num_envs`` environments in processes of their own, without autoreset.

    Args:
        make: makes one; it is called in each process, and once in this one, to see its spaces.
        num_envs: how many.

    Example:
        >>> envs = make_worker_env(partial(gym.make, "CartPole-v1"), 2)
        >>> envs.num_envs, envs.close()
        (2, None)
    """
    check_whole("num_envs", num_envs)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["neuralq.runs.recipe.environments"])
    makers = [partial(_made, make, index, os.getpid()) for index in range(num_envs)]
    with safe_path(), without_main():
        return WorkerVectorEnv(
            makers, copy=False, context="forkserver", autoreset_mode=AutoresetMode.DISABLED, daemon=True
        )

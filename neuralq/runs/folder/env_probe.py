"""Whether a run can be resumed bit for bit, found out by doing it on throwaway instances."""

from __future__ import annotations

import contextlib
import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete, MultiDiscrete, Space
from gymnasium.vector import AutoresetMode, VectorEnv

from neuralq.runs.folder.env_encode import Encoder, NotCopyable, difference, encode_env
from neuralq.runs.folder.env_restore import restore_env

__all__ = ["PROBE_SECONDS", "SIMULATED", "Resumability", "is_resumable", "untried"]

NUM_STEPS_BEFORE = 25  # most episodes are under way by then, and some have ended
NUM_STEPS_AFTER = 50
PROBE_SECONDS = 1.0


@dataclass(frozen=True, slots=True)
class Resumability:
    """Whether resuming is ``exact``, and the ``reason``, a sentence for the user. Ask for ``exact`` by name.

    Its truth value is not defined, so that ``if is_resumable(...)`` cannot be right by accident.
    """

    exact: bool
    reason: str

    def __bool__(self) -> bool:
        raise TypeError("ask for .exact: a Resumability is neither true nor false")


SIMULATED = Resumability(True, "resumes bit-exact: the environment's model is simulated, all of whose state is saved")


def untried(env: Any) -> Resumability:
    """Whether the state of ``env`` can be taken; whether that is all of its state is not tried.

    Example:
        >>> untried(gymnasium.make("CartPole-v1")).exact
        True
    """
    try:
        encode_env(env)
    except NotCopyable as error:
        return _inexact(str(error))
    return Resumability(True, "resumes from the environment's own state; whether bit-exact was not tried")


def is_resumable(
    make_env: Callable[[], Any], seed: int, rng: np.random.Generator, seconds: float = math.inf
) -> Resumability:
    """Two instances, one continued and one restored from a snapshot, must agree in every bit of 60 steps and a reset.

    Where the environment is slow there are fewer, at least one: a third of ``seconds`` goes into each of the steps
    before the snapshot, those after it, and their repetition; making and resetting the environment comes on top.

    Args:
        make_env: makes the environment (`gymnasium.Env` or `gymnasium.vector.VectorEnv`); called twice, both closed.
        seed: of the first reset.
        rng: draws the random actions; an ``action_mask`` in info or observation is obeyed.
        seconds: that this may take, about.

    Example:
        >>> is_resumable(lambda: gymnasium.make("CartPole-v1"), 0, np.random.default_rng(0)).exact
        True
    """
    envs: list[Any] = []
    try:
        envs.append(make_env())
        first = _Driver(envs[0], rng)
        first.reset(seed)
        first.run(NUM_STEPS_BEFORE, seconds / 3)
        tree, ended, num_before = encode_env(envs[0]), first.ended, len(first.actions)
        # The original goes on first: whatever it shares behind the scenes with the second has moved on by then.
        reference = first.course(None, seconds / 3)
        envs.append(make_env())
        second = _Driver(envs[1], rng)
        restore_env(envs[1], tree)
        second.ended = ended
        where = difference(reference, second.course(first.actions[num_before:]), "step")
    except NotCopyable as error:
        return _inexact(str(error))
    except Exception as error:  # the environment's own code ran: whatever it raises, training will say it better
        return _inexact(f"the environment raised {type(error).__name__}: {error}")
    finally:
        for env in envs:
            with contextlib.suppress(Exception):
                env.close()
    if where is not None:
        return _inexact(f"a restored environment went another way ({where}): it has state outside of its attributes")
    shown = len(first.actions) - num_before
    return Resumability(
        True, f"resumes bit-exact as far as {shown} steps show: a restored environment repeated each of the original's"
    )


def _inexact(reason: str) -> Resumability:
    return Resumability(False, f"resumes at an episode boundary, not bit-exact: {reason}")


class _Driver:
    """Steps one environment, with actions that it draws or is given, and starts episodes where it must."""

    def __init__(self, env: Any, rng: np.random.Generator) -> None:
        self.env, self.rng = env, rng
        self.actions: list[Any] = []
        self.ended = np.zeros(getattr(env, "num_envs", 1), dtype=bool)
        self.masks: Any = None
        self.space: Space[Any] = copy.deepcopy(env.action_space)  # drawing from the environment's own would change it
        self.space.seed(int(rng.integers(2**31)))
        self.is_vector = isinstance(env, VectorEnv)
        mode = env.metadata.get("autoreset_mode") if self.is_vector else AutoresetMode.DISABLED
        self.resets_itself = mode is not AutoresetMode.DISABLED

    def reset(self, seed: int | None, options: dict[str, Any] | None = None) -> Any:
        obs, extra = self.env.reset(seed=seed, options=options)
        self._remember_masks(obs, extra)
        self.ended = np.zeros_like(self.ended)
        return obs

    def step(self, action: Any) -> list[Any]:
        """Everything that a learner sees of one step, and of the reset before it, if there was one."""
        seen = []
        if self.ended.any() and not self.resets_itself:
            options = {"reset_mask": self.ended.copy()} if self.is_vector else None
            seen.append(self.reset(None, options))
        action = self._draw() if action is None else action
        self.actions.append(copy.deepcopy(action))
        obs, reward, terminated, truncated, extra = self.env.step(action)
        self._remember_masks(obs, extra)
        self.ended = np.atleast_1d(np.logical_or(terminated, truncated))
        return [*seen, obs, reward, terminated, truncated]

    def run(self, num_steps: int, seconds: float) -> None:
        """Steps before those that are compared."""
        until = math.inf
        for number in range(num_steps):
            self.step(None)
            until = time.monotonic() + seconds if number == 0 else until  # the first may have had to load kernels
            if time.monotonic() > until:
                break

    def course(self, actions: list[Any] | None, seconds: float = math.inf) -> list[Any]:
        """The steps that are compared, then those after a reset, which draws from the environment's generator.

        Where the time is up it ends; with actions given it has as many steps as there are.
        """
        seen: list[Any] = []
        until = time.monotonic() + seconds
        for number in range(NUM_STEPS_AFTER + NUM_STEPS_AFTER // 5 if actions is None else len(actions)):
            if number == NUM_STEPS_AFTER:
                seen.append(_frozen_copy(self.reset(None)))
            seen.append(_frozen_copy(self.step(None if actions is None else actions[number])))
            if time.monotonic() > until:
                break
        return seen

    def _remember_masks(self, obs: Any, extra: dict[str, Any]) -> None:
        self.masks = extra.get("action_mask", obs.get("action_mask") if isinstance(obs, dict) else None)

    def _draw(self) -> Any:
        if self.masks is None:
            return self.space.sample()
        masks = np.asarray(self.masks)
        if isinstance(self.space, Discrete) and masks.ndim == 1:
            return self.space.sample(mask=masks.astype(np.int8))
        if isinstance(self.space, MultiDiscrete) and masks.ndim == 2:
            return self.space.sample(mask=tuple(row.astype(np.int8) for row in masks))
        return self.space.sample()


def _frozen_copy(seen: Any) -> Any:
    """A copy that no buffer-reusing environment can change, in the form that `difference` compares."""
    return Encoder().encode(seen, "observation", gymnasium.Env)

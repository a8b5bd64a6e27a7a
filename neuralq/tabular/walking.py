"""A Gymnasium environment walked by a tabular learner: one step of it, one call of a kernel.

Everything here is paid at every step, and a step of a small environment takes 8 µs: so the kernels are called without
looking at their types, what stands in the walk's counters is kept in local names until the walk pauses, and what an
environment hands out is looked at by its type first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from neuralq.jit import specialised
from neuralq.tabular.kernels.acting import (
    ACTION,
    EPISODE_STEPS,
    EPISODES,
    LIMIT,
    REPLAY,
    STATE,
    STEP,
    Log,
    Walk,
    choose,
    new_log,
)
from neuralq.tabular.learner import Learner
from neuralq.tabular.model import empty_arrays

__all__ = ["EnvironmentWalk", "Episode", "WalkFault", "state_reader"]

Episode = tuple[float, int]
"""Undiscounted return and length of an episode that has ended."""

_FLAGS = (bool, np.bool_)


class WalkFault(RuntimeError):
    """An environment raised, which is the cause, or handed out what its spaces did not promise; says in which field."""


def state_reader(space: Discrete) -> Callable[[Any], int]:
    """What makes states 0, 1, … of a `Discrete` space's observations, and refuses what is none of them.

    Example:
        >>> state_reader(Discrete(3, start=5))(6)
        1
    """
    first, num_states = int(space.start), int(space.n)

    def read(observation: Any) -> int:
        try:
            whole = int(observation)
            s = whole - first if whole == observation else -1
        except (TypeError, ValueError, OverflowError):
            s = -1
        if not 0 <= s < num_states:
            raise WalkFault(f"observation must lie in {first}..{first + num_states - 1}, got {observation!r}")
        return s

    return read


class EnvironmentWalk:
    """One environment, a learner that acts in it, and where they are.

    Args:
        env: with Discrete actions.
        read: observations to states 0, 1, …; raises `WalkFault` for what is none.
        learner: what learns and acts.
        walk: where the agent is; its counters hold while `run` is not running.
        seed: of the first reset; None if the environment stands within an episode already.
        remembered: how many of the last transitions are kept in `recent`.
        mask_of: the legal actions ``[A]`` of where the environment stands, of its info; None where it tells none.
        reward_scale: by what rewards are multiplied for the learner; returns of episodes are not.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        read: Callable[[Any], int],
        learner: Learner,
        walk: Walk,
        seed: int | None,
        remembered: int = 1,
        mask_of: Callable[[dict[str, Any]], Any] = lambda extras: extras.get("action_mask"),
        reward_scale: float = 1.0,
    ) -> None:
        self._env, self._read, self._learner, self._walk = env, read, learner, walk
        self._first_action = int(env.action_space.start)  # type: ignore[attr-defined]
        self._seed, self._mask_of = seed, mask_of
        self.masks: list[bytes | None] = [None] * len(learner.acting_table.q)
        self._scale = reward_scale
        self.running_return, self.num_taken = 0.0, 0
        self.begun: dict[int, int] = {}
        """How many episodes began in a state, since this walk was made."""
        self.recent = new_log(remembered, REPLAY)
        self._rows = [self.recent._replace(offset=row) for row in range(remembered)]
        self._nothing = empty_arrays()
        self._codes: tuple[Callable[..., Any], Callable[..., Any]] | None = None

    def _compiled(self, gamma: float) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """The learner's loop and its choice of an action."""
        if self._codes is None:
            learner = self._learner
            like = (self._nothing, learner.policy, learner.table, self._walk, self.recent, *learner.arguments, gamma, 1)
            acts = (learner.acting_table, np.uint64(0), 0, learner.policy, self._walk.rng)
            self._codes = specialised(learner.loop, *like), specialised(choose, *acts)
        return self._codes

    def run(self, gamma: float, num_steps: int, log: Log | None = None) -> list[Episode]:
        """Take ``num_steps`` steps, learn from each, and say which episodes ended.

        Args:
            gamma: γ.
            num_steps: how many; none compiles what is called.
            log: where the transitions are recorded as well, from its offset on.

        Raises:
            WalkFault: the environment's fault. The walk is over then.
            ValueError: the learner cannot learn from what came.
        """
        learn, choose_in = self._compiled(float(gamma))
        learner, counters, rng, rows = self._learner, self._walk.counters, self._walk.rng, self._rows
        policy, acting, on_policy, single = learner.policy, learner.acting_table, learner.on_policy, learner.acts_in
        before, after = (self._nothing, policy, learner.table, self._walk), (*learner.arguments, float(gamma), 1)
        s_tm1, a_tm1, r, discount, reached, a_next, ends = self.recent[2:]
        s, a, length = int(counters[STATE]), int(counters[ACTION]), int(counters[EPISODE_STEPS])
        step, total, scale, limit = (
            int(counters[STEP]),
            self.running_return,
            self._scale,
            int(counters[LIMIT]) or 1 << 62,
        )
        episodes: list[Episode] = []
        for i in range(num_steps):
            if s < 0:
                s, length, total = self._begin(), 0, 0.0
            if a < 0:
                a = choose_in(acting, s, step, policy, rng)
            observation, reward, terminated, truncated, extras = self._take(a)
            s_t = self._arrive(observation, extras, terminated)
            length += 1
            total += reward
            last = terminated or truncated or length >= limit
            a_t = choose_in(acting, s_t, step + 1, policy, rng) if on_policy and not terminated else -1
            k = step % len(rows)
            s_tm1[k], a_tm1[k], r[k], discount[k] = s, a if single is None else 0, scale * reward, gamma
            reached[k], a_next[k], ends[k] = s_t, a_t, last
            if terminated:
                discount[k] = 0.0
            if log is not None:
                _copy_row(self.recent, k, log, i)
            learn(*before, rows[k], *after)
            step, s, a = step + 1, s_t, a_t
            if last:
                episodes.append((total, length))
                s, a, length, total = -1, -1, 0, 0.0
        self.running_return, self.num_taken = total, self.num_taken + num_steps
        self._pause(s, a, length, len(episodes))
        return episodes

    def _pause(self, s: int, a: int, length: int, num_episodes: int) -> None:
        """Writes down where the walk stands."""
        counters = self._walk.counters
        counters[STATE], counters[ACTION], counters[EPISODE_STEPS] = s, a, length
        counters[EPISODES] += num_episodes
        if self._learner.check is not None:
            self._learner.check()

    def _take(self, a: int) -> tuple[Any, float, bool, bool, Any]:
        """One step of the environment, its reward and its flags looked at."""
        try:
            observation, reward, terminated, truncated, extras = self._env.step(a + self._first_action)
        except (Exception, SystemExit) as error:
            raise WalkFault("step") from error
        if type(reward) is not float or not math.isfinite(reward):
            reward = _reward(reward)
        if type(terminated) not in _FLAGS or type(truncated) not in _FLAGS:
            terminated, truncated = _flag("terminated", terminated), _flag("truncated", truncated)
        return observation, reward, terminated, truncated, extras

    def continue_from(self, running_return: float) -> None:
        """The environment stands within an episode, or at the end of one, that has earned so much."""
        self._seed, self.running_return = None, running_return

    def begin_anew(self, seed: int | None) -> None:
        """The next step begins an episode, with this seed."""
        self._seed, self.running_return = seed, 0.0

    def _begin(self) -> int:
        """The first state of an episode."""
        try:
            observation, extras = self._env.reset(seed=self._seed)
        except (Exception, SystemExit) as error:
            raise WalkFault("reset") from error
        self._seed = None
        s = self._arrive(observation, extras, False)
        self.begun[s] = self.begun.get(s, 0) + 1
        return s

    def _arrive(self, observation: Any, extras: Any, over: bool) -> int:
        """The state of an observation; the first sight of one tells which actions it has."""
        s = self._read(observation)
        if type(extras) is not dict:
            raise WalkFault(f"info must be a mapping, got {extras!r}")
        mask = self._mask_of(extras)
        if mask is None:
            return s
        known, given = self.masks[s], np.asarray(mask).tobytes()
        if known != given:
            self._learn_mask(s, mask, given, over)
        return s

    def _learn_mask(self, s: int, mask: Any, given: bytes, over: bool) -> None:
        legal, shape = np.asarray(mask) != 0, self._learner.acting_table.q.shape[1:]
        if legal.shape != shape:
            raise WalkFault(f"info['action_mask'] must have {shape[0]} entries, got shape {legal.shape}")
        if not legal.any():  # a terminal state may say that it has none: nothing is ever chosen there
            if not over:
                raise WalkFault(
                    "info['action_mask'] must allow an action until the episode has terminated, allows none"
                )
            return
        if self.masks[s] is not None and not np.array_equal(self._learner.legal(s), legal):
            raise WalkFault(
                f"info['action_mask'] was another one when state {s} was seen before; in a table actions are legal or "
                "not by the state: make what decides it part of the observation, or take --learner online --layout "
                "table, which is handed the mask with every observation"
            )
        self.masks[s] = given
        self._learner.allow_only(s, legal)


def _reward(reward: Any) -> float:
    try:
        found = float(reward)
    except Exception:
        raise WalkFault(f"reward must be a number, got {reward!r}") from None
    if not math.isfinite(found):
        raise WalkFault(f"reward must be finite, got {found}")
    return found


def _flag(field: str, value: Any) -> bool:
    """Whether an episode has ended; what is neither yes nor no would be taken for either without a word."""
    found: NDArray[Any] = np.asarray(value)
    if found.size == 1 and found.dtype.kind in "biuf" and found.reshape(-1)[0] in (0, 1):
        return bool(found.reshape(-1)[0])
    raise WalkFault(f"{field} must be true or false, got {value!r}")


def _copy_row(source: Log, k: int, log: Log, i: int) -> None:
    for column, values in zip(log[2:], source[2:], strict=True):
        column[log.offset + i] = values[k]

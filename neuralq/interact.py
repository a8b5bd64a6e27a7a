"""Experience from vector environments: the one place where episodes end, and the place where they end right.

Gymnasium's vector environments restart finished episodes in one of three ways. NEXT_STEP (the default) inserts a step that
was never taken; storing it trains across episodes, so lanes that take it are left out. SAME_STEP returns the next
episode's first observation and hides the true successor in ``info["final_obs"]``, which is read. DISABLED leaves the
restart to the caller, who asks for it here. Each lane's experience is the same in all three (tests/test_interact.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from torch import Tensor

from neuralq.checks import check_discount
from neuralq.features import Encoder, ObservationError, discrete_actions, encoder_for
from neuralq.types import Transition

__all__ = [
    "EnvironmentFault",
    "Episode",
    "Interaction",
    "Lane",
    "LaneFault",
    "ObservationSpec",
    "Policy",
    "Step",
    "interact",
    "make_vector_env",
]

_Array = np.ndarray[Any, np.dtype[Any]]
Policy = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Observations ``[N, *obs]`` to actions ``[N]`` int64 and the probability of each under this policy ``[N]``."""


class EnvironmentFault(RuntimeError):
    """An environment broke its contract; says which one, when and in which field."""


class LaneFault(RuntimeError):
    """An environment raised: carries its index so that a batch can say which."""

    def __init__(self, index: int, cause: BaseException) -> None:
        super().__init__(f"environment {index} raised {type(cause).__name__}: {cause}")
        self.index = index


class Lane(gym.Wrapper[Any, Any, Any, Any]):
    """One environment of a batch: its observations are copies, and what it raises names its index.

    Copying matters under SAME_STEP: an environment that reuses its observation array would overwrite the true successor
    with the next episode's first observation before anybody could read it.
    """

    def __init__(self, env: gym.Env[Any, Any], index: int) -> None:
        super().__init__(env)
        self.index = index

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment's own, with a copied observation."""
        try:
            observation, reward, terminated, truncated, info = self.env.step(action)
        except Exception as error:
            raise LaneFault(self.index, error) from error
        return _copied(observation), reward, terminated, truncated, info

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As the environment's own, with a copied observation."""
        try:
            observation, info = self.env.reset(seed=seed, options=options)
        except Exception as error:
            raise LaneFault(self.index, error) from error
        return _copied(observation), info


def _copied(observation: Any) -> Any:
    if isinstance(observation, np.ndarray):
        return observation.copy()
    if isinstance(observation, Mapping):
        return {key: _copied(value) for key, value in observation.items()}
    if isinstance(observation, tuple):
        return tuple(_copied(value) for value in observation)
    return observation


def make_vector_env(make: Callable[[], gym.Env[Any, Any]], num_envs: int) -> SyncVectorEnv:
    """``num_envs`` environments stepped in turn, without autoreset and without copying twice.

    Example:
        >>> envs = make_vector_env(lambda: gym.make("CartPole-v1"), 2)
        >>> envs.num_envs
        2
    """
    return SyncVectorEnv(
        [lambda i=i: Lane(make(), i) for i in range(num_envs)],  # type: ignore[misc]
        copy=False,
        autoreset_mode=AutoresetMode.DISABLED,
    )


@dataclass(frozen=True, slots=True)
class ObservationSpec:
    """What a representation is handed.

    Args:
        shape: of one encoded observation, mask included.
        dtype: NumPy dtype it is stored in.
        inner_shape: shape without the action mask.
        num_categories: number of states if the observation is a state index, else None.
        masked: whether an action mask is appended.
        num_actions: A.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    inner_shape: tuple[int, ...]
    num_categories: int | None
    masked: bool
    num_actions: int


@dataclass(frozen=True, slots=True)
class Episode:
    """A finished episode: its lane, undiscounted return and length in steps."""

    lane: int
    episode_return: float
    length: int


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a batch of environments: ``transition`` has one row for each lane in ``lanes`` that really moved."""

    transition: Transition
    lanes: _Array
    episodes: tuple[Episode, ...]


class Interaction:
    """A vector environment and where it stands: the iterator's state, so that a run can stop and go on.

    Args:
        envs: Gymnasium vector environment with Discrete actions, in any autoreset mode. The sub-environments of a
            `SyncVectorEnv` are wrapped in `Lane`, in place.
        discount: γ in [0, 1].
        seed: of the first reset; None continues the environments' own randomness.
        as_index: encode finite observations as one index, for tables.

    Raises:
        ValueError: for spaces that cannot be learned from and environments that do not say how they restart.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any], discount: float, seed: int | None, as_index: bool = False) -> None:
        check_discount("discount", discount)
        self.envs = envs
        self.num_envs: int = envs.num_envs
        self.discount = np.float32(discount)
        self.encoder: Encoder = encoder_for(envs.single_observation_space, as_index=as_index)
        self.num_actions, self._first_action = discrete_actions(envs.single_action_space)
        self.mode = _autoreset_mode(envs)
        if isinstance(envs, SyncVectorEnv):
            envs.envs = tuple(e if isinstance(e, Lane) else Lane(e, i) for i, e in enumerate(envs.envs))
        self.num_steps = 0
        self._everyone = np.arange(self.num_envs)
        self._broken = False
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)
        self._pending = np.zeros(self.num_envs, bool)
        self._mask: _Array | None = None
        self.restart(seed)
        self.spec = self._describe()

    def _describe(self) -> ObservationSpec:
        inner = self.encoder.shape
        masked = self._mask is not None
        if not masked:
            return ObservationSpec(inner, self.encoder.dtype, inner, self.encoder.num_categories, False, self.num_actions)
        return ObservationSpec(
            self._s.shape[1:], self._s.dtype, inner, self.encoder.num_categories, True, self.num_actions
        )

    def restart(self, seed: int | None) -> None:
        """Reset every environment: an episode boundary in every lane."""
        try:
            observation, info = self.envs.reset(seed=seed)
        except Exception as error:
            raise EnvironmentFault(f"at reset: {error}") from error
        self._pending[:] = False
        self._returns[:] = 0
        self._lengths[:] = 0
        self._s = self._observe(observation, info)

    def _observe(self, observation: Any, info: Mapping[str, Any]) -> _Array:
        """Encode a batch, with the action mask appended where the environment gives one."""
        try:
            encoded = self.encoder.encode(observation)
        except ObservationError as error:
            raise self._fault(str(error)) from error
        if "action_mask" in info:
            self._read_mask(info)
        return encoded if self._mask is None else self._with_mask(encoded)

    def _read_mask(self, info: Mapping[str, Any]) -> None:
        given = np.asarray(info["action_mask"])
        if given.dtype == object:  # lanes without one hold None
            rows = np.flatnonzero(info["_action_mask"])
            given = np.stack([np.asarray(given[i]) for i in rows]) if len(rows) else given[:0]
        else:
            rows = np.flatnonzero(info.get("_action_mask", np.ones(self.num_envs, bool)))
            given = given[rows]
        if len(rows) and given.shape[1:] != (self.num_actions,):
            raise self._fault(f"info['action_mask'] must have {self.num_actions} entries, got {given.shape[1:]}")
        if self._mask is None:
            self._mask = np.ones((self.num_envs, self.num_actions), bool)
        self._mask[rows] = given != 0
        if not self._mask.any(-1).all():
            # A finished episode may show a state without actions; the world has ended there.
            self._mask[~self._mask.any(-1)] = True

    def _with_mask(self, encoded: _Array) -> _Array:
        assert self._mask is not None
        flat = encoded.reshape(len(encoded), -1)
        dtype = np.int64 if self.encoder.num_categories is not None else np.float32
        return np.concatenate([flat.astype(dtype), self._mask.astype(dtype)], axis=1)

    def _fault(self, what: str) -> EnvironmentFault:
        self._broken = True
        return EnvironmentFault(f"after {self.num_steps:,} environment steps, {what}")

    def steps(self, policy: Policy) -> Iterator[Step]:
        """Endless steps under ``policy``."""
        while True:
            yield self.step(policy)

    def step(self, policy: Policy) -> Step:
        """Act once in every environment.

        Raises:
            EnvironmentFault: if an environment raises, or hands out NaN or a wrong shape or dtype.
        """
        if self._broken:
            raise EnvironmentFault("this interaction has ended with an error; start a new one")
        action, mu = policy(torch.from_numpy(self._s))
        chosen = action.numpy()
        try:
            observation, reward, terminated, truncated, info = self.envs.step(chosen + self._first_action)
        except Exception as error:
            raise self._fault(_describe_error(error)) from error
        last = terminated | truncated
        r_t = self._checked_reward(reward)
        arrived = self._observe(observation, info)
        s_t = self._true_successors(arrived, last, info) if self.mode is AutoresetMode.SAME_STEP else arrived
        fake = self._pending
        everyone = not fake.any()
        lanes = self._everyone if everyone else np.flatnonzero(~fake)
        discount_t = np.where(terminated, np.float32(0), self.discount)
        rows = [self._s, chosen, mu.numpy(), r_t, discount_t, s_t, last]
        if not everyone:
            rows = [row[lanes] for row in rows]
            r_t = np.where(fake, 0, r_t)
        transition = Transition(*(torch.from_numpy(row) for row in rows))
        self.num_steps += len(lanes)
        self._returns += r_t
        self._lengths[lanes] += 1
        episodes = self._finish(last, arrived) if last.any() else ()
        if self.mode is AutoresetMode.NEXT_STEP:
            self._pending = last
        if not (self.mode is AutoresetMode.DISABLED and episodes):
            self._s = arrived
        return Step(transition, lanes, episodes)

    def _checked_reward(self, reward: Any) -> _Array:
        r_t = np.asarray(reward, np.float32)
        if r_t.shape != (self.num_envs,):
            raise self._fault(f"field reward: must have shape ({self.num_envs},), got {r_t.shape}")
        if not np.isfinite(r_t).all():
            lane = int(np.flatnonzero(~np.isfinite(r_t))[0])
            raise self._fault(
                f"environment {lane}, step {self._lengths[lane] + 1} of its episode, field reward: must be finite, "
                f"got {r_t[lane]}"
            )
        return r_t

    def _true_successors(self, arrived: _Array, last: _Array, info: Mapping[str, Any]) -> _Array:
        if not last.any():
            return arrived
        successors = arrived.copy()
        final, final_info = info["final_obs"], info.get("final_info", {})
        width = self.num_actions
        for lane in np.flatnonzero(last):
            try:
                encoded = self.encoder.encode_single(final[lane], lane=int(lane))
            except ObservationError as error:
                raise self._fault(str(error)) from error
            if self._mask is None:
                successors[lane] = encoded
                continue
            successors[lane, :-width] = np.reshape(encoded, -1)
            mask = final_info.get("action_mask")
            legal = np.ones(width) if mask is None or mask[lane] is None else np.asarray(mask[lane]) != 0
            successors[lane, -width:] = legal if legal.any() else 1
        return successors

    def _finish(self, last: _Array, arrived: _Array) -> tuple[Episode, ...]:
        """Account for the finished episodes and, where restarting is ours, restart those lanes."""
        ended = np.flatnonzero(last)
        episodes = tuple(Episode(int(i), float(self._returns[i]), int(self._lengths[i])) for i in ended)
        self._returns[ended] = 0
        self._lengths[ended] = 0
        if self.mode is AutoresetMode.DISABLED:
            try:
                observation, info = self.envs.reset(options={"reset_mask": last})
            except Exception as error:
                raise self._fault(_describe_error(error)) from error
            fresh = self._observe(observation, info)
            self._s = arrived.copy()
            self._s[ended] = fresh[ended]
        return episodes

    def running_episodes(self) -> list[tuple[float, int]]:
        """Return so far and length of each lane's unfinished episode."""
        return [(float(r), int(n)) for r, n in zip(self._returns, self._lengths, strict=True)]

    def state_dict(self) -> dict[str, Any]:
        """Where the stream stands, without the environments' own state."""
        return {
            "num_steps": self.num_steps,
            "s": self._s,
            "returns": self._returns,
            "lengths": self._lengths,
            "pending": self._pending,
            "mask": self._mask,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`; the environments must have been restored to the same point."""
        self.num_steps = int(state["num_steps"])
        self._s = np.array(state["s"])
        self._returns = np.array(state["returns"])
        self._lengths = np.array(state["lengths"])
        self._pending = np.array(state["pending"])
        self._mask = None if state["mask"] is None else np.array(state["mask"])


def _describe_error(error: Exception) -> str:
    return str(error) if isinstance(error, LaneFault) else f"an environment raised {type(error).__name__}: {error}"


def _autoreset_mode(envs: VectorEnv[Any, Any, Any]) -> AutoresetMode:
    mode = (envs.metadata or {}).get("autoreset_mode")
    if not isinstance(mode, AutoresetMode):
        raise ValueError(
            f"{type(envs).__name__} does not say how it restarts episodes: metadata['autoreset_mode'] must be a "
            f"gymnasium.vector.AutoresetMode, got {mode!r}; without it a step that was never taken could be stored"
        )
    return mode


def interact(
    envs: VectorEnv[Any, Any, Any],
    policy: Callable[[Tensor, np.random.Generator], tuple[Tensor, Tensor]],
    rng: np.random.Generator,
    discount: float = 0.99,
) -> Iterator[Transition]:
    """Transitions from ``envs`` under ``policy``, without end and never across an episode's end.

    Args:
        envs: Gymnasium vector environment in any autoreset mode.
        policy: observations ``[N, *obs]`` and a generator to actions ``[N]`` and their probabilities ``[N]``.
        rng: drawn from by the policy and for the environments' seed.
        discount: γ.

    Yields:
        Transitions ``[k]``, one row for each environment that moved: all N, fewer while one restarts.

    Example:
        >>> envs = make_vector_env(lambda: gym.make("CartPole-v1"), 2)
        >>> push_left = lambda s, rng: (torch.zeros(len(s), dtype=torch.int64), torch.ones(len(s)))
        >>> next(interact(envs, push_left, np.random.default_rng(0))).r_t.tolist()
        [1.0, 1.0]
    """
    stream = Interaction(envs, discount, seed=int(rng.integers(2**31)))
    for step in stream.steps(lambda s: policy(s, rng)):
        yield step.transition

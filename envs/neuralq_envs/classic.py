"""Gymnasium's Mountain Car and Acrobot, many at a time: the same numbers as its scalar environments, in compiled loops.

``neuralq/MountainCar-v0`` and ``neuralq/Acrobot-v0`` are Gymnasium's own ``MountainCar-v0`` and ``Acrobot-v1`` when one
is made, and `ClassicVectorEnv` when many are. That one is a `gymnasium.vector.SyncVectorEnv` of Gymnasium's
environments to the bit, only quicker: environment i draws from a generator of its own, seeded with ``seed + i``, and in
the same order, so resets agree too; an episode's last observation is the one it arrived at; and at the time limit
``truncated`` is true even where the episode terminates in that very step.

Gymnasium's own ids are left as they are. This package registers its environments wherever it is installed, so a vector
entry point added to ``MountainCar-v0`` would change what ``gymnasium.make_vec("MountainCar-v0")`` returns, and how it
restarts, in programs that know nothing of it. `neuralq_envs.vector_twin` says which of ours stands for which of
Gymnasium's, and training asks it.

A car is observed as its position and velocity. Equality to the bit holds where NumPy and the compiled code take their
cosines from the same C library; elsewhere a step differs by about 1e-16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.envs.classic_control.utils import maybe_parse_reset_bounds
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq_envs.classic_kernels import acrobot_step, mountain_car_step

__all__ = ["Acrobot", "ClassicVectorEnv", "Dynamics", "MountainCar", "make_acrobot_vector", "make_mountain_car_vector"]

_Flags = NDArray[np.bool_]
_Arrays = tuple[NDArray[np.float64], NDArray[np.int64], _Flags, NDArray[np.float32]]
_NO_LIMIT = int(np.iinfo(np.int64).max)


class Dynamics(Protocol):
    """What `ClassicVectorEnv` steps: where episodes start and how one step changes the arrays of all environments."""

    @property
    def num_state(self) -> int:
        """Numbers that make up one state."""
        ...

    def observation_space(self) -> Box:
        """Of one environment, float32."""
        ...

    def start_bounds(self, options: dict[str, Any] | None) -> tuple[float, float]:
        """Interval that starts are drawn from."""
        ...

    def start(self, low: float, high: float, rng: np.random.Generator) -> tuple[Any, Any]:
        """A first state and its observation."""
        ...

    def step(self, arrays: _Arrays, actions: NDArray[np.int64], limit: int, out: tuple[Any, Any, Any]) -> int:
        """Steps every environment of ``arrays`` (state, steps, over, observation); answers as the kernels do."""
        ...


@dataclass(frozen=True)
class MountainCar:
    """An under-powered car that must swing to get up the hill; the start is at rest, x uniform in [−0.6, −0.4).

    Args:
        goal_velocity: least velocity with which the goal must be reached.

    Example:
        >>> MountainCar().observation_space().shape
        (2,)
    """

    goal_velocity: float = 0.0

    @property
    def num_state(self) -> int:
        """Position and velocity."""
        return 2

    def observation_space(self) -> Box:
        """Position in [−1.2, 0.6] and velocity in [−0.07, 0.07]."""
        high = np.array([0.6, 0.07], np.float32)
        return Box(np.array([-1.2, -0.07], np.float32), high, dtype=np.float32)

    def start_bounds(self, options: dict[str, Any] | None) -> tuple[float, float]:
        """``options["low"]`` and ``options["high"]`` of the position, −0.6 and −0.4 where they are not given."""
        low, high = maybe_parse_reset_bounds(options, -0.6, -0.4)
        return float(low), float(high)

    def start(self, low: float, high: float, rng: np.random.Generator) -> tuple[Any, Any]:
        """One uniform draw for the position."""
        state = (rng.uniform(low, high), 0.0)
        return state, state

    def step(self, arrays: _Arrays, actions: NDArray[np.int64], limit: int, out: tuple[Any, Any, Any]) -> int:
        """As `mountain_car_step`."""
        return mountain_car_step(*arrays, actions, limit, self.goal_velocity, *out)


@dataclass(frozen=True)
class Acrobot:
    """Two links driven at the joint between them that must swing up; the start is uniform in [−0.1, 0.1)⁴, as float32.

    Example:
        >>> Acrobot().observation_space().shape
        (6,)
    """

    @property
    def num_state(self) -> int:
        """Two angles and two angular velocities."""
        return 4

    def observation_space(self) -> Box:
        """Cosines and sines in [−1, 1], angular velocities in ±4π and ±9π."""
        high = np.array([1.0, 1.0, 1.0, 1.0, 4 * np.pi, 9 * np.pi], np.float32)
        return Box(-high, high, dtype=np.float32)

    def start_bounds(self, options: dict[str, Any] | None) -> tuple[float, float]:
        """``options["low"]`` and ``options["high"]``, −0.1 and 0.1 where they are not given."""
        low, high = maybe_parse_reset_bounds(options, -0.1, 0.1)
        return float(low), float(high)

    def start(self, low: float, high: float, rng: np.random.Generator) -> tuple[Any, Any]:
        """Four uniform draws, rounded to float32; only here are sines and cosines those of float32 numbers."""
        s = rng.uniform(low, high, 4).astype(np.float32)
        return s, (np.cos(s[0]), np.sin(s[0]), np.cos(s[1]), np.sin(s[1]), s[2], s[3])

    def step(self, arrays: _Arrays, actions: NDArray[np.int64], limit: int, out: tuple[Any, Any, Any]) -> int:
        """As `acrobot_step`."""
        return acrobot_step(*arrays, actions, limit, 2.0, *out)


class ClassicVectorEnv(gymnasium.vector.VectorEnv[NDArray[np.float32], NDArray[np.int64], NDArray[Any]]):
    """Many copies of one classic problem stepped together; autoreset is disabled.

    A copy that ended is started again by ``reset(options={"reset_mask": mask})``. Every returned array is new.

    Args:
        dynamics: `MountainCar` or `Acrobot`.
        num_envs: N.
        max_episode_steps: steps after which an episode is truncated; None for never.

    Raises:
        ValueError: ``num_envs`` or ``max_episode_steps`` below 1.

    Example:
        >>> envs = ClassicVectorEnv(MountainCar(), 2, 200)
        >>> _ = envs.reset(seed=0)
        >>> envs.step(np.array([0, 2]))[1].tolist()
        [-1.0, -1.0]
    """

    def __init__(self, dynamics: Dynamics, num_envs: int, max_episode_steps: int | None = None) -> None:
        check_whole("num_envs", num_envs)
        if max_episode_steps is not None:
            check_whole("max_episode_steps", max_episode_steps)
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": []}
        self.num_envs = num_envs
        self.single_observation_space = dynamics.observation_space()
        self.single_action_space = Discrete(3)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._dynamics = dynamics
        self._limit = _NO_LIMIT if max_episode_steps is None else max_episode_steps
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._state = np.zeros((num_envs, dynamics.num_state))
        self._steps = np.zeros(num_envs, np.int64)
        self._over = np.ones(num_envs, bool)
        self._observation = np.zeros((num_envs, *(self.single_observation_space.shape or ())), np.float32)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Starts every copy, or only those of ``options["reset_mask"]`` (bool, ``[N]``), in their order.

        Each environment draws its start from its own generator, so what one does moves no other's. The others'
        observations stay as they are.

        Args:
            seed: of environment i is ``seed + i``, or ``seed[i]``; None goes on with the environment's generator, which
            the system's
                entropy seeds if nothing else has. Environments that are not reset are not seeded.
            options: ``"reset_mask"``, and ``"low"`` and ``"high"``, between which starts are drawn.

        Raises:
            ValueError: a mask of another shape or type, bounds that are no interval, or seeds of another number.
        """
        low, high = self._dynamics.start_bounds(options)
        env_indices = self._envs_to_reset(options)
        seeds = self._seeds(seed)
        for i in env_indices.tolist():
            rng = self._generators[i]
            if rng is None or seeds[i] is not None:
                rng = self._generators[i] = seeding.np_random(seeds[i])[0]
            self._state[i], self._observation[i] = self._dynamics.start(low, high, rng)
        self._steps[env_indices], self._over[env_indices] = 0, False
        return self._observation.copy(), {}

    def _envs_to_reset(self, options: dict[str, Any] | None) -> NDArray[np.int64]:
        if options is None or "reset_mask" not in options:
            return np.arange(self.num_envs)
        mask = np.asarray(options["reset_mask"])
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(f"reset_mask must be bool of shape ({self.num_envs},), got {mask.dtype} {mask.shape}")
        return np.flatnonzero(mask)

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int):
            return [seed + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must be one number or {self.num_envs} of them, got {len(seed)}")
        return list(seed)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], _Flags, _Flags, dict[str, Any]]:
        """One step of every copy.

        Raises:
            ResetNeeded: a copy that ended and was not reset, by its number; no copy has moved.
            ValueError: actions of another shape or kind, or outside the space; no copy has moved.
        """
        given, num = np.asarray(actions), self.num_envs
        if given.shape != (num,) or given.dtype.kind not in "iu":
            raise ValueError(f"actions must be {num} whole numbers, got {given.dtype} of shape {given.shape}")
        reward, terminated, truncated = np.empty(num), np.empty(num, bool), np.empty(num, bool)
        arrays = (self._state, self._steps, self._over, self._observation)
        chosen = given if given.dtype == np.int64 else given.astype(np.int64)
        refused = self._dynamics.step(arrays, chosen, self._limit, (reward, terminated, truncated))
        if refused >= num:
            raise ValueError(f"actions must be 0, 1 or 2, got {given[refused - num]} for environment {refused - num}")
        if refused >= 0:
            raise ResetNeeded(
                f"environment {refused} must be reset before it is stepped: pass "
                'reset(options={"reset_mask": terminations | truncations})'
            )
        return self._observation.copy(), reward, terminated, truncated, {}


def make_mountain_car_vector(
    num_envs: int = 1, max_episode_steps: int | None = 200, goal_velocity: float = 0.0
) -> ClassicVectorEnv:
    """What ``gymnasium.make_vec("neuralq/MountainCar-v0")`` calls.

    Example:
        >>> make_mountain_car_vector(5).reset(seed=0)[0].shape
        (5, 2)
    """
    return ClassicVectorEnv(MountainCar(float(goal_velocity)), num_envs, max_episode_steps)


def make_acrobot_vector(num_envs: int = 1, max_episode_steps: int | None = 500) -> ClassicVectorEnv:
    """What ``gymnasium.make_vec("neuralq/Acrobot-v0")`` calls.

    Example:
        >>> make_acrobot_vector(5).reset(seed=0)[0].shape
        (5, 6)
    """
    return ClassicVectorEnv(Acrobot(), num_envs, max_episode_steps)

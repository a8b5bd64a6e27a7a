"""A finite model as environments: one, or many stepped together by array operations.

Both draw from the model's `Outcomes`, so their samples have its own frequencies and rewards. Taking an illegal action
leaves the state as it is with reward 0: the mask tells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.mdp.sampler import Sampler

if TYPE_CHECKING:
    from neuralq.mdp.model import FiniteMDP

__all__ = ["ModelEnv", "ModelVectorEnv"]


class ModelEnv(gymnasium.Env[Any, Any]):
    """A finite model as a Gymnasium environment: observation and action are numbers, ``info`` carries the legal mask.

    ``info["action_mask"]`` is int8 ``[A]``, 1 where the action is legal in the state observed. An illegal action leaves
    the state with reward 0. A terminal state's mask is all 0.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> env = ModelEnv(FiniteMDP.from_arrays([[[0.0]]], [[5.0]], substochastic=True))
        >>> _ = env.reset(seed=0)
        >>> env.step(0)[:3]
        (0, 5.0, True)
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(self, mdp: FiniteMDP) -> None:
        self._mdp, self._sampler = mdp, Sampler(mdp)
        self._mask = mdp.legal.astype(np.int8)
        self.observation_space = Discrete(mdp.num_states)
        self.action_space = Discrete(mdp.num_actions)
        self._state: int | None = None
        self._terminated = False

    def mdp(self) -> FiniteMDP:
        """The model this environment simulates."""
        return self._mdp

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """A first state drawn from the start distribution, or the one that ``options["state"]`` names.

        Raises:
            ValueError: ``options["state"]`` that is not a state with an action.
        """
        super().reset(seed=seed)
        asked = None if options is None else options.get("state")
        if asked is not None and not (self.observation_space.contains(asked) and self._mask[asked].any()):
            raise ValueError(
                f"options['state'] must be a state of 0..{self._mdp.num_states - 1} that has an action, got {asked!r}"
            )
        first = self._sampler.first_states(1, self.np_random)[0] if asked is None else asked
        self._state, self._terminated = int(first), False
        return self._state, {"action_mask": self._mask[self._state].copy()}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """One transition drawn from the model.

        Raises:
            ResetNeeded: before the first reset, or after termination.
            ValueError: an action outside the space.
        """
        if self._state is None or self._terminated:
            raise ResetNeeded("the episode has not begun or has terminated: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be in 0..{self._mdp.num_actions - 1}, got {action!r}")
        row, reward = int(self._mdp.row_index[self._state, action]), 0.0
        if row >= 0:
            s_t, r_t, terminated = self._sampler.next_steps(np.array([row]), self.np_random)
            self._state, reward, self._terminated = int(s_t[0]), float(r_t[0]), bool(terminated[0])
        return self._state, reward, self._terminated, False, {"action_mask": self._mask[self._state].copy()}


class ModelVectorEnv(gymnasium.vector.VectorEnv[NDArray[np.int64], NDArray[np.int64], NDArray[Any]]):
    """Many copies of a finite model stepped together; autoreset is disabled.

    A copy that ended is started again by ``reset(options={"reset_mask": mask})``. One generator serves all copies.
    ``info["action_mask"]`` is int8 ``[N, A]``. Every returned array is new.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> envs = ModelVectorEnv(FiniteMDP.from_arrays([[[0.0]]], [[5.0]], substochastic=True), 2)
        >>> _ = envs.reset(seed=0)
        >>> envs.step(np.zeros(2, dtype=int))[2].tolist()
        [True, True]
        >>> envs.reset(options={"reset_mask": np.array([True, False])})[0].tolist()
        [0, 0]
    """

    def __init__(self, mdp: FiniteMDP, num_envs: int, *, max_episode_steps: int | None = None) -> None:
        check_whole("num_envs", num_envs)
        if max_episode_steps is not None:
            check_whole("max_episode_steps", max_episode_steps)
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": []}
        self.num_envs = num_envs
        self._mdp, self._sampler, self._limit = mdp, Sampler(mdp), max_episode_steps
        self._mask = mdp.legal.astype(np.int8)
        self.single_observation_space = Discrete(mdp.num_states)
        self.single_action_space = Discrete(mdp.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._state = np.zeros(num_envs, dtype=np.int64)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._over = np.ones(num_envs, dtype=bool)

    def mdp(self) -> FiniteMDP:
        """The model these environments simulate."""
        return self._mdp

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.int64], dict[str, Any]]:
        """Starts every copy, or only those of ``options["reset_mask"]`` (bool, ``[N]``).

        Raises:
            ValueError: a mask of another shape or type.
        """
        super().reset(seed=seed)
        mask = np.ones(self.num_envs, dtype=bool)
        if options is not None and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
                raise ValueError(f"reset_mask must be bool of shape ({self.num_envs},), got {mask.dtype} {mask.shape}")
        self._state = self._state.copy()
        self._state[mask] = self._sampler.first_states(int(mask.sum()), self.np_random)
        self._steps[mask], self._over[mask] = 0, False
        return self._state.copy(), self._legal_mask()

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One transition of every copy.

        Raises:
            ResetNeeded: a copy that ended and was not reset, by its number.
            ValueError: actions of another shape or outside the space.
        """
        actions = np.asarray(actions)
        if self._over.any():
            raise ResetNeeded(
                f"environment {int(np.argmax(self._over))} must be reset before it is stepped: pass "
                'reset(options={"reset_mask": terminations | truncations})'
            )
        if actions.shape != (self.num_envs,) or ((actions < 0) | (actions >= self._mdp.num_actions)).any():
            raise ValueError(
                f"actions must be {self.num_envs} numbers in 0..{self._mdp.num_actions - 1}, got {actions}"
            )
        row = self._mdp.row_index[self._state, actions.astype(np.int64)]
        legal = row >= 0
        s_t, r_t, terminated = self._sampler.next_steps(np.where(legal, row, 0), self.np_random)
        self._state = np.where(legal, s_t, self._state)
        self._steps += 1
        terminations = terminated & legal
        limit = self._steps >= self._limit if self._limit is not None else np.zeros(self.num_envs, dtype=bool)
        truncations = limit & ~terminations
        self._over = terminations | truncations
        return self._state.copy(), np.where(legal, r_t, 0.0), terminations, truncations, self._legal_mask()

    def _legal_mask(self) -> dict[str, Any]:
        return {"action_mask": self._mask[self._state], "_action_mask": np.ones(self.num_envs, dtype=bool)}

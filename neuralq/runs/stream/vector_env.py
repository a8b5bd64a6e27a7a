"""The environments of a batch, each knowing its index in it: what goes wrong in one of them is told with that index."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from neuralq.checks import check_whole
from neuralq.runs.stream.encoding import encoder_for

__all__ = ["MASK_METHODS", "SubEnv", "SubEnvFault", "as_number", "legal_actions", "make_vector_env", "what_it_did"]

MASK_METHODS = ("action_masks", "valid_action_mask")
"""Methods by which environments tell their legal actions, for those that do not put them into info."""


def legal_actions(env: gym.Env[Any, Any], info: Mapping[str, Any]) -> Any:
    """The action mask of where an environment stands: of ``info``, else by a method of its own, else None.

    Args:
        env: a single environment, wrapped or not, with one of `MASK_METHODS` or none.
        info: of its last reset or step.

    Example:
        >>> env = gym.make("CartPole-v1")
        >>> legal_actions(env, {}) is None, legal_actions(env, {"action_mask": [1, 0]})
        (True, [1, 0])
    """
    if "action_mask" in info:
        return info["action_mask"]
    method = _mask_method(env)
    return None if method is None else method()


def _mask_method(env: gym.Env[Any, Any]) -> Callable[[], Any] | None:
    for name in MASK_METHODS:
        if env.has_wrapper_attr(name):
            found: Callable[[], Any] = env.get_wrapper_attr(name)
            if callable(found):
                return found
    return None


_FLAGS = (bool, np.bool_)


class SubEnvFault(RuntimeError):
    """An environment of a batch raised; the message names its index."""

    def __init__(self, index: int, problem: str) -> None:
        super().__init__(f"environment {index}{problem}")
        self.index = index
        self.problem = problem


def what_it_did(error: BaseException) -> str:
    """What somebody's code did that ended with this error.

    Example:
        >>> what_it_did(KeyError("speed")), what_it_did(SystemExit(3))
        ("raised KeyError: 'speed'", 'called sys.exit(3)')
    """
    if isinstance(error, SystemExit):
        return f"called sys.exit({'' if error.code is None else repr(error.code)})"
    return f"raised {type(error).__name__}: {error}"


class SubEnv(gym.Wrapper[Any, Any, Any, Any]):
    """One environment of a batch: its observations are copies of the promised kind, and what it raises names its index.

    Copying matters under SAME_STEP: an environment that reuses its observation array would overwrite the true successor
    with the next episode's first observation before anybody could read it. Checking matters because a batch casts what
    it is given to the space's dtype without a word, and says nothing of the index where the shape is wrong.

    Legal actions that the environment tells by a method (`MASK_METHODS`) are put into ``info["action_mask"]``.
    """

    def __init__(self, env: gym.Env[Any, Any], index: int) -> None:
        super().__init__(env)
        self.index = index
        space = env.observation_space
        self._encoder = encoder_for(space)
        self._shape = space.shape if isinstance(space, spaces.Box) else None
        self._dtype = space.dtype
        self._whole = isinstance(space, spaces.Discrete)
        self._mask_method = _mask_method(env)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment's own, with a copied observation and the reward as a float."""
        try:
            observation, reward, terminated, truncated, info = self.env.step(action)
        except (Exception, SystemExit) as error:
            raise self._raised(error) from error
        try:
            r_t = float(as_number(reward))
        except Exception as error:
            raise SubEnvFault(self.index, f": reward must be a number, got {reward!r}") from error
        if type(terminated) not in _FLAGS or type(truncated) not in _FLAGS:
            terminated, truncated = self._flag("terminated", terminated), self._flag("truncated", truncated)
        return self._checked(observation), r_t, terminated, truncated, self._with_mask(info)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As the environment's own, with a copied observation."""
        try:
            observation, info = self.env.reset(seed=seed, options=options)
        except (Exception, SystemExit) as error:
            raise self._raised(error) from error
        return self._checked(observation), self._with_mask(info)

    def _with_mask(self, info: dict[str, Any]) -> dict[str, Any]:
        """What the environment says of its legal actions where ``info`` looks for it; ``info`` wins if both speak."""
        if not isinstance(info, dict):
            raise SubEnvFault(self.index, f": info must be a mapping, got {info!r}")
        if self._mask_method is None or "action_mask" in info:
            return info
        try:
            return {**info, "action_mask": np.asarray(self._mask_method())}
        except (Exception, SystemExit) as error:
            raise self._raised(error) from error

    def _flag(self, field: str, value: Any) -> bool:
        """Whether an episode has ended; what is neither yes nor no would be cast to either without a word."""
        found = np.asarray(value)
        if found.size == 1 and found.dtype.kind in "biuf" and found.item() in (0, 1):
            return bool(found.item())
        raise SubEnvFault(self.index, f": {field} must be true or false, got {value!r}")

    def _raised(self, error: BaseException) -> SubEnvFault:
        return SubEnvFault(self.index, f" {what_it_did(error)}")

    def _checked(self, observation: Any) -> Any:
        """A copy; the quick way first, for arrays and numbers of exactly the promised kind."""
        if type(observation) is np.ndarray and self._shape is not None:
            if observation.dtype != self._dtype or observation.shape != self._shape:
                self._encoder.encode_single(observation, env_index=self.index)
                self._dtype = observation.dtype
            return observation.copy()
        if not (self._whole and type(observation) in (int, np.int64)):
            self._encoder.encode_single(observation, env_index=self.index)
        return _copied(observation)


def as_number(reward: Any) -> Any:
    """The reward, if it is not the text of a number, which Python and NumPy would read as one.

    Raises:
        TypeError: it is text.
    """
    if isinstance(reward, str | bytes) or (isinstance(reward, np.ndarray) and reward.dtype.kind in "SU"):
        raise TypeError("text is no number")
    return reward


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
    check_whole("num_envs", num_envs)
    made: list[gym.Env[Any, Any]] = []
    try:
        for index in range(num_envs):
            made.append(make())
            made[-1] = SubEnv(made[-1], index)
        return SyncVectorEnv(
            [partial(made.__getitem__, i) for i in range(num_envs)], copy=False, autoreset_mode=AutoresetMode.DISABLED
        )
    except BaseException as error:
        for env in made:
            with contextlib.suppress(Exception):
                env.close()
        if 0 < len(made) < num_envs and isinstance(error, Exception):
            error.add_note(f"{len(made)} of {num_envs} were made before; there may have to be fewer at a time")
        raise

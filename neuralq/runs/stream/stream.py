"""The stream of experience: one step of a batch of environments after another, as transitions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from torch import Tensor

from neuralq.checks import check_discount
from neuralq.runs.stream.encoding import Encoder, ObservationError, discrete_actions, encoder_for
from neuralq.runs.stream.faults import EnvironmentFault, describe_error
from neuralq.runs.stream.normalisation import Normalisation
from neuralq.runs.stream.spec import ObservationSpec
from neuralq.runs.stream.vector_env import SubEnv, as_number
from neuralq.types import Array, Transition

__all__ = ["Episode", "Interaction", "Policy", "Step", "interact"]


class Policy(Protocol):
    """Observations ``[N, *obs]`` to actions ``[N]`` int64 and the probability of each under this policy ``[N]``.

    A policy with an ``on_arrays`` that is not None is asked there, arrays in and arrays out, which spares a tensor or
    two per step; `neuralq.runs.stream.acting.EpsilonGreedyPolicy` has one.
    """

    def __call__(self, s: Tensor, /) -> tuple[Tensor, Tensor]:
        """Actions and their probabilities."""
        ...


@dataclass(frozen=True, slots=True)
class Episode:
    """A finished episode: index of its environment, undiscounted return and length in steps."""

    env_index: int
    episode_return: float
    length: int


class Step(NamedTuple):
    """One step of a batch of environments, with one row for each environment that really moved.

    Args:
        rows: the fields of the `Transition`, in its order, as arrays ``[k, …]``. Whoever keeps them copies them;
            making tensors first would cost as much again as the copying.
        env_indices: which environment each row comes from, ``[k]``.
        episodes: those that ended with this step.
    """

    rows: tuple[Array, ...]
    env_indices: Array
    episodes: tuple[Episode, ...]

    @property
    def transition(self) -> Transition:
        """The same as tensors, sharing the memory of ``rows``."""
        return Transition(*(torch.from_numpy(row) for row in self.rows))


class Interaction:
    """A vector environment and where it stands: the iterator's state, so that a run can stop and go on.

    Args:
        envs: Gymnasium vector environment with Discrete actions, in any autoreset mode. The sub-environments of a
            `SyncVectorEnv` are wrapped in `SubEnv`, in place.
        discount: γ in [0, 1].
        seed: of the first reset; None continues the environments' own randomness.
        as_index: encode finite observations as one index, for tables.
        normalisation: through which observations and the rewards of transitions are seen; episode returns are not.
        memory_size: numbers that whoever acts remembers of an episode; ``next_memory`` is then to be set, from
            observations with their memories ``[N, d + M …]`` to the memories after them ``[N, M]``.

    Raises:
        ValueError: for spaces that cannot be learned from and environments that do not say how they restart.
    """

    def __init__(
        self,
        envs: VectorEnv[Any, Any, Any],
        discount: float,
        seed: int | None,
        as_index: bool = False,
        normalisation: Normalisation | None = None,
        memory_size: int = 0,
    ) -> None:
        check_discount("discount", discount)
        self.envs = envs
        self.normalisation = normalisation
        self.num_envs: int = envs.num_envs
        self.discount = float(discount)
        # Centred before they are rounded to float32, which knows 1e9 and 1e9 + 1 as one number.
        wide = normalisation is not None and normalisation.observations
        self.encoder: Encoder = encoder_for(envs.single_observation_space, as_index=as_index, wide=wide)
        self.num_actions, self._first_action = discrete_actions(envs.single_action_space)
        self.mode = _autoreset_mode(envs)
        inner = envs.unwrapped
        if isinstance(inner, SyncVectorEnv):
            inner.envs = [e if isinstance(e, SubEnv) else SubEnv(e, i) for i, e in enumerate(inner.envs)]
        self.num_steps = 0
        self.next_memory: Callable[[Array], Array] | None = None
        self._memory = np.zeros((self.num_envs, memory_size), np.float32)  # before what is observed next
        self._everyone = np.arange(self.num_envs)
        self._discounts = np.full(self.num_envs, self.discount)
        self._broken = False
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)
        self._pending = np.zeros(self.num_envs, bool)
        self._mask: Array | None = None
        self._begun = False
        self.restart(seed)
        self._begun = True
        self.spec = self._describe()

    def _describe(self) -> ObservationSpec:
        encoder, masked = self.encoder, self._mask is not None
        return ObservationSpec(
            self._s.shape[1:], self._s.dtype, encoder.shape, encoder.num_categories, masked, self.num_actions,
            encoder.frame_scaling, self._memory.shape[1], encoder.dtype if self._memory.shape[1] else None,
        )  # fmt: skip

    def restart(self, seed: int | None) -> None:
        """Reset every environment: an episode boundary in all of them.

        Raises:
            EnvironmentFault: if an environment raises, or hands out what its space did not promise.
        """
        try:
            observation, info = self.envs.reset(seed=seed)
        except (Exception, SystemExit) as error:
            raise self._fault(f"at reset, {describe_error(error)}") from error
        self._pending[:] = False
        self._returns[:] = 0
        self._lengths[:] = 0
        self._memory[:] = 0
        self._s = self._observe(observation, info, self._everyone)

    def _observe(
        self, observation: Any, info: Mapping[str, Any], env_indices: Array, over: Array | None = None
    ) -> Array:
        """Encode a batch, with action masks appended where there are any; ``env_indices`` says whose are new.

        Where ``over`` is true the world has ended, and there may be no legal action.
        """
        encoded = self._normalised(self._encoded(observation), env_indices)
        self._take_masks(info, env_indices, over)
        return self._joined(encoded, self._mask)

    def _encoded(self, observation: Any) -> Array:
        try:
            encoded = self.encoder.encode(observation)
        except ObservationError as error:
            raise self._fault(str(error)) from error
        if len(encoded) != self.num_envs:
            raise self._fault(f"field observation: must have {self.num_envs} rows, got {len(encoded)}")
        return encoded

    def _normalised(self, encoded: Array, env_indices: Array) -> Array:
        return encoded if self.normalisation is None else self.normalisation.observe(encoded, env_indices)

    def _take_masks(self, info: Mapping[str, Any], env_indices: Array, over: Array | None) -> None:
        if self._mask is None and "action_mask" in info:
            if self._begun:
                raise self._fault("field info['action_mask']: given now but not at the first reset; give it always")
            self._mask = np.ones((self.num_envs, self.num_actions), bool)
        if self._mask is not None:
            self._mask[env_indices] = self._legal(info, env_indices, over)

    def _legal(self, info: Mapping[str, Any], env_indices: Array, over: Array | None) -> Array:
        """Action masks of ``env_indices``, ``[k, A]`` bool; an environment without one may do everything."""
        legal = np.ones((len(env_indices), self.num_actions), bool)
        given, held = info.get("action_mask"), info.get("_action_mask")
        if given is None:
            return legal
        rows = np.flatnonzero(np.ones(len(env_indices)) if held is None else held[env_indices])
        found = np.asarray(given)[env_indices[rows]]
        masks = found if found.dtype != object else [np.asarray(mask) for mask in found]
        shapes = [found.shape[1:]] if found.dtype != object else [mask.shape for mask in masks]
        for row, shape in zip(rows, shapes, strict=False):
            if shape != (self.num_actions,):
                problem = f"must have {self.num_actions} entries, got shape {shape}"
                raise self._fault_in(env_indices[row], f"info['action_mask']: {problem}")
        if len(rows):
            legal[rows] = np.asarray(masks) != 0
        for row in np.flatnonzero(~legal.any(-1)):
            if over is None or not over[env_indices[row]]:
                problem = "must allow an action until the episode has terminated, allows none"
                raise self._fault_in(env_indices[row], f"info['action_mask']: {problem}")
            legal[row] = True  # the world has ended: nothing is chosen, and a discount of 0 ignores what is best there
        return legal

    def _joined(self, encoded: Array, mask: Array | None) -> Array:
        """Observations with what is remembered from before them, and with their masks, where there are such."""
        if mask is None and self._memory.shape[1] == 0:
            return encoded
        flat = encoded.reshape(len(encoded), -1)
        if self._memory.shape[1]:
            flat = np.concatenate([flat.astype(np.float32), self._memory], axis=1)
        # Bytes stay bytes, indices indices.
        return flat if mask is None else np.concatenate([flat, mask.astype(flat.dtype)], axis=1)

    def _fault_in(self, env_index: int, what: str) -> EnvironmentFault:
        return self._fault(f"environment {env_index}, step {self._lengths[env_index] + 1} of its episode, field {what}")

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
        chosen, mu = self._act(policy)
        threads = torch.get_num_threads()
        try:
            observation, reward, terminated, truncated, info = self.envs.step(chosen + self._first_action)
        except (Exception, SystemExit) as error:
            raise self._fault(describe_error(error)) from error
        if torch.get_num_threads() != threads:  # with another number sums have other bits, and a run other times
            torch.set_num_threads(threads)
        terminated, truncated = self._flags("terminated", terminated), self._flags("truncated", truncated)
        last = terminated | truncated
        r_t = self._checked_reward(reward)
        ended = np.count_nonzero(last) > 0  # four times as quick as last.any(), here at every step
        if ended and self.mode is AutoresetMode.SAME_STEP:
            s_t, arrived = self._across_the_end(observation, last, terminated, info)
        else:
            s_t = arrived = self._observe(observation, info, self._everyone, terminated)
        fake = self._pending
        everyone = np.count_nonzero(fake) == 0
        env_indices = self._everyone if everyone else np.flatnonzero(~fake)
        discount_t = np.where(terminated, 0.0, self.discount) if ended else self._discounts.copy()
        rows: tuple[Array, ...] = (self._s, chosen, mu, r_t, discount_t, s_t, last)
        if self.normalisation is not None:
            rows = (*rows[:3], self.normalisation.reward(r_t, last, ~fake), *rows[4:])
        if not everyone:
            rows = tuple(row[env_indices] for row in rows)
            r_t = np.where(fake, 0, r_t)
        self.num_steps += len(env_indices)
        self._returns += r_t
        self._lengths += 1 if everyone else ~fake
        episodes = self._finish(last, arrived) if ended else ()
        if self.mode is AutoresetMode.NEXT_STEP:
            self._pending = last
        if not (self.mode is AutoresetMode.DISABLED and episodes):
            self._s = arrived
        return Step(rows, env_indices, episodes)

    def _act(self, policy: Policy) -> tuple[Array, Array]:
        """Actions and their probabilities; what was seen is remembered."""
        if self.next_memory is not None:
            self._memory = self.next_memory(self._s)
            self._memory[self._pending] = 0  # a new episode begins
        on_arrays = getattr(policy, "on_arrays", None)
        if on_arrays is not None:
            return on_arrays(self._s)  # type: ignore[no-any-return]
        action, mu = policy(torch.from_numpy(self._s))
        return action.numpy(), mu.numpy()

    def _flags(self, field: str, value: Any) -> Array:
        """Which episodes have ended, ``[N]`` bool; what is neither yes nor no would be cast to either."""
        if type(value) is np.ndarray and value.dtype == bool and value.shape == (self.num_envs,):
            return value
        found = np.asarray(value)
        if found.shape != (self.num_envs,):
            raise self._fault(f"field {field}: must have shape ({self.num_envs},), got {found.shape}")
        for env_index, one in enumerate(found.tolist()):
            if one not in (0, 1):
                raise self._fault_in(env_index, f"{field}: must be true or false, got {one!r}")
        return found.astype(bool)

    def _checked_reward(self, reward: Any) -> Array:
        try:
            found = reward if isinstance(reward, np.ndarray) else np.array(reward)
            for one in found.flat if found.dtype.kind in "OSU" else ():
                as_number(one)
            r_t = np.array(reward, np.float64)
        except (TypeError, ValueError) as error:
            raise self._fault(f"field reward: must be numbers, got {reward!r}") from error
        if r_t.shape != (self.num_envs,):
            raise self._fault(f"field reward: must have shape ({self.num_envs},), got {r_t.shape}")
        if np.count_nonzero(np.isfinite(r_t)) < r_t.size:
            env_index = int(np.flatnonzero(~np.isfinite(r_t))[0])
            raise self._fault_in(env_index, f"reward: must be finite, got {r_t[env_index]}")
        return r_t

    def _across_the_end(
        self, observation: Any, last: Array, terminated: Array, info: Mapping[str, Any]
    ) -> tuple[Array, Array]:
        """Under SAME_STEP, what the finished episodes really arrived at, and where the next ones begin.

        Statistics take them in in this order, as they do where restarting is asked for.
        """
        fresh, ended = self._encoded(observation), np.flatnonzero(last)
        s_t = fresh.copy()
        for env_index in ended:
            s_t[env_index] = self._final(info, int(env_index))
        arrived = s_t = self._normalised(s_t, self._everyone)
        arrived = arrived.copy()
        arrived[ended] = self._normalised(fresh, ended)[ended]
        self._take_masks(info, self._everyone, None)
        mask = self._mask
        if mask is not None:
            mask = mask.copy()
            mask[ended] = self._legal(info.get("final_info", {}), ended, terminated)
        s_t = self._joined(s_t, mask)
        self._memory[ended] = 0
        return s_t, self._joined(arrived, self._mask)

    def _final(self, info: Mapping[str, Any], env_index: int) -> Array:
        try:
            return self.encoder.encode_single(info["final_obs"][env_index], env_index=env_index)
        except (LookupError, TypeError) as error:
            problem = "info['final_obs']: an environment that restarts in the same step must give the last observation"
            raise self._fault_in(env_index, f"{problem} there, got {info.get('final_obs')!r}") from error
        except ObservationError as error:
            raise self._fault(str(error)) from error

    def _finish(self, last: Array, arrived: Array) -> tuple[Episode, ...]:
        """Account for the finished episodes and, where restarting is ours, restart those environments."""
        ended = np.flatnonzero(last)
        episodes = tuple(Episode(int(i), float(self._returns[i]), int(self._lengths[i])) for i in ended)
        self._returns[ended] = 0
        self._lengths[ended] = 0
        if self.mode is AutoresetMode.DISABLED:
            try:
                observation, info = self.envs.reset(options={"reset_mask": last})
            except (Exception, SystemExit) as error:
                raise self._fault(describe_error(error)) from error
            self._memory[ended] = 0
            fresh = self._observe(observation, info, ended)
            self._s = arrived.copy()
            self._s[ended] = fresh[ended]
        return episodes

    def running_episodes(self) -> list[tuple[float, int]]:
        """Return so far and length of each environment's unfinished episode."""
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
            "normalisation": None if self.normalisation is None else self.normalisation.state_dict(),
            "scalings": self.encoder.scalings,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`; the environments must have been restored to the same point."""
        self.num_steps = int(state["num_steps"])
        self._s = np.array(state["s"])
        self._returns = np.array(state["returns"])
        self._lengths = np.array(state["lengths"])
        self._pending = np.array(state["pending"])
        self._mask = None if state["mask"] is None else np.array(state["mask"])
        self.load_normalisation(state)

    def load_normalisation(self, state: Mapping[str, Any]) -> None:
        """Of `state_dict`, the statistics alone: they stay true where the episodes have to start anew.

        Raises:
            ValueError: the observations of that stream were scaled otherwise.
        """
        self.encoder.require_scalings(state.get("scalings"))
        if self.normalisation is not None:
            self.normalisation.load_state_dict(state["normalisation"])


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
        >>> import gymnasium as gym
        >>> envs = gym.make_vec("CartPole-v1", num_envs=2)
        >>> push_left = lambda s, rng: (torch.zeros(len(s), dtype=torch.int64), torch.ones(len(s)))
        >>> next(interact(envs, push_left, np.random.default_rng(0))).r_t.tolist()
        [1.0, 1.0]
    """
    stream = Interaction(envs, discount, seed=int(rng.integers(2**31)))
    for step in stream.steps(lambda s: policy(s, rng)):
        yield step.transition

"""Simulation of a finite model: one environment, or many stepped together by array operations.

Both draw from the same `Outcomes` by inverting the cumulative distribution of a row, so their samples have the model's
own frequencies and rewards. Taking an illegal action leaves the state as it is with reward 0: the mask tells.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from scipy import sparse

from neuralq.checks import check_whole

if TYPE_CHECKING:
    from neuralq.mdp import FiniteMDP

__all__ = ["ModelEnv", "ModelVectorEnv", "Outcomes", "Sampler", "short_sum"]


def short_sum(mass: float) -> str:
    """What to tell of a row whose probabilities sum to less than 1."""
    return (
        f"probabilities sum to {mass}, less than 1; if the missing probability is that of the episode's end, "
        "pass substochastic=True"
    )


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Everything that can follow each row: outcomes of row k are ``indptr[k]:indptr[k + 1]``.

    Args:
        indptr: ``[K + 1]``.
        probability: ``[M]``; a row's mass below 1 ends the episode in the state that was left, with reward 0.
        s_t: state that is reached, ``[M]``.
        reward: reward of this very transition, ``[M]``.
        terminated: whether the episode ends here, ``[M]``.

    Example:
        >>> two = Outcomes(*map(np.array, ([0, 2], [0.5, 0.5], [0, 1], [0.0, 4.0], [False, True])))
        >>> two.expected(num_states=2)[1].tolist()
        [2.0]
    """

    indptr: NDArray[np.int64]
    probability: NDArray[np.float64]
    s_t: NDArray[np.int64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]

    @property
    def row(self) -> NDArray[np.int64]:
        """The row of each outcome, ``[M]``."""
        return np.repeat(np.arange(len(self.indptr) - 1), np.diff(self.indptr))

    def check(
        self, s_tm1: NDArray[np.int64], a_tm1: NDArray[np.int64], num_states: int, *, substochastic: bool = False
    ) -> None:
        """Every outcome is a probability, a finite reward and a state, and those of a row sum to 1.

        Raises:
            ValueError: the first that is not, with its row, its pair and its value.
        """
        for what, values, wrong in (
            ("probability", self.probability, ~((self.probability >= 0) & np.isfinite(self.probability))),
            ("reward", self.reward, ~np.isfinite(self.reward)),
            (f"state of 0..{num_states - 1}", self.s_t, (self.s_t < 0) | (self.s_t >= num_states)),
        ):
            bad = np.flatnonzero(wrong)
            if bad.size:
                k = int(self.row[bad[0]])
                raise ValueError(f"row {k} (s={s_tm1[k]}, a={a_tm1[k]}): {values[bad[0]]} is not a valid {what}")
        mass = np.bincount(self.row, weights=self.probability, minlength=len(s_tm1))
        bad = np.flatnonzero(mass > 1 + 1e-9)
        if bad.size:
            k = int(bad[0])
            raise ValueError(f"row {k} (s={s_tm1[k]}, a={a_tm1[k]}): probabilities sum to {mass[k]}, more than 1")
        bad = np.flatnonzero(mass < 1 - 1e-9)
        if bad.size and not substochastic:
            k = int(bad[0])
            raise ValueError(f"row {k} (s={s_tm1[k]}, a={a_tm1[k]}): {short_sum(mass[k])}")

    def expected(self, num_states: int) -> tuple[sparse.csr_array, NDArray[np.float64]]:
        """The continuing transition matrix ``[K, S]`` and the expected reward ``[K]`` of these outcomes."""
        row, k = self.row, len(self.indptr) - 1
        goes_on = ~self.terminated & (self.probability > 0)
        entries = (self.probability[goes_on], (row[goes_on], self.s_t[goes_on]))
        transition = sparse.coo_array(entries, shape=(k, num_states)).tocsr()
        reward = np.bincount(row, weights=self.probability * self.reward, minlength=k)
        return transition, reward.astype(np.float64)


def _outcomes_of_rows(mdp: FiniteMDP) -> Outcomes:
    """The outcomes a model has when only its transition matrix and expected rewards are known."""
    transition, k = mdp.transition, mdp.num_rows
    row = np.repeat(np.arange(k), np.diff(transition.indptr))
    s_t = transition.indices.astype(np.int64)
    keep = transition.data > 0
    ends = np.flatnonzero(mdp.termination > 0)
    row, s_t = np.concatenate([row[keep], ends]), np.concatenate([s_t[keep], mdp.s_tm1[ends]])
    probability = np.concatenate([transition.data[keep], mdp.termination[ends]])
    terminated = np.concatenate([np.zeros(int(keep.sum()), dtype=bool), np.ones(len(ends), dtype=bool)])
    order = np.argsort(row, kind="stable")
    indptr = np.searchsorted(row[order], np.arange(k + 1)).astype(np.int64)
    return Outcomes(indptr, probability[order], s_t[order], mdp.reward[row[order]], terminated[order])


class Sampler:
    """Draws the outcome of many rows at once: one uniform number and one binary search each.

    The cumulative probabilities of row k live in [k, k + 1], so that one search over all of them inverts any row.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> sampler = Sampler(FiniteMDP.garnet(5, 2, 1, seed=0))
        >>> sampler.next_steps(np.array([0, 3]), np.random.default_rng(0))[0].shape
        (2,)
    """

    def __init__(self, mdp: FiniteMDP) -> None:
        source = mdp.outcomes or _outcomes_of_rows(mdp)
        keep = source.probability > 0
        self._row = source.row[keep]
        self._s_t, self._reward = source.s_t[keep], source.reward[keep]
        self._terminated = source.terminated[keep] | mdp.is_terminal[self._s_t]
        running = np.cumsum(source.probability[keep])
        first = np.searchsorted(self._row, np.arange(mdp.num_rows + 1))
        before = np.concatenate([[0.0], running])[first[:-1]]
        within = running - before[self._row]
        mass = np.concatenate([[0.0], running])[first[1:]] - before
        whole = mass > 1 - 1e-9
        within /= np.where(whole, np.maximum(mass, 1e-300), 1.0)[self._row]
        self._cumulative = self._row + within
        self._s_tm1 = mdp.s_tm1
        # Rounding must not push a draw past the last outcome of a full row.
        self._last = np.where(whole & (first[1:] > first[:-1]), first[1:] - 1, first[1:])
        self._discount = mdp.row_discount
        self._random_end = bool(np.any(self._discount < 1))
        self._start = np.cumsum(mdp.start_distribution)

    def first_states(self, num: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """``num`` independent draws from the start distribution."""
        drawn: NDArray[np.int64] = np.searchsorted(self._start, rng.random(num) * self._start[-1], side="right")
        return drawn

    def next_steps(
        self, row: NDArray[np.int64], rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
        """Successor, reward and whether the episode terminates, ``[N]`` each, for one draw of every given row."""
        found = np.searchsorted(self._cumulative, row + rng.random(len(row)), side="right")
        found = np.minimum(found, self._last[row])
        # A draw beyond the listed mass of its row ends the episode where it stands.
        inside = (found < len(self._row)) & (self._row[np.minimum(found, len(self._row) - 1)] == row)
        found = np.where(inside, found, 0)
        s_t = np.where(inside, self._s_t[found], self._s_tm1[row])
        terminated = np.where(inside, self._terminated[found], True)
        if self._random_end:
            terminated |= rng.random(len(row)) >= self._discount[row]
        return s_t, np.where(inside, self._reward[found], 0.0), terminated


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

"""Finite Markov decision processes: one row per legal state-action pair, checked when built.

A row k stands for the pair (s_tm1[k], a_tm1[k]) and holds P(s_t | s, a) as a sparse row, the expected reward and a
discount. Rows may be substochastic: the missing mass is the probability that the episode ends there. A state without
rows is terminal: the episode ends on entering it and its value is 0. Both forms give the same Bellman operator

    (T V)(s) = max_{a legal in s} [ r(s, a) + γ · discount(s, a) · Σ_{s'} P(s' | s, a) V(s') ]    (Mitchell 1997, 13.9)

so solvers need no case for termination. `Outcomes` keeps the rewards of single transitions where the source has them;
simulation draws from it, planning only needs expectations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from neuralq.checks import check_whole
from neuralq.mdp.comparison import changing_wrapper, difference
from neuralq.mdp.environment import ModelEnv, ModelVectorEnv
from neuralq.mdp.outcomes import Outcomes, short_sum
from neuralq.mdp.sources import garnet_rows, outcomes_of_functions

__all__ = ["FiniteMDP"]

_LARGEST_INDEX = np.iinfo(np.int32).max
_UNCHECKED = "leave out the option or wrapper that changes it, or take the model as it stands (check=False, --no-check)"
_SUM_TOLERANCE = 1e-9  # a row may miss 1 by this much: what decimal probabilities leave behind


@dataclass(frozen=True, eq=False)
class FiniteMDP:
    """A finite MDP is S states, A actions and one row for each legal pair, sorted by state, then action.

    Args:
        num_states: S.
        num_actions: A.
        s_tm1: state of each row, ``[K]``.
        a_tm1: action of each row, ``[K]``.
        transition: P(s_t | row), a CSR array ``[K, S]``; a row sums to at most 1, the missing mass ends the episode.
        reward: expected reward of each row, ``[K]``.
        discount: continuation factor of each row in [0, 1], ``[K]``, multiplied by γ; default 1. Simulated as the
            probability that the episode goes on.
        start: distribution of the first state, ``[S]``; default uniform over the states that have an action.
        state_names: optional, S strings.
        action_names: optional, A strings.
        outcomes: optional, the transitions with their own rewards that ``transition`` and ``reward`` summarise.

    Raises:
        ValueError: a row or state that breaks these rules, by number, name and value.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.5]]], [[0.0], [1.0]], substochastic=True)
        >>> mdp.num_rows, mdp.termination.tolist()
        (2, [0.0, 0.5])
    """

    num_states: int
    num_actions: int
    s_tm1: NDArray[np.int64]
    a_tm1: NDArray[np.int64]
    transition: sparse.csr_array
    reward: NDArray[np.float64]
    discount: NDArray[np.float64] | None = None
    start: NDArray[np.float64] | None = None
    state_names: Sequence[str] | None = None
    action_names: Sequence[str] | None = None
    outcomes: Outcomes | None = None

    def __post_init__(self) -> None:
        check_whole("num_states", self.num_states)
        check_whole("num_actions", self.num_actions)
        store = object.__setattr__
        store(self, "s_tm1", _frozen(self.s_tm1, np.int64))
        store(self, "a_tm1", _frozen(self.a_tm1, np.int64))
        store(self, "reward", _frozen(self.reward, np.float64))
        store(self, "discount", _frozen(np.ones(self.num_rows) if self.discount is None else self.discount, np.float64))
        self._check_rows()
        self._check_transition()
        if self.start is None:
            store(self, "start", _frozen(~self.is_terminal / np.count_nonzero(~self.is_terminal), np.float64))
        else:
            store(self, "start", _frozen(self.start, np.float64))
        self._check_start()
        for field, size in (("state_names", self.num_states), ("action_names", self.num_actions)):
            names = getattr(self, field)
            if names is not None and len(names) != size:
                raise ValueError(f"{field} must hold {size} names, got {len(names)}")
            store(self, field, None if names is None else tuple(names))

    def _check_rows(self) -> None:
        k = self.num_rows
        for name in ("s_tm1", "a_tm1", "reward", "discount"):
            shape = np.shape(getattr(self, name))
            if shape != (k,):
                raise ValueError(f"{name} must have shape ({k},), one entry per row, got {shape}")
        if k == 0:
            raise ValueError("an MDP needs at least one legal state-action pair, got none: every state is terminal")
        for name, index, size in (("state", self.s_tm1, self.num_states), ("action", self.a_tm1, self.num_actions)):
            bad = np.flatnonzero((index < 0) | (index >= size))
            if bad.size:
                raise ValueError(f"row {bad[0]}: {name} {index[bad[0]]} is not in 0..{size - 1}")
        pair = self.s_tm1 * self.num_actions + self.a_tm1
        bad = np.flatnonzero(np.diff(pair) <= 0)
        if bad.size:
            raise ValueError(
                f"{self.row_name(bad[0] + 1)} must come after {self.row_name(bad[0])}: "
                "rows are sorted by state, then action, without repeats"
            )
        bad = np.flatnonzero(~np.isfinite(self.reward))
        if bad.size:
            raise ValueError(
                f"{self.row_name(bad[0])}: reward must be finite, got {self.reward[bad[0]]}; "
                "leave out the row to make the action illegal"
            )
        discount = self.row_discount
        bad = np.flatnonzero(~((discount >= 0) & (discount <= 1)))
        if bad.size:
            raise ValueError(f"{self.row_name(bad[0])}: discount must lie in [0, 1], got {discount[bad[0]]}")

    def _check_transition(self) -> None:
        transition = sparse.csr_array(self.transition, dtype=np.float64)
        if max(transition.nnz, *transition.shape) <= _LARGEST_INDEX:  # half the memory to read in every sweep
            index, starts = transition.indices.astype(np.int32), transition.indptr.astype(np.int32)
            transition = sparse.csr_array((transition.data, index, starts), shape=transition.shape)
        object.__setattr__(self, "transition", transition)
        if transition.shape != (self.num_rows, self.num_states):
            raise ValueError(f"transition must have shape ({self.num_rows}, {self.num_states}), got {transition.shape}")
        bad = np.flatnonzero(~((transition.data >= 0) & np.isfinite(transition.data)))
        if bad.size:
            row = int(np.searchsorted(transition.indptr, bad[0], side="right")) - 1
            raise ValueError(
                f"{self.row_name(row)}: P(s_t={transition.indices[bad[0]]}) must be finite and not "
                f"negative, got {transition.data[bad[0]]}"
            )
        bad = np.flatnonzero(self.row_mass > 1 + _SUM_TOLERANCE)
        if bad.size:
            raise ValueError(f"{self.row_name(bad[0])}: probabilities sum to {self.row_mass[bad[0]]}, more than 1")
        if self.outcomes is not None and len(self.outcomes.indptr) != self.num_rows + 1:
            raise ValueError(f"outcomes must describe {self.num_rows} rows, got {len(self.outcomes.indptr) - 1}")

    def _check_start(self) -> None:
        start = self.start_distribution
        if start.shape != (self.num_states,):
            raise ValueError(f"start must have shape ({self.num_states},), got {start.shape}")
        bad = np.flatnonzero(~((start >= 0) & np.isfinite(start)))
        if bad.size:
            raise ValueError(f"start[{bad[0]}] must be a probability, got {start[bad[0]]}")
        if abs(start.sum() - 1) > _SUM_TOLERANCE:
            raise ValueError(f"start must sum to 1, got {start.sum()}")
        bad = np.flatnonzero((start > 0) & self.is_terminal)
        if bad.size:
            raise ValueError(
                f"start puts probability {start[bad[0]]} on {self.state_name(bad[0])}, which has no action"
            )

    @property
    def num_rows(self) -> int:
        """K, the number of legal state-action pairs."""
        return len(self.s_tm1)

    @property
    def row_discount(self) -> NDArray[np.float64]:
        """The continuation factor of every row, ``[K]``."""
        assert self.discount is not None
        return self.discount

    @property
    def start_distribution(self) -> NDArray[np.float64]:
        """The distribution of the first state, ``[S]``."""
        assert self.start is not None
        return self.start

    @cached_property
    def row_mass(self) -> NDArray[np.float64]:
        """Probability that a row leads to a state at all, ``[K]``."""
        return np.asarray(self.transition.sum(axis=1), dtype=np.float64).reshape(-1)

    @cached_property
    def termination(self) -> NDArray[np.float64]:
        """Probability of each row to end the episode without entering a state, ``[K]``: the missing mass."""
        missing = 1.0 - self.row_mass
        return np.where(missing > _SUM_TOLERANCE, missing, 0.0)

    @cached_property
    def row_starts(self) -> NDArray[np.int64]:
        """Rows of state s are ``row_starts[s]:row_starts[s + 1]``, ``[S + 1]``."""
        return np.searchsorted(self.s_tm1, np.arange(self.num_states + 1)).astype(np.int64)

    @cached_property
    def row_index(self) -> NDArray[np.int64]:
        """Row of every pair, ``[S, A]``; -1 where the action is not legal."""
        index = np.full((self.num_states, self.num_actions), -1, dtype=np.int64)
        index[self.s_tm1, self.a_tm1] = np.arange(self.num_rows)
        return index

    @property
    def legal(self) -> NDArray[np.bool_]:
        """Which actions each state has, ``[S, A]``."""
        return self.row_index >= 0

    @cached_property
    def is_terminal(self) -> NDArray[np.bool_]:
        """States without an action, ``[S]``: entering one ends the episode."""
        mask: NDArray[np.bool_] = np.diff(self.row_starts) == 0
        return mask

    def state_name(self, s: int) -> str:
        """How messages call state ``s``."""
        return f"state {s}" if self.state_names is None else f"state {s} ({self.state_names[s]})"

    def row_name(self, row: int) -> str:
        """How messages call a row."""
        return f"row {row} (s={self.s_tm1[row]}, a={self.a_tm1[row]})"

    @classmethod
    def from_arrays(
        cls,
        transition: ArrayLike | Sequence[sparse.sparray],
        reward: ArrayLike,
        *,
        legal: ArrayLike | None = None,
        substochastic: bool = False,
        start: ArrayLike | None = None,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
    ) -> FiniteMDP:
        """Arrays ``P[a, s, s']`` and ``R[s, a]`` make an MDP; NaN in R, or False in ``legal``, marks an illegal action.

        Args:
            transition: ``[A, S, S]``, or a sequence of A sparse ``[S, S]`` arrays. Rows of legal pairs sum to 1.
            reward: expected reward, ``[S, A]``.
            legal: optional mask, ``[S, A]``.
            substochastic: whether rows may sum to less than 1; the missing probability ends the episode.
            start: optional start distribution, ``[S]``.
            state_names: optional.
            action_names: optional.

        Raises:
            ValueError: wrong shapes, or any row that `FiniteMDP` refuses.

        Example:
            >>> FiniteMDP.from_arrays([[[1.0]]], [[2.0]]).reward.tolist()
            [2.0]
        """
        reward = np.asarray(reward, dtype=np.float64)
        blocks = [sparse.csr_array(block, dtype=np.float64) for block in transition]  # type: ignore[union-attr]
        num_actions, num_states = len(blocks), reward.shape[0] if reward.ndim else 0
        bad = [a for a, block in enumerate(blocks) if block.shape != (num_states, num_states)]
        if reward.shape != (num_states, num_actions) or bad:
            got = f"P[{bad[0]}] of shape {blocks[bad[0]].shape}" if bad else f"{num_actions} matrices"
            raise ValueError(f"P must be [A, S, S] and R [S, A], got R of shape {reward.shape} and {got}")
        mask = ~np.isnan(reward) if legal is None else np.asarray(legal, dtype=bool)
        if mask.shape != reward.shape:
            raise ValueError(f"legal must have the shape of R, {reward.shape}, got {mask.shape}")
        s_tm1, a_tm1 = np.nonzero(mask)
        by_action = np.flatnonzero(mask.T)  # position a·S + s in the stack of blocks
        order = np.lexsort((by_action // num_states, by_action % num_states))
        rows = sparse.vstack(blocks, format="csr")[by_action[order]]
        begin = None if start is None else np.asarray(start, dtype=np.float64)
        mdp = cls(num_states, num_actions, s_tm1, a_tm1, rows, reward[mask], None, begin, state_names, action_names)
        if not substochastic and mdp.termination.any():
            row = int(np.argmax(mdp.termination > 0))
            raise ValueError(f"{mdp.row_name(row)}: {short_sum(mdp.row_mass[row])}")
        return mdp

    @classmethod
    def from_gymnasium(cls, env: gymnasium.Env[Any, Any], *, check: bool = True) -> FiniteMDP:
        """The model inside a Gymnasium environment: its ``mdp()``, or its table ``P[s][a] = [(p, s', r, terminated)]``.

        Transitions flagged as terminated give missing mass. The start distribution is ``initial_state_distrib`` where
        the environment has one, else uniform.

        Args:
            env: the environment, which is not touched.
            check: whether a few thousand steps of a copy of it are compared with the table first. A table may lack what
                its environment does besides, and a wrapper changes one and not the other; a time limit is no
                difference, but the values are those without it.

        Raises:
            ValueError: the environment has neither, its table is not a valid model, or its steps are not the table's.

        Example:
            >>> FiniteMDP.from_gymnasium(gymnasium.make("FrozenLake-v1")).num_rows
            64
        """
        inner = env.unwrapped
        if callable(getattr(inner, "mdp", None)):
            model: FiniteMDP = inner.mdp()  # type: ignore[attr-defined]
            wrapper = changing_wrapper(env)
            if check and wrapper is not None:
                raise ValueError(
                    f"the wrapper {wrapper} may change what {inner} does, unknown to its model; {_UNCHECKED}"
                )
            return model
        table = getattr(inner, "P", None)
        if table is None:
            raise ValueError(
                f"{inner} has no transition table: its unwrapped environment needs P[s][a], a list of "
                "(probability, next state, reward, terminated), or a method mdp()"
            )
        if not isinstance(inner.observation_space, Discrete) or not isinstance(inner.action_space, Discrete):
            raise ValueError(
                f"{inner} has a table, but its observations are {inner.observation_space} and its actions "
                f"{inner.action_space}; a table needs states and actions that are numbers, Discrete(n)"
            )
        num_states, num_actions = int(inner.observation_space.n), int(inner.action_space.n)
        start = getattr(inner, "initial_state_distrib", None)

        def actions(s: int) -> Iterable[int]:
            return range(num_actions) if not hasattr(table[s], "keys") else sorted(table[s].keys())

        try:
            mdp = cls.from_functions(num_states, num_actions, actions, lambda s, a: table[s][a], start=start)
        except (KeyError, IndexError) as error:
            raise ValueError(
                f"the table of {inner} has no entry {error}; it needs P[s][a] for every state of 0..{num_states - 1}"
            ) from error
        found = difference(env, mdp, start) if check else None
        if found is not None:
            raise ValueError(f"{inner} does not do what its table says: {found}; {_UNCHECKED}")
        return mdp

    @classmethod
    def from_functions(
        cls,
        num_states: int,
        num_actions: int,
        actions: Callable[[int], Iterable[int]],
        transitions: Callable[[int, int], Iterable[tuple[float, int, float, bool]]],
        *,
        substochastic: bool = False,
        start: ArrayLike | None = None,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> FiniteMDP:
        """Two functions make an MDP: each is called once per state and once per legal pair.

        Args:
            num_states: S.
            num_actions: A.
            actions: legal actions of a state; none makes it terminal.
            transitions: the ``(probability, s_t, reward, terminated)`` of a pair, which must sum to 1.
            substochastic: whether rows may sum to less; the missing mass ends the episode with reward 0.
            start: optional start distribution, ``[S]``.
            state_names: optional.
            action_names: optional.
            progress: optional, called a hundred times with the states that are built, and S.

        Raises:
            ValueError: a row that `FiniteMDP` refuses.

        Example:
            >>> walk = FiniteMDP.from_functions(3, 1, lambda s: [0], lambda s, a: [(1.0, s, float(s), s == 2)])
            >>> walk.termination.tolist()
            [0.0, 0.0, 1.0]
        """
        s_tm1, a_tm1, outcomes = outcomes_of_functions(num_states, actions, transitions, progress)
        outcomes.check(s_tm1, a_tm1, num_states, substochastic=substochastic)
        transition, reward = outcomes.expected(num_states)
        begin = None if start is None else np.asarray(start, dtype=np.float64)
        return cls(
            num_states, num_actions, s_tm1, a_tm1, transition, reward, None, begin, state_names, action_names, outcomes
        )

    @classmethod
    def garnet(cls, num_states: int, num_actions: int, branching: int, *, seed: int) -> FiniteMDP:
        """A random MDP: each pair reaches ``branching`` distinct random states, at random cut points of [0, 1].

        Rewards are standard normal. Source: Archibald, McKinnon & Thomas 1995.

        Raises:
            ValueError: a number that is not a whole number of at least 1, or ``branching > num_states``.

        Example:
            >>> FiniteMDP.garnet(10, 2, 3, seed=0).transition.nnz
            60
        """
        for name, value in (("num_states", num_states), ("num_actions", num_actions), ("branching", branching)):
            check_whole(name, value)
        if branching > num_states:
            raise ValueError(f"branching must be at most num_states={num_states}, got {branching}")
        transition, reward = garnet_rows(num_states, num_actions, branching, np.random.default_rng(seed))
        s_tm1, a_tm1 = np.divmod(np.arange(len(reward)), num_actions)
        return cls(num_states, num_actions, s_tm1, a_tm1, transition, reward)

    def as_env(self) -> ModelEnv:
        """This model as a Gymnasium environment; ``info["action_mask"]`` names the legal actions.

        Example:
            >>> env = FiniteMDP.garnet(4, 2, 2, seed=0).as_env()
            >>> env.reset(seed=1)[1]["action_mask"].tolist()
            [1, 1]
        """
        return ModelEnv(self)

    def as_vector_env(self, num_envs: int, *, max_episode_steps: int | None = None) -> ModelVectorEnv:
        """``num_envs`` copies of this model stepped by array operations, without autoreset.

        Example:
            >>> envs = FiniteMDP.garnet(4, 2, 2, seed=0).as_vector_env(3)
            >>> envs.reset(seed=1)[0].shape
            (3,)
        """
        return ModelVectorEnv(self, num_envs, max_episode_steps=max_episode_steps)


def _frozen(values: ArrayLike, dtype: Any) -> NDArray[Any]:
    array = np.array(values, dtype=dtype)
    array.flags.writeable = False
    return array

"""What a tabular run gives back: values, visits, a curve of distances to the exact answer, and its transitions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_whole

__all__ = ["Band", "Curve", "Experience", "Learned", "over_seeds"]


@dataclass(frozen=True, eq=False)
class Experience:
    """Transitions in the order in which they happened, one row each.

    Args:
        s_tm1: state that was left, ``[T]``.
        a_tm1: action taken, ``[T]``.
        r_t: reward, ``[T]``.
        discount_t: γ, or 0 where the world terminated, ``[T]``.
        s_t: state that was reached, ``[T]``.
        last_t: whether the stream breaks here (termination or a time limit), ``[T]``.
        a_t: action that was chosen for ``s_t`` before the update, ``[T]``, −1 where there was none. On-policy rules
            need it wherever ``discount_t`` is not 0; by default it is the next row's action within a stream.

    Raises:
        ValueError: columns of different lengths.

    Example:
        >>> Experience([0, 1], [0, 0], [0.0, 1.0], [0.9, 0.0], [1, 2], [False, True]).a_t.tolist()
        [0, -1]
    """

    s_tm1: NDArray[np.int64]
    a_tm1: NDArray[np.int64]
    r_t: NDArray[np.float64]
    discount_t: NDArray[np.float64]
    s_t: NDArray[np.int64]
    last_t: NDArray[np.bool_]
    a_t: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        """Arrays of one length and the right types."""
        types = {"r_t": np.float64, "discount_t": np.float64, "last_t": np.bool_}
        for name in ("s_tm1", "a_tm1", "r_t", "discount_t", "s_t", "last_t"):
            column: NDArray[Any] = np.ascontiguousarray(getattr(self, name), dtype=types.get(name, np.int64))
            object.__setattr__(self, name, column)
            if column.shape != (len(self.s_tm1),):
                raise ValueError(f"{name} must have shape ({len(self.s_tm1)},) as s_tm1 has, got {column.shape}")
        if self.a_t is None:
            follows = np.append(self.a_tm1[1:], -1)
            object.__setattr__(self, "a_t", np.where(self.last_t, -1, follows))
        else:
            object.__setattr__(self, "a_t", np.ascontiguousarray(self.a_t, dtype=np.int64))
        if self.next_actions.shape != self.s_tm1.shape:
            raise ValueError(f"a_t must have shape {self.s_tm1.shape} as s_tm1 has, got {self.next_actions.shape}")

    @property
    def next_actions(self) -> NDArray[np.int64]:
        """``a_t``, which is never None once built."""
        assert self.a_t is not None
        return self.a_t

    def __len__(self) -> int:
        """How many transitions."""
        return len(self.s_tm1)


@dataclass(frozen=True, eq=False)
class Curve:
    """How learned values approach the exact ones, every ``record_every`` steps.

    Args:
        steps: steps taken at each record, ``[C]``.
        distance: max |Q̂ − Q| over legal pairs, ``[C]``; NaN without an exact Q.
        excess: max (Q̂ − Q), at most 0 where Q̂ never exceeds Q (Mitchell 13.3.3), ``[C]``; NaN without an exact Q.
        lowest: min Q̂, ``[C]``.
        decrease: largest fall of any value since the record before, 0 where Q̂ only grows, ``[C]``.
    """

    steps: NDArray[np.int64]
    distance: NDArray[np.float64]
    excess: NDArray[np.float64]
    lowest: NDArray[np.float64]
    decrease: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Learned:
    """What a tabular learner knows after its last step.

    Args:
        q: action values ``[S, A]``, NaN where an action is not legal.
        visits: updates from real experience of each pair, ``[S, A]``.
        num_steps: real transitions.
        episode_lengths: steps of each complete episode, where transitions were recorded; else empty.
        num_episodes: episodes that ended.
        num_backups: all updates of a pair's value, imagined ones included.
        average_reward: the learned gain ρ of R-learning; NaN for the others.
        curve: distances, where asked for; else None.
        experience: the transitions, where asked for; else None.
        cpu_seconds: time spent in learning, not in compiling or recording.
    """

    q: NDArray[np.float64]
    visits: NDArray[np.int64]
    num_steps: int
    episode_lengths: NDArray[np.int64]
    num_episodes: int
    num_backups: int
    average_reward: float
    curve: Curve | None
    experience: Experience | None
    cpu_seconds: float

    @property
    def v(self) -> NDArray[np.float64]:
        """The best value of every state, ``[S]``; 0 where no action is legal."""
        best = np.max(np.nan_to_num(self.q, nan=-np.inf), axis=1)
        return np.where(np.isneginf(best), 0.0, best)

    @property
    def policy(self) -> NDArray[np.int64]:
        """A best action of every state, the lowest of those that tie, ``[S]``; −1 where no action is legal."""
        best = np.argmax(np.nan_to_num(self.q, nan=-np.inf), axis=1)
        return np.where(np.isnan(self.q).all(axis=1), -1, best)


@dataclass(frozen=True, eq=False)
class Band:
    """The same run with many seeds.

    Args:
        runs: one result per seed.
    """

    runs: tuple[Learned, ...]

    @property
    def q(self) -> NDArray[np.float64]:
        """Action values ``[N, S, A]``."""
        return np.stack([run.q for run in self.runs])

    @property
    def steps(self) -> NDArray[np.int64]:
        """Steps at each record, ``[C]``."""
        return self._curves()[0].steps

    @property
    def distance(self) -> NDArray[np.float64]:
        """Distances to the exact Q, ``[N, C]``."""
        return np.stack([curve.distance for curve in self._curves()])

    def interval(self, level: float = 0.95) -> NDArray[np.float64]:
        """Lower quantile, median and upper quantile of the distance over seeds, ``[3, C]``."""
        tail = (1 - level) / 2
        return np.asarray(np.quantile(self.distance, [tail, 0.5, 1 - tail], axis=0))

    def _curves(self) -> list[Curve]:
        curves = [run.curve for run in self.runs if run.curve is not None]
        if len(curves) < len(self.runs):
            raise ValueError("these runs recorded no curve; set RunOptions(record_every=...)")
        return curves


def over_seeds(
    learn: Callable[[np.random.SeedSequence], Learned], num_seeds: int, *, seed: int = 0, num_threads: int = 1
) -> Band:
    """The same learner with ``num_seeds`` independent random streams; kernels run in parallel threads.

    Args:
        learn: one run, given its seed.
        num_seeds: how many runs.
        seed: parent of all streams; run i is the same whatever ``num_seeds`` and ``num_threads``.
        num_threads: runs at a time.

    Raises:
        ValueError: a count below 1.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> from neuralq.tabular import q_learning
        >>> mdp = FiniteMDP.garnet(3, 2, 2, seed=0)
        >>> over_seeds(lambda seed: q_learning(mdp, 100, 0.9, seed=seed), 4).q.shape
        (4, 3, 2)
    """
    check_whole("num_seeds", num_seeds)
    check_whole("num_threads", num_threads)
    seeds: Sequence[np.random.SeedSequence] = np.random.SeedSequence(seed).spawn(num_seeds)
    if num_threads == 1:
        return Band(tuple(map(learn, seeds)))
    with ThreadPoolExecutor(num_threads) as pool:
        return Band(tuple(pool.map(learn, seeds)))


def masked(q: ArrayLike) -> NDArray[np.float64]:
    """Values with NaN in place of −∞, the mark of illegal actions inside kernels.

    Example:
        >>> masked([1.0, -np.inf]).tolist()
        [1.0, nan]
    """
    values = np.array(q, dtype=np.float64)
    values[np.isneginf(values)] = np.nan
    return values

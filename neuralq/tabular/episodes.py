"""Q-learning on stored transitions: episodes updated backwards, and old transitions replayed (Mitchell 1997, 13.3.6).

Nothing is learned during an episode. When it ends, its transitions are updated once, in reverse or in their own order,
and then ``num_replayed`` transitions drawn from all that are stored. In reverse order the reward of the goal reaches
every transition of the path at once; in forward order it moves back one transition per episode.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.jit import lean_kernel
from neuralq.tabular.engine import RunOptions, Source, learn, new_table, replay, table_from
from neuralq.tabular.kernels.acting import Log, Table, Walk, best_value, next_step, step_length
from neuralq.tabular.kernels.random_numbers import Seed, uniform
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, PolicyLike, StepCode, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Experience, Learned

__all__ = ["Store", "apply_episodes", "episodic_q_learning", "run_episodes"]

ORDERS = ("reverse", "forward")
COUNT, EPISODE, BACKUPS = range(3)

_ONE: Any = np.uint64(1)


class Store(NamedTuple):
    """A ring of transitions, updates of each pair, and counters: ever stored, in this episode, updates."""

    s_tm1: NDArray[np.uint64]
    a_tm1: NDArray[np.uint64]
    r_t: NDArray[np.float64]
    discount_t: NDArray[np.float64]
    s_t: NDArray[np.uint64]
    updates: NDArray[np.int64]
    counters: NDArray[np.int64]


@lean_kernel
def _update(table: Table, store: Store, step_size: StepCode, k: Any) -> None:
    """Q-learning from stored transition ``k``."""
    q, s, a = table.q, store.s_tm1[k], store.a_tm1[k]
    store.updates[s, a] += 1
    alpha = step_length(step_size, store.updates[s, a])
    target = store.r_t[k]
    if store.discount_t[k] != 0.0:
        target += store.discount_t[k] * best_value(q, store.s_t[k])
    q[s, a] = target if alpha == 1.0 else q[s, a] + alpha * (target - q[s, a])
    store.counters[BACKUPS] += 1


@lean_kernel
def run_episodes(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    store: Store,
    reverse: bool,
    num_replayed: int,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions; updates happen where an episode ends.

    Args:
        model: where transitions come from, unless ``log`` replays.
        policy: how to act.
        table: values and visits, changed in place.
        walk: where the agent is, changed in place.
        log: what to record, or to replay.
        step_size: α by updates of the pair.
        store: changed in place; an episode longer than it keeps its newest transitions.
        reverse: whether an episode is updated from its end.
        num_replayed: transitions drawn from the store after each episode.
        gamma: γ.
        num_steps: how many.
    """
    counters = store.counters
    capacity = store.r_t.size
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, _a_t, last_t = next_step(model, policy, table, walk, log, i, gamma, False)
        table.visits[s, a] += 1
        at = np.uint64(counters[COUNT] % capacity)
        store.s_tm1[at], store.a_tm1[at], store.r_t[at] = s, a, r_t
        store.discount_t[at], store.s_t[at] = discount_t, s_t
        counters[COUNT] += 1
        counters[EPISODE] += 1
        if not last_t:
            continue
        length = min(counters[EPISODE], capacity)
        for k in range(length):
            back = k + 1 if reverse else length - k
            _update(table, store, step_size, np.uint64((counters[COUNT] - back) % capacity))
        held = min(counters[COUNT], capacity)
        for _ in range(num_replayed):
            _update(table, store, step_size, np.uint64(uniform(walk.rng) * held))
        counters[EPISODE] = 0


class EpisodicLearner:
    """The learner that `run_episodes` runs.

    Args:
        table: values and visits, changed in place.
        policy: how to act.
        step_size: α by updates of the pair.
        order: "reverse" or "forward".
        num_replayed: stored transitions drawn after each episode.
        capacity: transitions stored.

    Raises:
        ValueError: an argument out of range.
    """

    def __init__(
        self, table: Table, policy: ActingCode, step_size: StepCode, order: str, num_replayed: int, capacity: int
    ) -> None:
        check_choice("order", order, ORDERS)
        check_whole("num_replayed", num_replayed, 0)
        check_whole("capacity", capacity)
        self.table = table
        self.policy = policy
        self.on_policy = False
        self._step_size = step_size
        self._rest = (order == "reverse", num_replayed)
        index = np.uint64
        self._store = Store(
            np.zeros(capacity, index), np.zeros(capacity, index), np.zeros(capacity), np.zeros(capacity),
            np.zeros(capacity, index), np.zeros(table.q.shape, np.int64), np.zeros(3, np.int64),
        )  # fmt: skip

    @property
    def num_backups(self) -> int:
        """Updates so far."""
        return int(self._store.counters[BACKUPS])

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> Any:
        """``num_steps`` transitions from the model, or from the log if it replays."""
        run_episodes(
            model, self.policy, self.table, walk, log, self._step_size, self._store, *self._rest, gamma, num_steps
        )


def episodic_q_learning(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    order: str = "reverse",
    num_replayed: int = 0,
    capacity: int | None = None,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Q-learning after each episode, backwards, and again from stored transitions.

    Args:
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces; episodes must end
            (set ``max_episode_steps`` where the world never does).
        num_steps: transitions.
        gamma: γ in [0, 1].
        order: "reverse" or "forward", of the updates of an episode.
        num_replayed: stored transitions drawn (with replacement) and updated after each episode.
        capacity: transitions stored; None for all.
        policy: how to act.
        step_size: α by updates of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range.

    Source: Mitchell 1997, section 13.3.6; Lin 1992.

    Example:
        One episode of two steps: backwards both learn.

        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> episodic_q_learning(mdp, 2, gamma=0.5, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
        >>> episodic_q_learning(mdp, 2, gamma=0.5, step_size=1.0, order="forward").q.tolist()
        [[0.0], [8.0]]
    """
    table, ready = new_table(source, options)
    alpha = step_code(step_size, num_steps * (1 + num_replayed))
    learner = EpisodicLearner(table, acting_code(policy), alpha, order, num_replayed, capacity or num_steps)
    return learn(learner, ready, num_steps, gamma, seed, options)


def apply_episodes(
    q: ArrayLike,
    experience: Experience,
    *,
    order: str = "reverse",
    num_replayed: int = 0,
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
) -> Learned:
    """The same updates on recorded episodes.

    Args:
        q: values to start from, ``[S, A]``, NaN where illegal; not changed.
        experience: whole episodes; what follows the last end is not learned from.
        order: "reverse" or "forward".
        num_replayed: stored transitions drawn and updated after each episode.
        step_size: α by updates of the pair, counted from 0.
        seed: of the draws.

    Raises:
        ValueError: an argument out of range, or transitions that do not fit the table.

    Example:
        >>> steps = Experience([0, 1], [0, 0], [0.0, 8.0], [0.5, 0.0], [1, 1], [False, True])
        >>> apply_episodes([[0.0], [0.0]], steps, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    code = step_code(step_size, len(experience) * (1 + num_replayed))
    learner = EpisodicLearner(table_from(q), acting_code("random"), code, order, num_replayed, max(1, len(experience)))
    return replay(learner, experience, seed)

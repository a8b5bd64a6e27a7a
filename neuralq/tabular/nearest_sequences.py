"""Nearest sequence memory: what to do is asked of those moments of the past that came about like the present one.

Every moment is kept: what was observed, what was done, and a value q of having done so. Two moments match as far back
as their observations and actions are the same, the present observation first; no match reaches over the beginning of a
trial. The value of an action now is the mean q of its k nearest moments, those with the longest match (of equal ones
the latest); who does not match at all is not asked. What comes of the action is the q of the new moment, and moves
those that were asked:  q ← q + α (r + γ max_a Q(a) − q).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_discount, check_fraction, check_whole
from neuralq.tabular.moments import check_moment, double

__all__ = ["NearestSequenceMemory"]


class NearestSequenceMemory:
    """A learner of actions in any stream of observations that are whole numbers, with all of the past as its state.

    Args:
        num_actions: A.
        num_neighbours: k.
        step_size: α in [0, 1].
        gamma: γ in [0, 1].
        max_match: matches that are longer count as this long; 1 looks at the present observation only. None for no
            limit.

    Raises:
        ValueError: an argument out of range.

    Source: McCallum 1995, "Instance-based state identification for reinforcement learning".

    Example:
        What is worth 1 depends on the observation before the last.

        >>> memory = NearestSequenceMemory(2, num_neighbours=1, step_size=1.0)
        >>> for before in (0, 1):
        ...     for a in (0, 1):
        ...         memory.begin(before)
        ...         memory.learn(0, 0.0, 2)
        ...         memory.learn(a, float(a == before), terminated=True)
        >>> memory.begin(1)
        >>> memory.learn(0, 0.0, 2)
        >>> memory.values().tolist()
        [0.0, 1.0]
    """

    def __init__(
        self,
        num_actions: int,
        *,
        num_neighbours: int = 8,
        step_size: float = 0.2,
        gamma: float = 0.9,
        max_match: int | None = None,
    ) -> None:
        check_whole("num_actions", num_actions)
        check_whole("num_neighbours", num_neighbours)
        check_fraction("step_size", step_size)
        check_discount("gamma", gamma)
        if max_match is not None:
            check_whole("max_match", max_match)
        self._num_actions, self._k, self._alpha, self._gamma = num_actions, num_neighbours, step_size, gamma
        self._most = np.iinfo(np.int64).max if max_match is None else max_match
        self._num = 0
        self._o, self._a, self._match = (np.zeros(64, np.int64) for _ in range(3))
        self._q, self._is_first = np.zeros(64), np.zeros(64, bool)
        self._now = -1
        self._begins = True
        self._voters: list[NDArray[np.int64]] = []
        self._values = np.zeros(num_actions)

    def __len__(self) -> int:
        """How many moments are kept."""
        return self._num

    def begin(self, o: int) -> None:
        """A trial begins with this observation; what came before has nothing to do with it.

        Raises:
            ValueError: an observation that is not a whole number from 0.
        """
        check_whole("o", o, 0)
        self._now, self._begins = o, True
        n = self._num
        self._match[:n] = self._o[:n] == o
        self._look()

    def values(self) -> NDArray[np.float64]:
        """The value of each action now, ``[A]``; 0 for one that was never taken where it looked like this.

        Raises:
            ValueError: no trial has begun, or it has ended.
        """
        self._check_begun()
        return self._values.copy()

    def learn(self, a: int, r: float, o_t: int | None = None, terminated: bool = False) -> None:
        """What came of action ``a``: the reward and the next observation, or the end of the trial.

        Args:
            a: what was done.
            r: what it earned.
            o_t: what is observed now; left out where the trial has ended.
            terminated: whether it has. (A trial that was merely cut short goes on until the next `begin`.)

        Raises:
            ValueError: no trial has begun, another action or observation, or none although the trial goes on.
        """
        self._check_begun()
        check_moment(a, self._num_actions, o_t, terminated)
        voters, target = self._voters[a], r
        self._keep(a)
        if o_t is None or terminated:
            self._now = -1
        else:
            self._go_on(a, o_t)
            target += self._gamma * float(self._values.max())
        self._q[voters] += self._alpha * (target - self._q[voters])
        self._q[self._num - 1] = target
        self._ask()

    def _check_begun(self) -> None:
        if self._now < 0:
            raise ValueError("no trial has begun: call begin(observation) first")

    def _keep(self, a: int) -> None:
        """The present moment becomes one of the past, for now worth what its action was thought to be."""
        n = self._num
        if n == len(self._o):
            double(self, ("_o", "_a", "_match", "_q", "_is_first"))
        self._o[n], self._a[n], self._q[n], self._is_first[n] = self._now, a, self._values[a], self._begins
        self._num = n + 1

    def _go_on(self, a: int, o_t: int) -> None:
        """Matches of every moment with the new one: one more than those of the moments before both."""
        n = self._num
        longer = np.ones(n, np.int64)
        longer[1:] += np.where((self._a[: n - 1] == a) & ~self._is_first[1:n], self._match[: n - 1], 0)
        self._match[:n] = np.where(self._o[:n] == o_t, np.minimum(longer, self._most), 0)
        self._now, self._begins = o_t, False
        self._look()

    def _look(self) -> None:
        """The nearest moments of each action, and what they say."""
        near = np.flatnonzero(self._match[: self._num])  # in their order, the latest last
        action, match = self._a[near], self._match[near]
        self._voters = []
        for a in range(self._num_actions):
            taken = np.flatnonzero(action == a)
            if len(taken) > self._k:
                order = match[taken] * len(near) + taken
                taken = taken[np.argpartition(order, -self._k)[-self._k :]]
            self._voters.append(near[taken])
        self._ask()

    def _ask(self) -> None:
        """What the nearest moments say."""
        for a, voters in enumerate(self._voters):
            self._values[a] = self._q[voters].mean() if len(voters) else 0.0

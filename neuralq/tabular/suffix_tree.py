"""Utile suffix memory: a tree over what came before, grown only where the value of an action depends on it.

The root tells moments apart by the present observation, the next level by the action before it, then by the observation
before that, and so on. The leaf that a moment falls in is its state; counts of what followed each leaf and action make
a model, and one sweep of value iteration a step keeps its values. Below every leaf hangs a fringe of deeper nodes that
are not states yet. If the values r + γ V that were seen after an action in one of them and those in the rest of the
leaf do not come from one distribution (Kolmogorov and Smirnov's test), the leaf is split down to it: that much more of
the past is of use. What looks different but is worth the same is not told apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import kolmogorov

from neuralq.checks import check_discount, check_positive, check_whole
from neuralq.tabular.moments import check_moment, double

__all__ = ["SuffixNode", "UtileSuffixMemory"]

_NOTHING = -1  # came before a trial began


@dataclass(eq=False)
class SuffixNode:
    """A node of the tree.

    Args:
        suffix: what its moments have in common: the present observation, the action before, the observation before
            that, and so on; −1 where the trial had not begun.
        children: by what comes next in the suffix; empty for a leaf.
        leaf: number of the leaf, −1 for an inner node.
    """

    suffix: tuple[int, ...]
    children: dict[int, SuffixNode] = field(default_factory=dict)
    leaf: int = -1

    def leaves(self) -> Iterator[SuffixNode]:
        """Those below it, or itself."""
        if self.leaf >= 0:
            yield self
        for child in self.children.values():
            yield from child.leaves()


class UtileSuffixMemory:
    """A learner of actions in any stream of observations that are whole numbers, whose state is a suffix of the past.

    Args:
        num_actions: A.
        gamma: γ in [0, 1].
        max_depth: of the tree; 1 looks at the present observation only, each further one a step back: action,
            observation, action.
        test_every: steps between two looks at the fringe.
        p_value: the tree is grown where two samples of one distribution would differ as much less often than this.
        min_samples: values that both samples need.

    Raises:
        ValueError: an argument out of range.

    Source: McCallum 1995, "Instance-based utile distinctions for reinforcement learning with hidden state".

    Example:
        What is worth 1 depends on the observation before the last.

        >>> memory = UtileSuffixMemory(2, test_every=1)
        >>> for i in range(120):
        ...     memory.begin(i % 2)
        ...     memory.learn(0, 0.0, 2)
        ...     memory.learn(i // 2 % 2, float(i // 2 % 2 == i % 2), terminated=True)
        >>> memory.begin(1)
        >>> memory.learn(0, 0.0, 2)
        >>> memory.values().tolist(), sorted(leaf.suffix for leaf in memory.tree.leaves())
        ([0.0, 1.0], [(0,), (1,), (2, 0, 0), (2, 0, 1)])
    """

    def __init__(
        self,
        num_actions: int,
        *,
        gamma: float = 0.9,
        max_depth: int = 4,
        test_every: int = 25,
        p_value: float = 1e-4,
        min_samples: int = 6,
    ) -> None:
        check_whole("num_actions", num_actions)
        check_discount("gamma", gamma)
        check_whole("max_depth", max_depth)
        check_whole("test_every", test_every)
        check_positive("p_value", p_value)
        check_whole("min_samples", min_samples)
        self._num_actions, self._gamma, self._depth = num_actions, gamma, max_depth
        self._every, self._p_value, self._fewest = test_every, p_value, min_samples
        self.tree = SuffixNode(())
        """The root. Its leaves are the states so far."""
        self._num, self._num_steps = 0, 0
        self._suffix = np.zeros((64, max_depth), np.int64)  # of each moment that was followed by another, or by the end
        self._a, self._leaf, self._leaf_t = (np.zeros(64, np.int64) for _ in range(3))  # leaf_t −1: the end
        self._r = np.zeros(64)
        self._leaves: list[SuffixNode] = []
        self._q = np.zeros((0, num_actions))
        self._count = np.zeros((0, num_actions))
        self._reward = np.zeros((0, num_actions))
        self._follow = np.zeros((0, num_actions, 0))
        self._now: NDArray[np.int64] | None = None
        self._here = -1

    @property
    def num_leaves(self) -> int:
        """States that are told apart."""
        return len(self._leaves)

    def leaf_values(self) -> dict[tuple[int, ...], NDArray[np.float64]]:
        """The values of every state by its suffix, ``[A]`` each."""
        return {leaf.suffix: self._q[i].copy() for i, leaf in enumerate(self._leaves)}

    def begin(self, o: int) -> None:
        """A trial begins with this observation; what came before has nothing to do with it.

        Raises:
            ValueError: an observation that is not a whole number from 0.
        """
        check_whole("o", o, 0)
        self._now = np.full(self._depth, _NOTHING)
        self._now[0] = o
        self._here = self._find(self._now)

    def values(self) -> NDArray[np.float64]:
        """The value of each action now, ``[A]``; 0 for one that was never taken in a state like this.

        Raises:
            ValueError: no trial has begun, or it has ended.
        """
        self._check_begun()
        return np.asarray(self._q[self._here].copy())

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
        now = self._check_begun()
        check_moment(a, self._num_actions, o_t, terminated)
        self._now = None if o_t is None or terminated else np.array([o_t, a, *now])[: self._depth]
        here_t = -1 if self._now is None else self._find(self._now)
        self._keep(now, a, r, here_t)
        self._count_moments(self._num - 1)
        self._here = here_t
        self._sweep()
        self._num_steps += 1
        if self._num_steps % self._every == 0:
            self._look_at_the_fringe()

    def _check_begun(self) -> NDArray[np.int64]:
        if self._now is None:
            raise ValueError("no trial has begun: call begin(observation) first")
        return self._now

    def _find(self, suffix: NDArray[np.int64], values: NDArray[np.float64] | None = None) -> int:
        """The leaf of a moment; one that is new is worth ``values``, or 0."""
        node = self.tree
        while node.leaf < 0:
            label = int(suffix[len(node.suffix)])
            if label not in node.children:
                node.children[label] = SuffixNode((*node.suffix, label), leaf=self.num_leaves)
                self._leaves.append(node.children[label])
                row = np.zeros(self._num_actions) if values is None else values
                self._q = np.vstack([self._q, row])
                self._count, self._reward = (np.pad(one, ((0, 1), (0, 0))) for one in (self._count, self._reward))
                self._follow = np.pad(self._follow, ((0, 1), (0, 0), (0, 1)))
            node = node.children[label]
        return node.leaf

    def _keep(self, suffix: NDArray[np.int64], a: int, r: float, leaf_t: int) -> None:
        """The present moment becomes one of the past."""
        n = self._num
        if n == len(self._r):
            double(self, ("_suffix", "_a", "_leaf", "_leaf_t", "_r"))
        self._suffix[n], self._a[n], self._r[n], self._leaf[n], self._leaf_t[n] = suffix, a, r, self._here, leaf_t
        self._num = n + 1

    def _count_moments(self, first: int) -> None:
        """Adds the moments from the ``first`` on to the counts."""
        kept = slice(first, self._num)
        leaf, a, leaf_t = self._leaf[kept], self._a[kept], self._leaf_t[kept]
        np.add.at(self._count, (leaf, a), 1)
        np.add.at(self._reward, (leaf, a), self._r[kept])
        goes_on = leaf_t >= 0
        np.add.at(self._follow, (leaf[goes_on], a[goes_on], leaf_t[goes_on]), 1)

    def _sweep(self) -> None:
        """One sweep of value iteration on what was counted; what was never tried keeps its value."""
        total = self._reward + self._gamma * self._follow @ self._q.max(axis=1)
        np.divide(total, self._count, out=self._q, where=self._count > 0)

    def _look_at_the_fringe(self) -> None:
        """Splits every leaf below which the value of an action depends on more of the past."""
        v = np.append(self._q.max(axis=1), 0.0)  # the last one is that of the end, leaf −1
        n = self._num
        seen = self._r[:n] + self._gamma * v[self._leaf_t[:n]]
        found = []
        for node in self._leaves:
            suffix = self._useful_suffix(node, np.flatnonzero(self._leaf[:n] == node.leaf), seen)
            if suffix is not None:
                found.append((node, suffix))
        for node, suffix in found:
            self._split(node, suffix)

    def _useful_suffix(
        self, node: SuffixNode, moments: NDArray[np.int64], seen: NDArray[np.float64]
    ) -> tuple[int, ...] | None:
        """The fringe node below a leaf, of the least depth that has one, that differs most surely from the rest."""
        taken = [moments[self._a[moments] == a] for a in range(self._num_actions)]
        taken = [some for some in taken if len(some) >= 2 * self._fewest and np.ptp(seen[some]) > 0]
        for depth in range(len(node.suffix) + 1, self._depth + 1):
            least, best = self._p_value, None
            for some in taken:
                labels, group = np.unique(self._suffix[some, :depth], axis=0, return_inverse=True)
                group = group.reshape(-1)
                for i, size in enumerate(np.bincount(group).tolist()):
                    if self._fewest <= size <= len(some) - self._fewest:
                        p = _same_distribution(seen[some[group == i]], seen[some[group != i]])
                        if p < least:
                            least, best = p, tuple(labels[i].tolist())
            if best is not None:
                return best
        return None

    def _split(self, node: SuffixNode, suffix: tuple[int, ...]) -> None:
        """A leaf gives way to those on the way to a fringe node, and to their siblings."""
        old, o, values, n = node.leaf, node.suffix[0], self._q[node.leaf].copy(), self._num
        node.leaf = -1
        for depth in range(len(node.suffix), len(suffix) - 1):
            node.children[suffix[depth]] = SuffixNode(suffix[: depth + 1])
            node = node.children[suffix[depth]]
        for i in np.flatnonzero(self._leaf[:n] == old).tolist():
            self._leaf[i] = self._find(self._suffix[i], values)
        for i in np.flatnonzero(self._leaf_t[:n] == old).tolist():
            self._leaf_t[i] = self._find(np.array([o, self._a[i], *self._suffix[i]])[: self._depth], values)
        if self._now is not None:
            self._here = self._find(self._now, values)
        self._leave_out(old)

    def _leave_out(self, old: int) -> None:
        """Renumbers the leaves without one that has none of the moments any more, and counts anew."""
        self._leaves = [leaf for i, leaf in enumerate(self._leaves) if i != old]
        self._q = np.delete(self._q, old, axis=0)
        for i, leaf in enumerate(self._leaves):
            leaf.leaf = i
        for numbers in (self._leaf[: self._num], self._leaf_t[: self._num]):
            numbers[numbers > old] -= 1
        self._here -= self._here > old
        self._count, self._reward = np.zeros_like(self._q), np.zeros_like(self._q)
        self._follow = np.zeros((*self._q.shape, len(self._q)))
        self._count_moments(0)


def _same_distribution(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """How often two samples of one distribution differ as much as these (Kolmogorov and Smirnov, for large samples)."""
    one, other = np.sort(one), np.sort(other)
    both = np.concatenate([one, other])
    below = [np.searchsorted(sample, both, side="right") / len(sample) for sample in (one, other)]
    size = len(one) * len(other) / len(both)
    return float(kolmogorov(np.sqrt(size) * np.abs(below[0] - below[1]).max()))

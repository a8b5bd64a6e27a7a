"""Nearest sequence memory and utile suffix memory beside slow readable versions of themselves.

Mutants that die here: a match that reaches over the beginning of a trial, or is one action out of step; the eldest of
equal neighbours; a new moment that is moved twice; a trial's end that is worth something; a tree whose fringe is one
level short, a node compared with a leaf that contains it, leaves that lose the values they were split from.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pytest
import scipy.stats

from neuralq.tabular import NearestSequenceMemory, UtileSuffixMemory


class PlainNearest:
    """Trials as lists of [observation, action, value]; matches by walking back."""

    def __init__(self, num_actions: int, k: int, alpha: float, gamma: float, most: int) -> None:
        self.num_actions, self.k, self.alpha, self.gamma, self.most = num_actions, k, alpha, gamma, most
        self.trials: list[list[list[Any]]] = []

    def begin(self, o: int) -> None:
        self.trials.append([])
        self.now = o

    def match(self, trial: int, at: int, o: int, before: list[list[Any]]) -> int:
        if self.trials[trial][at][0] != o:
            return 0
        length, back = 1, 1
        while length < self.most and back <= min(at, len(before)):
            if self.trials[trial][at - back][:2] != before[-back][:2]:
                break
            length, back = length + 1, back + 1
        return length

    def neighbours(self, a: int, o: int, before: list[list[Any]]) -> list[list[Any]]:
        found = [
            (self.match(i, j, o, before), i, j)
            for i, trial in enumerate(self.trials)
            for j, moment in enumerate(trial)
            if moment[1] == a
        ]
        return [self.trials[i][j] for match, i, j in sorted(found)[-self.k :] if match > 0]

    def values(self) -> list[float]:
        return [self.mean(self.neighbours(a, self.now, self.trials[-1])) for a in range(self.num_actions)]

    @staticmethod
    def mean(moments: list[list[Any]]) -> float:
        return float(np.mean([moment[2] for moment in moments])) if moments else 0.0

    def learn(self, a: int, r: float, o_t: int, terminated: bool) -> None:
        asked = self.neighbours(a, self.now, self.trials[-1])
        new = [self.now, a, self.mean(asked)]
        self.trials[-1].append(new)
        self.now = o_t
        target = r + (0.0 if terminated else self.gamma * max(self.values()))
        for moment in asked:
            moment[2] += self.alpha * (target - moment[2])
        new[2] = target


class PlainTree:
    """Leaves by suffix with their values; everything else is looked up in the list of all moments."""

    def __init__(self, num_actions: int, gamma: float, depth: int, every: int, p_value: float, fewest: int) -> None:
        self.num_actions, self.gamma, self.depth = num_actions, gamma, depth
        self.every, self.p_value, self.fewest = every, p_value, fewest
        self.leaves: dict[tuple[int, ...], list[float]] = {}
        self.inner: set[tuple[int, ...]] = set()
        self.moments: list[tuple[tuple[int, ...], int, float, tuple[int, ...] | None]] = []

    def leaf(self, suffix: tuple[int, ...], values: list[float] | None = None) -> tuple[int, ...]:
        for d in range(1, self.depth + 1):
            if suffix[:d] not in self.inner:
                self.leaves.setdefault(suffix[:d], list(values or [0.0] * self.num_actions))
                return suffix[:d]
        raise AssertionError

    def begin(self, o: int) -> None:
        self.now: tuple[int, ...] = (o, *[-1] * (self.depth - 1))
        self.leaf(self.now)

    def values(self) -> list[float]:
        return self.leaves[self.leaf(self.now)]

    def seen(self) -> list[float]:
        v = {leaf: max(values) for leaf, values in self.leaves.items()}
        return [r + (0.0 if s_t is None else self.gamma * v[self.leaf(s_t)]) for _, _, r, s_t in self.moments]

    def learn(self, a: int, r: float, o_t: int, terminated: bool) -> None:
        after = (o_t, a, *self.now)[: self.depth]
        if not terminated:
            self.leaf(after)
        self.moments.append((self.now, a, r, None if terminated else after))
        self.now = after
        by_pair = defaultdict(list)
        for (s, a_then, _, _), y in zip(self.moments, self.seen(), strict=True):
            by_pair[self.leaf(s), a_then].append(y)
        for (leaf, a_then), ys in by_pair.items():
            self.leaves[leaf][a_then] = float(np.mean(ys))
        if len(self.moments) % self.every == 0:
            seen = self.seen()
            for leaf, suffix in [(leaf, self.useful(leaf, seen)) for leaf in self.leaves]:
                if suffix is not None:
                    self.split(leaf, suffix, terminated)

    def useful(self, leaf: tuple[int, ...], seen: list[float]) -> tuple[int, ...] | None:
        for d in range(len(leaf) + 1, self.depth + 1):
            found = []
            for a in range(self.num_actions):
                here = [i for i, moment in enumerate(self.moments) if self.leaf(moment[0]) == leaf and moment[1] == a]
                for suffix in sorted({self.moments[i][0][:d] for i in here}):
                    one = [seen[i] for i in here if self.moments[i][0][:d] == suffix]
                    rest = [seen[i] for i in here if self.moments[i][0][:d] != suffix]
                    if min(len(one), len(rest)) >= self.fewest:
                        gap = scipy.stats.ks_2samp(one, rest, method="asymp").statistic
                        size = len(one) * len(rest) / (len(one) + len(rest))
                        found.append((float(scipy.stats.kstwobign.sf(np.sqrt(size) * gap)), len(found), suffix))
            if found and min(found)[0] < self.p_value:
                return min(found)[2]
        return None

    def split(self, leaf: tuple[int, ...], suffix: tuple[int, ...], terminated: bool) -> None:
        values = self.leaves.pop(leaf)
        self.inner |= {suffix[:d] for d in range(len(leaf), len(suffix))}
        known = [s for moment in self.moments for s in (moment[0], moment[3]) if s is not None]
        for s in [*known, *([] if terminated else [self.now])]:
            if s[: len(leaf)] == leaf:
                self.leaf(s, values)


def along(one: Any, other: Any, num_steps: int, seed: int) -> None:
    """A stream of three observations in which it matters what came before; some trials end, some are cut short."""
    rng = np.random.default_rng(seed)
    o, last = int(rng.integers(3)), 0
    one.begin(o)
    other.begin(o)
    for _ in range(num_steps):
        assert one.values() == pytest.approx(other.values(), abs=1e-9)
        a, o_t = int(rng.integers(2)), int(rng.integers(3))
        r, terminated = float(a == (o + last) % 2) + 0.1 * float(rng.integers(3)), bool(rng.random() < 0.1)
        one.learn(a, r, o_t, terminated)
        other.learn(a, r, o_t, terminated)
        o, last = o_t, o
        if terminated or rng.random() < 0.1:
            o = int(rng.integers(3))
            one.begin(o)
            other.begin(o)


@pytest.mark.parametrize("most", [1, 2, 10**6])
def test_nearest_sequences_are_those_that_are_found_by_walking_back(most: int) -> None:
    ours = NearestSequenceMemory(2, num_neighbours=3, step_size=0.3, gamma=0.7, max_match=most)
    along(ours, PlainNearest(2, 3, 0.3, 0.7, most), 150, seed=most)
    assert len(ours) == 150


def test_the_tree_is_that_of_looking_everything_up() -> None:
    ours = UtileSuffixMemory(2, gamma=0.7, max_depth=3, test_every=10, p_value=0.01, min_samples=4)
    plain = PlainTree(2, 0.7, 3, 10, 0.01, 4)
    along(ours, plain, 260, seed=1)
    assert set(ours.leaf_values()) == set(plain.leaves) and ours.num_leaves == len(plain.leaves)
    assert max(map(len, plain.leaves)) == 3
    shallow = UtileSuffixMemory(2, max_depth=1, test_every=5, p_value=0.5)
    along(shallow, PlainTree(2, 0.9, 1, 5, 0.5, 6), 60, seed=2)
    assert shallow.num_leaves == 3


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda m: m.values(), r"call begin\(observation\) first"),
        (lambda m: m.learn(0, 0.0, 1), r"call begin\(observation\) first"),
        (lambda m: m.begin(-1), "o must be a whole number of at least 0"),
        (lambda m: (m.begin(0), m.learn(2, 0.0, 1)), "a must be a whole number from 0 to 1, got 2"),
        (lambda m: (m.begin(0), m.learn(0, 0.0)), "say terminated=True if it has"),
        (lambda m: (m.begin(0), m.learn(0, 0.0, 0.5)), "o_t must be a whole number"),
        (lambda m: (m.begin(0), m.learn(0, 0.0, terminated=True), m.values()), "no trial has begun"),
        (lambda m: type(m)(0), "num_actions must be"),
        (lambda m: type(m)(2, gamma=1.5), "gamma must lie in"),
    ],
)
@pytest.mark.parametrize("kind", [NearestSequenceMemory, UtileSuffixMemory])
def test_what_makes_no_sense_is_refused(kind: Any, act: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        act(kind(2))


@pytest.mark.parametrize("name", ["max_depth", "test_every", "min_samples", "p_value"])
def test_settings_of_the_tree_are_held_to_their_range(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be"):
        UtileSuffixMemory(2, **{name: 0})

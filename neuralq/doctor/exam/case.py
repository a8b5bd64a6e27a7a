"""What every measurement is given: the subject, its world, and the episodes that were played with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from neuralq.doctor.findings import Finding
from neuralq.doctor.play import Clock, Episode, horizon, play
from neuralq.doctor.subject import Settings, Subject
from neuralq.doctor.worlds import World
from neuralq.types import Array, Floats, Indices

__all__ = ["CannotMeasure", "Case", "begin", "seen_at", "stacked"]

NUM_GREEDY, NUM_EXPLORED, NUM_OTHER = 100, 30, 30
_EPSILON = 0.1
_MOST_PAST = 1500
"""Steps past the limit at most: what is still missing then is at most γ^1500 of the value."""


class CannotMeasure(Exception):
    """A measurement needs something that is not there; the message says what."""


@dataclass(frozen=True, eq=False)
class Case:
    """What is examined.

    Args:
        subject: the value function.
        world: its environment.
        gamma: γ.
        settings: how it was trained, as far as that is known.
        seed: of every draw.
        clock: of the budget.
        greedy: episodes of its greedy policy, played past the limit where that can be lifted.
        explored: the same with ε = 0.1.
        chance: of the uniformly random policy.
        constant: of each action alone, by its number.
        stored: the data that it was trained on, by column; None where none was given.
    """

    subject: Subject
    world: World
    gamma: float
    settings: Settings
    seed: int
    clock: Clock
    greedy: Sequence[Episode]
    explored: Sequence[Episode]
    chance: Sequence[Episode]
    constant: Mapping[int, Sequence[Episode]]
    stored: Mapping[str, Array] | None

    def rng(self, number: int) -> np.random.Generator:
        """A generator of its own for a measurement: what others draw changes nothing."""
        return np.random.default_rng([self.seed, number])

    @property
    def episodes(self) -> list[Episode]:
        """Of every policy."""
        return [*self.greedy, *self.explored, *self.chance, *(one for all_ in self.constant.values() for one in all_)]

    @cached_property
    def chance_valued(self) -> list[Episode]:
        """The random episodes with what the subject says of their observations."""
        return [replace(one, values=self.subject.values(one.observations[:-1])) for one in self.chance]

    @property
    def largest_reward(self) -> float:
        """Max |r| seen."""
        return max((float(np.abs(one.rewards).max()) for one in self.episodes), default=0.0)

    @property
    def horizon(self) -> int:
        """Steps after which 95 % of a constant stream's value has come in."""
        return horizon(self.gamma)

    def visited(self, num: int, number: int) -> Array:
        """Observations that its policy meets (greedy and explored), ``[≤ num, *obs]``."""
        pool = [*self.greedy, *self.explored]
        return seen_at(pool, self.rng(number).permutation(sum(one.length for one in pool))[:num])


Measurement = Callable[[Case], "Finding | Sequence[Finding]"]


def seen_at(episodes: Sequence[Episode], steps: Indices, later: int = 0) -> Array:
    """The observations of these steps, which are numbered through all episodes, or of the ones after: ``[n, *obs]``."""
    begins = np.cumsum([0, *(one.length for one in episodes)])
    which = np.searchsorted(begins, steps, side="right") - 1
    rows = [episodes[i].observations[t - begins[i] + later] for i, t in zip(which, steps, strict=True)]
    return np.stack(rows)


def stacked(episodes: Sequence[Episode]) -> tuple[Array, Indices, Floats, Array, Array, Indices]:
    """The steps of episodes in a row: s, a, r, s', whether the world ended there, and of which episode they are."""
    return (
        np.concatenate([one.observations[:-1] for one in episodes]),
        np.concatenate([one.actions for one in episodes]),
        np.concatenate([one.rewards for one in episodes]),
        np.concatenate([one.observations[1:] for one in episodes]),
        np.concatenate([np.arange(one.length) == (one.length - 1 if one.terminated else -1) for one in episodes]),
        np.repeat(np.arange(len(episodes)), [one.length for one in episodes]),
    )


def begin(
    subject: Subject, world: World, gamma: float, settings: Settings, stored: Mapping[str, Array] | None, seed: int,
    clock: Clock, say: Callable[[str], None],
) -> Case:  # fmt: skip
    """Play the episodes that all measurements share, in at most half of the budget."""
    num_actions, budget = world.num_actions, clock.budget_s
    past = 0 if gamma >= 1 else min(horizon(gamma, 0.01), _MOST_PAST)

    def greedy(s: Array, rng: np.random.Generator) -> tuple[Indices, Floats]:
        values = subject.values(s)
        return np.nan_to_num(values, nan=-np.inf).argmax(1), values

    def explored(s: Array, rng: np.random.Generator) -> tuple[Indices, Floats]:
        best, values = greedy(s, rng)
        chance = rng.random(len(s)) < _EPSILON
        return np.where(chance, rng.integers(num_actions, size=len(s)), best), values

    def chance(s: Array, rng: np.random.Generator) -> tuple[Indices, Floats]:
        return rng.integers(num_actions, size=len(s)), np.full((len(s), num_actions), np.nan)

    def always(a: int) -> Callable[[Array, np.random.Generator], tuple[Indices, Floats]]:
        return lambda s, rng: (np.full(len(s), a), np.full((len(s), num_actions), np.nan))

    say("playing greedy episodes")
    best = play(world, greedy, NUM_GREEDY, seed, seconds=0.25 * budget, past_limit=past)
    say("playing with ε = 0.1, at random, and each action alone")
    tried = play(world, explored, NUM_EXPLORED, seed + 1000, seconds=0.1 * budget, past_limit=past, share=0.5)
    random = play(world, chance, NUM_OTHER, seed + 2000, seconds=0.1 * budget, share=0.5)
    each = max(3, 30 // num_actions)
    constant = {
        a: play(world, always(a), each, seed + 3000, seconds=0.1 * budget / num_actions, share=0.5 / num_actions)
        for a in range(num_actions)
    }
    return Case(subject, world, gamma, settings, seed, clock, best, tried, random, constant, stored)

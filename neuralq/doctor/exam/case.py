"""What every measurement is given: the subject, its world, and the episodes that were played with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np

from neuralq.doctor.findings import Finding
from neuralq.doctor.play import Clock, Episode, horizon, play, returns_from
from neuralq.doctor.subject import Settings, Subject
from neuralq.doctor.worlds import World
from neuralq.types import Array, Floats, Indices

__all__ = ["CannotMeasure", "Case", "any_of", "begin", "greedy_of", "legal_at", "seen_at", "stacked"]

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
    def masked(self) -> bool:
        """Whether the environment says which actions are legal."""
        return self.greedy[0].legal is not None

    @property
    def width(self) -> int:
        """Numbers of an observation as a row for regressions."""
        return int(self.world.as_rows(self.greedy[0].observations[:1]).shape[1])

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

    def returns(self, one: Episode) -> Floats:
        """G of its steps whose return is known, ``[n]``: to 1 % where episodes go on past the limit, else to 5 %."""
        return returns_from(one, self.gamma, 0.01 if self.world.liftable else 0.05)

    @property
    def horizon(self) -> int:
        """Steps after which 95 % of a constant stream's value has come in."""
        return horizon(self.gamma)

    def visited(self, num: int, number: int) -> tuple[Array, Array | None]:
        """Observations that its policy meets (greedy and explored), ``[≤ num, *obs]``, and their legal actions."""
        pool = [*self.greedy, *self.explored]
        steps = self.rng(number).permutation(sum(one.length for one in pool))[:num]
        return seen_at(pool, steps), legal_at(pool, steps)


Measurement = Callable[[Case], "Finding | Sequence[Finding]"]


def seen_at(episodes: Sequence[Episode], steps: Indices, later: int = 0) -> Array:
    """The observations of these steps, which are numbered through all episodes, or of the ones after: ``[n, *obs]``."""
    begins = np.cumsum([0, *(one.length for one in episodes)])
    which = np.searchsorted(begins, steps, side="right") - 1
    rows = [episodes[i].observations[t - begins[i] + later] for i, t in zip(which, steps, strict=True)]
    return np.stack(rows)


def greedy_of(values: Floats, legal: Array) -> Indices:
    """The best of the legal actions, ``[N, A] -> [N]``; NaN is no value.

    Example:
        >>> greedy_of(np.array([[3.0, 1.0, np.nan]]), np.array([[False, True, True]])).tolist()
        [1]
    """
    best: Indices = np.where(legal, np.nan_to_num(values, nan=-np.inf), -np.inf).argmax(1)
    return best


def any_of(legal: Array, rng: np.random.Generator) -> Indices:
    """One of the legal actions of each row, all as likely: ``[N, A] -> [N]``."""
    if legal.all():
        return rng.integers(legal.shape[1], size=len(legal))
    drawn: Indices = np.where(legal, rng.random(legal.shape), -1.0).argmax(1)
    return drawn


def legal_at(episodes: Sequence[Episode], steps: Indices, later: int = 0) -> Array | None:
    """Which actions are legal at these steps, as `seen_at` has them: ``[n, A]``; None where no mask is given."""
    if not episodes or episodes[0].legal is None:
        return None
    begins = np.cumsum([0, *(one.length for one in episodes)])
    which = np.searchsorted(begins, steps, side="right") - 1
    return np.stack([cast(Array, episodes[i].legal)[t - begins[i] + later] for i, t in zip(which, steps, strict=True)])


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

    def greedy(s: Array, legal: Array, rng: np.random.Generator) -> tuple[Indices, Floats]:
        values = subject.values(s)
        return greedy_of(values, legal), values

    def explored(s: Array, legal: Array, rng: np.random.Generator) -> tuple[Indices, Floats]:
        best, values = greedy(s, legal, rng)
        chance = rng.random(len(s)) < _EPSILON
        return np.where(chance, any_of(legal, rng), best), values

    def chance(s: Array, legal: Array, rng: np.random.Generator) -> tuple[Indices, Floats]:
        return any_of(legal, rng), np.full((len(s), num_actions), np.nan)

    def always(a: int) -> Callable[[Array, Array, np.random.Generator], tuple[Indices, Floats]]:
        """This action, and a random one where it is illegal."""
        return lambda s, legal, rng: (
            np.where(legal[:, a], a, any_of(legal, rng)),
            np.full((len(s), num_actions), np.nan),
        )

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

"""One life in the nine mazes: one after the other with what was learned before, or each from nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from neuralq.checks import check_fraction, check_whole
from neuralq.systems.child.kernels import MazeArrays, Rewards, Scratch, learn_maze
from neuralq.tabular import HierarchyRates, TransitionHierarchy, new_stream, new_transition_hierarchy
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq_envs.ring_mazes import NUM_MAZES, NUM_PERCEPTS, corridors, shortest_way

__all__ = [
    "FROM_NOTHING_LIMIT",
    "GOAL_ONLY",
    "LIMIT",
    "NO_GROWTH",
    "NUM_INPUTS",
    "Life",
    "Settings",
    "live",
    "maze_arrays",
]

NUM_ACTIONS = 4
NUM_INPUTS = NUM_PERCEPTS * (NUM_ACTIONS + 1)
"""One for each percept and move before it, or none."""
LIMIT, FROM_NOTHING_LIMIT = 40_000, 120_000
"""Steps after which a maze is given up."""
_TEST_EVERY = 5


class Settings(NamedTuple):
    """Constants of a life.

    Args:
        rates: of the hierarchy.
        rewards: what is paid.
        epsilon: of exploring.
        max_units: how many units it may grow.
    """

    rates: HierarchyRates = HierarchyRates(step_size=0.15, averaging=0.03, ratio=0.7, threshold=0.75)
    rewards: Rewards = Rewards(gamma=0.97, step=-1.0, goal=0.0)
    epsilon: float = 0.1
    max_units: int = 1000


NO_GROWTH = Settings()._replace(rates=Settings().rates._replace(threshold=np.inf))
GOAL_ONLY = Settings(HierarchyRates(0.3, 0.03, 0.9, 0.2), Rewards(0.91, 0.0, 1.0))
"""As Ring paid, and constants that go with it."""


@dataclass(frozen=True, eq=False)
class Life:
    """What came of one life.

    Args:
        steps: that each maze took until it was walked the shortest way; one more than the limit where it never was.
        num_units: after each maze.
        limit: steps after which a maze was given up.
        net: what was learned in the end.
    """

    steps: tuple[int, ...]
    num_units: tuple[int, ...]
    limit: int
    net: TransitionHierarchy

    @property
    def solved(self) -> tuple[bool, ...]:
        """Which mazes were."""
        return tuple(steps <= self.limit for steps in self.steps)


@cache
def maze_arrays(maze: int) -> MazeArrays:
    """What a trial needs to know of a maze.

    Example:
        >>> maze_arrays(9).shortest
        20
    """
    one = corridors(maze)
    return MazeArrays(one.led, one.percepts, len(shortest_way(maze)))


def live(
    seed: Seed,
    settings: Settings = Settings(),  # noqa: B008 - frozen
    mazes: Sequence[int] = range(1, NUM_MAZES + 1),
    from_nothing: bool = False,
    limit: int = LIMIT,
) -> Life:
    """These mazes, each until it is walked the shortest way (tried after every fifth trial) or given up.

    Args:
        seed: of the stream.
        settings: constants.
        mazes: which, in this order.
        from_nothing: whether what was learned in one is forgotten before the next.
        limit: steps after which a maze is given up.

    Raises:
        ValueError: a maze that there is not, or a constant out of range.

    Example:
        >>> life = live(0, mazes=(1, 2))
        >>> life.solved, life.num_units
        ((True, True), (0, 1))
    """
    check_whole("limit", limit)
    check_fraction("epsilon", settings.epsilon)
    stream, scratch = new_stream(seed), Scratch(np.zeros(NUM_INPUTS), np.zeros(NUM_ACTIONS))
    net = new_transition_hierarchy(NUM_INPUTS, NUM_ACTIONS, settings.max_units)
    steps, num_units = [], []
    for maze in mazes:
        if from_nothing:
            net = new_transition_hierarchy(NUM_INPUTS, NUM_ACTIONS, settings.max_units)
        arrays = maze_arrays(maze)
        taken = learn_maze(
            net, settings.rates, settings.rewards, settings.epsilon, arrays, scratch, _TEST_EVERY, limit, stream
        )
        steps.append(int(taken))
        num_units.append(int(net.counts[0]) - NUM_ACTIONS)
    return Life(tuple(steps), tuple(num_units), limit, net)

"""Mazes of one kind in several sizes, solved by regions and state by state."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq.systems.regions.operators import maze_operators
from neuralq.tabular.regions import RegionPlan, region_dp
from neuralq_envs.slide_maze import SlideMaze, draw_maze, successors

__all__ = ["KINDS", "Solved", "by_regions", "by_states", "solve_mazes"]

KINDS: Mapping[str, Mapping[str, float]] = {
    "5 rectangles": {"num_rectangles": 5},
    "15 rectangles": {"num_rectangles": 15},
    "40 rectangles": {"num_rectangles": 40},
    "10 % random walls": {"num_rectangles": 0, "wall_share": 0.1},
    "30 % random walls": {"num_rectangles": 0, "wall_share": 0.3},
}
"""How walls are drawn, by a name."""


@dataclass(frozen=True, eq=False)
class Solved:
    """One maze, solved twice.

    Args:
        maze: which.
        plan: by regions.
        num_backups: of single states.
        difference: the largest between both costs, over all cells.
        seconds: CPU time by regions and by states, from the map.
    """

    maze: SlideMaze
    plan: RegionPlan
    num_backups: int
    difference: float
    seconds: tuple[float, float]

    @property
    def ratio(self) -> float:
        """Backups of regions in units of those of states."""
        return self.plan.num_backups / self.num_backups


def solve_mazes(seed: np.random.SeedSequence, kind: str, sizes: Sequence[int]) -> dict[int, Solved]:
    """A maze of each size.

    Args:
        seed: draws the mazes.
        kind: one of `KINDS`.
        sizes: cells in a row and rows.

    Raises:
        ValueError: another kind.

    Example:
        >>> found = solve_mazes(np.random.SeedSequence(0), "5 rectangles", [10, 20])
        >>> [(size, one.difference) for size, one in found.items()]
        [(10, 0.0), (20, 0.0)]
    """
    check_choice("kind", kind, KINDS)
    drawn = int(seed.generate_state(1)[0])
    return {size: _solve(draw_maze(size, seed=drawn, **KINDS[kind])) for size in sizes}  # type: ignore[arg-type]


def _solve(maze: SlideMaze) -> Solved:
    began = time.thread_time()
    plan = by_regions(maze)
    between = time.thread_time()
    costs, num_backups = by_states(maze)
    ended = time.thread_time()
    difference = float(np.abs(costs[maze.free] - plan.costs[maze.free]).max())
    return Solved(maze, plan, num_backups, difference, (between - began, ended - between))


def by_regions(maze: SlideMaze) -> RegionPlan:
    """The cheapest way from every cell, by regions.

    Example:
        >>> by_regions(SlideMaze(np.ones((9, 9), bool), (0, 0))).costs[8].tolist()
        [1.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0]
    """
    row, column = maze.goal
    return region_dp(maze.free, (slice(row, row + 1), slice(column, column + 1)), maze_operators(maze.free))


def by_states(maze: SlideMaze) -> tuple[NDArray[np.float64], int]:
    """The same cell by cell, from a table of where each action leads: costs, and how many backups they took.

    Every cell that has a way is regressed through every action once, which is the least that can be.

    Example:
        >>> by_states(SlideMaze(np.ones((9, 9), bool), (0, 0)))[1]
        648
    """
    before = [_predecessors(led) for led in successors(maze.free).T]
    costs, goal = [np.inf] * maze.free.size, maze.goal[0] * maze.free.shape[1] + maze.goal[1]
    costs[goal] = 0.0
    queue, num_backups = deque([goal]), 0
    while queue:
        s = queue.popleft()
        cost = costs[s] + 1.0
        for table in before:
            num_backups += 1
            for s_tm1 in table[s]:
                if cost < costs[s_tm1]:
                    costs[s_tm1] = cost
                    queue.append(s_tm1)
    return np.array(costs).reshape(maze.free.shape), num_backups


def _predecessors(led: NDArray[np.int64]) -> list[list[int]]:
    """From which cells one action leads to each cell."""
    order = np.argsort(led, kind="stable").tolist()
    starts = np.searchsorted(np.sort(led), np.arange(len(led) + 1)).tolist()
    return [order[starts[s] : starts[s + 1]] for s in range(len(led))]

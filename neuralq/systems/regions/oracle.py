"""What must be exact: regions give the values of the model itself, and a regression is the inverse of its action."""

from __future__ import annotations

import numpy as np

from neuralq.exact import solve
from neuralq.runs.report.claims import Row, number
from neuralq.systems.regions.mazes import KINDS, by_regions
from neuralq.systems.regions.operators import maze_operators
from neuralq.tabular.regions import cover
from neuralq_envs.slide_maze import draw_maze, mdp, successors

__all__ = ["model_difference", "oracle", "wrong_regressions"]


def oracle() -> tuple[Row, ...]:
    """Both, as rows."""
    return (
        number("20 x 20 cells: difference from the model's own optimum", 0.0, model_difference(), tol=1e-9),
        number(
            "cells that a regression has or lacks although their action does not lead there, or does",
            0.0,
            wrong_regressions(),
            tol=0.0,
            note="200 rectangles, eight actions",
        ),
    )


def model_difference(size: int = 20) -> float:
    """The largest difference of −V*, by regions and by the exact solver on the environment's model, over all kinds.

    Example:
        >>> model_difference(8)
        0.0
    """
    worst = 0.0
    for seed, kind in enumerate(KINDS.values()):
        maze = draw_maze(size, seed=seed, **kind)  # type: ignore[arg-type]
        exact = solve(mdp(size, seed=seed, **kind), 1.0)  # type: ignore[arg-type]
        ours = by_regions(maze).costs[maze.free]
        worst = max(worst, float(np.abs(ours + exact.v.reshape(size, size)[maze.free]).max()))
    return worst


def wrong_regressions(size: int = 12, num_rectangles: int = 200, seed: int = 0) -> int:
    """How often a regression and the actions themselves disagree on a cell, among the free cells outside.

    Example:
        >>> wrong_regressions(num_rectangles=10)
        0
    """
    rng = np.random.default_rng(seed)
    free = draw_maze(size, 3, 0.1, seed).free
    operators, led = maze_operators(free), successors(free)
    wrong = 0
    for _ in range(num_rectangles):
        cells = np.zeros(free.shape, bool)
        (top, bottom), (left, right) = (np.sort(rng.choice(size + 1, 2, replace=False)) for _ in range(2))
        cells[top:bottom, left:right] = True
        region = next(cover(cells & free), (slice(0, 0), slice(0, 0)))  # holds no wall, as those of a plan
        inside = np.zeros(free.shape, bool)
        inside[region] = True
        for a, operator in enumerate(operators):
            told = np.zeros(free.shape, bool)
            for before in operator.regress(region):
                told[before] = True
            leads = inside.ravel()[led[:, a]].reshape(free.shape)
            wrong += int(np.count_nonzero((told != leads)[free & ~inside]))
    return wrong

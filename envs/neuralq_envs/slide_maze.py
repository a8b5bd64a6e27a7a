"""Mazes in which one goes by a step or slides to the wall, with walls that are large rectangles or single cells.

Eight actions, −1 each: one cell north, east, south or west, and as far as it goes north, east, south or west. Where a
wall or the edge is in the way one stays. An episode ends in the goal; who slides over it does not stop there.

A maze of n x n cells is drawn from its seed: rectangles with sides below n / 6 anywhere, or each cell a wall with some
chance. What is cut off from the largest part that is left is wall too, and the goal is one of its cells.

Source: the task of Dietterich & Flann 1997 ("Explanation-based learning and reinforcement learning: a unified view",
Machine Learning 28), whose mazes we do not have; sizes and how walls are drawn are ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.grids import Grid
from neuralq_envs.rendering import factories

__all__ = ["ACTIONS", "SlideMaze", "draw_maze", "make", "make_vector", "mdp", "successors"]

_SIDES = ("north", "east", "south", "west")
ACTIONS = (*_SIDES, *(f"slide {side}" for side in _SIDES))
_MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))


class SlideMaze(NamedTuple):
    """A map and where its goal is.

    Args:
        free: cells that are no wall, ``[n, n]``.
        goal: row and column.
    """

    free: NDArray[np.bool_]
    goal: tuple[int, int]


def draw_maze(size: int = 20, num_rectangles: int = 5, wall_share: float = 0.0, seed: int = 0) -> SlideMaze:
    """A maze, the same for the same seed.

    Args:
        size: n, cells in a row and rows.
        num_rectangles: walls that are rectangles; they may overlap.
        wall_share: chance of every other cell to be a wall, from 0 to 0.9.
        seed: draws walls and goal.

    Raises:
        ValueError: fewer than 3 cells in a row, a negative count, or a chance out of range.

    Example:
        >>> maze = draw_maze(12, num_rectangles=2)
        >>> maze.free.shape, bool(maze.free[maze.goal])
        ((12, 12), True)
    """
    check_whole("size", size, 3)
    check_whole("num_rectangles", num_rectangles, 0)
    check_whole("seed", seed, 0)
    if not 0.0 <= wall_share <= 0.9:
        raise ValueError(f"wall_share must lie in [0, 0.9], got {wall_share}; more leaves nowhere to go")
    rng = np.random.default_rng(seed)
    free = rng.random((size, size)) >= wall_share
    longest = max((size - 1) // 6, 1)  # below n / 6
    for _ in range(num_rectangles):
        height, width = rng.integers(1, longest + 1, 2)
        top, left = rng.integers(0, size - height + 1), rng.integers(0, size - width + 1)
        free[top : top + height, left : left + width] = False
    parts, _ = ndimage.label(free)
    sizes = np.bincount(parts.ravel(), minlength=2)
    sizes[0] = 0  # the walls
    if sizes.max() < 2:
        raise ValueError(f"these walls leave no two cells together (seed {seed}); ask for fewer, or for another seed")
    free = parts == sizes.argmax()
    row, column = np.argwhere(free)[rng.integers(np.count_nonzero(free))]
    return SlideMaze(free, (int(row), int(column)))


def successors(free: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Where each action leads from each cell, ``[n·n, 8]``, cells counted row by row; walls lead to themselves.

    Args:
        free: cells that are no wall, ``[n, n]``.

    Example:
        >>> successors(np.array([[True, True, True], [True, False, True], [True, True, True]]))[6].tolist()
        [3, 7, 6, 6, 0, 8, 6, 6]
    """
    height, width = free.shape
    cells = np.arange(height * width).reshape(height, width)
    led = np.empty((height, width, 8), np.int64)
    for a, (down, across) in enumerate(_MOVES):
        row, column = np.mgrid[:height, :width]
        for is_slide in (False, True):
            for _ in range(max(height, width) if is_slide else 1):
                next_row, next_column = row + down, column + across
                inside = (next_row >= 0) & (next_row < height) & (next_column >= 0) & (next_column < width)
                goes = inside & free[next_row % height, next_column % width] & free
                if not goes.any():
                    break
                row, column = np.where(goes, next_row, row), np.where(goes, next_column, column)
            led[:, :, a + 4 * is_slide] = cells[row, column]
            row, column = np.mgrid[:height, :width]
    return led.reshape(-1, 8)


def mdp(size: int = 20, num_rectangles: int = 5, wall_share: float = 0.0, seed: int = 0) -> FiniteMDP:
    """The exact model; episodes start in any free cell but the goal.

    Example:
        >>> mdp(6, 0).num_rows  # eight actions in each of 35 cells
        280
    """
    maze = draw_maze(size, num_rectangles, wall_share, seed)
    led, free = successors(maze.free), maze.free.ravel()
    goal = maze.goal[0] * size + maze.goal[1]
    starts = free & (np.arange(size * size) != goal)
    return FiniteMDP.from_functions(
        size * size,
        len(ACTIONS),
        lambda s: range(len(ACTIONS)) if starts[s] else (),
        lambda s, a: [(1.0, int(led[s, a]), -1.0, bool(led[s, a] == goal))],
        start=starts / np.count_nonzero(starts),
        state_names=[f"row {s // size}, column {s % size}" for s in range(size * size)],
        action_names=ACTIONS,
    )


def _scene(size: int = 20, num_rectangles: int = 5, wall_share: float = 0.0, seed: int = 0) -> Grid:
    maze = draw_maze(size, num_rectangles, wall_share, seed)
    signs = np.where(maze.free, ".", "#")
    signs[maze.goal] = "G"
    return Grid("\n".join("".join(row) for row in signs))


make, make_vector = factories(mdp, _scene)

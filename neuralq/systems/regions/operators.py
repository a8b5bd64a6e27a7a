"""The eight actions of a slide maze, backwards: from which rectangles do they lead into a rectangle?"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from neuralq.tabular.regions import Region, RegionOperator

__all__ = ["maze_operators"]

_MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))


def maze_operators(free: NDArray[np.bool_]) -> tuple[RegionOperator, ...]:
    """The operators of `neuralq_envs.slide_maze`, in the order of its actions, for a map ``[n, n]``.

    Example:
        >>> west = maze_operators(np.ones((3, 4), bool))[7]
        >>> list(west.regress((slice(1, 2), slice(0, 2))))
        [(slice(1, 2, None), slice(0, 4, None))]
    """
    steps = [RegionOperator(1.0, partial(_before_step, free.shape, move)) for move in _MOVES]
    slides = [RegionOperator(1.0, partial(_before_slide, _lengths(free, move), move)) for move in _MOVES]
    return (*steps, *slides)


def _before_step(shape: tuple[int, ...], move: tuple[int, int], region: Region) -> Iterator[Region]:
    """The region moved back by one cell, as far as that is on the map."""
    yield tuple(
        slice(max(side.start - by, 0), min(side.stop - by, size))
        for side, by, size in zip(region, move, shape, strict=True)
    )


def _before_slide(lengths: NDArray[np.int64], move: tuple[int, int], region: Region) -> Iterator[Region]:
    """For every cell of the region at which a slide stops, the cells that it passes."""
    inside = lengths[region]
    for row, column in np.argwhere(inside).tolist():
        passed, ends = int(inside[row, column]), (row + region[0].start, column + region[1].start)
        yield tuple(
            slice(end - (passed - 1) * (by > 0), end + 1 + (passed - 1) * (by < 0))
            for end, by in zip(ends, move, strict=True)
        )


def _lengths(free: NDArray[np.bool_], move: tuple[int, int]) -> NDArray[np.int64]:
    """How many cells, itself included, slide to each cell; 0 where no slide stops."""
    sideways = move[0] == 0
    ahead = free if sideways else free.T
    ahead = ahead if sum(move) > 0 else ahead[:, ::-1]  # now the slide goes to the right
    passed = np.zeros(ahead.shape, np.int64)
    for j in range(ahead.shape[1]):
        passed[:, j] = ahead[:, j] * ((passed[:, j - 1] if j else 0) + 1)
    passed[:, :-1] *= ~ahead[:, 1:]
    passed = passed if sum(move) > 0 else passed[:, ::-1]
    return passed if sideways else passed.T

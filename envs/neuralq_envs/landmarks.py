"""A room with three landmarks, to be visited in an order that the task names: A, or A and then C, or A, B and C.

The room has 8 x 8 cells with a wall of four; moves are north, east, south and west, −.05 each, and the end of the task
earns 1 on top. The state is what the task is, how much of it is behind one, and the cell. An episode draws a task, and
a cell other than its first landmark; passing a landmark out of turn does nothing.

Source: after Singh 1992 ("Transfer of learning by composing solutions of elemental sequential tasks", Machine Learning
8), whose composite tasks are sequences of elemental ones; this room is ours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.mdp import FiniteMDP
from neuralq_envs.canvas import BLUE, CELL, GREEN, GREY, INK, PAPER, blank, disk, frame, write
from neuralq_envs.rendering import factories

__all__ = ["LANDMARKS", "LAYOUT", "TASKS", "Room", "make", "make_vector", "mdp", "room"]

LAYOUT = """
........
.A......
........
..####..
........
......B.
.C......
........
"""
LANDMARKS = "ABC"
TASKS = ("A", "B", "C", "AC", "BC", "ABC")
ACTIONS = ("north", "east", "south", "west")
_MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
_MIDDLE = ((CELL - 1) / 2, (CELL - 1) / 2)
_ROWS = LAYOUT.split()
_SIZE = len(_ROWS)
NUM_CELLS = _SIZE * _SIZE


class Room(NamedTuple):
    """The room, and what its tasks ask for; cells are counted row by row, stages of all tasks one after the other.

    Args:
        free: cells that are no wall.
        led: where each move leads from each cell, ``[64, 4]``.
        first: the first stage of each task, ``[tasks + 1]``; the last number is how many stages there are.
        goals: the cell that each stage is to reach, ``[stages]``.
        landmarks: which landmark that is, 0 for A, ``[stages]``.
    """

    free: NDArray[np.int64]
    led: NDArray[np.int64]
    first: NDArray[np.int64]
    goals: NDArray[np.int64]
    landmarks: NDArray[np.int64]

    @property
    def is_last(self) -> NDArray[np.bool_]:
        """Whether a stage is the last one of its task, ``[stages]``."""
        return np.isin(np.arange(len(self.goals)) + 1, self.first)


def room(tasks: Sequence[str] = TASKS) -> Room:
    """The room with some tasks.

    Args:
        tasks: each a sequence of landmarks, such as ``"AC"``, none twice in a row.

    Raises:
        ValueError: no task, or one that is no such sequence.

    Example:
        >>> one = room(["AC", "B"])
        >>> one.first.tolist(), one.goals.tolist(), one.is_last.tolist()
        ([0, 2, 3], [9, 49, 46], [False, True, True])
    """
    if not tasks or isinstance(tasks, str):
        raise ValueError(f"tasks must be a list of sequences of landmarks, such as ['A', 'AC'], got {tasks!r}")
    for task in tasks:
        if not task or not set(task) <= set(LANDMARKS) or any(pair in task for pair in ("AA", "BB", "CC")):
            raise ValueError(f"a task must be landmarks of {LANDMARKS!r}, none twice in a row, got {task!r}")
    signs = "".join(_ROWS)
    led = np.empty((NUM_CELLS, 4), np.int64)
    for cell in range(NUM_CELLS):
        for a, (down, across) in enumerate(_MOVES):
            row, column = cell // _SIZE + down, cell % _SIZE + across
            inside = 0 <= row < _SIZE and 0 <= column < _SIZE and _ROWS[row][column] != "#"
            led[cell, a] = row * _SIZE + column if inside else cell
    stages = "".join(tasks)
    return Room(
        np.array([cell for cell, sign in enumerate(signs) if sign != "#"]),
        led,
        np.cumsum([0, *map(len, tasks)]),
        np.array([signs.index(landmark) for landmark in stages]),
        np.array([LANDMARKS.index(landmark) for landmark in stages]),
    )


def mdp(tasks: Sequence[str] = TASKS, step_reward: float = -0.05, goal_reward: float = 1.0) -> FiniteMDP:
    """The exact model; a state is 64 times its stage, counted over all tasks, plus its cell.

    Args:
        tasks: of which each episode draws one.
        step_reward: of every move.
        goal_reward: on top, for the end of the task.

    Raises:
        ValueError: tasks as `room` refuses them, or a reward that is not finite.

    Example:
        >>> mdp().num_states  # six tasks of ten stages in all
        640
    """
    for name, value in (("step_reward", step_reward), ("goal_reward", goal_reward)):
        if not math.isfinite(value):
            raise ValueError(f"{name} must be finite, got {value}")
    place, is_last = room(tasks), room(tasks).is_last
    num_stages = len(place.goals)

    def actions(s: int) -> Sequence[int]:
        return range(4) if s % NUM_CELLS in place.free and s % NUM_CELLS != place.goals[s // NUM_CELLS] else ()

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        stage, cell = s // NUM_CELLS, int(place.led[s % NUM_CELLS, a])
        reached = cell == place.goals[stage]
        ended = bool(reached and is_last[stage])
        stage += int(reached and not ended)
        return [(1.0, stage * NUM_CELLS + cell, step_reward + goal_reward * ended, ended)]

    start = np.zeros((num_stages, NUM_CELLS))
    for stage in place.first[:-1]:
        start[stage, place.free] = 1.0
        start[stage, place.goals[stage]] = 0.0
    names = [f"{task}, stage {i + 1}" for task in tasks for i in range(len(task))]
    return FiniteMDP.from_functions(
        num_stages * NUM_CELLS,
        4,
        actions,
        transitions,
        start=start.ravel() / start.sum(),
        state_names=[f"{name}, row {c // _SIZE}, column {c % _SIZE}" for name in names for c in range(NUM_CELLS)],
        action_names=ACTIONS,
    )


class _Scene:
    """The room from above, and the task with what is behind one."""

    def __init__(self, tasks: Sequence[str] = TASKS, **_: float) -> None:
        self._stages = [(task, i) for task in tasks for i in range(len(task))]
        self._width = max(_SIZE, *map(len, tasks))

    def text(self, state: int | None) -> str:
        """The map with the agent as ``@``, and the task with the landmark that comes next in brackets."""
        signs, told = list("".join(_ROWS)), []
        if state is not None:
            signs[state % NUM_CELLS] = "@"
            task, i = self._stages[state // NUM_CELLS]
            told = [f"{task[:i]}[{task[i]}]{task[i + 1 :]}"]
        lines = [" ".join(signs[i : i + _SIZE]) for i in range(0, NUM_CELLS, _SIZE)]
        return "\n".join([*lines, *told, ""])

    def pixels(self, state: int | None) -> NDArray[np.uint8]:
        """The map, and below it the task: what comes next in green, what is behind one in grey."""
        picture = blank((_SIZE + 1) * CELL, self._width * CELL)
        for cell, sign in enumerate("".join(_ROWS)):
            square = self._square(picture, *divmod(cell, _SIZE))
            if sign == "#":
                square[:] = INK
            elif sign != ".":
                write(square, sign, _MIDDLE, scale=4)
            if state is not None and state % NUM_CELLS == cell:
                disk(square, _MIDDLE, 0.3 * CELL, BLUE)
            frame(square, GREY)
        if state is not None:
            task, stage = self._stages[state // NUM_CELLS]
            for i, landmark in enumerate(task):
                square = self._square(picture, _SIZE, i)
                square[:] = GREEN if i == stage else GREY if i < stage else PAPER
                write(square, landmark, _MIDDLE, scale=4)
                frame(square, INK)
        return picture

    def _square(self, picture: NDArray[np.uint8], row: int, column: int) -> NDArray[np.uint8]:
        return picture[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]  # a view


make, make_vector = factories(mdp, _Scene)

"""The board as text and as a small picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq_envs.canvas import BLUE, GREEN, GREY, INK, RED, Colour, blank, disk, frame
from neuralq_envs.lin_world.kernels import COLUMN, ENERGY, LEFT, ROW, World
from neuralq_envs.lin_world.sensors import REACH

__all__ = ["board_picture", "board_text"]

_CELL = 16  # pixels
_INSIDE = slice(REACH, -REACH)


def board_text(world: World) -> str:
    """Rows of signs, ``#`` obstacle, ``$`` food, ``E`` enemy, ``I`` the agent, and its energy."""
    signs = np.where(world.obstacles == 1, "#", np.where(world.food == 1, "$", "."))
    signs[world.agent[ROW], world.agent[COLUMN]] = "I"
    signs[world.guarded == 1] = "E"
    rows = ["".join(row) for row in signs[_INSIDE, _INSIDE]]
    return "\n".join([*rows, f"energy {world.agent[ENERGY]}, food left {world.agent[LEFT]}", ""])


def board_picture(world: World) -> NDArray[np.uint8]:
    """Obstacles grey, food green, enemies red, the agent blue; uint8 ``[16 R, 16 C, 3]``."""
    obstacles = world.obstacles[_INSIDE, _INSIDE]
    picture = blank(*(_CELL * size for size in obstacles.shape))
    picture[np.kron(obstacles, np.ones((_CELL, _CELL), np.int8)) == 1] = GREY

    def dot(row: int, column: int, radius: float, colour: Colour) -> None:
        disk(picture, ((row - REACH + 0.5) * _CELL, (column - REACH + 0.5) * _CELL), radius, colour)

    for row, column in np.argwhere(world.food == 1):
        dot(row, column, 5, GREEN)
    dot(world.agent[ROW], world.agent[COLUMN], 7, BLUE)
    for row, column in np.argwhere(world.guarded == 1):
        dot(row, column, 6, RED)
    frame(picture, INK)
    return picture

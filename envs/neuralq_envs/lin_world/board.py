"""The board as text, and worlds made of such texts."""

from __future__ import annotations

from typing import Any

import numpy as np

from neuralq_envs.lin_world.kernels import COLUMN, ENERGY, LAST, NUM_MOVES, ROW, World
from neuralq_envs.lin_world.sensors import REACH

__all__ = ["BOARD", "ENERGY_AT_START", "NUM_FOOD", "copied_world", "new_world"]

ENERGY_AT_START, NUM_FOOD = 40, 15
BOARD = """
######.............######
#...........E...........#
#..##...##.###.##...##..#
#.###...##.#.#.##...###.#
#.###...............###.#
#.......................#
......E.....E.....E......
.........................
..##....####.####....##..
..##....###...###....##..
........##.....##........
..##....#.......#....##..
..#.........#.........#..
..##....#.......#....##..
........##.....##........
..##....###...###....##..
..##....####.####....##..
.........................
............I............
#.......................#
#.###...............###.#
#.###...##.#.#.##...###.#
#..##...##.###.##...##..#
#.......................#
######.............######
"""
_SIGNS = "#.EI"


def new_world(board: str = BOARD, energy: int = ENERGY_AT_START) -> World:
    """A world without food; `neuralq_envs.lin_world.kernels.settle` puts it there and begins a play.

    Args:
        board: rows of one length: ``#`` obstacle, ``.`` free, ``E`` an enemy, ``I`` the agent, exactly one. It is
            surrounded by obstacles.
        energy: the agent's when a play begins, at least 1.

    Raises:
        ValueError: rows of several lengths, another sign, no agent or several, or too little energy.

    Example:
        >>> world = new_world()
        >>> len(world.starts), len(world.free), int(world.obstacles[12:37, 12:37].sum())
        (4, 451, 169)
    """
    lines = [line.strip() for line in board.strip().splitlines()]
    if len({len(line) for line in lines}) != 1 or not set("".join(lines)) <= set(_SIGNS):
        raise ValueError(f"board must be rows of one length made of {', '.join(map(repr, _SIGNS))}, got {board!r}")
    signs = np.pad(np.array([list(line) for line in lines]), REACH, constant_values="#")
    agent, enemies = np.argwhere(signs == "I"), np.argwhere(signs == "E")
    if len(agent) != 1:
        raise ValueError(f"board must have one agent 'I', got {len(agent)}")
    if energy < 1:
        raise ValueError(f"energy must be at least 1, got {energy}")
    start = np.zeros(6, np.int64)
    start[[ROW, COLUMN, ENERGY, LAST]] = *agent[0], energy, -1
    walls = (signs == "#").astype(np.int8)
    return World(
        walls, np.zeros_like(walls), np.zeros_like(walls), enemies.copy(), start.copy(), start, enemies,
        np.argwhere(signs == "."), np.zeros(NUM_MOVES),
    )  # fmt: skip


def copied_world(world: World) -> World:
    """The same world, of which nothing is shared.

    Example:
        >>> world = new_world()
        >>> copied_world(world).food is world.food
        False
    """
    parts: Any = (part.copy() for part in world)
    return World(*parts)

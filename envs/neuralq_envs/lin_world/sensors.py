"""What the agent sees: 145 bits, from sensors that stand around it and turn with the action that is judged.

A sensor is a set of cells, given by how many rows down and columns to the right of the agent they are. An X is a cell
and its four neighbours, an O a square of nine, a Y that and the four cells two away. Bits are, in this order,

* 52 that see food: 12 X within two moves, 20 O farther off, 20 Y ten moves away;
* 32 that see enemies: the same X and O;
* 40 that see obstacles: the cells within four moves;
* 16 of energy, of which the one is on that stands for 1 to 4, 5 to 8, ..., 61 and more;
* 4 of the last action, and one that says that it was a bump.

Source: Lin 1992, "Self-improving reactive agents based on reinforcement learning, planning and teaching", figure 3.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "BUMPED_BIT",
    "ENEMY_BIT",
    "ENEMY_CELLS",
    "ENERGY_BIT",
    "FOOD_BIT",
    "FOOD_CELLS",
    "LAST_BIT",
    "NUM_BITS",
    "OBSTACLE_BIT",
    "OBSTACLE_CELLS",
    "REACH",
    "SENSOR_PLACES",
    "turns",
]

Offsets = list[tuple[int, int]]


def _within(distance: int) -> Offsets:
    """All but the agent's own cell, row by row."""
    span = range(-distance, distance + 1)
    return [at for at in product(span, span) if 0 < abs(at[0]) + abs(at[1]) <= distance]


_CROSS: Offsets = [(0, 0), *_within(1)]
_SQUARE: Offsets = list(product((-1, 0, 1), (-1, 0, 1)))
_STAR: Offsets = [*_SQUARE, (-2, 0), (2, 0), (0, -2), (0, 2)]
_X_PLACES = _within(2)
_O_PLACES: Offsets = [
    *product((-2, 2), (-2, 2)),
    *product((-4, 4), (-2, 0, 2)),
    *product((-2, 0, 2), (-4, 4)),
    *((-6, 0), (6, 0), (0, -6), (0, 6)),
]
_EVEN = range(-10, 11, 2)
_Y_PLACES = [at for at in product(_EVEN, _EVEN) if abs(at[0]) + abs(at[1]) == 10]
_NEAR = [*((at, _CROSS) for at in _X_PLACES), *((at, _SQUARE) for at in _O_PLACES)]
_FOOD = [*_NEAR, *((at, _STAR) for at in _Y_PLACES)]
_OBSTACLES = [(at, [(0, 0)]) for at in _within(4)]

NUM_BITS, REACH = 145, 12
"""How many bits, and how far a sensor can see along a row or a column."""
FOOD_BIT, ENEMY_BIT, OBSTACLE_BIT, ENERGY_BIT, LAST_BIT, BUMPED_BIT = 0, 52, 84, 124, 140, 144
"""The first bit of each kind."""
SENSOR_PLACES = tuple(at for at, _ in [*_FOOD, *_NEAR, *_OBSTACLES])
"""The middle of each of the first 124 sensors, rows down and columns to the right of the agent."""


def _cells(first: int, sensors: list[tuple[tuple[int, int], Offsets]]) -> NDArray[np.int64]:
    rows = [(first + i, at[0] + cell[0], at[1] + cell[1]) for i, (at, shape) in enumerate(sensors) for cell in shape]
    return np.array(rows, np.int64)


FOOD_CELLS = _cells(FOOD_BIT, _FOOD)
"""Every cell that a bit for food covers: bit, rows down, columns to the right; ``[500, 3]``."""
ENEMY_CELLS = _cells(ENEMY_BIT, _NEAR)
OBSTACLE_CELLS = _cells(OBSTACLE_BIT, _OBSTACLES)


def turns() -> NDArray[np.int64]:
    """Where each bit stands for who looks in the direction of an action, ``[4, 145]``.

    Actions are north, east, south and west. For who looks east, the sensor ahead is the one east of the agent: bit i of
    what is seen is bit ``turns()[1, i]`` of what is seen looking east. Bits of energy and of bumping stay.

    Example:
        >>> ahead, right = (SENSOR_PLACES.index(at) for at in ((-6, 0), (0, 6)))
        >>> bool(turns()[1, right] == ahead), turns()[0].tolist() == list(range(NUM_BITS))
        (True, True)
    """
    found = np.tile(np.arange(NUM_BITS), (4, 1))
    kinds = ((FOOD_BIT, ENEMY_BIT), (ENEMY_BIT, OBSTACLE_BIT), (OBSTACLE_BIT, ENERGY_BIT))
    for action in range(1, 4):
        for first, end in kinds:
            where = {at: bit for bit, at in enumerate(SENSOR_PLACES[first:end], first)}
            for (down, right), bit in where.items():
                for _ in range(action):
                    down, right = -right, down  # a quarter turn of the world against the clock
                found[action, bit] = where[down, right]
        for last in range(4):
            found[action, LAST_BIT + last] = LAST_BIT + (last - action) % 4
    return found

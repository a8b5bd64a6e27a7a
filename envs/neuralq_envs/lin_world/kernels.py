"""Lin's world, compiled: how agent and enemies move, and what is seen.

A step: energy falls by 1; the agent goes north, east, south or west, and stays where there is an obstacle; on food it
gets 15 units of energy and a reward of .4; then one enemy after the other moves with a chance of .8, in direction a
with a probability proportional to

    exp(.33 W(a) T),   W = (180 − angle between a and the way to the agent) / 180,
    T = 15 − d for a distance d ≤ 4, 9 − d/2 for d ≤ 15, else 1,

and never onto an obstacle or another enemy. Being caught costs 1, and so does an energy of 0; both end the play, as
does eating the last food.

Source: Lin 1992, appendix; the layout and the constants as reconstructed by others from the paper.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq_envs.lin_world.sensors import (
    BUMPED_BIT,
    ENEMY_CELLS,
    ENERGY_BIT,
    FOOD_CELLS,
    LAST_BIT,
    OBSTACLE_CELLS,
)

__all__ = [
    "ATE",
    "BUMPED",
    "CAUGHT",
    "CLEARED",
    "COLUMN",
    "DOWN",
    "ENERGY",
    "LAST",
    "LEFT",
    "NUM_MOVES",
    "RIGHT",
    "ROW",
    "STARVED",
    "WENT",
    "World",
    "enemy_chances",
    "move",
    "reward_of",
    "sense",
    "settle",
]

NUM_MOVES = 4
DOWN, RIGHT = (-1, 0, 1, 0), (0, 1, 0, -1)
"""Of each move: rows down and columns to the right."""
ROW, COLUMN, ENERGY, LAST, BUMPED, LEFT = range(6)
"""Of `World.agent`: where it is, its energy, its last move (−1 for none), whether that was a bump, how much food is
left."""
WENT, ATE, CLEARED, CAUGHT, STARVED = range(5)
"""What a step led to; the last three end the play. `CLEARED`: that was the last food."""
_CHANCE, _MEAL, _EAGERNESS, _BITS_OF_ENERGY = 0.8, 15, 0.33, 16


class World(NamedTuple):
    """A board with `REACH` cells of obstacles around it, and who is on it. Rows and columns count from its corner.

    Args:
        obstacles: 1 where one is, ``[R, C]``.
        food: 1 where some is, ``[R, C]``.
        guarded: 1 where an enemy is, ``[R, C]``.
        enemies: row and column of each, ``[E, 2]``.
        agent: six numbers by the names above.
        start: what ``agent`` is when a play begins.
        starts: where enemies begin, ``[E, 2]``.
        free: cells where food may be put, ``[N, 2]``.
        chances: room for an enemy's four.
    """

    obstacles: NDArray[np.int8]
    food: NDArray[np.int8]
    guarded: NDArray[np.int8]
    enemies: NDArray[np.int64]
    agent: NDArray[np.int64]
    start: NDArray[np.int64]
    starts: NDArray[np.int64]
    free: NDArray[np.int64]
    chances: NDArray[np.float64]


@lean_kernel
def settle(world: World, drawn: NDArray[np.float64]) -> None:
    """Begins a play: everybody at the start, and food where ``drawn`` says, every set of open cells equally likely.

    Args:
        world: written.
        drawn: a number in [0, 1) for each piece of food (Floyd's way to draw without putting back).

    Example:
        >>> from neuralq_envs.lin_world.board import new_world
        >>> world = new_world("I..E.")
        >>> settle(world, np.array([0.0, 0.0]))
        >>> world.food[12, 12:17].tolist(), world.guarded[12, 12:17].tolist()
        ([0, 1, 0, 0, 1], [0, 0, 0, 1, 0])
    """
    world.food[:, :] = 0
    world.guarded[:, :] = 0
    for i in range(len(world.enemies)):
        world.enemies[i, 0], world.enemies[i, 1] = world.starts[i, 0], world.starts[i, 1]
        world.guarded[world.enemies[i, 0], world.enemies[i, 1]] = 1
    for i in range(len(world.agent)):
        world.agent[i] = world.start[i]
    world.agent[LEFT] = len(drawn)
    for i in range(len(drawn)):
        last = len(world.free) - len(drawn) + i
        k = int(drawn[i] * (last + 1))
        if world.food[world.free[k, 0], world.free[k, 1]] == 1:
            k = last
        world.food[world.free[k, 0], world.free[k, 1]] = 1


@lean_kernel
def enemy_chances(world: World, i: int) -> None:
    """Writes how likely enemy ``i`` goes in each direction if it moves into ``world.chances``; zeros if it cannot.

    Example:
        The agent is one cell west of it, at an angle of 0, and away is at one of 180 degrees: e^(.33 · 14) to 1.

        >>> from neuralq_envs.lin_world.board import new_world
        >>> world = new_world("IE.")
        >>> settle(world, np.zeros(0))
        >>> enemy_chances(world, 0)
        >>> world.chances.round(4).tolist()
        [0.0, 0.0098, 0.0, 0.9902]
    """
    row, column = world.enemies[i, 0], world.enemies[i, 1]
    down, right = world.agent[ROW] - row, world.agent[COLUMN] - column
    distance = math.sqrt(down * down + right * right)
    urge = 15.0 - distance if distance <= 4.0 else 9.0 - distance / 2.0 if distance <= 15.0 else 1.0
    total = 0.0
    for a in range(NUM_MOVES):
        to_row, to_column = row + DOWN[a], column + RIGHT[a]
        world.chances[a] = 0.0
        if world.obstacles[to_row, to_column] == 0 and world.guarded[to_row, to_column] == 0:
            cosine = (DOWN[a] * down + RIGHT[a] * right) / distance
            angle = math.acos(min(max(cosine, -1.0), 1.0))
            world.chances[a] = math.exp(_EAGERNESS * urge * (1.0 - angle / math.pi))
            total += world.chances[a]
    if total > 0.0:
        for a in range(NUM_MOVES):
            world.chances[a] /= total


@lean_kernel
def move(world: World, action: int, drawn: NDArray[np.float64]) -> int:
    """One step of everybody; says what it led to.

    Args:
        world: changed in place.
        action: 0 north, 1 east, 2 south, 3 west.
        drawn: two numbers in [0, 1) for each enemy: whether it moves, and where.

    Returns:
        `WENT`, `ATE`, `CLEARED`, `CAUGHT` or `STARVED`.

    Example:
        >>> from neuralq_envs.lin_world.board import new_world
        >>> world = new_world("I..E")
        >>> settle(world, np.zeros(1))
        >>> move(world, 1, np.array([0.9, 0.0])) == CLEARED, int(world.agent[ENERGY])
        (True, 54)
    """
    agent = world.agent
    row, column = agent[ROW] + DOWN[action], agent[COLUMN] + RIGHT[action]
    agent[ENERGY] -= 1
    agent[LAST] = action
    agent[BUMPED] = world.obstacles[row, column]
    found = WENT
    if agent[BUMPED] == 0:
        agent[ROW], agent[COLUMN] = row, column
        if world.guarded[row, column] == 1:
            return CAUGHT
        if world.food[row, column] == 1:
            world.food[row, column] = 0
            agent[ENERGY] += _MEAL
            agent[LEFT] -= 1
            found = ATE
            if agent[LEFT] == 0:
                return CLEARED
    if agent[ENERGY] == 0:
        return STARVED
    for i in range(len(world.enemies)):
        if drawn[2 * i] < _CHANCE and _advance(world, i, drawn[2 * i + 1]):
            return CAUGHT
    return found


@lean_kernel
def _advance(world: World, i: int, drawn: float) -> bool:
    """Moves an enemy, and says whether that caught the agent."""
    enemy_chances(world, i)
    chosen = -1
    for a in range(NUM_MOVES):
        if world.chances[a] > 0.0:
            chosen = a  # the last one that is possible, should rounding leave something over
            if drawn < world.chances[a]:
                break
            drawn -= world.chances[a]
    if chosen < 0:
        return False
    world.guarded[world.enemies[i, 0], world.enemies[i, 1]] = 0
    world.enemies[i, 0] += DOWN[chosen]
    world.enemies[i, 1] += RIGHT[chosen]
    world.guarded[world.enemies[i, 0], world.enemies[i, 1]] = 1
    return bool(world.enemies[i, 0] == world.agent[ROW] and world.enemies[i, 1] == world.agent[COLUMN])


@lean_kernel
def reward_of(found: int) -> Any:
    """.4 for food, −1 for an end that is none of one's own, else 0.

    Example:
        >>> [reward_of(found) for found in (WENT, ATE, CLEARED, CAUGHT, STARVED)]
        [0.0, 0.4, 0.4, -1.0, -1.0]
    """
    return 0.4 if found == ATE or found == CLEARED else -1.0 if found == CAUGHT or found == STARVED else 0.0


@lean_kernel
def sense(world: World, bits: NDArray[np.int8]) -> None:
    """Writes what the agent sees, ``[145]`` (`neuralq_envs.lin_world.sensors`).

    Example:
        40 cells with obstacles but for one with food, which four X see; and the energy.

        >>> from neuralq_envs.lin_world.board import new_world
        >>> world, bits = new_world("I."), np.zeros(145, np.int8)
        >>> settle(world, np.zeros(1))
        >>> sense(world, bits)
        >>> [int(part.sum()) for part in np.split(bits, (52, 84, 124))]
        [4, 0, 39, 1]
    """
    row, column = world.agent[ROW], world.agent[COLUMN]
    bits[:] = 0
    for k in range(len(FOOD_CELLS)):
        bits[FOOD_CELLS[k, 0]] |= world.food[row + FOOD_CELLS[k, 1], column + FOOD_CELLS[k, 2]]
    for k in range(len(ENEMY_CELLS)):
        bits[ENEMY_CELLS[k, 0]] |= world.guarded[row + ENEMY_CELLS[k, 1], column + ENEMY_CELLS[k, 2]]
    for k in range(len(OBSTACLE_CELLS)):
        bits[OBSTACLE_CELLS[k, 0]] = world.obstacles[row + OBSTACLE_CELLS[k, 1], column + OBSTACLE_CELLS[k, 2]]
    energy = world.agent[ENERGY]
    if energy > 0:
        bits[ENERGY_BIT + min((energy - 1) // 4, _BITS_OF_ENERGY - 1)] = 1
    if world.agent[LAST] >= 0:
        bits[LAST_BIT + world.agent[LAST]] = 1
    bits[BUMPED_BIT] = world.agent[BUMPED]

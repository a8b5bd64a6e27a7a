"""A teacher who sees the whole board: the shortest way to food that keeps away from enemies, else flight."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq_envs.lin_world.kernels import COLUMN, DOWN, NUM_MOVES, RIGHT, ROW, World

__all__ = ["Plan", "advised", "new_plan"]

_CARE = 3
"""Moves from an enemy within which no way leads, if it can be had."""


class Plan(NamedTuple):
    """Room for a search in breadth.

    Args:
        first: the first move of the way to a cell, −1 where none is known, ``[R, C]``.
        queue: rows and columns of the cells to look at, ``[R C, 2]``.
    """

    first: NDArray[np.int64]
    queue: NDArray[np.int64]


def new_plan(world: World) -> Plan:
    """Room for a world.

    Example:
        >>> from neuralq_envs.lin_world.board import new_world
        >>> new_plan(new_world("I.")).first.shape
        (25, 26)
    """
    return Plan(np.zeros(world.food.shape, np.int64), np.zeros((world.food.size, 2), np.int64))


@lean_kernel
def advised(world: World, plan: Plan) -> int:
    """What the teacher would do: a way to food no cell of which is within 3 moves of an enemy, else 2, else 1.

    Where there is none, whatever leads farthest from the nearest enemy; the first of those that tie.
    """
    for care in range(_CARE, 0, -1):
        action = _towards_food(world, plan, care)
        if action >= 0:
            return action
    best, farthest = 0, -1
    for a in range(NUM_MOVES):
        row, column = world.agent[ROW] + DOWN[a], world.agent[COLUMN] + RIGHT[a]
        if world.obstacles[row, column] == 0:
            away = _distance(world, row, column)
            if away > farthest:
                best, farthest = a, away
    return best


@lean_kernel
def _distance(world: World, row: int, column: int) -> int:
    """Moves to the nearest enemy, were there no obstacles."""
    nearest = world.obstacles.size
    for i in range(len(world.enemies)):
        nearest = min(nearest, abs(world.enemies[i, 0] - row) + abs(world.enemies[i, 1] - column))
    return nearest


@lean_kernel
def _towards_food(world: World, plan: Plan, care: int) -> int:
    """The first move of a shortest such way, or −1."""
    plan.first[:, :] = -1
    plan.queue[0, 0], plan.queue[0, 1] = world.agent[ROW], world.agent[COLUMN]
    plan.first[world.agent[ROW], world.agent[COLUMN]] = NUM_MOVES
    taken, put = 0, 1
    while taken < put:
        row, column = plan.queue[taken, 0], plan.queue[taken, 1]
        first = plan.first[row, column]
        if world.food[row, column] == 1:
            return int(first)
        taken += 1
        for a in range(NUM_MOVES):
            to_row, to_column = row + DOWN[a], column + RIGHT[a]
            if plan.first[to_row, to_column] < 0 and world.obstacles[to_row, to_column] == 0:
                if _distance(world, to_row, to_column) > care:
                    plan.first[to_row, to_column] = a if first == NUM_MOVES else first
                    plan.queue[put, 0], plan.queue[put, 1] = to_row, to_column
                    put += 1
    return -1

"""Action models: what the other actions would have led to, learned and imagined, to learn from that too.

The agent knows what its own moves do; what enemies do it counts, by where it stands relative to one. Before each move
it imagines, for every other action that it might well have taken, where that could lead, and moves Q towards the mean
of what it would then be told: relaxation planning. The agent is told more than its sensors tell, where enemies stand.

Source: Lin 1992, QCON-M.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.learners.turned import TurnedNetwork, turned_policy, turned_update, turned_values
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.lin_world.board import copied_world
from neuralq_envs.lin_world.kernels import (
    ATE,
    CAUGHT,
    COLUMN,
    DOWN,
    NUM_MOVES,
    RIGHT,
    ROW,
    World,
    move,
    reward_of,
    sense,
)

__all__ = ["EnemyModel", "count_moves", "new_enemy_model", "plan"]

_SIGHT = 6
"""Rows and columns up to which places are told apart."""
_SAMPLES = 3


class EnemyModel(NamedTuple):
    """How often an enemy went where (four directions, and staying), and room to imagine.

    Args:
        counts: by rows and columns from it to the agent, ``[13, 13, 5]``; 1 before anything was seen.
        before: where enemies were, ``[E, 2]``.
        imagined: another world.
        still: numbers with which no enemy moves, ``[2 E]``.
        x: what would be seen there, ``[145]``.
    """

    counts: NDArray[np.float64]
    before: NDArray[np.int64]
    imagined: World
    still: NDArray[np.float64]
    x: NDArray[np.int8]


def new_enemy_model(world: World, num_bits: int) -> EnemyModel:
    """A model that expects everything.

    Example:
        >>> from neuralq_envs.lin_world.board import new_world
        >>> new_enemy_model(new_world(), 145).counts.shape
        (13, 13, 5)
    """
    places = 2 * _SIGHT + 1
    return EnemyModel(
        np.ones((places, places, NUM_MOVES + 1)), world.starts.copy(), copied_world(world),
        np.ones(2 * len(world.starts)), np.zeros(num_bits, np.int8),
    )  # fmt: skip


@lean_kernel
def _place(world: World, row: int, column: int) -> tuple[int, int]:
    """Where the agent is for an enemy there, as far as it is told apart."""
    down, right = world.agent[ROW] - row, world.agent[COLUMN] - column
    return min(max(down, -_SIGHT), _SIGHT) + _SIGHT, min(max(right, -_SIGHT), _SIGHT) + _SIGHT


@lean_kernel
def count_moves(model: EnemyModel, world: World) -> None:
    """Counts how enemies came from ``model.before`` to where they are."""
    for i in range(len(world.enemies)):
        row, column = model.before[i, 0], model.before[i, 1]
        went_down, went_right = world.enemies[i, 0] - row, world.enemies[i, 1] - column
        way = NUM_MOVES
        for a in range(NUM_MOVES):
            if went_down == DOWN[a] and went_right == RIGHT[a]:
                way = a
        down, right = _place(world, row, column)
        model.counts[down, right, way] += 1.0


@lean_kernel
def plan(
    model: EnemyModel,
    world: World,
    network: TurnedNetwork,
    x: NDArray[np.int8],
    chosen: int,
    temperature: float,
    least_chance: float,
    step_size: float,
    gamma: float,
    rng: NDArray[np.uint64],
) -> None:
    """Moves the values of the other likely actions towards what the model says that they would lead to.

    Args:
        model: its counts are read, the rest is written.
        world: as it is before the move.
        network: of values; changed in place.
        x: what is seen, ``[145]``.
        chosen: the action that is tried out in earnest.
        temperature: of the policy.
        least_chance: actions of a smaller probability are left out.
        step_size: α.
        gamma: γ.
        rng: a stream; advanced.
    """
    for a in range(NUM_MOVES):
        if a != chosen and turned_policy(network, x, a, temperature) >= least_chance:
            target = 0.0
            for _ in range(_SAMPLES):
                found = _imagine(model, world, a, rng)
                target += reward_of(found)
                if found <= ATE:
                    sense(model.imagined, model.x)
                    target += gamma * turned_values(network, model.x)
            turned_update(network, x, a, target / _SAMPLES, step_size)


@lean_kernel
def _imagine(model: EnemyModel, world: World, action: int, rng: NDArray[np.uint64]) -> int:
    """What an action could lead to, in another world."""
    other = model.imagined
    for row in range(world.food.shape[0]):
        for column in range(world.food.shape[1]):
            other.food[row, column] = world.food[row, column]
            other.guarded[row, column] = world.guarded[row, column]
    for i in range(len(world.agent)):
        other.agent[i] = world.agent[i]
    for i in range(len(world.enemies)):
        other.enemies[i, 0], other.enemies[i, 1] = world.enemies[i, 0], world.enemies[i, 1]
    found = move(other, action, model.still)
    if found > ATE:
        return found
    for i in range(len(other.enemies)):
        down, right = _place(other, other.enemies[i, 0], other.enemies[i, 1])
        left, way = uniform(rng) * model.counts[down, right].sum(), 0
        while way < NUM_MOVES and left >= model.counts[down, right, way]:
            left -= model.counts[down, right, way]
            way += 1
        if way < NUM_MOVES:
            row, column = other.enemies[i, 0] + DOWN[way], other.enemies[i, 1] + RIGHT[way]
            if other.obstacles[row, column] == 0 and other.guarded[row, column] == 0:
                other.guarded[other.enemies[i, 0], other.enemies[i, 1]] = 0
                other.guarded[row, column] = 1
                other.enemies[i, 0], other.enemies[i, 1] = row, column
                if row == other.agent[ROW] and column == other.agent[COLUMN]:
                    return CAUGHT
    return found

"""What must be exact: bits turn with the world, enemies move by their law, and one is caught when the law says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.learners.turned import new_turned_network, turned_values
from neuralq.runs.report.claims import Row, claim, number
from neuralq_envs.lin_world.board import new_world
from neuralq_envs.lin_world.kernels import (
    COLUMN,
    DOWN,
    LAST,
    NUM_MOVES,
    RIGHT,
    ROW,
    World,
    enemy_chances,
    sense,
    settle,
)
from neuralq_envs.lin_world.sensors import NUM_BITS, turns

__all__ = ["CATCH_STEPS", "catch_steps", "enemy_law", "oracle", "turned_mismatches", "unturned_spread"]

CATCH_STEPS = 5.8157
"""Steps until a lone enemy catches who stands in the other corner of a closed room of nine cells."""


def oracle() -> tuple[Row, ...]:
    """As rows."""
    return (
        number("bits that differ after the world and the agent have turned", 0.0, turned_mismatches(), tol=0.0,
               note="200 random worlds, three turns each"),
        *(
            number(f"enemy {cells} cells from the agent goes {name}", chance, ours, tol=5e-6)
            for cells, law in ((3, (0.77208, 0.1066, 0.01472)), (20, (0.29285, 0.24831, 0.21054)))
            for name, chance, ours in zip(("there", "aside", "away"), law, enemy_law(cells)[:3], strict=True)
        ),
        number("mean steps to be caught in a closed room of 3 x 3", CATCH_STEPS, catch_steps(), tol=5e-5,
               note="linear equations over the enemy's eight cells"),
        claim("values of the four actions where nothing is turned", "equal", unturned_spread(), unturned_spread() == 0,
              "one network, so nothing can be learned"),
    )  # fmt: skip


def random_world(rng: np.random.Generator) -> World:
    """The board with obstacles, food and enemies anywhere, the agent too, and whatever it did last.

    Example:
        >>> random_world(np.random.default_rng(0)).food.shape
        (49, 49)
    """
    world = new_world()
    inside = (slice(12, -12),) * 2
    world.obstacles[inside] = rng.random((25, 25)) < 0.3
    world.food[inside] = rng.random((25, 25)) < 0.05
    world.guarded[inside] = rng.random((25, 25)) < 0.05
    world.agent[:] = *rng.integers(12, 37, 2), rng.integers(0, 80), rng.integers(-1, 4), rng.integers(2), 0
    return world


def turned_world(world: World, quarters: int) -> World:
    """The world turned against the clock, so that what was east is north after one quarter.

    Example:
        >>> world = random_world(np.random.default_rng(0))
        >>> turned_world(world, 1).agent[ROW] == 48 - world.agent[COLUMN]
        np.True_
    """
    agent = world.agent.copy()
    for _ in range(quarters):
        agent[ROW], agent[COLUMN] = len(world.food) - 1 - agent[COLUMN], agent[ROW]
        agent[LAST] = (agent[LAST] - 1) % NUM_MOVES if agent[LAST] >= 0 else -1
    obstacles, food, guarded = (
        np.ascontiguousarray(np.rot90(layer, quarters)) for layer in (world.obstacles, world.food, world.guarded)
    )
    return world._replace(obstacles=obstacles, food=food, guarded=guarded, agent=agent)


def _bits(world: World) -> NDArray[np.int8]:
    bits = np.zeros(NUM_BITS, np.int8)
    sense(world, bits)
    return bits


def turned_mismatches(num_worlds: int = 200) -> int:
    """Bits that are not where `turns` says, over random worlds and three turns of each.

    Example:
        >>> turned_mismatches(5)
        0
    """
    rng, places, wrong = np.random.default_rng(0), turns(), 0
    for _ in range(num_worlds):
        world = random_world(rng)
        bits = _bits(world)
        for action in range(1, NUM_MOVES):
            wrong += int((_bits(turned_world(world, action))[places[action]] != bits).sum())
    return wrong


def enemy_law(cells: int) -> tuple[float, ...]:
    """How likely an enemy so many cells south of the agent goes north, east, south and west if it moves.

    Example:
        >>> [round(chance, 4) for chance in enemy_law(3)]
        [0.7721, 0.1066, 0.0147, 0.1066]
    """
    world = new_world("\n".join(["...", ".I.", *["..."] * (cells - 1), ".E.", "..."]))
    settle(world, np.zeros(0))
    enemy_chances(world, 0)
    return tuple(world.chances.tolist())


def catch_steps() -> float:
    """Mean steps until an enemy catches who stays in the south-west corner of nine cells, from the north-east one.

    Example:
        >>> round(catch_steps(), 4)
        5.8157
    """
    world = new_world("..E\n...\nI..")
    settle(world, np.zeros(0))
    corner = world.agent[[ROW, COLUMN]] - (2, 0)
    stays = np.eye(9)
    for cell in range(9):
        if cell == 6:
            continue  # there the agent is
        world.enemies[0] = corner + np.divmod(cell, 3)
        world.guarded[:] = 0
        enemy_chances(world, 0)
        stays[cell, cell] -= 0.2
        for a, chance in enumerate(world.chances):
            to = cell + 3 * DOWN[a] + RIGHT[a]
            if chance > 0:
                stays[cell, to] -= 0.8 * chance
    others = [cell for cell in range(9) if cell != 6]
    return float(np.linalg.solve(stays[np.ix_(others, others)], np.ones(8))[2])


def unturned_spread() -> float:
    """The largest difference between two actions' values for one network that looks in one direction only.

    Example:
        >>> unturned_spread()
        0.0
    """
    rng = np.random.default_rng(0)
    network = new_turned_network(np.tile(np.arange(NUM_BITS), (NUM_MOVES, 1)), 30, rng)
    turned_values(network, _bits(random_world(rng)))
    return float(np.ptp(network.q))

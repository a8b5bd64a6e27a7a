"""What is exactly known of the M: steps with the cell in sight, with memory, and by a coin for each percept."""

from __future__ import annotations

import numpy as np

from neuralq.exact import best_memoryless, evaluate_memoryless, solve, solve_histories
from neuralq.mdp import AliasedMDP
from neuralq.runs.report.claims import Row, claim, number
from neuralq_envs.aliased import mccallum

__all__ = ["BEST", "COIN", "best_coin", "oracle", "step_costs", "tossed"]

BEST, COIN = 4.3, 8.03
"""Mean steps of who remembers everything, and of the best coins; computed with every page."""


def step_costs() -> AliasedMDP:
    """The maze in which every step costs 1.

    Example:
        >>> float(step_costs().mdp.reward.max())
        -1.0
    """
    return mccallum(step_reward=-1.0, goal_reward=-1.0, bump_reward=-1.0)


def tossed(north: float, east: float) -> float:
    """Mean steps of a policy that goes north, else south, in the strokes and east, else west, at the top.

    Example:
        >>> round(tossed(0.5, 0.5), 2)
        8.3
    """
    maze = step_costs()
    policy = np.zeros((maze.num_observations, 4))
    policy[maze.observation[[0, 2, 4, 10]], [1, 2, 3, 0]] = 1.0  # the corners, the middle, the feet
    policy[maze.observation[5], [0, 2]] = north, 1 - north
    policy[maze.observation[1], [1, 3]] = east, 1 - east
    return -float(maze.mdp.start_distribution @ evaluate_memoryless(maze, policy, 1.0))


def best_coin() -> float:
    """The least of `tossed` over a grid of .05, from .2 to .8.

    Example:
        >>> round(best_coin(), 2)
        8.03
    """
    chances = np.arange(0.2, 0.81, 0.05)
    return min(tossed(north, east) for north in chances for east in chances)


def oracle() -> tuple[Row, ...]:
    """As rows."""
    maze = step_costs()
    beliefs, certain = solve_histories(maze, 1.0), best_memoryless(maze, 1.0)
    return (
        number("mean steps, who sees the cell", 3.9, -float(solve(maze.mdp, 1.0).v.sum() / 10)),
        number("mean steps, who remembers", BEST, -beliefs.value, note=f"over {len(beliefs.beliefs)} beliefs"),
        number("mean steps, a coin for each percept", COIN, best_coin(), tol=5e-3, note="the best of a grid of .05"),
        claim(
            "percepts alone, without a coin",
            "never arrives from everywhere",
            "proved" if certain.proved and certain.value == -np.inf else "not proved",
            certain.proved and certain.value == -np.inf,
            f"{certain.num_bounds} bounds",
        ),
    )

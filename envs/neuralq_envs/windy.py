"""The windy grid world (Sutton & Barto 2018, example 6.5 and exercise 6.9): 7 x 10 cells, −1 a step, a cross-wind.

The wind of the column that is left pushes up by 0 to 2 cells. With four moves the shortest way from S to G takes 15
steps, with the eight moves of a king 7.
"""

from __future__ import annotations

from neuralq.mdp import FiniteMDP
from neuralq_envs.grids import Grid
from neuralq_envs.rendering import factories

__all__ = ["GAMMA", "WIND", "grid", "make", "make_vector", "mdp"]

GAMMA = 1.0
WIND = (0, 0, 0, 1, 1, 1, 2, 2, 1, 0)
_LAYOUT = "\n".join(["." * 10] * 3 + ["S......G.."] + ["." * 10] * 3)


def grid(num_moves: int = 4) -> Grid:
    """The map with its wind, and 4 or 8 moves.

    Raises:
        ValueError: another number of moves.

    Example:
        >>> grid().num_rows, grid().num_columns
        (7, 10)
    """
    return Grid(_LAYOUT, step_reward=-1.0, goal_reward=-1.0, wind=WIND, num_moves=num_moves)


def mdp(num_moves: int = 4) -> FiniteMDP:
    """The exact model.

    Example:
        >>> mdp().num_rows  # 69 cells other than G, four moves each
        276
        >>> make(num_moves=8).action_space
        Discrete(8)
    """
    return grid(num_moves).mdp()


make, make_vector = factories(mdp, grid)

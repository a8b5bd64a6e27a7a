"""The grid worlds of Mitchell 1997, Figure 13.2 and exercise 13.2: two rows of three cells and a goal G.

Cells are numbered row by row from the top left; actions are north, east, south, west. Entering G pays and ends the
episode, every other move pays 0. Moves off the grid are not legal, and no action leaves G. Episodes start in a random
cell other than G.

* Figure 13.2: G in the top right corner, reward 100, 12 state-action pairs (seven borders between cells, crossed either
  way, less the two ways out of G). With γ = 0.9 the figure shows V* = [[90, 100, 0], [81, 90, 100]].
* Exercise 13.2: reward 10, γ = 0.8; the goal cell is a parameter. With G at the bottom middle
  V* = [[8, 10, 8], [10, 0, 10]].
"""

from __future__ import annotations

from neuralq.mdp import FiniteMDP
from neuralq_envs.grids import ACTIONS as _ALL_ACTIONS
from neuralq_envs.grids import Grid
from neuralq_envs.rendering import factories

__all__ = [
    "ACTIONS",
    "EXERCISE_GAMMA",
    "EXERCISE_GOAL",
    "EXERCISE_REWARD",
    "GAMMA",
    "GOAL",
    "GOAL_REWARD",
    "NUM_COLUMNS",
    "NUM_ROWS",
    "grid",
    "make",
    "make_vector",
    "mdp",
]

NUM_ROWS, NUM_COLUMNS = 2, 3
ACTIONS = _ALL_ACTIONS[:4]
GOAL, GOAL_REWARD, GAMMA = 2, 100.0, 0.9
EXERCISE_GOAL, EXERCISE_REWARD, EXERCISE_GAMMA = 4, 10.0, 0.8


def grid(goal: int = GOAL, goal_reward: float = GOAL_REWARD) -> Grid:
    """The map with G in cell ``goal``.

    Raises:
        ValueError: a goal that is not one of the cells 0 to 5.

    Example:
        >>> grid(goal=4).layout.split()
        ['...', '.G.']
    """
    if goal not in range(NUM_ROWS * NUM_COLUMNS):
        raise ValueError(f"goal must be a cell of 0..{NUM_ROWS * NUM_COLUMNS - 1}, row by row, got {goal!r}")
    signs = "".join("G" if s == goal else "." for s in range(NUM_ROWS * NUM_COLUMNS))
    return Grid(f"{signs[:NUM_COLUMNS]}\n{signs[NUM_COLUMNS:]}", goal_reward=goal_reward, blocked="illegal")


def mdp(goal: int = GOAL, goal_reward: float = GOAL_REWARD) -> FiniteMDP:
    """The exact model: Figure 13.2 as it stands, exercise 13.2 with another goal and reward.

    Example:
        >>> mdp().num_rows
        12
        >>> mdp(goal=EXERCISE_GOAL, goal_reward=EXERCISE_REWARD).num_rows
        11
    """
    return grid(goal, goal_reward).mdp()


make, make_vector = factories(mdp, grid)

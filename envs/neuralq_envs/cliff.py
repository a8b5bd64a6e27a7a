"""The cliff (Sutton & Barto 2018, example 6.6): 4 x 12 cells, −1 a step, −100 and back to the start over the edge.

The shortest way along the edge takes 13 steps: the optimal return is −13 (γ = 1).
"""

from __future__ import annotations

from neuralq.mdp import FiniteMDP
from neuralq_envs.grids import Grid
from neuralq_envs.rendering import factories

__all__ = ["GAMMA", "GRID", "make", "make_vector", "mdp"]

GAMMA = 1.0
GRID = Grid(
    """
    ............
    ............
    ............
    SCCCCCCCCCCG
    """,
    step_reward=-1.0,
    goal_reward=-1.0,
    cliff_reward=-100.0,
)


def mdp() -> FiniteMDP:
    """The exact model; the ten cells of the cliff are states that nobody enters.

    Example:
        >>> mdp().num_states, mdp().num_rows
        (48, 148)
        >>> env = make()
        >>> env.reset(seed=0)[0], env.step(1)[:3]  # east of the start is the cliff
        (36, (36, -100.0, False))
    """
    return GRID.mdp()


make, make_vector = factories(mdp, lambda: GRID)

"""Any grid world from a text map; the signs of a map and the rules of a move are those of `neuralq_envs.grids.Grid`.

The default map is the 4 x 3 world of Russell & Norvig (Artificial Intelligence: A Modern Approach). With their rewards
(step −.04, goal and trap ±1 on top), slip .2 and γ = 1 its values are .812 .868 .918 / .762 .660 / .705 .655 .611 .388.
"""

from __future__ import annotations

from functools import partial

from neuralq.mdp import FiniteMDP
from neuralq_envs.grids import Grid
from neuralq_envs.rendering import factories

__all__ = ["LAYOUT", "make", "make_vector", "mdp"]

LAYOUT = """
...G
.#.T
S...
"""


def mdp(grid: Grid | None = None) -> FiniteMDP:
    r"""The exact model of a grid world; default: the one that is registered.

    Example:
        >>> mdp(Grid("S..\n.#G", slip=0.1)).num_states
        6
        >>> import gymnasium  # every parameter of `Grid` is one of the environment
        >>> gymnasium.make("neuralq/Gridworld-v0", layout="S....\n.##.G", slip=0.2).observation_space
        Discrete(10)
    """
    return (_grid() if grid is None else grid).mdp()


_grid = partial(Grid, layout=LAYOUT)
make, make_vector = factories(lambda **parameters: _grid(**parameters).mdp(), _grid, _grid)

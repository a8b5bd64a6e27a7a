"""The Dyna maze (Sutton 1990; Sutton & Barto 2018, example 8.1): 6 x 9 cells, seven of them walls, 1 for reaching G.

From S = (2, 0) the goal G = (0, 8) is 14 steps away. Littman 1994 starts anywhere: the shortest ways from the 46 free
cells other than G take 404 steps together.
"""

from __future__ import annotations

from neuralq.mdp import FiniteMDP
from neuralq_envs.grids import Grid
from neuralq_envs.rendering import factories

__all__ = ["GAMMA", "grid", "make", "make_vector", "mdp"]

GAMMA = 0.95
_LAYOUT = """
.......#G
..#....#.
S.#....#.
..#......
.....#...
.........
"""


def grid(random_start: bool = False) -> Grid:
    """The maze; with ``random_start`` episodes start in any free cell but G, as Littman's do.

    Example:
        >>> sum(sign != "#" for sign in grid().signs)
        47
    """
    return Grid(_LAYOUT.replace("S", ".") if random_start else _LAYOUT)


def mdp(random_start: bool = False) -> FiniteMDP:
    """The exact model.

    Example:
        >>> import numpy as np
        >>> np.flatnonzero(mdp().start_distribution).tolist(), len(np.flatnonzero(mdp(True).start_distribution))
        ([18], 46)
    """
    return grid(random_start).mdp()


make, make_vector = factories(mdp, grid)

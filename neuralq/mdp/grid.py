"""Where the states of a grid lie, read off the model or the environment, so that values can be drawn as a map."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.mdp.model import FiniteMDP

__all__ = ["GridPlan", "grid_plan"]

_MOST_COLUMNS = 16
_COMPASS = ("north", "east", "south", "west")
# Moves of Gymnasium's own grids, in the order of their action numbers: left, down, right, up, and clockwise from up.
_FROZEN_LAKE, _CLIFF_WALKING = (3, 2, 1, 0), (0, 1, 2, 3)


@dataclass(frozen=True)
class GridPlan:
    """How the states of a model lie on a grid, row by row from the top left.

    Args:
        num_columns: width.
        directions: where each action goes: 0 north, 1 east, 2 south, 3 west.
        signs: one sign per cell; a space where the cell has none.
        walls: cells that nothing leads to and nothing leaves, ``[S]``.
    """

    num_columns: int
    directions: tuple[int, ...]
    signs: str
    walls: NDArray[np.bool_]


def grid_plan(env: Any, mdp: FiniteMDP) -> GridPlan | None:
    """The plan of a model, from the names of its states, or from what Gymnasium's own grids say; None without one.

    Args:
        env: the environment without its wrappers.
        mdp: its model.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("FrozenLake-v1")
        >>> plan = grid_plan(env.unwrapped, FiniteMDP.from_gymnasium(env, check=False))
        >>> plan.num_columns, plan.signs
        (4, '     H H   HH  G')
    """
    found = _found(env, mdp)
    if found is None:
        return None
    entered = np.zeros(mdp.num_states, dtype=bool)
    entered[mdp.transition.indices if mdp.outcomes is None else mdp.outcomes.s_t] = True
    return GridPlan(*found, mdp.is_terminal & ~entered)


def _found(env: Any, mdp: FiniteMDP) -> tuple[int, tuple[int, ...], str] | None:
    """Width, directions and signs."""
    desc, shape = getattr(env, "desc", None), getattr(env, "shape", None)
    if mdp.state_names is not None:
        return _named(mdp)
    if isinstance(desc, np.ndarray) and desc.size == mdp.num_states and mdp.num_actions == 4:
        signs = "".join(desc.astype(str).reshape(-1).tolist())
        return desc.shape[1], _FROZEN_LAKE, re.sub("[^GH]", " ", signs)
    if isinstance(shape, tuple) and len(shape) == 2 and np.prod(shape) == mdp.num_states and mdp.num_actions == 4:
        return int(shape[1]), _CLIFF_WALKING, " " * mdp.num_states
    return None


def _named(mdp: FiniteMDP) -> tuple[int, tuple[int, ...], str] | None:
    """States called "row i, column j", row by row."""
    found = [re.fullmatch(r"row (\d+), column (\d+)", name) for name in mdp.state_names or ()]
    places = [(int(match[1]), int(match[2])) for match in found if match is not None]
    num_columns = 1 + max((column for _, column in places), default=-1)
    in_order = [(s // num_columns, s % num_columns) for s in range(mdp.num_states)] if num_columns else []
    names = mdp.action_names or ()
    if not in_order or places != in_order or num_columns > _MOST_COLUMNS or set(names) != set(_COMPASS):
        return None
    return num_columns, tuple(map(_COMPASS.index, names)), " " * mdp.num_states

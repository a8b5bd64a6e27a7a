"""Mazes in which cells look alike: what is observed is which of the neighbouring cells are walls, and nothing else.

* **Littman's maze** (Littman 1994): Sutton's of 46 cells and a goal, seen through the 8 neighbours: 30 percepts. A step
  costs 1. The shortest ways from everywhere take 404 steps together; the best policy that acts on the percept alone
  takes 416.
* **McCallum's maze** (McCallum 1995), an M of 11 cells with the goal at the foot of its middle stroke, seen through 4
  neighbours: 6 percepts. The goal pays 5, a bump costs 1, any other step .1. From everywhere else the shortest ways
  take 3.9 steps in the mean, whoever remembers what it saw can do with 4.3, and no policy of the percept alone that
  leaves nothing to chance ever arrives from everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq.mdp import AliasedMDP
from neuralq_envs import dyna
from neuralq_envs.grids import Grid
from neuralq_envs.rendering import RenderedEnv, Scene

__all__ = ["AliasedGridEnv", "littman", "littman_grid", "make", "mccallum", "mccallum_grid", "walked"]

_M = """
.....
.#.#.
.#G#.
"""


def littman_grid() -> Grid:
    """Sutton's maze with any free cell as a start; each step costs 1, the last one too.

    Example:
        >>> float(littman_grid().mdp().reward.max())
        -1.0
    """
    layout = dyna.grid(random_start=True).layout
    return Grid(layout, step_reward=-1.0, goal_reward=-1.0)


def littman() -> AliasedMDP:
    """Littman's maze through the eight neighbours of each cell.

    Example:
        >>> maze = littman()
        >>> int(maze.legal.any(axis=1).sum())
        30
    """
    return AliasedMDP(littman_grid().mdp(), littman_grid().percepts(8))


def mccallum_grid(step_reward: float = -0.1, goal_reward: float = 5.0, bump_reward: float = -1.0) -> Grid:
    """The M with what a step, the goal and a bump pay.

    Example:
        >>> int((mccallum_grid().mdp().start_distribution > 0).sum())
        10
    """
    return Grid(_M, step_reward=step_reward, goal_reward=goal_reward, bump_reward=bump_reward)


def mccallum(step_reward: float = -0.1, goal_reward: float = 5.0, bump_reward: float = -1.0) -> AliasedMDP:
    """McCallum's maze through the four neighbours of each cell.

    Example:
        >>> mccallum().num_observations
        6
    """
    grid = mccallum_grid(step_reward, goal_reward, bump_reward)
    return AliasedMDP(grid.mdp(), grid.percepts(4))


def walked(maze: AliasedMDP, policy: NDArray[np.int64], lost: int) -> NDArray[np.int64]:
    """Steps from each start by a policy of what is seen, in a maze where nothing is left to chance.

    Args:
        maze: the maze.
        policy: an action for each observation, ``[O]``.
        lost: said of a start from which it never arrives, or takes longer.

    Example:
        >>> walked(mccallum(), np.array([1, 1, 2, 3, 0, 0]), 200).tolist()
        [200, 200, 200, 200, 200, 200, 200, 200, 200, 200]
    """
    mdp = maze.mdp
    rows = mdp.row_index[np.arange(mdp.num_states), policy[maze.observation]]
    s_t = np.where(mdp.termination[rows] < 0.5, np.asarray(mdp.transition.argmax(axis=1)).reshape(-1)[rows], -1)
    found = []
    for s in np.flatnonzero(mdp.start_distribution).tolist():
        steps = 0
        while s >= 0 and steps <= mdp.num_states:
            s, steps = int(s_t[s]), steps + 1
        found.append(lost if s >= 0 else min(steps, lost))
    return np.array(found)


class AliasedGridEnv(gymnasium.Env[Any, Any]):
    """A grid of which the percept of the present cell is observed; ``info["state"]`` is the cell.

    Args:
        model: the grid's model with its percepts.
        grid: the grid, or what else shows a cell.
        render_mode: None, ``"ansi"`` or ``"rgb_array"``; both show the cell.
        num_observations: if there are more than occur here.

    Raises:
        ValueError: another render mode.

    Example:
        >>> env = AliasedGridEnv(mccallum(), mccallum_grid())
        >>> [env.reset(options={"state": cell})[0] for cell in (5, 7, 9, 2)]
        [4, 4, 4, 2]
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(
        self, model: AliasedMDP, grid: Scene, render_mode: str | None = None, num_observations: int | None = None
    ) -> None:
        self._cells = RenderedEnv(model.mdp, grid, render_mode)
        self.render_mode = render_mode
        self.model = model
        self.observation_space = Discrete(num_observations or model.num_observations)
        self.action_space = Discrete(model.mdp.num_actions)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """A first cell drawn from the starts, or ``options["state"]``."""
        super().reset(seed=seed)
        self._cells.np_random = self.np_random
        s, extra = self._cells.reset(options=options)
        return self._seen(s, extra)

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """One move.

        Raises:
            ResetNeeded: before the first reset, or after the goal.
            ValueError: an action outside the space.
        """
        s, reward, terminated, truncated, extra = self._cells.step(action)
        o, extra = self._seen(s, extra)
        return o, reward, terminated, truncated, extra

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode."""
        return self._cells.render()

    def _seen(self, s: int, extra: dict[str, Any]) -> tuple[int, dict[str, Any]]:
        return int(self.model.observation[s]), {**extra, "state": s}


_MAZES: dict[str, tuple[Callable[[], AliasedMDP], Callable[[], Grid]]] = {
    "littman": (littman, littman_grid),
    "mccallum": (mccallum, mccallum_grid),
}


def make(render_mode: str | None = None, maze: str = "littman") -> AliasedGridEnv:
    """What ``gymnasium.make`` calls for ``neuralq/LittmanMaze-v0`` and ``neuralq/McCallumMaze-v0``.

    Raises:
        ValueError: another maze.

    Example:
        >>> make(maze="mccallum").observation_space
        Discrete(6)
    """
    check_choice("maze", maze, _MAZES)
    model, grid = _MAZES[maze]
    return AliasedGridEnv(model(), grid(), render_mode)

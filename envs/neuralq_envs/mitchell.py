"""The grid world of Mitchell 1997, Figure 13.2: two rows of three cells, the goal G in the top right corner.

Cells are numbered row by row from the top left; actions are north, east, south, west. Entering G pays 100 and ends the
episode, every other move pays 0. Moves off the grid are not legal, and no action leaves G: 12 state-action pairs (seven
borders between cells, crossed either way, less the two ways out of G).
Episodes start in a random cell other than G. With γ = 0.9 the figure shows V* = [[90, 100, 0], [81, 90, 100]].
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq.mdp import FiniteMDP
from neuralq.simulate import ModelVectorEnv

__all__ = ["ACTIONS", "GOAL", "NUM_COLUMNS", "NUM_ROWS", "MitchellGrid", "make", "make_vector", "mdp"]

NUM_ROWS, NUM_COLUMNS = 2, 3
GOAL = 2
ACTIONS = ("north", "east", "south", "west")
_MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
_GOAL_REWARD = 100.0
_CELL = 48  # pixels
_PAPER, _LINE, _GREEN, _BLUE = (255, 255, 255), (70, 70, 70), (170, 215, 170), (40, 90, 190)


def mdp() -> FiniteMDP:
    """The exact model of Figure 13.2, with its 12 legal pairs.

    Example:
        >>> mdp().num_rows
        12
    """

    def target(s: int, a: int) -> int | None:
        row, column = s // NUM_COLUMNS + _MOVES[a][0], s % NUM_COLUMNS + _MOVES[a][1]
        return row * NUM_COLUMNS + column if 0 <= row < NUM_ROWS and 0 <= column < NUM_COLUMNS else None

    def actions(s: int) -> list[int]:
        return [] if s == GOAL else [a for a in range(len(ACTIONS)) if target(s, a) is not None]

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        s_t = target(s, a)
        assert s_t is not None
        return [(1.0, s_t, _GOAL_REWARD if s_t == GOAL else 0.0, s_t == GOAL)]

    names = [f"row {s // NUM_COLUMNS}, column {s % NUM_COLUMNS}" for s in range(NUM_ROWS * NUM_COLUMNS)]
    return FiniteMDP.from_functions(
        NUM_ROWS * NUM_COLUMNS, len(ACTIONS), actions, transitions, state_names=names, action_names=ACTIONS
    )


class MitchellGrid(gymnasium.Env[Any, Any]):
    """Figure 13.2 as an environment; ``info["action_mask"]`` names the moves that stay on the grid.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.

    Raises:
        ValueError: another render mode.

    Example:
        >>> env = MitchellGrid()
        >>> env.reset(seed=0)[1]["action_mask"].shape
        (4,)
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        self.render_mode = render_mode
        self._model = mdp().as_env()
        self.observation_space = Discrete(NUM_ROWS * NUM_COLUMNS)
        self.action_space = Discrete(len(ACTIONS))
        self._cell: int | None = None

    def mdp(self) -> FiniteMDP:
        """The exact model."""
        return self._model.mdp()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """A random cell other than G."""
        super().reset(seed=seed)
        self._model.np_random = self.np_random  # one generator, so that the seed decides everything
        self._cell, extra = self._model.reset()
        return self._cell, extra

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """One move; a move off the grid stays, with reward 0."""
        self._cell, reward, terminated, truncated, extra = self._model.step(action)
        return self._cell, reward, terminated, truncated, extra

    def render(self) -> Any:
        """The grid with the agent in it: text for ``ansi``, uint8 ``[96, 144, 3]`` for ``rgb_array``."""
        if self.render_mode == "ansi":
            return _text(self._cell)
        if self.render_mode == "rgb_array":
            return _pixels(self._cell)
        return None


def make(render_mode: str | None = None) -> MitchellGrid:
    """What ``gymnasium.make("neuralq/MitchellGrid-v0")`` calls.

    Example:
        >>> make().action_space
        Discrete(4)
    """
    return MitchellGrid(render_mode)


def make_vector(num_envs: int = 1, max_episode_steps: int | None = None) -> ModelVectorEnv:
    """What ``gymnasium.make_vec`` calls in mode ``"vector_entry_point"``: array operations, autoreset disabled.

    Example:
        >>> make_vector(num_envs=5).reset(seed=0)[0].shape
        (5,)
    """
    return mdp().as_vector_env(num_envs, max_episode_steps=max_episode_steps)


def _text(cell: int | None) -> str:
    signs = ["G" if s == GOAL else "." for s in range(NUM_ROWS * NUM_COLUMNS)]
    if cell is not None:
        signs[cell] = "A"
    return "".join(" ".join(signs[i : i + NUM_COLUMNS]) + "\n" for i in range(0, len(signs), NUM_COLUMNS))


def _pixels(cell: int | None) -> NDArray[np.uint8]:
    picture = np.full((NUM_ROWS * _CELL, NUM_COLUMNS * _CELL, 3), _PAPER, dtype=np.uint8)
    across = np.arange(_CELL) - (_CELL - 1) / 2
    disk = across[:, None] ** 2 + across**2 < (0.3 * _CELL) ** 2
    for s in range(NUM_ROWS * NUM_COLUMNS):
        top, left = s // NUM_COLUMNS * _CELL, s % NUM_COLUMNS * _CELL
        square = picture[top : top + _CELL, left : left + _CELL]  # a view: drawn in place
        if s == GOAL:
            square[:] = _GREEN
        if s == cell:
            square[disk] = _BLUE
        square[[0, -1]] = _LINE
        square[:, [0, -1]] = _LINE
    return picture

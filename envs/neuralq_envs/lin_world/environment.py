"""Lin's world as an environment of Gymnasium (`neuralq/LinWorld-v0`)."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Discrete, MultiBinary
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq_envs.lin_world.board import BOARD, ENERGY_AT_START, NUM_FOOD, copied_world, new_world
from neuralq_envs.lin_world.drawing import board_picture, board_text
from neuralq_envs.lin_world.kernels import (
    ATE,
    CAUGHT,
    CLEARED,
    ENERGY,
    LEFT,
    NUM_MOVES,
    STARVED,
    World,
    move,
    reward_of,
    sense,
    settle,
)
from neuralq_envs.lin_world.sensors import NUM_BITS, REACH

__all__ = ["LinWorldEnv", "make"]

_OUTCOMES = {"ate": (ATE, CLEARED), "caught": (CAUGHT,), "starved": (STARVED,)}


class LinWorldEnv(gymnasium.Env[Any, Any]):
    """An agent that looks for food among obstacles and enemies; observations are its 145 bits.

    Actions: north, east, south, west. Food earns .4, being caught or starving costs 1. ``info`` has whether the agent
    ate, was caught or starved in this step, its energy, and how much food is left. A play ends with either of the last
    two or when everything is eaten; on the board of the paper that takes at most 250 steps.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.
        board: as `neuralq_envs.lin_world.board.new_world` takes it.
        num_food: pieces of food, each on another free cell.
        energy: at the start.

    Raises:
        ValueError: another render mode, a board that is none, or more food than free cells.

    Source: Lin 1992.

    Example:
        >>> env = LinWorldEnv()
        >>> bits, info = env.reset(seed=0)
        >>> bits.shape, info["energy"], env.step(0)[1]
        ((145,), 40, 0.0)
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        board: str = BOARD,
        num_food: int = NUM_FOOD,
        energy: int = ENERGY_AT_START,
    ) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        self._world = new_world(board, energy)
        check_whole("num_food", num_food, 0)
        if num_food > len(self._world.free):
            raise ValueError(f"num_food must be at most the board's {len(self._world.free)} free cells, got {num_food}")
        self.render_mode, self._num_food = render_mode, num_food
        self.observation_space, self.action_space = MultiBinary(NUM_BITS), Discrete(NUM_MOVES)
        self._is_playing = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.int8], dict[str, Any]]:
        """Food is put elsewhere, or where ``options["food"]`` says (rows and columns, from 0); all others begin anew.

        Raises:
            ValueError: food outside the board, on an obstacle, twice on one cell, or where somebody stands.
        """
        super().reset(seed=seed)
        given = (options or {}).get("food")
        settle(self._world, self.np_random.random(self._num_food if given is None else 0))
        if given is not None:
            _put(self._world, given)
        self._is_playing = True
        return self._bits(), self._info(-1)

    def step(self, action: int) -> tuple[NDArray[np.int8], float, bool, bool, dict[str, Any]]:
        """A move of the agent, then those of the enemies.

        Raises:
            ResetNeeded: before the first reset, and after the end of a play.
            ValueError: another action.
        """
        if not self._is_playing:
            raise ResetNeeded("no play is going on: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be a whole number from 0 to {NUM_MOVES - 1}, got {action!r}")
        found = int(move(self._world, int(action), self.np_random.random(2 * len(self._world.starts))))
        self._is_playing = found <= ATE
        return self._bits(), float(reward_of(found)), not self._is_playing, False, self._info(found)

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode."""
        if self.render_mode is None:
            return None
        return board_text(self._world) if self.render_mode == "ansi" else board_picture(self._world)

    @property
    def world(self) -> World:
        """Where everything is, as copies; rows and columns count from 12 cells outside of the board."""
        return copied_world(self._world)

    def _bits(self) -> NDArray[np.int8]:
        bits = np.zeros(NUM_BITS, np.int8)
        sense(self._world, bits)
        return bits

    def _info(self, found: int) -> dict[str, Any]:
        outcome: dict[str, Any] = {name: found in codes for name, codes in _OUTCOMES.items()}
        agent = self._world.agent
        return {**outcome, "energy": int(agent[ENERGY]), "food_left": int(agent[LEFT])}


def make(render_mode: str | None = None, **given: Any) -> LinWorldEnv:
    """What ``gymnasium.make("neuralq/LinWorld-v0")`` calls.

    Example:
        >>> make().reset(seed=1)[0].dtype
        dtype('int8')
    """
    return LinWorldEnv(render_mode, **given)


def _put(world: World, given: Any) -> None:
    """Food on these cells."""
    try:
        cells = np.array(given, np.int64).reshape(-1, 2)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"options['food'] must be pairs of row and column, got {given!r}") from error
    free = {(int(row) - REACH, int(column) - REACH) for row, column in world.free}
    for cell in map(tuple, cells.tolist()):
        if cell not in free:
            raise ValueError(f"there can be no food at {cell}: it must be another free cell of the board each time")
        free.remove(cell)
    world.food[tuple((cells + REACH).T)] = 1
    world.agent[LEFT] = len(cells)

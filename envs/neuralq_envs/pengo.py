"""The small Pengo of `neuralq_envs.pengo_kernels` as an environment: what is where, what moves and what is paid."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq_envs.canvas import BLUE, CELL, GREEN, GREY, INK, RED, blank, disk, frame
from neuralq_envs.pengo_kernels import (
    BLOCK,
    FOOD,
    FREE,
    NUM_ACTIONS,
    NUM_DEALT,
    NUM_DRAWN,
    NUM_ENEMIES,
    NUM_INPUTS,
    SIDE,
    Game,
    deal,
    look,
    new_game,
    play,
)

__all__ = ["PengoEnv", "make"]

_SIGNS = {".": FREE, "#": BLOCK, "o": FOOD, "E": FREE, "@": FREE}


class PengoEnv(gymnasium.Env[Any, Any]):
    """The game; observations are the 44 inputs, actions four moves and four pushes, north first and clockwise.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.

    Raises:
        ValueError: another render mode.

    Source: after Agre & Chapman 1987 and Maclin & Shavlik 1996; the sizes are ours.

    Example:
        >>> env = PengoEnv()
        >>> env.reset(seed=0)[0].shape, env.step(0)[1] in (0.0, 1.0, -1.0)
        ((44,), True)
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        self.render_mode = render_mode
        self.observation_space = Box(0.0, 1.0, (NUM_INPUTS,), np.float32)
        self.action_space = Discrete(NUM_ACTIONS)
        self._game: Game | None = None
        self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Another board, or ``options["board"]``: seven rows of ``.``, ``#``, ``o``, ``E`` and one ``@``.

        Raises:
            ValueError: a board of another size, with other signs, without food, or with more than two enemies.
        """
        super().reset(seed=seed)
        self._game, self._over = new_game(), False
        if options is not None and "board" in options:
            _arrange(self._game, options["board"])
        else:
            deal(self._game, self.np_random.random(NUM_DEALT))
        return self._seen(), {}

    def step(self, action: int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One action, and a move of each enemy.

        Raises:
            ResetNeeded: before the first reset, or after the end of a game.
            ValueError: another action.
        """
        if self._game is None or self._over:
            raise ResetNeeded("the game is over, or there is none yet: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be a whole number from 0 to {NUM_ACTIONS - 1}, got {action!r}")
        reward, self._over = play(self._game, int(action), self.np_random.random(NUM_DRAWN))
        return self._seen(), float(reward), bool(self._over), False, {}

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode or before a reset."""
        if self._game is None or self.render_mode is None:
            return None
        return _text(self._game) if self.render_mode == "ansi" else _picture(self._game)

    @property
    def game(self) -> Game:
        """The board and who is where, as copies.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self._game is None:
            raise ResetNeeded("there is no game yet: call reset() first")
        return Game(*(part.copy() for part in self._game))

    def _seen(self) -> NDArray[np.float32]:
        assert self._game is not None
        x = np.zeros(NUM_INPUTS)
        look(self._game, x)
        return x.astype(np.float32)


def make(render_mode: str | None = None, **given: Any) -> PengoEnv:
    """What ``gymnasium.make("neuralq/Pengo-v0")`` calls.

    Example:
        >>> make().reset(seed=1)[0].dtype
        dtype('float32')
    """
    return PengoEnv(render_mode, **given)


def _arrange(game: Game, board: Any) -> None:
    """The board as the option has it."""
    rows = board.split() if isinstance(board, str) else []
    text = "".join(rows)
    if len(rows) != SIDE or any(len(row) != SIDE for row in rows) or not set(text) <= set(_SIGNS):
        raise ValueError(
            f"options['board'] must be {SIDE} rows of {SIDE} signs of {' '.join(_SIGNS)} (free, block, food, enemy, "
            f"player), got {board!r}"
        )
    if text.count("@") != 1 or "o" not in text or text.count("E") > NUM_ENEMIES:
        raise ValueError(
            f"options['board'] must have one player @, some food o and at most {NUM_ENEMIES} enemies E, got {board!r}"
        )
    game.cells[:] = [_SIGNS[sign] for sign in text]
    game.player[0] = text.index("@")
    enemies = [cell for cell, sign in enumerate(text) if sign == "E"]
    game.enemies[: len(enemies)] = enemies


def _text(game: Game) -> str:
    signs = [".#o"[kind] for kind in game.cells]
    signs[game.player[0]] = "@"
    for enemy in game.enemies[game.enemies >= 0]:
        signs[enemy] = "E"
    return "".join(" ".join(signs[row * SIDE : (row + 1) * SIDE]) + "\n" for row in range(SIDE))


def _picture(game: Game) -> NDArray[np.uint8]:
    picture = blank(SIDE * CELL, SIDE * CELL)
    middle = ((CELL - 1) / 2, (CELL - 1) / 2)
    for cell, kind in enumerate(game.cells):
        row, column = divmod(cell, SIDE)
        square = picture[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]  # a view
        if kind == BLOCK:
            square[:] = INK
        elif kind == FOOD:
            disk(square, middle, 0.2 * CELL, GREEN)
        if cell == game.player[0]:
            disk(square, middle, 0.35 * CELL, BLUE)
        if cell in game.enemies:
            disk(square, middle, 0.35 * CELL, RED)
        frame(square, GREY)
    return picture

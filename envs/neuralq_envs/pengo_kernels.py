"""A small Pengo: a player among blocks that slide when they are pushed, food to be eaten, and enemies that are not.

The board has 7 × 7 cells: eight blocks, five pieces of food, two enemies more than two steps from the player, all
somewhere. Actions 0 to 3 move north, east, south and west, 4 to 7 push there. A block that is pushed slides to the next
block or the edge, and destroys what it meets. Food earns 1, an enemy destroyed .9; touching an enemy costs 1 and ends
the game, and so does the end of all food, at no cost. After each action every enemy moves, half of the time at random
and else to the free cell beside it that is nearest to the player; food and blocks are in its way.

The player sees 44 inputs between 0 and 1: for each of the four cells beside it, which of wall, free, block, food and
enemy it is; and for each of eight sectors, north first and clockwise, how near the nearest block, food and enemy are,
min(1, 3/d) at d steps, 0 for none.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel

__all__ = [
    "BLOCK",
    "FOOD",
    "FREE",
    "NEAR",
    "NUM_ACTIONS",
    "NUM_DEALT",
    "NUM_DRAWN",
    "NUM_ENEMIES",
    "NUM_INPUTS",
    "SIDE",
    "Game",
    "deal",
    "input_of",
    "look",
    "new_game",
    "play",
    "sector_of",
    "steps_between",
]

SIDE = 7
NUM_BLOCKS, NUM_FOOD, NUM_ENEMIES = 8, 5, 2
NUM_ACTIONS, NUM_INPUTS = 8, 44
NUM_DEALT, NUM_DRAWN = SIDE * SIDE - 1, 2 * NUM_ENEMIES
"""Random numbers for a board, and for the enemies after an action."""
FREE, BLOCK, FOOD = range(3)
"""What lies in a cell."""
NEAR = 1
"""Steps within which something is as near as it can be seen to be."""
FOOD_REWARD, KILL_REWARD, CAUGHT_REWARD = 1.0, 0.9, -1.0
_APART = 2  # steps from the player within which no enemy begins
_KINDS = ("wall", "free", "block", "food", "enemy")
_SECTOR_KINDS = ("block", "food", "enemy")
_DOWN, _ACROSS = (-1, 0, 1, 0), (0, 1, 0, -1)


class Game(NamedTuple):
    """A board and who is where; cells are counted row by row.

    Args:
        cells: what lies in each, ``[49]``.
        player: its cell, ``[1]``.
        enemies: theirs, −1 for one that is destroyed, ``[2]``.
        order: room for an order of the cells, ``[49]``.
    """

    cells: NDArray[np.int64]
    player: NDArray[np.int64]
    enemies: NDArray[np.int64]
    order: NDArray[np.int64]


def new_game() -> Game:
    """An empty board; `deal` or a caller fills it.

    Example:
        >>> new_game().cells.shape
        (49,)
    """
    cells = np.zeros(SIDE * SIDE, np.int64)
    return Game(cells, np.zeros(1, np.int64), np.full(NUM_ENEMIES, -1), cells.copy())


def input_of(kind: str, direction: int | None = None, sector: int | None = None) -> int:
    """The number of an input: what is beside the player in one of four directions, or how near in one of 8 sectors.

    Example:
        >>> input_of("food", direction=1), input_of("enemy", sector=2)
        (8, 28)
    """
    if direction is not None:
        return len(_KINDS) * direction + _KINDS.index(kind)
    assert sector is not None
    return 4 * len(_KINDS) + len(_SECTOR_KINDS) * sector + _SECTOR_KINDS.index(kind)


@lean_kernel
def deal(game: Game, drawn: NDArray[np.float64]) -> None:
    """Another game.

    Args:
        game: written.
        drawn: numbers in [0, 1), ``[48]``.

    Example:
        >>> game = new_game()
        >>> deal(game, np.random.default_rng(0).random(NUM_DEALT))
        >>> np.bincount(game.cells).tolist()
        [36, 8, 5]
    """
    count = len(game.cells)
    for i in range(count):
        game.order[i] = i
        game.cells[i] = FREE
    for i in range(count - 1):
        j = i + int(drawn[i] * (count - i))
        game.order[i], game.order[j] = game.order[j], game.order[i]
    game.player[0] = game.order[0]
    for i in range(NUM_BLOCKS + NUM_FOOD):
        game.cells[game.order[1 + i]] = BLOCK if i < NUM_BLOCKS else FOOD
    placed, i = 0, 1 + NUM_BLOCKS + NUM_FOOD
    while placed < NUM_ENEMIES:  # at most twelve cells are too near, and there are 35
        if steps_between(game.player[0], game.order[i]) > _APART:
            game.enemies[placed] = game.order[i]
            placed += 1
        i += 1


@lean_kernel
def steps_between(cell: int, other: int) -> Any:
    """Steps from cell to cell where nothing is in the way.

    Example:
        >>> steps_between(0, 48)
        12
    """
    return abs(cell // SIDE - other // SIDE) + abs(cell % SIDE - other % SIDE)


@lean_kernel
def sector_of(down: int, across: int) -> Any:
    """Which of eight sectors something lies in that is so many rows below and so many columns to the right.

    Example:
        >>> sector_of(-2, 0), sector_of(-1, 1), sector_of(0, 3), sector_of(1, -5)
        (0, 1, 2, 6)
    """
    return math.floor(math.atan2(float(across), float(-down)) * 4.0 / math.pi + 8.5) % 8


@lean_kernel
def look(game: Game, x: NDArray[np.float64]) -> None:
    """Writes the 44 inputs.

    Example:
        Food to the east, and an enemy two steps to the north, in a game without blocks.

        >>> game, x = new_game(), np.zeros(NUM_INPUTS)
        >>> game.player[0], game.cells[25], game.enemies[0] = 24, FOOD, 10
        >>> look(game, x)
        >>> np.flatnonzero(x).tolist(), x[[input_of("food", sector=2), input_of("enemy", sector=0)]].tolist()
        ([1, 8, 11, 16, 22, 27], [1.0, 1.0])
    """
    for i in range(len(x)):
        x[i] = 0.0
    player = game.player[0]
    for d in range(4):
        cell = _beside(player, d)
        kind = 0 if cell < 0 else 1 + game.cells[cell]
        if cell >= 0 and _enemy_at(game, cell) >= 0:
            kind = 4
        x[5 * d + kind] = 1.0
    for cell in range(len(game.cells)):
        if game.cells[cell] != FREE:
            _see(player, cell, game.cells[cell] - 1, x)
    for enemy in game.enemies:
        if enemy >= 0:
            _see(player, enemy, 2, x)


@lean_kernel
def _see(player: int, cell: int, kind: int, x: NDArray[np.float64]) -> None:
    """What lies in a cell, in its sector."""
    if cell == player:
        return
    at = 20 + 3 * sector_of(cell // SIDE - player // SIDE, cell % SIDE - player % SIDE) + kind
    x[at] = max(x[at], min(1.0, NEAR / steps_between(player, cell)))


@lean_kernel
def play(game: Game, action: int, drawn: NDArray[np.float64]) -> Any:
    """An action of the player, then the enemies' moves.

    Args:
        game: changed in place.
        action: 0 to 3 move, 4 to 7 push, north first and clockwise.
        drawn: numbers in [0, 1), two for each enemy, ``[4]``: whether it moves at random, and where to.

    Returns:
        The reward, and whether the game has ended.

    Example:
        A block slides over two free cells, an enemy and food, to the edge.

        >>> game = new_game()
        >>> game.player[0], game.cells[1], game.cells[5], game.cells[40], game.enemies[0] = 0, BLOCK, FOOD, FOOD, 4
        >>> play(game, 5, np.zeros(NUM_DRAWN)), np.flatnonzero(game.cells).tolist(), game.enemies.tolist()
        ((0.9, False), [6, 40], [-1, -1])
    """
    direction = action % 4
    cell = _beside(game.player[0], direction)
    reward = 0.0
    if cell >= 0 and action >= 4:
        if game.cells[cell] == BLOCK:
            reward = KILL_REWARD * _slide(game, cell, direction)
    elif cell >= 0 and game.cells[cell] != BLOCK:
        game.player[0] = cell
        if _enemy_at(game, cell) >= 0:
            return CAUGHT_REWARD, True
        if game.cells[cell] == FOOD:
            game.cells[cell] = FREE
            reward = FOOD_REWARD
    if not _any_food(game):
        return reward, True
    for i in range(len(game.enemies)):
        if game.enemies[i] >= 0:
            _chase(game, i, drawn[2 * i] < 0.5, drawn[2 * i + 1])
    if _enemy_at(game, game.player[0]) >= 0:
        return reward + CAUGHT_REWARD, True
    return reward, False


@lean_kernel
def _slide(game: Game, cell: int, direction: int) -> Any:
    """A block as far as it goes; returns how many enemies it has destroyed."""
    destroyed = 0
    game.cells[cell] = FREE
    following = _beside(cell, direction)
    while following >= 0 and game.cells[following] != BLOCK:
        cell = following
        game.cells[cell] = FREE  # food, if there was some
        enemy = _enemy_at(game, cell)
        while enemy >= 0:
            game.enemies[enemy] = -1
            destroyed += 1
            enemy = _enemy_at(game, cell)
        following = _beside(cell, direction)
    game.cells[cell] = BLOCK
    return destroyed


@lean_kernel
def _chase(game: Game, i: int, wanders: bool, where: float) -> None:
    """A move of one enemy, which stays where no cell beside it is free."""
    here = game.enemies[i]
    count, nearest, chosen = 0, SIDE * SIDE, -1
    for d in range(4):
        cell = _beside(here, d)
        if cell < 0 or game.cells[cell] != FREE or _enemy_at(game, cell) >= 0:
            continue
        count += 1
        steps = steps_between(cell, game.player[0])
        if steps < nearest:
            nearest, chosen = steps, cell
    if wanders and count > 0:
        which = int(where * count)
        for d in range(4):
            cell = _beside(here, d)
            if cell < 0 or game.cells[cell] != FREE or _enemy_at(game, cell) >= 0:
                continue
            if which == 0:
                chosen = cell
            which -= 1
    if chosen >= 0:
        game.enemies[i] = chosen


@lean_kernel
def _beside(cell: int, direction: int) -> Any:
    """The next cell in one of four directions, −1 beyond the edge."""
    row, column = cell // SIDE + _DOWN[direction], cell % SIDE + _ACROSS[direction]
    if row < 0 or row >= SIDE or column < 0 or column >= SIDE:
        return -1
    return row * SIDE + column


@lean_kernel
def _enemy_at(game: Game, cell: int) -> Any:
    """Which enemy is in a cell; −1 for none."""
    for i in range(len(game.enemies)):
        if game.enemies[i] == cell:
            return i
    return -1


@lean_kernel
def _any_food(game: Game) -> Any:
    for cell in range(len(game.cells)):
        if game.cells[cell] == FOOD:
            return True
    return False

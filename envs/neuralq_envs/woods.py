"""Woods1 (Wilson 1994): an animal among trees that sees the eight cells around it and looks for food.

The map repeats itself in both directions. Eight moves, clockwise from north; one onto a tree stays where it is, one
onto food ends the episode and earns 1000. The animal sees two bits for each cell around it, clockwise from north:
00 free, 10 a tree, 11 food. In Woods1 that tells its 16 free cells apart; food is 1.6875 moves away in the mean.

Source: Wilson 1994, "ZCS: a zeroth level classifier system", Evolutionary Computation 2.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Discrete, MultiBinary
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq.mdp import FiniteMDP
from neuralq_envs.canvas import BLUE, CELL, GREEN, GREY, INK, blank, disk, frame, write

__all__ = ["MOVES", "NUM_BITS", "NUM_MOVES", "REWARD", "WOODS1", "WoodsEnv", "make", "mdp", "percepts", "successors"]

WOODS1 = """
.....
.OOF.
.OOO.
.OOO.
.....
"""
MOVES = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
NUM_MOVES, NUM_BITS = 8, 16
REWARD = 1000.0
_NAMES = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
_SEEN = {".": 0b00, "O": 0b10, "F": 0b11}


def _signs(layout: str) -> NDArray[np.str_]:
    lines = [line.strip() for line in layout.strip().splitlines()]
    if len({len(line) for line in lines}) != 1 or not set("".join(lines)) <= set(_SEEN):
        raise ValueError(f"layout must be rows of one length made of '.', 'O' and 'F', got {layout!r}")
    if "." not in layout or "F" not in layout:
        raise ValueError(f"layout must have a free cell '.' and food 'F', got {layout!r}")
    return np.array([list(line) for line in lines])


def _around(signs: NDArray[np.str_]) -> NDArray[np.int64]:
    """The cells around each cell, clockwise from north, ``[S, 8]``."""
    cells = np.arange(signs.size).reshape(signs.shape)
    return np.stack([np.roll(cells, (-down, -across), (0, 1)).ravel() for down, across in MOVES], axis=1)


def percepts(layout: str = WOODS1) -> NDArray[np.int64]:
    r"""What is seen from each cell, as a whole number whose lowest bits are north, ``[S]``.

    Raises:
        ValueError: a map that is not rectangular, has other signs, no food or no free cell.

    Example:
        >>> free = [cell for cell, sign in enumerate(WOODS1.replace("\n", "")) if sign == "."]
        >>> len(free), len(set(percepts()[free].tolist()))
        (16, 16)
    """
    signs = _signs(layout)
    seen = np.array([_SEEN[sign] for sign in signs.ravel()])
    return np.asarray((seen[_around(signs)] << 2 * np.arange(NUM_MOVES)).sum(axis=1))


def successors(layout: str = WOODS1) -> NDArray[np.int64]:
    """Where each move leads from each cell, ``[S, 8]``; cells are counted row by row.

    Raises:
        ValueError: as `percepts`.

    Example:
        >>> successors()[0].tolist()  # north of the top is the bottom
        [20, 21, 1, 0, 5, 9, 4, 24]
    """
    signs = _signs(layout)
    around = _around(signs)
    return np.where(signs.ravel()[around] == "O", np.arange(signs.size)[:, None], around)


def mdp(layout: str = WOODS1) -> FiniteMDP:
    """The exact model by cells, which an animal that sees bits is not told; episodes start in any free cell.

    Raises:
        ValueError: as `percepts`.

    Example:
        >>> mdp().num_rows  # eight moves in each of 16 cells
        128
    """
    signs, led = _signs(layout).ravel(), successors(layout)
    free = signs == "."
    return FiniteMDP.from_functions(
        len(signs),
        NUM_MOVES,
        lambda s: range(NUM_MOVES) if free[s] else (),
        lambda s, a: [(1.0, int(led[s, a]), REWARD * (signs[led[s, a]] == "F"), bool(signs[led[s, a]] == "F"))],
        start=free / np.count_nonzero(free),
        action_names=_NAMES,
    )


class WoodsEnv(gymnasium.Env[Any, Any]):
    """The animal; observations are its 16 bits, and ``info["cell"]`` is where it is.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.
        layout: the map: ``.`` free, ``O`` a tree, ``F`` food.

    Raises:
        ValueError: another render mode, or a map as `percepts` refuses it.

    Example:
        >>> env = WoodsEnv()
        >>> env.reset(options={"cell": 4})[0].tolist()
        [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0]
        >>> env.step(5)[1:3]  # south-west
        (1000.0, True)
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, layout: str = WOODS1) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        self.render_mode = render_mode
        self._signs, self._percepts, self._led = _signs(layout), percepts(layout), successors(layout)
        self.observation_space, self.action_space = MultiBinary(NUM_BITS), Discrete(NUM_MOVES)
        self._cell: int | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.int8], dict[str, Any]]:
        """In any free cell, or in ``options["cell"]``, counted row by row.

        Raises:
            ValueError: a cell that is not free, or not on the map.
        """
        super().reset(seed=seed)
        free = np.flatnonzero(self._signs.ravel() == ".")
        if options is not None and "cell" in options:
            if options["cell"] not in free:
                raise ValueError(
                    f"options['cell'] must be one of the free cells {free.tolist()}, got {options['cell']!r}"
                )
            self._cell = int(options["cell"])
        else:
            self._cell = int(self.np_random.choice(free))
        return self._seen(), {"cell": self._cell}

    def step(self, action: int) -> tuple[NDArray[np.int8], float, bool, bool, dict[str, Any]]:
        """One move, clockwise from north (0); 1000 for food.

        Raises:
            ResetNeeded: before the first reset, or when the food is found.
            ValueError: another action.
        """
        if self._cell is None or self._signs.flat[self._cell] == "F":
            raise ResetNeeded("the food is found, or there is no animal yet: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be a whole number from 0 to {NUM_MOVES - 1}, got {action!r}")
        self._cell = int(self._led[self._cell, action])
        found = bool(self._signs.flat[self._cell] == "F")
        return self._seen(), REWARD * found, found, False, {"cell": self._cell}

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode or before a reset."""
        if self._cell is None or self.render_mode is None:
            return None
        return _text(self._signs, self._cell) if self.render_mode == "ansi" else _picture(self._signs, self._cell)

    def _seen(self) -> NDArray[np.int8]:
        assert self._cell is not None
        return np.asarray(self._percepts[self._cell] >> np.arange(NUM_BITS) & 1, np.int8)


def make(render_mode: str | None = None, **given: Any) -> WoodsEnv:
    """What ``gymnasium.make("neuralq/Woods1-v0")`` calls.

    Example:
        >>> make().reset(seed=0)[0].shape
        (16,)
    """
    return WoodsEnv(render_mode, **given)


def _text(signs: NDArray[np.str_], cell: int) -> str:
    shown = signs.copy()
    shown.flat[cell] = "A"
    return "".join(" ".join(row) + "\n" for row in shown)


def _picture(signs: NDArray[np.str_], cell: int) -> NDArray[np.uint8]:
    picture = blank(signs.shape[0] * CELL, signs.shape[1] * CELL)
    middle = ((CELL - 1) / 2, (CELL - 1) / 2)
    for (row, column), sign in np.ndenumerate(signs):
        square = picture[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]  # a view
        if sign == "O":
            disk(square, middle, 0.4 * CELL, GREEN)
        elif sign == "F":
            square[:] = GREY
            write(square, "F", middle, INK, 4)
        if row * signs.shape[1] + column == cell:
            disk(square, middle, 0.3 * CELL, BLUE)
        frame(square, GREY)
    return picture

"""Grid worlds from a text map: walls, wind, slips, cliffs and traps, with their exact model and their picture.

A map has one sign per cell: ``.`` free, ``S`` free and a start, ``#`` wall, ``G`` goal and ``T`` trap (both end the
episode), ``C`` cliff (back to the start), ``x`` a cell that was closed: it cannot be entered, but whoever was in it can
leave. Every cell is a state, numbered row by row from the top left; cells in which nobody can be have no action.

A move goes to the neighbouring cell, or stays where a wall or the edge is in the way; then the wind of the column where
it began pushes up, cell by cell, until something is in the way. Actions are north, east, south, west, then with eight
moves north-east, south-east, south-west, north-west.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_fraction, check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.canvas import BLUE, CELL, GREEN, GREY, INK, RED, blank, disk, frame, write
from neuralq_envs.rendering import RenderedEnv

__all__ = ["ACTIONS", "Grid"]

ACTIONS = ("north", "east", "south", "west", "north-east", "south-east", "south-west", "north-west")
_MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1), (-1, 1), (1, 1), (1, -1), (-1, -1))
_COMPASS = {4: (0, 1, 2, 3), 8: (0, 4, 1, 5, 2, 6, 3, 7)}  # clockwise: where a slip goes
_SIGNS = ".S#GTCx"
_GROUND = {"#": INK, "x": INK, "G": GREEN, "T": RED, "C": RED}
_BREEZE = np.array([28, 12, 0])  # what one unit of wind takes from white


@dataclass(frozen=True)
class Grid:
    """A grid world is a map and what its moves do and pay.

    Args:
        layout: the map, one line per row.
        step_reward: of a move that enters neither goal, trap nor cliff.
        goal_reward: of entering a goal, instead of ``step_reward``.
        trap_reward: of entering a trap, instead.
        cliff_reward: of falling off a cliff, instead.
        bump_reward: of a move that a wall or the edge refuses, instead; None for ``step_reward``.
        wind: cells by which each column pushes up, one whole number per column; empty for none.
        slip: probability of going to one of the two neighbouring directions instead, half of it each.
        num_moves: 4, or 8 with diagonal moves (which may pass between two walls).
        blocked: whether a move off the grid or into a wall is ``"legal"``, and stays, or ``"illegal"``.

    Raises:
        ValueError: a map that is not rectangular, has other signs or no cell to be in; a cliff without exactly one
            start; parameters out of range.

    Example:
        >>> Grid("S.G").mdp().reward.tolist()  # four moves in each of two cells; only east from the second enters G
        [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    """

    layout: str
    step_reward: float = 0.0
    goal_reward: float = 1.0
    trap_reward: float = -1.0
    cliff_reward: float = -1.0
    bump_reward: float | None = None
    wind: tuple[int, ...] = ()
    slip: float = 0.0
    num_moves: int = 4
    blocked: str = "legal"

    def __post_init__(self) -> None:
        object.__setattr__(self, "layout", "\n".join(line.strip() for line in self.layout.strip().splitlines()))
        object.__setattr__(self, "wind", tuple(self.wind))
        self._check_layout()
        check_fraction("slip", self.slip)
        check_choice("num_moves", self.num_moves, _COMPASS)
        check_choice("blocked", self.blocked, ("legal", "illegal"))
        for name in ("step_reward", "goal_reward", "trap_reward", "cliff_reward", "bump_reward"):
            if getattr(self, name) is not None and not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        if self.wind and len(self.wind) != self.num_columns:
            raise ValueError(f"wind must have {self.num_columns} numbers, one for each column, got {len(self.wind)}")
        for strength in self.wind:
            check_whole("wind", strength, minimum=0)

    def _check_layout(self) -> None:
        for row, line in enumerate(self.layout.split("\n")):
            if len(line) != self.num_columns:
                raise ValueError(f"row {row} of the map must have {self.num_columns} cells like row 0, got {len(line)}")
            unknown = [sign for sign in line if sign not in _SIGNS]
            if unknown:
                raise ValueError(f"row {row} of the map: the sign must be one of {_SIGNS!r}, got {unknown[0]!r}")
        if not any(sign in ".S" for sign in self.signs):
            raise ValueError("the map has no cell to be in; mark at least one as '.' or 'S'")
        if "C" in self.signs and self.signs.count("S") != 1:
            raise ValueError(f"a map with a cliff must have one start 'S' to fall back to, got {self.signs.count('S')}")

    @cached_property
    def signs(self) -> str:
        """The sign of every cell, row by row."""
        return self.layout.replace("\n", "")

    @cached_property
    def num_rows(self) -> int:
        """Height in cells."""
        return self.layout.count("\n") + 1

    @cached_property
    def num_columns(self) -> int:
        """Width in cells."""
        return (self.layout + "\n").index("\n")

    def cell(self, row: int, column: int) -> int:
        r"""The number of the cell at ``row`` and ``column``, counted from the top left.

        Raises:
            ValueError: off the grid.

        Example:
            >>> Grid("...\n..G").cell(1, 2)
            5
        """
        if not (0 <= row < self.num_rows and 0 <= column < self.num_columns):
            raise ValueError(f"({row}, {column}) is not on this grid of {self.num_rows} x {self.num_columns} cells")
        return row * self.num_columns + column

    def mdp(self) -> FiniteMDP:
        """The exact model; episodes start uniformly in the cells ``S``, or in all free cells if there is none.

        Example:
            >>> Grid("..G").mdp().start_distribution.tolist()
            [0.5, 0.5, 0.0]
        """
        signs = self.signs
        starts = np.array([sign == ("S" if "S" in signs else ".") for sign in signs])
        names = [f"row {s // self.num_columns}, column {s % self.num_columns}" for s in range(len(signs))]
        return FiniteMDP.from_functions(
            len(signs),
            self.num_moves,
            self._actions,
            self._transitions,
            start=starts / np.count_nonzero(starts),
            state_names=names,
            action_names=ACTIONS[: self.num_moves],
        )

    def percepts(self, num_neighbours: int = 4) -> NDArray[np.int64]:
        r"""What each cell looks like from within, by which of its neighbours cannot be entered, ``[S]``.

        Patterns are numbered in the order of the cells that first have them; goals and traps look free. Cells in which
        nobody can be are given 0.

        Args:
            num_neighbours: 4, or 8 with those at the corners.

        Example:
            >>> Grid("...\n.#.\n..G").percepts().tolist()
            [0, 1, 2, 3, 0, 3, 4, 1, 5]
        """
        check_choice("num_neighbours", num_neighbours, _COMPASS)
        patterns: dict[tuple[bool, ...], int] = {}
        seen = np.zeros(len(self.signs), dtype=np.int64)
        for s, sign in enumerate(self.signs):
            if sign not in "#x":
                pattern = tuple(self._neighbour(s, move) is None for move in _MOVES[:num_neighbours])
                seen[s] = patterns.setdefault(pattern, len(patterns))
        return seen

    def env(self, render_mode: str | None = None) -> RenderedEnv:
        """The grid as an environment.

        Example:
            >>> Grid("S.G").env().reset(seed=0)[0]
            0
        """
        return RenderedEnv(self.mdp(), self, render_mode)

    def _actions(self, s: int) -> list[int]:
        if self.signs[s] not in ".Sx":
            return []
        everything = range(self.num_moves)
        return [a for a in everything if self.blocked == "legal" or self._neighbour(s, _MOVES[a]) is not None]

    def _transitions(self, s: int, a: int) -> list[tuple[float, int, float, bool]]:
        compass = _COMPASS[self.num_moves]
        at = compass.index(a)
        aside = [compass[at - 1], compass[(at + 1) % len(compass)]]
        chances = [(1 - self.slip, a), *((self.slip / 2, b) for b in aside)]
        return [(p, *self._outcome(s, _MOVES[b])) for p, b in chances if p > 0]

    def _outcome(self, s: int, move: tuple[int, int]) -> tuple[int, float, bool]:
        """Where a move ends, what it pays and whether it ends the episode."""
        stepped = self._neighbour(s, move)
        s_t = s if stepped is None else stepped
        for _ in range(self.wind[s % self.num_columns] if self.wind else 0):
            blown = self._neighbour(s_t, (-1, 0))
            s_t = s_t if blown is None else blown
        if self.signs[s_t] == "C":
            return self.signs.index("S"), self.cliff_reward, False
        step_reward = self.step_reward if stepped is not None or self.bump_reward is None else self.bump_reward
        reward = {"G": self.goal_reward, "T": self.trap_reward}.get(self.signs[s_t], step_reward)
        return s_t, reward, self.signs[s_t] in "GT"

    def _neighbour(self, s: int, move: tuple[int, int]) -> int | None:
        row, column = s // self.num_columns + move[0], s % self.num_columns + move[1]
        if not (0 <= row < self.num_rows and 0 <= column < self.num_columns):
            return None
        cell = row * self.num_columns + column
        return None if self.signs[cell] in "#x" else cell

    def text(self, state: int | None) -> str:
        """The map with the agent as ``A``, and a last line with the wind of each column if there is any.

        Example:
            >>> print(Grid("S.G", wind=(0, 1, 0)).text(1))
            S A G
            0 1 0
            <BLANKLINE>
        """
        signs = list(self.signs.replace("x", "#"))
        if state is not None:
            signs[state] = "A"
        lines = [signs[i : i + self.num_columns] for i in range(0, len(signs), self.num_columns)]
        return "".join(" ".join(map(str, line)) + "\n" for line in [*lines, *([self.wind] if self.wind else [])])

    def pixels(self, state: int | None) -> NDArray[np.uint8]:
        """The map in colour, 48 pixels a cell: walls dark, goals green, traps and cliffs red, wind a tint of blue.

        Example:
            >>> Grid("S.G").pixels(1).shape
            (48, 144, 3)
        """
        picture = blank(self.num_rows * CELL, self.num_columns * CELL)
        middle = ((CELL - 1) / 2, (CELL - 1) / 2)
        for s, sign in enumerate(self.signs):
            row, column = s // self.num_columns, s % self.num_columns
            square = picture[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]  # a view
            if sign in _GROUND:
                square[:] = _GROUND[sign]
            elif self.wind:
                square[:] = np.maximum(255 - self.wind[column] * _BREEZE, 100)
            if sign in "SGT" and s != state:
                write(square, sign, middle, scale=4)
            if s == state:
                disk(square, middle, 0.3 * CELL, BLUE)
            frame(square, GREY if sign in "#x" else INK)
        return picture

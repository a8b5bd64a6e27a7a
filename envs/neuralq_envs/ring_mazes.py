"""Nine mazes of growing length in which most cells look alike (after Ring 1994): corridors, and crossings like others.

Each maze is a way from one start to one goal. Maze m is the last m + 1 of ten straight corridors, so that what is known
of one maze is the end of what the next one asks for. Where two corridors meet is a crossing, whose two other arms are
blind alleys of one cell. Walls are thin: cells beside each other are
parted unless the way, or an alley, leads from one to the other.

Seen is which of the four sides of the present cell are walls, a number from 0 to 15 (north 1, east 2, south 4, west 8);
every crossing is 0. A move against a wall stays. Each step costs 1, but the one to the goal, which ends the episode.
The shortest ways have 4, 5, 7, 10, 12, 14, 17, 18 and 20 steps.

Source: after the nine mazes of Ring 1994, "Continual learning in reinforcement environments"; these are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.mdp import AliasedMDP, FiniteMDP
from neuralq_envs.aliased import AliasedGridEnv
from neuralq_envs.canvas import BLUE, CELL, GREEN, GREY, INK, PAPER, blank, disk, stroke, write

__all__ = ["NUM_MAZES", "NUM_PERCEPTS", "WAY", "Corridors", "corridors", "make", "model", "shortest_way"]

WAY = "E2 N1 E3 S2 E2 N3 E2 N1 E2 S2"
"""The corridors of the last maze, by direction and length; those before have as many of the last."""
NUM_MAZES, NUM_PERCEPTS = 9, 16
_NAMES = ("north", "east", "south", "west")
_MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))


@dataclass(frozen=True, eq=False)
class Corridors:
    """A maze of thin walls: cells, and where each move leads from them.

    Args:
        places: row and column of each cell, the start first and the goal second, ``[S, 2]``.
        led: the cell that each move leads to, ``[S, 4]``; the cell itself where there is a wall.
    """

    places: NDArray[np.int64]
    led: NDArray[np.int64]

    @property
    def walls(self) -> NDArray[np.bool_]:
        """Which sides of each cell are walls, ``[S, 4]``."""
        return np.asarray(self.led == np.arange(len(self.led))[:, None])

    @property
    def percepts(self) -> NDArray[np.int64]:
        """What each cell looks like, ``[S]``."""
        return np.asarray(self.walls @ (1 << np.arange(4)))

    def text(self, state: int | None) -> str:
        """Cells as ``.``, the start ``S``, the goal ``G``, the walker ``A``; what is open between cells as lines.

        Example:
            >>> print(corridors(1).text(0))
                .
                |
            A-.-.-.
                |
                .
                |
                G
            <BLANKLINE>
        """
        height, width = 2 * self.places.max(axis=0) + 1
        signs = np.full((height, width), " ")
        for s, (row, column) in enumerate(2 * self.places):
            for a, (down, across) in enumerate(_MOVES):
                if self.led[s, a] != s:
                    signs[row + down, column + across] = "-" if across else "|"
            signs[row, column] = "A" if s == state else "SG"[s] if s < 2 else "."
        return "".join("".join(line).rstrip() + "\n" for line in signs)

    def pixels(self, state: int | None) -> NDArray[np.uint8]:
        """The maze from above, 48 pixels a cell: white corridors with dark walls, the goal green, the walker blue.

        Example:
            >>> corridors(1).pixels(0).shape
            (192, 192, 3)
        """
        height, width = CELL * (self.places.max(axis=0) + 1)
        picture = blank(height, width)
        picture[:] = GREY
        middle = (CELL - 1) / 2
        for s, (row, column) in enumerate(self.places):
            square = picture[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]  # a view
            square[:] = GREEN if s == 1 else PAPER
            for (down, across), is_wall in zip(_MOVES, self.walls[s], strict=True):
                if is_wall:
                    along = np.array([-middle, middle])
                    side = np.stack([middle + down * (middle - 1) + across * along,
                                     middle + across * (middle - 1) + down * along], axis=1)  # fmt: skip
                    stroke(square, side, INK, 3)
            if s == state:
                disk(square, (middle, middle), 0.3 * CELL, BLUE)
            elif s < 2:
                write(square, "SG"[s], (middle, middle), scale=4)
        return picture


def corridors(maze: int = NUM_MAZES) -> Corridors:
    """One of the nine.

    Args:
        maze: m, from 1 to 9.

    Raises:
        ValueError: another number.

    Example:
        >>> [len(corridors(m).places) for m in (1, 9)]
        [7, 39]
    """
    path, crossings = [(0, 0)], []
    for direction, length in _ways(maze):
        for _ in range(length):
            path.append((path[-1][0] + _MOVES[direction][0], path[-1][1] + _MOVES[direction][1]))
        crossings.append(path[-1])
    doors = list(pairwise(path))
    for row, column in crossings[:-1]:
        doors += [((row, column), (row + down, column + across)) for down, across in _MOVES]
    cells = list(dict.fromkeys([path[0], path[-1], *path, *(there for _, there in doors)]))
    led = np.repeat(np.arange(len(cells))[:, None], len(_MOVES), axis=1)
    for here, there in doors:
        a = _MOVES.index((there[0] - here[0], there[1] - here[1]))
        s, s_t = cells.index(here), cells.index(there)
        led[s, a], led[s_t, (a + 2) % 4] = s_t, s
    places = np.array(cells)
    return Corridors(places - places.min(axis=0), led)


def shortest_way(maze: int = NUM_MAZES) -> list[int]:
    """The moves of the shortest way: 0 north, 1 east, 2 south, 3 west.

    Raises:
        ValueError: another number than those of the mazes.

    Example:
        >>> shortest_way(2)
        [0, 1, 1, 2, 2]
    """
    return [direction for direction, length in _ways(maze) for _ in range(length)]


def _ways(maze: int) -> list[tuple[int, int]]:
    """Direction and length of each corridor."""
    check_whole("maze", maze)
    if maze > NUM_MAZES:
        raise ValueError(f"maze must be at most {NUM_MAZES}, got {maze}")
    return [("NESW".index(corridor[0]), int(corridor[1:])) for corridor in WAY.split()[-maze - 1 :]]


def model(maze: int = NUM_MAZES, step_reward: float = -1.0, goal_reward: float = 0.0) -> AliasedMDP:
    """The exact model of its cells, and what they look like.

    Args:
        maze: m, from 1 to 9.
        step_reward: of a step that does not reach the goal.
        goal_reward: of the one that does.

    Raises:
        ValueError: another number than those of the mazes.

    Example:
        >>> model(1).mdp.num_rows  # four moves in all cells but the goal
        24
    """
    one = corridors(maze)
    mdp = FiniteMDP.from_functions(
        len(one.places),
        len(_MOVES),
        lambda s: () if s == 1 else range(len(_MOVES)),
        lambda s, a: [
            (1.0, int(one.led[s, a]), goal_reward if one.led[s, a] == 1 else step_reward, bool(one.led[s, a] == 1))
        ],
        start=np.arange(len(one.places)) == 0,
        action_names=_NAMES,
    )
    return AliasedMDP(mdp, one.percepts)


def make(
    render_mode: str | None = None, maze: int = NUM_MAZES, step_reward: float = -1.0, goal_reward: float = 0.0
) -> AliasedGridEnv:
    """What ``gymnasium.make("neuralq/RingMaze-v0", maze=m)`` calls.

    Raises:
        ValueError: another maze, or another render mode.

    Example:
        >>> env = make(maze=2)
        >>> env.reset(seed=0)[0], env.observation_space  # the start is open to the north
        (14, Discrete(16))
    """
    aliased = model(maze, step_reward, goal_reward)
    return AliasedGridEnv(aliased, corridors(maze), render_mode, NUM_PERCEPTS)

"""What CHILD shows: the nine mazes, the units that grew for each move, and how long each maze took."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.child.lives import NUM_ACTIONS, Life
from neuralq_envs.ring_mazes import NUM_MAZES, corridors, shortest_way

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from neuralq.tabular import TransitionHierarchy

__all__ = ["mazes_picture", "mazes_svg", "steps_picture", "tree_picture", "tree_svg"]

_CELL, _WIDTH, _HEIGHT = 13, 205, 150  # of a cell, and of the room for a maze
_ROW, _COLUMN, _LEFT, _TOP = 25, 84, 16, 30
_MOST_UNITS = 40
_TURNS = (0, 90, 180, 270)
_NAMES = ("north", "east", "south", "west")
_SIDES = ((0, 0, 1, 0), (1, 0, 1, 1), (0, 1, 1, 1), (0, 0, 0, 1))  # of a cell: from x, y to x, y
_INK, _SOFT = "var(--ink, #1b1f24)", "var(--soft, #5b6068)"


def _head(width: int, height: int, max_width: str, said: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" font-family="sans-serif" '
        f'font-size="13" style="display:block;width:100%;max-width:{max_width}" aria-label="{said}">'
    )


def _line(x: float, y: float, side: int, size: float, colour: str, width: float) -> str:
    one = _SIDES[side]
    return (
        f'<path d="M{x + size * one[0]:g} {y + size * one[1]:g}L{x + size * one[2]:g} {y + size * one[3]:g}" '
        f'stroke="{colour}" stroke-width="{width}" stroke-linecap="square"/>'
    )


def _arrow(x: float, y: float, action: int, colour: str) -> str:
    place = f"translate({x:g} {y:g}) rotate({_TURNS[action]})"
    return f'<path transform="{place}" d="M-1.5 7V-1H-4.5L0 -7L4.5 -1H1.5V7z" fill="{colour}"/>'


def mazes_svg() -> str:
    """The nine mazes with their shortest ways, three in a row.

    Example:
        >>> mazes_svg().count("<polyline")
        9
    """
    parts = [_head(3 * _WIDTH, 3 * _HEIGHT, "40rem", "Nine mazes, each with its shortest way")]
    for maze in range(1, NUM_MAZES + 1):
        one, left, top = corridors(maze), (maze - 1) % 3 * _WIDTH + 8, (maze - 1) // 3 * _HEIGHT
        parts.append(f'<text x="{left}" y="{top + 14}" fill="{_SOFT}">{maze}</text>')
        corners = _CELL * one.places[:, ::-1] + (left, top + 24)
        for (x, y), walls in zip(corners.tolist(), one.walls, strict=True):
            parts += [_line(x, y, side, _CELL, _INK, 1.2) for side in np.flatnonzero(walls).tolist()]
        path = [0]
        for a in shortest_way(maze):
            path.append(int(one.led[path[-1], a]))
        points = " ".join(f"{x:g},{y:g}" for x, y in (corners[path] + _CELL / 2).tolist())
        parts.append(f'<polyline points="{points}" fill="none" stroke="{COLOURS[0]}" stroke-width="2.5"/>')
        (x, y), colour = (corners[1] + _CELL / 2).tolist(), COLOURS[1]
        parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="4.5" fill="{colour}"/>')
    return "\n".join([*parts, "</svg>"])


def mazes_picture() -> Picture:
    """`mazes_svg` with what is to be seen in it."""
    caption = (
        "Each maze is the one before with one corridor more at its beginning. Seen is only which sides of a cell are "
        "walls; a crossing looks like every other."
    )
    return Picture("Nine mazes", mazes_svg(), caption)


def tree_svg(net: TransitionHierarchy, num_units: int) -> str:
    """The first units of a hierarchy as a tree for each output, from the present to the past.

    Args:
        net: of which inputs are percepts and moves before them.
        num_units: how many of its units.

    Example:
        >>> from neuralq.systems.child.lives import live
        >>> life = live(0, mazes=(1, 2, 3))
        >>> tree_svg(life.net, life.num_units[-1]).count("<rect") == life.num_units[-1]
        True
    """
    rows = _rows(net, NUM_ACTIONS + num_units)
    depth = int(net.delay[: NUM_ACTIONS + num_units].max())
    width, height = _LEFT + 50 + _COLUMN * max(depth, 2), _TOP + _ROW * (max(rows.values()) + 1)
    parts = [_head(width, height, "30rem", f"Four trees with {num_units} units")]
    parts += [
        f'<text x="{_LEFT + _COLUMN * d - 12}" y="16" fill="{_SOFT}">{one}</text>'
        for d, one in enumerate(("move", "sees", "saw before"))
    ]
    for unit, row in rows.items():
        x, y = _LEFT + _COLUMN * int(net.delay[unit]), _TOP + _ROW * (row + 0.5)
        if unit < NUM_ACTIONS:
            parts.append(_arrow(x, y, unit, _INK))
            continue
        parent, at = net.modifies[unit].tolist()
        from_y, from_x = _TOP + _ROW * (rows[parent] + 0.5), x - _COLUMN + (10 if parent < NUM_ACTIONS else 14)
        parts.append(f'<path d="M{from_x} {from_y:g}H{x - 26}V{y:g}H{x - 12}" fill="none" stroke="{_SOFT}"/>')
        parts.append(_moment(x, y, at))
    return "\n".join([*parts, "</svg>"])


def _rows(net: TransitionHierarchy, num_units: int) -> dict[int, int]:
    """Where each of the first units stands: beside the unit that it modifies, or below those that do too."""
    children: dict[int, list[int]] = {unit: [] for unit in range(num_units)}
    for unit in range(net.num_outputs, num_units):
        children[int(net.modifies[unit, 0])].append(unit)
    rows: dict[int, int] = {}
    used = 0
    for output in range(net.num_outputs):
        left = [output]
        while left:
            unit = left.pop()
            rows[unit] = used
            left += reversed(children[unit])
            used += not children[unit]
    return rows


def _moment(x: float, y: float, at: int) -> str:
    """A cell with its walls, and in it the move that led there."""
    percept, a = divmod(at, NUM_ACTIONS + 1)
    parts = [f'<rect x="{x - 11:g}" y="{y - 11:g}" width="22" height="22" fill="#dbe9f6"/>']
    parts += [_line(x - 8.5, y - 8.5, side, 17, "#1b1f24", 2.4) for side in range(4) if percept >> side & 1]
    parts.append(_arrow(x, y, a - 1, "#1b1f24") if a else f'<circle cx="{x:g}" cy="{y:g}" r="3" fill="#1b1f24"/>')
    return "".join(parts)


def tree_picture(life: Life) -> Picture:
    """The units that one life had grown when they were still few."""
    maze = max((i for i, count in enumerate(life.num_units) if count <= _MOST_UNITS), default=0)
    num_units = min(life.num_units[maze], _MOST_UNITS)
    caption = (
        f"All {num_units} units of one life after maze {maze + 1}. At the left the four moves. A square is a unit: "
        "what a move is worth where this is seen (walls dark, inside the move that led here; a dot: the trial began) "
        "depends on what was seen a moment before, and where one square follows another, on the moment before that."
    )
    return Picture("What grew", tree_svg(life.net, num_units), caption)


def steps_picture(found: Mapping[str, Sequence[Life]]) -> Picture:
    """Steps that each maze took: medians, and every life that came so far."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (name, lives) in enumerate(found.items()):
            steps = np.array([one.steps for one in lives], np.float64)
            at = np.arange(1, steps.shape[1] + 1)
            solved = steps <= lives[0].limit
            aside = (i - (len(found) - 1) / 2) * 0.18
            place, _ = np.broadcast_arrays(at + aside + np.linspace(-0.06, 0.06, len(lives))[:, None], steps)
            axes.plot(place[solved], steps[solved], ".", color=COLOURS[i], markersize=3.5, alpha=0.6)
            axes.plot(at + aside, np.median(steps, axis=0), color=COLOURS[i], label=name)
        axes.set(yscale="log", xlabel="maze", ylabel="steps until the shortest way")
        axes.set_xticks(range(1, NUM_MAZES + 1))
        figure.legend(loc="outside upper left", ncols=2, fontsize=9)

    solved = {name: np.mean([sum(one.solved) for one in lives]) for name, lives in found.items()}
    said = " ".join(f"{name}: {mean:.1f} of 9 mazes." for name, mean in solved.items())
    svg = draw_svg("child-steps", "Steps that each maze took", said, (5.2, 4.2), paint)
    caption = (
        "Dots: lives that walk the maze the shortest way; lines: medians, at the top where most were given up. Whoever "
        "learned the mazes before needs a few hundred steps where little is new."
    )
    return Picture("What the mazes before are worth", svg, caption)

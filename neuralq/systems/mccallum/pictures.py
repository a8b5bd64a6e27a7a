"""What the M shows: the maze in the colours of its percepts, the tree that tells them apart, and both learning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neuralq.exact import solve
from neuralq.figures import COLOURS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.mccallum.oracle import BEST, step_costs
from neuralq.systems.mccallum.trials import NUM_LAST, Training
from neuralq_envs.aliased import mccallum, mccallum_grid
from neuralq_envs.maze_picture import maze_svg, percept_colours

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["curves_svg", "learning_picture", "maze_picture", "tree_picture", "tree_svg"]

_ROW, _COLUMN, _LEFT, _TOP = 27, 118, 14, 34
_HEADS = ("sees", "did before", "saw before", "did before that")
_TURNS = (0, 90, 180, 270)


def maze_picture() -> Picture:
    """The maze, and the shortest way of who sees the cell."""
    best = solve(step_costs().mdp, 1.0).optimal_actions
    actions = [np.flatnonzero(one)[:1].tolist() for one in best]
    svg = maze_svg(mccallum_grid(), mccallum().observation, actions, "McCallum's maze of 11 cells, an M", "22rem")
    caption = (
        "Cells of one colour look alike. Arrows: the shortest way for who sees the cell. In the strokes (4) and at the "
        "top (1) cells that look alike need different moves; the feet (5) look alike too, but need the same."
    )
    return Picture("The maze as it is seen", svg, caption)


def tree_svg(leaves: Mapping[tuple[int, ...], NDArray[np.float64]]) -> str:
    """The tree from left to right: a row for each leaf, with the move that it likes best.

    Args:
        leaves: values of each leaf by its suffix.

    Example:
        >>> tree_svg({(0,): np.array([0.0, 1.0, 0.0, 0.0]), (1, 2): np.zeros(4)}).count("<path")
        4
    """
    order = sorted(leaves)
    colours = percept_colours(mccallum_grid(), mccallum().observation)
    depth = max(map(len, order))
    width, height = _LEFT + depth * _COLUMN + 90, _TOP + _ROW * len(order)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" font-family="sans-serif" '
        f'font-size="13" style="display:block;width:100%;max-width:34rem" '
        f'aria-label="A tree with {len(order)} leaves">'
    ]
    parts += [
        f'<text x="{_LEFT + d * _COLUMN}" y="16" fill="var(--soft, #5b6068)">{_HEADS[d]}</text>' for d in range(depth)
    ]
    heights: dict[tuple[int, ...], float] = {}
    for i, suffix in enumerate(order):
        for d in range(1, len(suffix) + 1):
            heights.setdefault(suffix[:d], _TOP + _ROW * (i + 0.5))
    for suffix, y in heights.items():
        x = _LEFT + (len(suffix) - 1) * _COLUMN
        if len(suffix) > 1:
            bend = x - 20
            parts.append(
                f'<path d="M{x - _COLUMN + 24} {heights[suffix[:-1]]:g}H{bend}V{y:g}H{x - 4}" fill="none" '
                'stroke="var(--soft, #5b6068)"/>'
            )
        parts.append(_node(suffix, x, y, colours))
    for suffix in order:
        x, y = _LEFT + (len(suffix) - 1) * _COLUMN, heights[suffix]
        values = leaves[suffix]
        parts.append(_arrow(x + 46, y, int(values.argmax()), "var(--ink, #1b1f24)"))
        parts.append(f'<text x="{x + 60}" y="{y + 4:g}" fill="var(--soft, #5b6068)">{values.max():.1f}</text>')
    return "\n".join([*parts, "</svg>"])


def _node(suffix: tuple[int, ...], x: float, y: float, colours: Mapping[int, str]) -> str:
    """A square with the number of a percept, an arrow for an action, or a dot for the beginning of a trial."""
    label = suffix[-1]
    if label < 0:
        return f'<circle cx="{x + 10}" cy="{y:g}" r="3" fill="var(--ink, #1b1f24)"/>'
    if len(suffix) % 2 == 0:
        return _arrow(x + 10, y, label, "var(--soft, #5b6068)")
    return (
        f'<rect x="{x}" y="{y - 10:g}" width="20" height="20" fill="{colours[label]}" stroke="#5b6068"/>'
        f'<text x="{x + 10}" y="{y + 4.5:g}" text-anchor="middle" fill="#1b1f24">{label}</text>'
    )


def _arrow(x: float, y: float, action: int, colour: str) -> str:
    place = f"translate({x:g} {y:g}) rotate({_TURNS[action]})"
    return f'<path transform="{place}" d="M-1.5 8V-2H-5L0 -9L5 -2H1.5V8z" fill="{colour}"/>'


def tree_picture(training: Training) -> Picture:
    """The tree of one training in the end."""
    caption = (
        f"What one training with USM came to tell apart, {len(training.leaves)} leaves. From left to right: what is "
        "seen now, what was done before (a dot: the trial began there), what was seen before that. At each leaf the "
        "move with the largest value, and the value. Only what looks alike and needs different moves has grown."
    )
    return Picture("The tree", tree_svg(training.leaves), caption)


def curves_svg(found: Mapping[str, Sequence[Training]]) -> str:
    """Steps of each trial, means over seeds and five trials, and leaves of the tree below."""

    def paint(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for (name, trainings), colour in zip(found.items(), COLOURS, strict=False):
            lengths = np.mean([one.lengths for one in trainings], axis=0)
            smooth = lengths[: len(lengths) // 5 * 5].reshape(-1, 5).mean(axis=1)
            above.plot(5 * np.arange(len(smooth)) + 3, smooth, color=colour, label=name)
            for one in trainings:
                if one.leaves:
                    below.plot(np.arange(1, len(one.num_leaves) + 1), one.num_leaves, color=colour, linewidth=0.8)
        above.axhline(BEST, color="#555555", linestyle=":", linewidth=1.2)
        above.text(1, BEST, " 4.3", transform=above.get_yaxis_transform(), va="center", fontsize=9, color="#555555")
        above.set_yscale("log")
        above.set_ylabel("steps of a trial")
        below.set_ylabel("leaves")
        below.set_xlabel("trial")
        figure.legend(loc="outside upper left", ncols=3)

    said = " ".join(f"{name}: {np.mean([one.steps for one in runs]):.2f}." for name, runs in found.items())
    return draw_svg("curves", "Steps of each trial", f"Mean of the last {NUM_LAST}: {said}", (5.2, 4.4), paint)


def learning_picture(found: Mapping[str, Sequence[Training]]) -> Picture:
    """`curves_svg` with what is to be seen in it."""
    caption = (
        "Above: means over seeds, five trials each; dotted: the optimum of who remembers. Below: leaves of every tree."
    )
    return Picture("Learning", curves_svg(found), caption)

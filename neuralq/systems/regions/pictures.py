"""What regions look like: rectangles coloured by cost, and how backups grow with the size of a maze."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.report.claims import Measured, Picture
from neuralq.systems.regions.mazes import Solved
from neuralq.tabular.regions import Region, cover

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.path import Path

__all__ = ["growth_picture", "maze_picture"]


def maze_picture(found: Mapping[str, Solved]) -> Picture:
    """Every region of some mazes, coloured by how far it is from the goal."""

    def paint(figure: Figure) -> None:
        grid = figure.subplots(len(found), 1, squeeze=False)[:, 0]
        for axes, (name, one) in zip(grid, found.items(), strict=True):
            _maze(axes, one)
            axes.set_title(f"{name}: {len(one.plan.regions):,} regions of {one.maze.free.sum():,} cells", fontsize=10)

    said = " ".join(
        f"{name}: {len(one.plan.regions)} rectangles, costs up to {one.plan.regions[-1][1]:.0f}."
        for name, one in found.items()
    )
    svg = draw_svg("mazes", "Regions of equal cost", said, (5.2, 5.4 * len(found)), paint)
    caption = (
        "Each rectangle was backed up at once; colour: how many actions its cells are from the goal (the star), from "
        "violet near it to yellow. Grey: walls. Long slides make long regions; where walls are single cells there is "
        "little to join."
    )
    return Picture("Rectangles, by cost", svg, caption)


def _maze(axes: Axes, one: Solved) -> None:
    from matplotlib import colormaps
    from matplotlib.patches import PathPatch

    costs = sorted({cost for _, cost in one.plan.regions})
    shades = colormaps["viridis"]
    for cost in costs:
        boxes = [region for region, at in one.plan.regions if at == cost]
        colour = shades(cost / max(costs[-1], 1.0))
        axes.add_patch(PathPatch(_outline(boxes), facecolor=colour, edgecolor="#ffffff", linewidth=0.25))
    axes.add_patch(PathPatch(_outline(list(cover(~one.maze.free))), facecolor="#808080", linewidth=0))
    axes.plot(one.maze.goal[1] + 0.5, one.maze.goal[0] + 0.5, "*", color="#D55E00", markersize=11)
    size = len(one.maze.free)
    axes.set(xlim=(-0.3, size + 0.3), ylim=(size + 0.3, -0.3), aspect="equal", xticks=[], yticks=[])


def _outline(boxes: Sequence[Region]) -> Path:
    """The outlines of many rectangles as one path, which takes a tenth of what one for each does."""
    from matplotlib.path import Path

    ends = [(rows.start, rows.stop, columns.start, columns.stop) for rows, columns in boxes]
    corners = [
        (x, y) for top, bottom, left, right in ends for x, y in
        ((left, top), (right, top), (right, bottom), (left, bottom), (left, top))
    ]  # fmt: skip
    codes = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY] * len(boxes)
    return Path(np.array(corners, np.float64).reshape(-1, 2), codes)


def growth_picture(found: Mapping[str, Sequence[Mapping[int, Solved]]]) -> Picture:
    """Backups in units of those of single states, by the size of the maze; medians, and every maze as a dot."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        rng = np.random.default_rng(0)
        for i, (name, mazes) in enumerate(found.items()):
            sizes = np.array(sorted(mazes[0]))
            ratios = np.array([[one[size].ratio for size in sizes] for one in mazes])
            beside = sizes * np.exp(rng.uniform(-0.04, 0.04, ratios.shape))
            axes.plot(beside, ratios, ".", color=COLOURS[i], alpha=0.3, markersize=4)
            axes.plot(sizes, np.median(ratios, axis=0), color=COLOURS[i], marker=MARKERS[i], label=name)
        axes.set(xscale="log", yscale="log", xlabel="cells in a row", ylabel="backups, regions over states")
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.minorticks_off()
        ticks = [0.03, 0.1, 0.3, 1.0]
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        figure.legend(loc="outside upper left", ncols=2, fontsize=9)

    largest = max(next(iter(found.values()))[0])
    said = ", ".join(
        f"{name}: {Measured('ratio', tuple(one[largest].ratio for one in mazes)).median:.3f}"
        for name, mazes in found.items()
    )
    svg = draw_svg("growth", "Backups by the size of the maze", f"{largest} cells in a row: {said}.", (5.2, 4.2), paint)
    caption = (
        "Medians over mazes, dots: each of them. Twice as many cells in a row are four times as many states, but among "
        "rectangles only about twice as many regions: the gain grows with the maze. Among random walls it does not."
    )
    return Picture("Backups by size", svg, caption)

"""What the job shop shows: a schedule before and after, its repair as a film, everybody's quality, and the learning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.job_shop.film import Frame, frames_of, repair_film
from neuralq.systems.job_shop.trials import Repaired, Settings, Training
from neuralq_envs.job_shop.problem import JobShop

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["film", "gantt_picture", "learning_picture", "quality_picture"]


def film(problem: JobShop, repaired: Repaired) -> Picture:
    """One frame for each repair."""
    caption = (
        "Every repair of one held-out problem, chosen by the learned values: above, a row for each task (green: what "
        "the "
        "repair moved); below, what is taken of each pool over time, its capacity as a line and in red what is too "
        "much. "
        "Conflicts are repaired from the left to the right; what they push may make new ones."
    )
    return Picture("A schedule is repaired", repair_film("repairs", problem, frames_of(problem, repaired)), caption)


def gantt_picture(problem: JobShop, repaired: Repaired) -> Picture:
    """The first and the last schedule: tasks in the colour of their mission, the pools below on the same time axis."""
    frames = frames_of(problem, repaired)
    first, last = frames[0], frames[-1]
    shop = problem.arrays
    ends = [frame.usage.shape[2] for frame in (first, last)]

    def paint(figure: Figure) -> None:
        rows = 1 + shop.capacities.size
        ratios = [4.2, *[1.0] * (rows - 1)]
        grid = figure.subplots(rows, 2, sharex=True, sharey="row", gridspec_kw={"height_ratios": ratios})
        for column, (frame, name) in enumerate(((first, "before"), (last, f"after {len(frames) - 1} repairs"))):
            _bars(grid[0, column], problem, frame)
            grid[0, column].set_title(f"{name}: length {ends[column]}", fontsize=10)
            for axes, (k, p) in zip(grid[1:, column], np.ndindex(*shop.capacities.shape), strict=True):
                _band(axes, frame.usage[k, p], int(shop.capacities[k, p]))
            grid[-1, column].set_xlabel("time", fontsize=9)
            grid[-1, column].set_xlim(0, max(ends))
        for axes, (k, p) in zip(grid[1:, 0], np.ndindex(*shop.capacities.shape), strict=True):
            axes.set_ylabel(f"{k}{'ab'[p]}", fontsize=9, rotation=0, labelpad=10)

    over = int((first.usage > shop.capacities[:, :, None]).any(axis=(0, 1)).sum())
    said = f"Before: length {ends[0]}, conflicts at {over} moments. After: length {ends[1]}, none."
    svg = draw_svg("gantt", "The schedule before and after", said, (6.0, 5.2), paint)
    caption = (
        "A held-out problem of three missions (colours). Before: every task as early as the tasks before it allow, "
        "with pools drawn by chance; red is what the four pools do not have. After: the same without a conflict."
    )
    return Picture("Before and after", svg, caption)


def _bars(axes: Axes, problem: JobShop, frame: Frame) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    durations, missions = problem.arrays.durations, np.array(_components(problem))
    for mission in range(missions.max() + 1):  # one outline each: as many rectangles would be three times as long
        corners = [
            np.array([[x, i - 0.4], [x + width, i - 0.4], [x + width, i + 0.4], [x, i + 0.4], [x, i - 0.4]])
            for i, (x, width) in enumerate(zip(frame.start.tolist(), durations.tolist(), strict=True))
            if missions[i] == mission
        ]
        outline = Path.make_compound_path(*(Path(one, closed=True) for one in corners))
        axes.add_patch(PathPatch(outline, facecolor=COLOURS[mission % len(COLOURS)], linewidth=0))
    axes.set_ylim(problem.num_tasks - 0.4, -0.6)
    axes.set_yticks([])
    axes.grid(visible=False, axis="y")


def _band(axes: Axes, usage: np.ndarray[tuple[int, ...], np.dtype[np.int64]], capacity: int) -> None:
    t = np.append(np.flatnonzero(np.diff(usage, prepend=-1)), len(usage))  # where it changes, and the end
    taken = np.append(usage, usage[-1])[t]
    axes.fill_between(t, np.minimum(taken, capacity), step="post", color=COLOURS[4], linewidth=0)
    axes.fill_between(t, capacity, np.maximum(taken, capacity), step="post", color=COLOURS[1], linewidth=0)
    axes.axhline(capacity, color="#555555", linewidth=1)
    axes.set_yticks([])
    axes.set_ylim(0, 2.2 * capacity)
    axes.grid(visible=False)


def _components(problem: JobShop) -> list[int]:
    """Which mission each task belongs to: tasks that wait for each other, however far apart."""
    mission = list(range(problem.num_tasks))
    for i in problem.arrays.order.tolist():
        for j in problem.before[i]:
            old, new = mission[i], mission[j]
            mission = [new if one == old else one for one in mission]
    names = {one: k for k, one in enumerate(dict.fromkeys(mission))}
    return [names[one] for one in mission]


def quality_picture(sets: Mapping[str, Mapping[str, tuple[float, float]]]) -> Picture:
    """Mean RDF against mean repairs, everybody a mark.

    Args:
        sets: by the size of the problems, mean repairs and RDF of everybody by name.
    """

    def paint(figure: Figure) -> None:
        panels = figure.subplots(1, len(sets), squeeze=False)[0]
        for axes, (size, found) in zip(panels, sets.items(), strict=True):
            for i, (name, (repairs, rdf)) in enumerate(found.items()):
                axes.plot(repairs, rdf, MARKERS[i % 7], color=COLOURS[i % 7], markersize=8, label=name)
            axes.set_title(size, fontsize=10)
            axes.set_xlabel("repairs")
            axes.set_ylim(0.95, None)
            axes.margins(x=0.12)
        panels[0].set_ylabel("RDF (1: no longer than S0's TRUI)")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=3, fontsize=9)

    said = " ".join(
        f"{size}: " + ", ".join(f"{name} {rdf:.3f} with {repairs:.0f}" for name, (repairs, rdf) in found.items()) + "."
        for size, found in sets.items()
    )
    svg = draw_svg("quality", "RDF and repairs", said, (6.0, 3.9), paint)
    caption = (
        "Lower is a shorter schedule, further left is less work. Repairs that are drawn are soon over, with a schedule "
        "nobody wants. The list scheduler makes no repairs and knows the whole problem: it is better than all of them."
    )
    return Picture("How good, for how many repairs", svg, caption)


def learning_picture(found: Mapping[str, Sequence[Training]]) -> Picture:
    """The mean return on problems for validation, every training a thin line, their median a thick one."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (name, trainings) in enumerate(found.items()):
            for one in trainings:
                axes.plot(one.episodes, one.scores, color=COLOURS[i], alpha=0.2, linewidth=0.8)
            middle = np.median([one.scores for one in trainings], axis=0)
            axes.plot(trainings[0].episodes, middle, color=COLOURS[i], label=name)
        axes.set_xlabel("episodes of repair")
        axes.set_ylabel("return on other problems")
        axes.legend(loc="lower right")

    said = " ".join(f"{name}: {np.median([one.scores[-1] for one in all_]):.3f}." for name, all_ in found.items())
    svg = draw_svg("learning", "What is learned", f"In the end, medians. {said}", (5.2, 3.4), paint)
    return Picture(
        "What is learned",
        svg,
        f"The return is −RDF − {Settings().step_cost:g} for every repair, as in learning, greedily, on 50 problems "
        "that are not learned from.",
    )

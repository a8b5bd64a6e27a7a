"""What the robot does: its paths from above, and how many targets it reaches by what it learned from how."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.thrun_robot.trainings import SHOWN, Training
from neuralq_envs.thrun_robot import NEAR, STRIDE, outcomes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["curve_picture", "on_the_ground", "path_picture"]

_NUM_PATHS = 16


def on_the_ground(seen: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Where the robot is when it sees a target at these places, having begun at 0 and faced upwards: i is up.

    Args:
        seen: the target in the robot's frame, ``[T, 2]``.

    Returns:
        ``[T]``.

    Example:
        Forward, then a turn, which leaves it where it is.

        >>> on_the_ground(np.array([[1.0, 0.5], [0.65, 0.5], [0.8, 0.18]])).tolist()
        [0j, 0.35j, 0.35j]
    """
    z = seen[:, 0] + 1j * seen[:, 1]
    place, heading = [0j], 1j
    for before, after in itertools.pairwise(z):
        if np.isclose(before - after, STRIDE):
            place.append(place[-1] + STRIDE * heading)
        else:
            heading *= (before / abs(before)) * (abs(after) / after)
            place.append(place[-1])
    return np.array(place)


def path_picture(found: Mapping[str, Training]) -> Picture:
    """Paths of learners of one seed after some episodes and at the end."""
    shown = [n for n in SHOWN if all(n in one.paths for one in found.values())]

    def paint(figure: Figure) -> None:
        grid = figure.subplots(len(shown), len(found), sharex=True, sharey=True, squeeze=False)
        for line, n in zip(grid, shown, strict=True):
            for axes, (name, one) in zip(line, found.items(), strict=True):
                _paths(axes, one.paths[n][:, :_NUM_PATHS])
                reached = int((outcomes(one.paths[n][-1, :_NUM_PATHS]) > 0).sum())
                axes.set_title(f"{name}\n{n} episodes: {reached} of {_NUM_PATHS}", fontsize=10)
            line[0].set_ylabel("metres ahead")
        for axes in grid[-1]:
            axes.set_xlabel("metres aside")

    counts = [
        f"{name} after {n}: {int((outcomes(one.paths[n][-1, :_NUM_PATHS]) > 0).sum())}"
        for n in shown
        for name, one in found.items()
    ]
    said = f"Targets reached of {_NUM_PATHS}: " + "; ".join(counts) + "."
    svg = draw_svg("paths", "Paths of the robot from above", said, (5.6, 2.7 * max(len(shown), 1)), paint)
    caption = (
        f"From above, the first seed; the robot begins at 0 and faces upwards. Blue: ways that end within {NEAR:g} m "
        "of their target (dots). Orange: targets that are lost, or not reached after 30 steps (crosses); who only "
        "turns leaves no line."
    )
    return Picture("The robot from above", svg, caption)


def _paths(axes: Axes, seen: NDArray[np.float64]) -> None:
    for one in seen.swapaxes(0, 1):
        place, target = on_the_ground(one), 1j * complex(*one[0])
        reached = bool(outcomes(one[-1]) > 0)
        colour = COLOURS[0] if reached else COLOURS[1]
        axes.plot(place.real, place.imag, color=colour, linewidth=1.2, alpha=0.8)
        axes.plot(target.real, target.imag, "o" if reached else "x", color=colour, markersize=4.5)
    axes.plot(0, 0, "^", color="#000000", markersize=7)
    axes.set_aspect("equal")
    axes.set_xlim(-3.9, 3.9)
    axes.set_ylim(-1.2, 4.4)


def curve_picture(found: Mapping[str, Sequence[Training]]) -> Picture:
    """The share of targets that are reached by the number of episodes, means over seeds with their standard error."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (name, trainings) in enumerate(found.items()):
            shares = np.array([one.success for one in trainings])
            middle, error = shares.mean(axis=0), shares.std(axis=0) / np.sqrt(len(shares))
            at, learns = np.arange(len(middle)), bool(np.ptp(shares, axis=1).any())
            every = max(len(middle) // 8, 1)
            line, marker = ("-", MARKERS[i]) if learns else (":", "")
            axes.plot(at, middle, line, color=COLOURS[i], marker=marker, markevery=every, label=name)
            axes.fill_between(at, middle - error, middle + error, color=COLOURS[i], alpha=0.15, linewidth=0)
        axes.set_ylim(-0.02, 1.05)
        axes.set_xlabel("episodes that are learned from")
        axes.set_ylabel("share of targets that are reached")
        figure.legend(loc="outside upper left", ncols=2, fontsize=9)

    last = {name: np.mean([one.success[-1] for one in trainings]) for name, trainings in found.items()}
    said = "At the end: " + ", ".join(f"{name}: {share:.2f}" for name, share in last.items()) + "."
    svg = draw_svg("success", "Targets reached by the number of episodes", said, (5.2, 4.4), paint)
    caption = (
        "Means over seeds, shaded by their standard error: 100 targets that were not seen, every move the best one. "
        "All four learners of a seed begin with the same networks and face the same targets and random moves."
    )
    return Picture("Success by episode", svg, caption)

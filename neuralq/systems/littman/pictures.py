"""What the maze shows: a move for each percept, and how far each training has to walk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neuralq.figures import COLOURS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.littman.trainings import LOST, Training
from neuralq_envs.aliased import littman, littman_grid
from neuralq_envs.maze_picture import maze_svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["policy_picture", "steps_picture", "steps_svg"]


def policy_picture(policy: NDArray[np.int64], whose: str) -> Picture:
    """The maze with the move of each percept."""
    maze = littman()
    moves = [
        [] if terminal else [int(policy[o])] for o, terminal in zip(maze.observation, maze.mdp.is_terminal, strict=True)
    ]
    shared = int((np.bincount(maze.observation[~maze.mdp.is_terminal]) > 1).sum())
    said = f"Littman's maze of 46 cells and a goal, with the move of each percept; {shared} percepts are shared"
    caption = (
        f"What {whose} does at each percept. Cells of one colour and number look alike, for they have the same walls "
        f"around them, so the same is done there; white ones look like no other. {shared} percepts are of more than "
        "one cell."
    )
    return Picture("A move for each percept", maze_svg(littman_grid(), maze.observation, moves, said), caption)


def steps_svg(found: Mapping[str, Sequence[Training]], best: float) -> str:
    """How far each training has to walk from the 46 starts together, a dot each.

    Args:
        found: trainings by the name of their method.
        best: what the best policy needs.
    """

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        rng = np.random.default_rng(0)
        for i, trainings in enumerate(found.values()):
            beside = i + rng.uniform(-0.18, 0.18, len(trainings))
            axes.plot(beside, [one.total for one in trainings], "o", color=COLOURS[i], alpha=0.6)
        axes.axhline(best, color="#555555", linestyle=":", linewidth=1.2)
        axes.text(len(found) - 0.5, best, f"best: {best:.0f}", va="bottom", ha="right", fontsize=9, color="#555555")
        axes.set_yscale("log")
        axes.set_xlim(-0.5, len(found) - 0.5)
        axes.set_xticks(range(len(found)), list(found))
        axes.set_ylabel(f"steps from 46 starts\n({LOST:,} for one that never arrives)")

    said = " ".join(f"{name}: {', '.join(f'{one.total:,}' for one in runs)}." for name, runs in found.items())
    return draw_svg("walks", "Steps from all starts by method", said, (5.2, 3.4), paint)


def steps_picture(found: Mapping[str, Sequence[Training]], best: float) -> Picture:
    """`steps_svg` with what is to be seen in it."""
    caption = (
        "Dots: trainings. Without traces a value leans on the values of what is seen next, and these are mixed up: the "
        "policy runs in circles from most starts."
    )
    return Picture("How far it is from everywhere", steps_svg(found, best), caption)

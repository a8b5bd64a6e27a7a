"""What OBELIX shows: a trial from above, and how often boxes are pushed by who learned how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg, steps_axis
from neuralq.runs.report.claims import Picture
from neuralq.systems.obelix.film import room_film
from neuralq.systems.obelix.lives import TRIAL_STEPS, Life

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["curve_picture", "film_picture"]

_BINS = 16


def film_picture(lives: Sequence[Life]) -> Picture:
    """The last trial of the life that pushed most in it."""
    best = max(lives, key=lambda life: int(life.pushed[-TRIAL_STEPS:].sum()))
    count = int(best.pushed[-TRIAL_STEPS:].sum())
    caption = (
        "The last hundred steps of one life, from above. The colour of the robot is the behaviour in control: it looks "
        "for a box, pushes what it touches, and frees itself where it is stuck. Dashed: its eight sonars."
    )
    return Picture(
        "The robot from above", room_film("room", f"{count} pushes in {TRIAL_STEPS} steps", best.film), caption
    )


def curve_picture(found: Mapping[str, Sequence[Life]]) -> Picture:
    """The share of steps that push over a life, means over seeds with their standard error."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (name, lives) in enumerate(found.items()):
            shares = np.array([[part.mean() for part in np.array_split(life.pushed, _BINS)] for life in lives])
            at = (np.arange(_BINS) + 0.5) * len(lives[0].pushed) / _BINS
            middle, error = shares.mean(axis=0), shares.std(axis=0) / np.sqrt(len(lives))
            colour, learner = COLOURS[i // 2 if i < 6 else i - 3], i < 6
            line = "-" if i % 2 or not learner else "--"
            axes.plot(at, middle, line, color=colour, marker=MARKERS[i % 7], label=name)
            axes.fill_between(at, middle - error, middle + error, color=colour, alpha=0.15, linewidth=0)
        axes.set_ylim(bottom=0)
        axes.set_ylabel("share of steps that push a box")
        steps_axis(axes, "steps of a life")
        figure.legend(loc="outside upper left", ncols=2, fontsize=9)

    said = ", ".join(f"{name}: {np.mean([life.share for life in lives]):.3f}" for name, lives in found.items())
    svg = draw_svg("lives", "Share of steps that push a box", f"In the last quarter: {said}.", (5.2, 4.4), paint)
    caption = (
        "Means over seeds, shaded by their standard error. Solid: three behaviours, each with a reward of its own; "
        "dashed: one learner for all."
    )
    return Picture("Learning to push", svg, caption)

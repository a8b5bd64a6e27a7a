"""What Lin's world shows: a play from above, and food by plays for whoever learned how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.lin.film import board_film, ending, num_eaten
from neuralq.systems.lin.trainings import Training

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["curves_svg", "film_picture", "learning_picture"]


def film_picture(trainings: Sequence[Training]) -> Picture:
    """Of the plays that end trainings the one with most food, the shortest of those."""
    films = [one.film for one in trainings if one.film is not None]
    film = max(films, key=lambda one: (num_eaten(one), -len(one.outcomes)))
    caption = (
        "A play after 300 plays of learning, from above, without exploring. Small dots are the sensors that are lit, "
        "for food and for enemies; they go with the agent and see up to twelve cells far. Bar: its energy, 1 less with "
        "every step and 15 more with every meal."
    )
    said = f"{num_eaten(film)} of {len(film.meals)} eaten, {ending(film)} after {len(film.outcomes) - 1} steps"
    return Picture("The world from above", board_film("lin", said, film), caption)


def curves_svg(found: Mapping[str, Sequence[Training]]) -> str:
    """Food eaten without exploring by plays: means over seeds with their standard error."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (name, trainings) in enumerate(found.items()):
            food, colour = np.array([one.food for one in trainings]), COLOURS[i % len(COLOURS)]
            middle, error = food.mean(axis=0), food.std(axis=0) / np.sqrt(len(food))
            if len(middle) == 1:
                axes.axhline(middle[0], color=colour, linestyle=":", label=name)
                continue
            at = trainings[0].plays
            axes.plot(at, middle, color=colour, marker=MARKERS[i % len(MARKERS)], label=name)
            axes.fill_between(at, middle - error, middle + error, color=colour, alpha=0.15, linewidth=0)
        axes.set(xlabel="plays", ylabel="food eaten, of 15", ylim=(0, 15), xlim=(0, None))
        figure.legend(loc="outside upper left", ncols=2, fontsize=9)

    said = ", ".join(f"{name}: {np.mean([one.last for one in trainings]):.1f}" for name, trainings in found.items())
    return draw_svg("food", "Food eaten by plays", f"In the last four tests: {said}.", (5.2, 4.4), paint)


def learning_picture(found: Mapping[str, Sequence[Training]]) -> Picture:
    """The curves, with what is to be seen."""
    caption = (
        "Food eaten in a test without exploring, of 15, by plays that were learned from. Means over seeds, shaded by "
        "their standard error; dotted: who does not learn."
    )
    return Picture("Learning to eat and not to be eaten", curves_svg(found), caption)

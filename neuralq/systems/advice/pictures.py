"""What advice shows: a game from above, and how good play is by games, with the moments of advice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg, steps_axis
from neuralq.runs.report.claims import Picture
from neuralq.systems.advice.film import game_film, played
from neuralq.systems.advice.rules import GOOD
from neuralq.systems.advice.studies import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["curve_picture", "film_picture"]

_NUM_LOOKED_AT = 12


def film_picture(study: Study) -> Picture:
    """The best of a dozen games of one network that was told everything."""
    rules = [rule for kind in GOOD.values() for rule in kind]
    games = [played(study.network, rules, seed) for seed in range(_NUM_LOOKED_AT)]
    best = max(games, key=lambda moments: moments[-1].total)
    caption = (
        f"A greedy game of the network that was told all rules at the start, first seed, best of {_NUM_LOOKED_AT}. "
        "The arrow is what the player does next, with a bar where it pushes; in orange where a rule says so."
    )
    told = f"{best[-1].total:.1f} in {len(best) - 1} steps"
    return Picture("A game from above", game_film("game", told, best), caption)


def curve_picture(found: Mapping[str, Sequence[Study]]) -> Picture:
    """Return of greedy games by games of training, means over seeds with their standard error."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (name, studies) in enumerate(found.items()):
            one = studies[0]
            returns = np.array([study.returns for study in studies])
            middle, error = returns.mean(axis=0), returns.std(axis=0) / np.sqrt(len(studies))
            later = one.games >= (one.told_at or 0)  # until then it is the learner that is told nothing
            colour = COLOURS[i % len(COLOURS)]
            at = one.games[later]
            axes.plot(at, middle[later], color=colour, marker=MARKERS[i % 7], markevery=2, label=name)
            axes.fill_between(
                at, (middle - error)[later], (middle + error)[later], color=colour, alpha=0.15, linewidth=0
            )
            if one.told_at:
                axes.axvline(one.told_at, color=colour, linestyle=":", linewidth=1.2)
        axes.set_ylabel("return of greedy games")
        steps_axis(axes, "games of training")
        figure.legend(loc="outside upper left", ncols=2, fontsize=9)

    said = ", ".join(f"{name}: {np.mean([one.late for one in studies]):.2f}" for name, studies in found.items())
    svg = draw_svg("curves", "Return by games of training", f"In the last quarter: {said}.", (5.2, 4.4), paint)
    caption = (
        "Mean return of the same 200 greedy games, means over seeds, shaded by their standard error. Dotted: when "
        "something was said; the first point there is just after it."
    )
    return Picture("Before and after advice", svg, caption)

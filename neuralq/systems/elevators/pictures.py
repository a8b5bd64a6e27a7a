"""What the elevators show: the same minutes three times, waits by contender, and how the network comes to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.elevators.contenders import LEARNED, NAMES, Outcome
from neuralq.systems.elevators.controllers import ALWAYS_STOP, LQF, NETWORK, new_controller
from neuralq.systems.elevators.film import elevator_film, record
from neuralq.systems.elevators.training import held_out_hours

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["bars_picture", "curve_picture", "film"]

_BEGIN, _END = 1260.0, 1500.0  # within the five minutes in which most people come


def film(learned: Outcome) -> Picture:
    """Four minutes of an hour that nobody has learned from, under the network and two rules of thumb."""
    assert learned.training is not None
    hour = held_out_hours(learned.seed, 1)[0]
    network = learned.training.network
    scenes = [
        record(name, new_controller(rule, seed=learned.seed, network=network), hour, _BEGIN, _END)
        for name, rule in ((LEARNED, NETWORK), (NAMES[LQF], LQF), (NAMES[ALWAYS_STOP], ALWAYS_STOP))
    ]
    caption = (
        "Four minutes of the same hour, from the 21st on, six times as fast as they were: the same people come at the "
        "same moments to the same floors, and all want down to floor 0. A dot is somebody who waits, blue at first and "
        "red after a minute; a car is filled as far as it is full."
    )
    return Picture("The same people, three ways to run the cars", elevator_film("lift", scenes), caption)


def bars_picture(found: Mapping[str, Sequence[Outcome]]) -> Picture:
    """Mean squared wait of every contender, a dot for each seed."""
    names = sorted(found, key=lambda name: _squared(found[name]))

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_xscale("log")
        for row, name in enumerate(reversed(names)):
            values = [one.waits.squared for one in found[name]]
            colour = COLOURS[1] if name == LEARNED else COLOURS[0] if name in NAMES.values() else "#999999"
            axes.barh(row, _squared(found[name]) - 200, left=200, color=colour, alpha=0.35, height=0.62)
            axes.plot(values, np.full(len(values), row), "o", color=colour, markersize=4)
        axes.set_yticks(range(len(names)), list(reversed(names)))
        axes.set_xlim(200, 40_000)
        axes.set_xticks([300, 1000, 3000, 10_000, 30_000], ["300", "1,000", "3,000", "10,000", "30,000"])
        axes.minorticks_off()
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("mean squared wait (s²)")

    said = " ".join(f"{name}: {_squared(found[name]):,.0f}." for name in names)
    svg = draw_svg("bars", "Mean squared wait by contender", said, (5.4, 3.6), paint)
    caption = (
        "Fifty hours for each seed that nobody has learned from, the same for all contenders. Bars: medians; dots: "
        "seeds. Blue: rules of thumb; grey: learners with a planted fault. The square makes one wait of a minute as "
        "bad as thirty-six of ten seconds."
    )
    return Picture("Squared waits", svg, caption)


def curve_picture(found: Mapping[str, Sequence[Outcome]]) -> Picture:
    """Squared waits on the held-out hours while the network learns."""
    learned = [one for one in found[LEARNED] if one.training is not None]

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_yscale("log")
        for i, one in enumerate(learned):
            assert one.training is not None
            label = LEARNED if i == 0 else None
            axes.plot(one.training.hours, one.training.squared, "o-", color=COLOURS[1], alpha=0.6, label=label)
            axes.plot(
                one.training.hours[-1] * 1.03, one.waits.squared, "D", color=COLOURS[6],
                label="its averaged weights" if i == 0 else None,
            )  # fmt: skip
        for name, colour in (("LQF", COLOURS[0]), ("HUFF", COLOURS[2]), ("nearest car", COLOURS[3])):
            axes.axhline(_squared(found[name]), color=colour, linestyle="--", label=name)
        axes.set_yticks([300, 500, 1000, 2000], ["300", "500", "1,000", "2,000"])
        axes.minorticks_off()
        axes.set_xlabel("simulated hours")
        axes.set_ylabel("mean squared wait (s²)")
        figure.legend(loc="outside upper left", ncols=3)

    ends = ", ".join(f"{one.waits.squared:,.0f}" for one in learned)
    svg = draw_svg("curve", "Squared waits while it learns", f"Averaged weights in the end: {ends}.", (5.4, 3.6), paint)
    caption = (
        "Each line is a training, measured without exploration by the weights of the moment. Those jump about; what is "
        "kept is their average over the last 30 % of the hours."
    )
    return Picture("How it comes to it", svg, caption)


def _squared(outcomes: Sequence[Outcome]) -> float:
    return float(np.median([one.waits.squared for one in outcomes]))

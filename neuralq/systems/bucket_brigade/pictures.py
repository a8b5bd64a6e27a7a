"""What the bucket brigade shows: payment that moves up a chain, what ZCS learned of Woods1, and how fast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, draw_svg, steps_axis
from neuralq.runs.report.claims import Picture
from neuralq.systems.bucket_brigade.chain import expected_bids
from neuralq.systems.bucket_brigade.lives import FREE, Life, best_moves
from neuralq_envs.woods import MOVES, WOODS1

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["chain_picture", "curve_picture", "woods_picture"]

_PASSES = (10, 30, 60, 100, 150, 250)
_WINDOW = 250  # problems that the curve averages


def chain_picture(num_rules: int = 10) -> Picture:
    """What each rule of a chain bids after some passes."""
    bid = expected_bids(num_rules, max(_PASSES))

    def paint(figure: Figure) -> None:
        from matplotlib import colormaps

        axes = figure.subplots()
        for i, k in enumerate(_PASSES):
            colour = colormaps["viridis"](i / len(_PASSES))
            axes.plot(np.arange(1, num_rules + 1), bid[k], marker="o", color=colour, label=f"{k} passes")
        axes.set(xlabel="rule of the chain", ylabel="bid (the last rule is paid 100)", ylim=(-3, 103))
        axes.set_xticks(range(1, num_rules + 1))
        figure.legend(loc="outside upper left", ncols=3, fontsize=9)

    said = " ".join(f"After {k} passes the first of {num_rules} rules bids {bid[k, 0]:.1f}." for k in _PASSES)
    svg = draw_svg("chain", "Bids along a chain of rules", said, (5.2, 3.9), paint)
    caption = (
        "Ten rules that fire one after the other, each of which pays a tenth of its strength to the one before. A wave "
        "of payment moves from the last rule to the first, one rule in ten passes."
    )
    return Picture("Payment moves up the chain", svg, caption)


def woods_picture(life: Life) -> Picture:
    """Woods1 with the strongest move of each cell."""
    rows = WOODS1.split()

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for y, row in enumerate(rows):
            for x, sign in enumerate(row):
                if sign == "O":
                    axes.plot(x, y, "o", color=COLOURS[2], markersize=22)
                elif sign == "F":
                    axes.plot(x, y, "*", color=COLOURS[1], markersize=22)
        for cell, move in zip(FREE.tolist(), life.moves.tolist(), strict=True):
            (down, across), (y, x) = MOVES[move], divmod(cell, len(rows[0]))
            short = 0.32 / max(np.hypot(down, across), 1.0)
            axes.annotate(
                "", (x + short * across, y + short * down), (x - short * across, y - short * down),
                arrowprops={"arrowstyle": "->", "color": COLOURS[0], "linewidth": 1.8},
            )  # fmt: skip
        axes.set(xlim=(-0.6, 4.6), ylim=(4.6, -0.6), aspect="equal", xticks=[], yticks=[])
        axes.grid(visible=False)

    best = best_moves(life.moves)
    svg = draw_svg("woods", "What ZCS does in Woods1", f"{best} of 16 moves are best.", (3.6, 3.6), paint)
    caption = (
        "The move with most strength behind it in each free cell, first seed; trees are green, food is a star, and the "
        f"map repeats itself on all sides. {best} of the 16 are on a shortest way."
    )
    return Picture("Woods1", svg, caption)


def curve_picture(found: Mapping[str, Sequence[Life]], shortest: float) -> Picture:
    """Steps by problem: means over seeds and over 250 problems, with their standard error."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (name, lives) in enumerate(found.items()):
            steps = np.array([one.steps[: len(one.steps) // _WINDOW * _WINDOW] for one in lives], np.float64)
            means = steps.reshape(len(lives), -1, _WINDOW).mean(axis=2)
            at, middle = (np.arange(means.shape[1]) + 0.5) * _WINDOW, means.mean(axis=0)
            error = means.std(axis=0) / np.sqrt(len(lives))
            axes.plot(at, middle, ":" if i == len(found) - 1 else "-", color=COLOURS[i], label=name)
            axes.fill_between(at, middle - error, middle + error, color=COLOURS[i], alpha=0.2, linewidth=0)
        axes.axhline(shortest, color="#555555", linestyle="--", linewidth=1.2, label="shortest ways")
        axes.set(yscale="log", ylabel="steps to food")
        ticks = (2, 3, 5, 10, 30)
        axes.set_yticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        steps_axis(axes, "problems")
        figure.legend(loc="outside upper left", ncols=3, fontsize=9)

    said = ", ".join(f"{name}: {np.mean([one.late for one in lives]):.2f}" for name, lives in found.items())
    svg = draw_svg("steps", "Steps to food by problem", f"In the last tenth: {said}.", (5.2, 4.0), paint)
    caption = (
        f"Means over seeds and {_WINDOW} problems, shaded by their standard error. It never stops exploring: moves are "
        "drawn by strength to the end, so that the shortest ways are not reached."
    )
    return Picture("Learning to find food", svg, caption)

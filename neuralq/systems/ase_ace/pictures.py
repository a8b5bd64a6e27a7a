"""What ASE/ACE shows: trials before and after, how long they last, and what both elements think of every box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neuralq.figures import COLOURS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.ase_ace.trials import Training, film_trials
from neuralq.tabular.kernels.ase_ace import AseAce, AseAceRates
from neuralq_envs.pole_film import Scene, pole_film

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["boxes_picture", "film", "lengths_picture", "median_lengths"]

_FILM_STEPS = 500  # ten seconds
_TRIALS = 200  # that the curve shows


def film(training: Training, rates: AseAceRates) -> Picture:
    """The first trial, one half way, and the first ten seconds of the last."""
    last = len(training.lengths) - 1
    trials = sorted({0, last // 2, last})
    scenes = []
    for trial, states in zip(trials, film_trials(training, rates, trials, _FILM_STEPS), strict=True):
        steps = int(training.lengths[trial])
        lasted = f"{steps:,} steps" + (f", the first {_FILM_STEPS // 50} s of them" if steps > _FILM_STEPS else "")
        scenes.append(Scene(f"trial {trial + 1}: {lasted}", states, steps <= _FILM_STEPS, COLOURS[0]))
    caption = (
        "One training in real time. It starts with nothing and is told nothing until the pole falls (12 degrees) or "
        "the cart leaves its track (2.4 m, the marks)."
    )
    return Picture("The pole, before and after", pole_film("pole", scenes), caption)


def median_lengths(trainings: Sequence[Training], num_trials: int) -> NDArray[np.float64]:
    """The median over trainings of how long each trial lasted, ``[num_trials]``; who balances goes on balancing.

    Example:
        >>> from neuralq.systems.ase_ace.trials import train
        >>> one = train(0, most_failures=3)
        >>> bool((median_lengths([one], 3) == one.lengths).all())
        True
    """
    table = np.full((len(trainings), num_trials), np.nan)
    for row, one in zip(table, trainings, strict=True):
        count = min(len(one.lengths), num_trials)
        row[:count] = one.lengths[:count]
        if one.balanced:
            row[count:] = one.long_trial_steps
    return np.asarray(np.median(table, axis=0))


def lengths_picture(found: Mapping[str, Sequence[Training]]) -> Picture:
    """How long trials last, by their number: medians, and every training of the first contender behind them."""
    first = next(iter(found))

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_yscale("log")
        for one in found[first]:
            lengths = one.lengths[:_TRIALS]
            axes.plot(np.arange(1, len(lengths) + 1), lengths, color=COLOURS[0], alpha=0.13, linewidth=0.8)
        for (name, trainings), colour in zip(found.items(), COLOURS, strict=False):
            axes.plot(np.arange(1, _TRIALS + 1), median_lengths(trainings, _TRIALS), color=colour, label=name)
        axes.set_xlabel("trial")
        axes.set_ylabel("steps until the pole falls")
        figure.legend(loc="outside upper left", ncols=2)

    said = " ".join(f"{name}: {median_lengths(runs, _TRIALS)[-1]:,.0f}." for name, runs in found.items())
    svg = draw_svg("lengths", "Steps of each trial", f"Median at trial {_TRIALS}. {said}", (5.2, 3.7), paint)
    caption = (
        "Median over seeds of how long each trial lasted (thin: every training of ASE/ACE). With the critic the curve "
        "leaves the bottom after some tens of failures; without it, it hardly does."
    )
    return Picture("How long trials last", svg, caption)


def boxes_picture(elements: AseAce) -> Picture:
    """All 162 boxes: the colour is the critic's prediction, the arrow what the other element does."""
    p = elements.predictions.reshape(3, 6, 3, 3)  # θ̇, θ, ẋ, x
    w = elements.weights.reshape(3, 6, 3, 3)
    lowest = min(float(p.min()), -1e-9)

    def paint(figure: Figure) -> None:
        from matplotlib.colors import LinearSegmentedColormap

        red = LinearSegmentedColormap.from_list("red", ("#cb181d", "#ffffff"))  # as strong where the page inverts it
        grid = figure.subplots(3, 3, sharex=True, sharey=True)
        for (x_dot, x), axes in np.ndenumerate(grid):
            shown = axes.pcolormesh(
                p[:, :, x_dot, x], cmap=red, vmin=lowest, vmax=0, edgecolor="#bbbbbb", linewidth=0.3
            )
            _arrows(axes, w[:, :, x_dot, x], p[:, :, x_dot, x] < 0.6 * lowest)
            _label(axes, x_dot, x)
        figure.supxlabel("angle of the pole (degrees)", fontsize=9)
        figure.supylabel("where the pole is turning (slow: up to 50 degrees/s)", fontsize=9)
        bar = figure.colorbar(shown, ax=grid, location="top", aspect=40, shrink=0.8)
        assert bar.solids is not None
        bar.solids.set_rasterized(False)  # the page loads no image
        bar.set_label("prediction of the critic (a fall is −1)", fontsize=9)
        bar.ax.tick_params(labelsize=7)

    right = int(np.count_nonzero(elements.weights > 0))
    left = int(np.count_nonzero(elements.weights < 0))
    described = f"162 boxes: {right} push right, {left} push left, {162 - right - left} were never learned in."
    svg = draw_svg("boxes", "What both elements learned", described, (5.2, 5.4), paint)
    caption = (
        "What one training has learned. Nine panels for where the cart is (across) and how fast it moves (down); "
        "within each, the angle of the pole across and its angular velocity upwards. Colour: how surely the critic "
        "expects a fall. Arrow: the way that is pushed; a dot where it was never told anything."
    )
    return Picture("What both elements learned", svg, caption)


def _label(axes: Axes, x_dot: int, x: int) -> None:
    axes.set_xticks(range(7), ["−12", "−6", "−1", "0", "1", "6", "12"], fontsize=7)
    axes.set_yticks([0.5, 1.5, 2.5], ["left", "slow", "right"], fontsize=7)
    axes.grid(visible=False)
    if x_dot == 0:
        axes.set_title(("x < −0.8 m", "middle", "x > 0.8 m")[x], fontsize=9)
    if x == 2:
        axes.yaxis.set_label_position("right")
        axes.set_ylabel(("ẋ < −0.5 m/s", "slow", "ẋ > 0.5 m/s")[x_dot], fontsize=9)


def _arrows(axes: Axes, weights: NDArray[np.float64], on_dark: NDArray[np.bool_]) -> None:
    for (row, column), weight in np.ndenumerate(weights):
        sign = "→" if weight > 0 else "←" if weight < 0 else "·"
        colour = "white" if on_dark[row, column] else "black"
        axes.text(column + 0.5, row + 0.5, sign, ha="center", va="center", fontsize=9, color=colour)

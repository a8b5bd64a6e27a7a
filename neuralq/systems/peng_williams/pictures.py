"""What Q(λ) on the pole shows: failures by λ, and the same trial of two trainings side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.report.claims import Measured, Picture
from neuralq.systems.peng_williams.trials import Training, film_trials
from neuralq_envs.pole_film import Scene, pole_film

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["failures_picture", "film"]

_FILM_STEPS = 500  # ten seconds


def film(one_step: Training, traced: Training) -> Picture:
    """The first trial of Q(λ), its last one, and that of one-step Q-learning after as many failures."""
    last = len(traced.lengths) - 1
    beside = min(last, len(one_step.lengths) - 1)
    scenes = []
    for training, trial, colour in (
        (traced, 0, COLOURS[1]),
        (one_step, beside, COLOURS[0]),
        (traced, last, COLOURS[1]),
    ):
        (states,) = film_trials(training, [trial], _FILM_STEPS)
        steps = int(training.lengths[trial])
        lasted = f"{steps:,} steps" + (f", the first {_FILM_STEPS // 50} s" if steps > _FILM_STEPS else "")
        caption = f"λ = {training.settings.lambda_:g}, trial {trial + 1}: {lasted}"
        scenes.append(Scene(caption, states, steps <= _FILM_STEPS, colour))
    caption = (
        "Two trainings in real time, of the same seed: λ = 0.9 when it begins, and both of them when λ = 0.9 has "
        "learned to balance."
    )
    return Picture("The pole, after as many failures", pole_film("pole", scenes), caption)


def failures_picture(groups: Mapping[str, Sequence[Sequence[Training]]]) -> Picture:
    """Failures before the long trial by λ: medians with their interval, and every training as a dot.

    Args:
        groups: by a name, the trainings of each λ.
    """

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_yscale("log")
        rng = np.random.default_rng(0)
        for i, (name, cells) in enumerate(groups.items()):
            middle, low, high = _medians(cells)
            across = np.arange(len(cells)) + 0.12 * (2 * i - len(groups) + 1)
            for x, trainings in zip(across, cells, strict=True):
                beside = x + rng.uniform(-0.07, 0.07, len(trainings))
                axes.plot(beside, [one.failures for one in trainings], ".", color=COLOURS[i], alpha=0.3, markersize=4)
            bars = np.stack([middle - low, high - middle])
            axes.errorbar(
                across, middle, bars, color=COLOURS[i], marker=MARKERS[i], capsize=3, linewidth=1.6, label=name
            )
        cells = next(iter(groups.values()))
        axes.set_xticks(range(len(cells)), [f"{runs[0].settings.lambda_:g}" for runs in cells])
        most = cells[0][0].settings.most_failures
        axes.axhline(most, color="#555555", linestyle=":", linewidth=1.2)
        axes.text(0, most * 0.9, "given up", va="top", fontsize=9, color="#555555")
        axes.set_xlabel("λ")
        axes.set_ylabel("failures until it balances")
        figure.legend(loc="outside upper left", ncols=2)

    said = " ".join(
        f"{name}: " + ", ".join(f"λ = {runs[0].settings.lambda_:g}: {_failures(runs)}" for runs in cells) + "."
        for name, cells in groups.items()
    )
    svg = draw_svg("failures", "Failures until the pole is balanced, by λ", said, (5.2, 3.8), paint)
    caption = (
        "Dots: trainings. Marks: medians with what the true median lies in with 95 %. Between the two ends lies what "
        "Q(λ) is for: λ = 0 passes a reward on one step at a time, λ = 1 believes nothing but whole trials."
    )
    return Picture("Failures by λ", svg, caption)


def _failures(trainings: Sequence[Training]) -> Measured:
    most = trainings[0].settings.most_failures
    return Measured("failures", tuple(one.failures for one in trainings), most)


def _medians(cells: Sequence[Sequence[Training]]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Median, lower and upper bound for each λ, ``[3, L]``; of few seeds the bounds are the range."""
    measured = [_failures(trainings) for trainings in cells]
    ends = [one.interval or (min(one.values), max(one.values)) for one in measured]
    return np.array([[one.median, *end] for one, end in zip(measured, ends, strict=True)]).T

"""What slopes do to a fit: a cut through it with points and tangents, where it is wrong, and the error by episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.report.claims import Measured, Picture
from neuralq.systems.ebnn.fits import BELIEVED, EXPLAINED, NONE, NUM_POINTS, WEIGHED, Fit, fit
from neuralq_envs.linear_quadratic import PUSH, action_values

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["cut_picture", "error_picture", "map_picture"]

_CUT = np.array([[-0.8, 0.0], [0.1, 0.0], [0.6, 0.0]])  # episodes that begin at rest
_TANGENT = 0.16
_GREY = "#777777"


def cut_picture(seed: np.random.SeedSequence) -> Picture:
    """Three episodes that begin at rest, and what is made of them with slopes and without."""
    panels = {
        "values alone": (NONE,),
        "slopes by a good theory": (EXPLAINED,),
        "slopes by a bad theory": (BELIEVED, WEIGHED),
    }
    names = {BELIEVED: "believed", WEIGHED: "weighed by LOB*"}
    fits = {source: fit(seed, source, (len(_CUT),), _CUT) for sources in panels.values() for source in sources}
    across = np.linspace(-1, 1, 101)
    line = np.stack([across, np.zeros(101)], axis=-1)
    truth = action_values(line, PUSH)

    def paint(figure: Figure) -> None:
        grid = figure.subplots(len(panels), 1, sharex=True, sharey=True)
        for axes, (title, sources) in zip(grid, panels.items(), strict=True):
            axes.plot(across, truth, color=_GREY, linestyle="--", linewidth=1.4, label="Q, exact")
            for source in sources:
                colour = COLOURS[1] if source in (NONE, BELIEVED) else COLOURS[0]
                one = fits[source].nets[len(_CUT)]
                axes.plot(across, one.values(line), color=colour, label=names.get(source, "fit"))
            if sources != (NONE,):
                _tangents(axes, fits[sources[0]])
            axes.plot(_CUT[:, 0], action_values(_CUT, PUSH), "o", color="#000000", markersize=6, zorder=5)
            axes.set_title(title, fontsize=11, loc="left")
            axes.legend(loc="lower right", fontsize=9, ncols=len(sources) + 1)
            axes.set_ylim(truth.min() - 2.2, truth.max() + 1.0)
            axes.set_ylabel("value of pushing")
        grid[-1].set_xlabel("position where the episode begins, at rest")

    worst = {source: np.abs(one.nets[len(_CUT)].values(line) - truth).max() for source, one in fits.items()}
    said = "Largest error along the cut: " + ", ".join(f"{source}: {value:.2f}" for source, value in worst.items())
    svg = draw_svg("cut", "Three episodes, fitted with slopes and without", said + ".", (5.2, 7.2), paint)
    caption = (
        "A cut through the fit of one seed. Dots: what three episodes earned; bars through them: the slopes that the "
        "theory explains. Dashed: the exact value. Values alone leave open how to go from dot to dot."
    )
    return Picture("Points and tangents", svg, caption)


def _tangents(axes: Axes, one: Fit) -> None:
    middle = action_values(one.points, PUSH)
    for (x, _), y, slope in zip(one.points, middle, one.slopes[:, 0], strict=True):
        reach = _TANGENT / np.sqrt(1 + (slope / 4) ** 2)  # the axes are four to one
        axes.plot([x - reach, x + reach], [y - reach * slope, y + reach * slope], color="#000000", linewidth=2.4)


def map_picture(plain: Fit, explained: Fit, num_points: int = 10) -> Picture:
    """Where the fits to the same episodes are wrong, over all states that episodes begin in."""
    side = np.linspace(-1, 1, 61)
    s = np.stack(np.meshgrid(side, side), axis=-1)
    truth = action_values(s, PUSH)
    wrong = {
        "values alone": np.abs(plain.nets[num_points].values(s) - truth),
        "with slopes": np.abs(explained.nets[num_points].values(s) - truth),
    }

    def paint(figure: Figure) -> None:
        from matplotlib.colors import LinearSegmentedColormap

        red = LinearSegmentedColormap.from_list("red", ("#ffffff", "#fcae91", "#cb181d", "#67000d"))
        grid = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, (title, error) in zip(grid, wrong.items(), strict=True):
            shown = axes.contourf(side, side, np.minimum(error, 3.99), np.linspace(0, 4, 9), cmap=red)
            _arrows(axes, explained, num_points if title == "with slopes" else 0)
            axes.plot(*explained.points[:num_points].T, "o", color="#000000", markersize=5)
            axes.set_title(f"{title}: mean {error.mean():.2f}", fontsize=10)
            axes.set_aspect("equal")
            axes.grid(visible=False)
            axes.set_xlabel("position")
            axes.set_xticks((-1, 0, 1))
            axes.set_yticks((-1, 0, 1))
        grid[0].set_ylabel("velocity")
        bar = figure.colorbar(shown, ax=grid, location="top", aspect=40, shrink=0.8)
        assert bar.solids is not None
        bar.solids.set_rasterized(False)
        bar.set_label("how far the fit is from the exact value (4: or more)", fontsize=9)

    said = ", ".join(f"{title}: mean error {error.mean():.2f}" for title, error in wrong.items())
    svg = draw_svg("map", f"Where the fits to {num_points} episodes are wrong", said + ".", (5.2, 3.6), paint)
    caption = (
        f"The same {num_points} episodes of one seed (dots where they begin). Arrows: the slopes that a good theory "
        "explains, as steps uphill; the length is how steep."
    )
    return Picture("Where the fit is wrong", svg, caption)


def _arrows(axes: Axes, one: Fit, num_points: int) -> None:
    for (x, y), slope in zip(one.points[:num_points], one.slopes[:num_points], strict=True):
        dx, dy = 0.045 * slope
        axes.arrow(x, y, dx, dy, color="#000000", width=0.008, head_width=0.06, length_includes_head=True)


def error_picture(measured: Mapping[str, Sequence[Measured]]) -> Picture:
    """Median error by the number of episodes, for each contender, with its interval."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_xscale("log")
        axes.set_yscale("log")
        for i, (name, cells) in enumerate(measured.items()):
            at = np.array(NUM_POINTS) * 1.02 ** (2 * i - len(measured) + 1)
            middle = np.array([one.median for one in cells])
            ends = np.array([one.interval or (min(one.values), max(one.values)) for one in cells]).T
            bars = np.abs(ends - middle)
            axes.errorbar(at, middle, bars, color=COLOURS[i], marker=MARKERS[i], capsize=3, linewidth=1.6, label=name)
        axes.set_xticks(NUM_POINTS, [str(n) for n in NUM_POINTS])
        axes.minorticks_off()
        axes.set_xlabel("episodes that are learned from")
        axes.set_ylabel("mean squared error of the value")
        figure.legend(loc="outside upper left", ncols=2, fontsize=9)

    said = " ".join(f"{name}: {_listed(cells)}." for name, cells in measured.items())
    svg = draw_svg("errors", "Error by the number of episodes", said, (5.2, 4.2), paint)
    caption = (
        "Medians over seeds with what the true median lies in with 95 %, on states that were not seen. Slopes "
        "from a good theory are worth several times as many episodes; a bad one that is believed spoils them all."
    )
    return Picture("Error by episodes", svg, caption)


def _listed(cells: Sequence[Measured]) -> str:
    return ", ".join(f"{n} episodes {one.median:.2g}" for n, one in zip(NUM_POINTS, cells, strict=True))

"""What hierarchies show: what modules are worth in every cell, which one each stage takes, and who is how soon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from neuralq.figures import COLOURS, MARKERS, draw_svg
from neuralq.runs.report.claims import Picture
from neuralq.systems.hierarchies.studies import COMPOSITE, ENOUGH, ROOM, Study
from neuralq_envs.landmarks import LANDMARKS, NUM_CELLS, TASKS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from neuralq.types import Floats

__all__ = ["curve_picture", "modules_picture"]


def modules_picture(study: Study) -> Picture:
    """Value maps of the modules, and the gate of every stage of the composite tasks."""
    stages = np.arange(ROOM.first[COMPOSITE[0]], len(ROOM.goals))
    names = [f"{TASKS[i]}, to {landmark}" for i in COMPOSITE for landmark in TASKS[i]]

    def paint(figure: Figure) -> None:
        grid = figure.subplot_mosaic([["A", "B", "C"], ["gate"] * 3], height_ratios=[1, 1.25])
        shown = np.full((3, NUM_CELLS), np.nan)
        shown[:, ROOM.free] = study.values[:, ROOM.free]
        for module, landmark in enumerate(LANDMARKS):
            axes, goal = grid[landmark], int(ROOM.goals[module])
            shown[module, goal] = np.nan  # nobody leaves it
            behind = shown[module] - np.nanmax(shown[module])  # modules differ by constants, which are in K
            image = axes.pcolormesh(behind.reshape(8, 8), cmap="viridis", vmin=-0.6, vmax=0.0)
            axes.text(goal % 8 + 0.5, goal // 8 + 0.5, landmark, ha="center", va="center", fontsize=9)
            axes.set(title=f"module {module + 1}", aspect="equal", xticks=[], yticks=[])
            axes.invert_yaxis()
            axes.grid(visible=False)
        bar = figure.colorbar(image, ax=[grid[landmark] for landmark in LANDMARKS], shrink=0.7, aspect=12)
        assert bar.solids is not None
        bar.solids.set_rasterized(False)  # the page loads no image
        _paint_gates(grid["gate"], names, study.gates[stages])
        figure.legend(loc="outside lower center", ncols=3, fontsize=9)

    said = " ".join(
        f"{name}: module {study.gates[stage].argmax() + 1}, K = {study.biases[stage]:.2f}."
        for name, stage in zip(names, stages, strict=True)
    )
    svg = draw_svg("modules", "Modules and gates of CQ-L", said, (5.4, 5.2), paint)
    caption = (
        "CQ-L, first seed. Above: the largest action value of each module by cell, less what it is beside the landmark "
        "that it learned to reach; that and the wall are blank. Below: which module the gate gives to each stage "
        "of the composite tasks."
    )
    return Picture("Modules and gates", svg, caption)


def _paint_gates(axes: Axes, names: Sequence[str], gates: Floats) -> None:
    """A bar a stage, of what the gate gives to each module, ``[stages, 3]``."""
    left = np.zeros(len(names))
    for module in range(3):
        axes.barh(names, gates[:, module], left=left, color=COLOURS[module], label=f"module {module + 1}")
        left += gates[:, module]
    axes.set(xlabel="probability of each module", xlim=(0, 1))
    axes.invert_yaxis()
    axes.grid(visible=False)


def curve_picture(found: Mapping[str, Sequence[Study]]) -> Picture:
    """Steps of composite tasks by trials, medians over seeds with their quartiles."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for i, (name, studies) in enumerate(found.items()):
            last = min(int(one.trials[-1]) for one in studies)
            at = np.unique(np.concatenate([[0], np.geomspace(20, max(last, 21), 30).astype(int)]))
            ratios = np.array([np.interp(at, one.trials, one.ratios) for one in studies])
            low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75], axis=0)
            axes.plot(at, middle, color=COLOURS[i], marker=MARKERS[i], markevery=4, label=name)
            axes.fill_between(at, low, high, color=COLOURS[i], alpha=0.15, linewidth=0)
        axes.axhline(ENOUGH, color="#555555", linestyle=":", linewidth=1.2)
        axes.set_xscale("symlog", linthresh=20)
        axes.set(yscale="log", xlabel="trials", ylabel="steps, in shortest ways", xlim=(0, None))
        ticks = (1, 2, 5, 10, 20)
        axes.set_yticks(ticks, [str(tick) for tick in ticks])
        axes.set_xticks((0, 20, 100, 500, 2000), ("0", "20", "100", "500", "2,000"))
        axes.minorticks_off()
        figure.legend(loc="outside upper left", ncols=2, fontsize=9)

    said = ", ".join(f"{name}: {np.median([one.enough for one in studies]):,.0f}" for name, studies in found.items())
    svg = draw_svg("curves", "Steps of composite tasks by trials", f"Median trials to 1.25: {said}.", (5.2, 4.4), paint)
    caption = (
        "Greedy steps of the three composite tasks in units of the shortest ways, medians over seeds and their "
        f"quartiles; dotted: {ENOUGH:g}. What was learned of the elemental tasks before is not counted; who learns all "
        "six tasks at once counts trials of all six."
    )
    return Picture("Composite tasks", svg, caption)

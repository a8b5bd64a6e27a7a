"""Region-based dynamic programming as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, number, own, published
from neuralq.systems import System
from neuralq.systems.regions.mazes import KINDS, Solved, solve_mazes
from neuralq.systems.regions.oracle import oracle
from neuralq.systems.regions.pictures import growth_picture, maze_picture

__all__ = ["REGIONS", "ratio"]

_SIZES, _FULL_SIZES = (25, 50, 100), (25, 50, 100, 200)
_MANY = ("15 rectangles", "40 rectangles")
_RANDOM = ("10 % random walls", "30 % random walls")
_MOST, _LEAST = 0.12, 0.3  # of the backups of states: what counts as a gain, and as none worth having

Mazes = Mapping[int, Solved]


def ratio(mazes: tuple[Mazes, ...], kind: str, size: int = 100) -> Measured:
    """Backups of regions in units of those of states, for mazes of one kind and size.

    Example:
        >>> one = solve_mazes(np.random.SeedSequence(0), "5 rectangles", [10])
        >>> 0 < ratio((one,), "5 rectangles", 10).median < 1
        True
    """
    what = f"{kind}, {size} x {size}: backups of regions in units of those of states"
    return Measured(what, tuple(one[size].ratio for one in mazes))


def _contender(kind: str) -> Callable[[np.random.SeedSequence, bool], Mazes]:
    return lambda seed, full: solve_mazes(seed, kind, _FULL_SIZES if full else _SIZES)


def _page(found: Mapping[str, tuple[Mazes, ...]], full: bool) -> ChapterPage:
    ratios = {kind: ratio(mazes, kind) for kind, mazes in found.items()}
    shown = {kind: found[kind][0][100] for kind in (_MANY[0], _RANDOM[0])}
    return ChapterPage(
        "regions",
        "Backups of whole regions",
        "13.8",
        _text(found, ratios),
        (*_claims(ratios), _equal(found), *_seconds(found)),
        (maze_picture(shown), growth_picture(found)),
        source="Dietterich & Flann 1997",
        measured=tuple(ratio(mazes, kind, size) for kind, mazes in found.items() for size in sorted(mazes[0])),
        facts={
            "task": "n x n cells, eight actions of cost 1: a step to a neighbour, or a slide to the wall",
            "walls": "rectangles with sides below n / 6, or single cells at random; one goal, anywhere",
            "a backup": "one region, or one state, regressed through one action",
        },
    )


def _text(found: Mapping[str, tuple[Mazes, ...]], ratios: Mapping[str, Measured]) -> tuple[str, ...]:
    held = all(ratios[kind].median <= _MOST for kind in _MANY) and all(
        ratios[kind].median >= _LEAST for kind in _RANDOM
    )
    first = "Reproduced" if held else "Not reproduced with these mazes"
    slower = {
        kind: np.median([one[100].seconds[0] / one[100].seconds[1] for one in mazes]) for kind, mazes in found.items()
    }
    return (
        f"{first}: among 15 rectangles regions take {ratios[_MANY[0]]} of the backups that single states take, among "
        f"40 {ratios[_MANY[1]]} (medians); where a tenth of the cells are walls, {ratios[_RANDOM[0]]}.",
        "Who explains why an action reached the goal knows more than that one state: every state from which the same "
        "action leads there is as good. Explanation-based learning calls that goal regression. Backwards from the "
        "goal, the cheapest region first, each rectangle is regressed through each action; cells that are reached "
        "cheaper than before get their value at once, and are cut into rectangles that are regressed in turn. "
        "Reinforcement learning adds that regions have values, so that what comes out is optimal, and no longer just "
        "one way that works.",
        "A backup of a region is more work than one of a state: its cells have to be compared, and what is left of "
        f"them to be cut. In CPU time, both in Python, regions take {slower[_MANY[0]]:.2g} times as long as states "
        f"among 15 rectangles, and {slower[_RANDOM[1]]:.2g} times where three cells in ten are walls.",
    )


def _claims(ratios: Mapping[str, Measured]) -> tuple[Row, ...]:
    gains = tuple(
        published(
            f"{kind}: backups of regions in units of those of states",
            "far fewer",
            str(ratios[kind]),
            ratios[kind].median <= _MOST,
            f"a gain if at most {_MOST:g}",
        )
        for kind in _MANY
    )
    controls = tuple(
        published(
            f"{kind}: the same",
            "no regions, little gain",
            str(ratios[kind]),
            ratios[kind].median >= _LEAST,
            f"the control: at least {_LEAST:g}",
        )
        for kind in _RANDOM
    )
    return (*gains, *controls)


def _equal(found: Mapping[str, tuple[Mazes, ...]]) -> Row:
    mazes = [one for several in found.values() for sizes in several for one in sizes.values()]
    worst = max(one.difference for one in mazes)
    cells = sum(int(one.maze.free.sum()) for one in mazes)
    return number(
        "difference from breadth-first search, all cells",
        0.0,
        worst,
        tol=0.0,
        note=f"{len(mazes)} mazes, {cells:,} cells",
    )


def _seconds(found: Mapping[str, tuple[Mazes, ...]]) -> tuple[Row, ...]:
    return tuple(
        own(
            f"{kind}: CPU seconds by regions, and by states",
            " and ".join(f"{np.median([one[100].seconds[i] for one in mazes]):.2g}" for i in range(2)),
            "100 x 100 cells, medians",
        )
        for kind, mazes in found.items()
    )


REGIONS = System(
    name="regions",
    environment="neuralq/SlideMaze-v0",
    learner="neuralq.tabular:region_dp",
    contenders={kind: _contender(kind) for kind in KINDS},
    baselines=_RANDOM,
    oracle=oracle,
    page=_page,
    num_seeds=6,
    full_num_seeds=30,
)

"""Dynamic programming on regions: one backup gives a value to every state that an operator leads into a region.

A state is a cell of a grid of whole numbers, in any number of dimensions, and a region is a box of it, written as the
slices that index it. An operator says of a region from which states it leads into it: goal regression, which is what
explanation-based learning generalises by. Backwards from the goal, cheapest regions first, every region is regressed
through every operator; states that are reached cheaper than before get their value at once, and are cut into boxes
that are regressed in turn. With regions of one cell each this is Dijkstra's algorithm.

Source: Dietterich & Flann 1997, "Explanation-based learning and reinforcement learning: a unified view", Machine
Learning 28, section 3 (off-line Region-DP).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Region", "RegionOperator", "RegionPlan", "cover", "region_dp"]

Region = tuple[slice, ...]
"""A box of cells, ``(slice(top, bottom), slice(left, right), ...)``."""


class RegionOperator(NamedTuple):
    """What a plan may use.

    Args:
        cost: of using it once, above 0.
        regress: all states from which it leads into a region, as regions, which may overlap and may hold illegal
            states; those that it leaves where they are need not be among them.
    """

    cost: float
    regress: Callable[[Region], Iterable[Region]]


@dataclass(frozen=True, eq=False)
class RegionPlan:
    """The cheapest way from every state to the goal.

    Args:
        costs: of the way, the shape of the grid: −V*; infinite where there is none.
        operators: which operator to use first; −1 where none is needed or helps.
        regions: what was regressed, with its cost, in that order; every state that has a way is in exactly one.
        num_backups: regressions of a region through an operator.
    """

    costs: NDArray[np.float64]
    operators: NDArray[np.int64]
    regions: tuple[tuple[Region, float], ...]
    num_backups: int


def region_dp(legal: NDArray[np.bool_], goal: Region, operators: Sequence[RegionOperator]) -> RegionPlan:
    """The cheapest way to a goal from every state, by regions.

    Args:
        legal: states that there are; an array of as many dimensions as a state has numbers.
        goal: where the way ends, at cost 0; a box inside the grid.
        operators: at least one.

    Raises:
        ValueError: a goal that is no box of this grid or has no legal state; no operator, or one without a cost or that
            regresses a region to what is not on the grid.

    Example:
        A row of a thousand states: one operator goes up by 1, another from the lower half to 900.

        >>> up = RegionOperator(1.0, lambda region: [(slice(max(region[0].start - 1, 0), region[0].stop - 1),)])
        >>> leap = RegionOperator(1.0, lambda region: [(slice(0, 500),)] if 900 in range(1000)[region[0]] else [])
        >>> plan = region_dp(np.ones(1000, bool), (slice(890, 1000),), [up, leap])
        >>> plan.costs[[0, 499, 500, 889, 890]].tolist(), plan.num_backups
        ([1.0, 1.0, 390.0, 1.0, 0.0], 784)
    """
    _check(legal, goal, operators)
    costs = np.where(legal, np.inf, -np.inf)  # nothing improves on what is illegal
    chosen, regions = np.full(legal.shape, -1), []
    queue: list[tuple[float, int, Region]] = []
    order = count()

    def improve(place: Region, states: NDArray[np.bool_], cost: float, operator: int) -> None:
        costs[place][states], chosen[place][states] = cost, operator
        for box in cover(states):
            heapq.heappush(queue, (cost, next(order), _moved(box, [side.start for side in place])))

    improve(goal, legal[goal], 0.0, -1)
    while queue:
        cost, _, found = heapq.heappop(queue)
        for box in cover(costs[found] == cost):  # some of it may have been reached cheaper meanwhile
            region = _moved(box, [side.start for side in found])
            regions.append((region, cost))
            for a, operator in enumerate(operators):
                place, before = _union(operator.regress(region), legal.shape)
                improve(place, before & (costs[place] > cost + operator.cost), cost + operator.cost, a)
    costs[~legal] = np.inf
    return RegionPlan(costs, chosen, tuple(regions), len(regions) * len(operators))


def cover(states: NDArray[np.bool_]) -> Iterator[Region]:
    """Cuts a set of cells into boxes that do not overlap: from its first cell as far as it goes, the last axis first.

    Args:
        states: which cells, an array of any number of dimensions.

    Example:
        >>> states = np.array([[True, True, False], [True, True, True]])
        >>> [(rows.start, rows.stop, columns.start, columns.stop) for rows, columns in cover(states)]
        [(0, 2, 0, 2), (1, 2, 2, 3)]
    """
    if states.all():  # most often
        if states.size:
            yield tuple(slice(0, size) for size in states.shape)
        return
    left = states.copy()
    while left.any():
        first = np.unravel_index(int(left.argmax()), left.shape)
        box = [slice(int(at), int(at) + 1) for at in first]
        for axis in reversed(range(left.ndim)):
            box[axis] = slice(box[axis].start, None)
            goes_on = np.asarray(left[tuple(box)].all(axis=tuple(i for i in range(left.ndim) if i != axis)))
            length = len(goes_on) if goes_on.all() else int(goes_on.argmin())
            box[axis] = slice(box[axis].start, box[axis].start + length)
        left[tuple(box)] = False
        yield tuple(box)


def _union(regions: Iterable[Region], shape: tuple[int, ...]) -> tuple[Region, NDArray[np.bool_]]:
    """The smallest box around some regions, and which of its cells are in one of them."""
    parts = [region for region in regions if all(side.stop > side.start for side in region)]
    if not parts:
        return (slice(0, 0),) * len(shape), np.zeros((0,) * len(shape), np.bool_)
    for region in parts:
        if not _is_box(region, shape):
            raise ValueError(
                f"an operator must regress to boxes inside {shape}, got {region!r}; cut off what is outside"
            )
    sides = list(zip(*parts, strict=True))
    place = tuple(slice(min(side.start for side in axis), max(side.stop for side in axis)) for axis in sides)
    inside = np.zeros([side.stop - side.start for side in place], np.bool_)
    for region in parts:
        inside[_moved(region, [-side.start for side in place])] = True
    return place, inside


def _moved(region: Region, by: Sequence[int]) -> Region:
    return tuple(slice(side.start + far, side.stop + far) for side, far in zip(region, by, strict=True))


def _is_box(region: Region, shape: tuple[int, ...]) -> bool:
    return len(region) == len(shape) and all(
        side.start is not None and side.stop is not None and side.step is None and 0 <= side.start < side.stop <= size
        for side, size in zip(region, shape, strict=True)
    )


def _check(legal: NDArray[np.bool_], goal: Region, operators: Sequence[RegionOperator]) -> None:
    if not _is_box(goal, legal.shape):
        raise ValueError(
            f"goal must be a slice with start and stop for each of the {legal.ndim} axes, inside {legal.shape}, "
            f"got {goal!r}"
        )
    if not legal[goal].any():
        raise ValueError(f"goal must hold a legal state, got {goal!r}, which has none")
    if not operators:
        raise ValueError("operators must be at least one RegionOperator, got none")
    for a, operator in enumerate(operators):
        if not 0.0 < operator.cost < np.inf:
            raise ValueError(f"the cost of operator {a} must be a finite number above 0, got {operator.cost!r}")

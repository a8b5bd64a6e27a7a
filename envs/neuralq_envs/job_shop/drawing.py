"""A schedule as text and as a picture: what is taken of each pool over time, and the tasks above it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq_envs.canvas import BLUE, GREY, INK, RED, blank
from neuralq_envs.job_shop.kernels import Plan, ShopArrays

__all__ = ["draw", "write_down"]

_WIDTH, _ROW, _UNIT, _GAP = 640, 4, 6, 10  # pixels: of all, of a task's row, of one unit of a resource, between bands
_SHOWN = 2.5  # times the length of S0


def write_down(shop: ShopArrays, plan: Plan) -> str:
    """A line for each pool with a sign for each time: how many units are taken, ``!`` where that is too many.

    Example:
        >>> from neuralq_envs.job_shop.kernels import lay_out
        >>> from neuralq_envs.job_shop.problem import JobShop, new_plan
        >>> shop = JobShop([2, 3], [[2], [2]], [(), ()], [[3]]).arrays
        >>> plan = new_plan(shop)
        >>> lay_out(shop, plan)
        >>> print(write_down(shop, plan))
        type 0 pool 0 of  3: !!2
        length 3, 2 moments in conflict
    """
    lines, length = [], int(plan.length[0])
    over = plan.usage[:, :, :length] > shop.capacities[:, :, None]
    for k, p in np.ndindex(*shop.capacities.shape):
        taken = plan.usage[k, p, :length].tolist()
        signs = "".join(
            "!" if above else "." if u == 0 else str(u) if u < 10 else "+"
            for u, above in zip(taken, over[k, p].tolist(), strict=True)
        )
        lines.append(f"type {k} pool {p} of {shop.capacities[k, p]:2d}: {signs}")
    lines.append(f"length {length}, {int(over.any(axis=(0, 1)).sum())} moments in conflict")
    return "\n".join(lines)


def draw(shop: ShopArrays, plan: Plan) -> NDArray[np.uint8]:
    """Every task as a bar, and below a band for each pool: taken in blue, in excess in red, the capacity as a line.

    Example:
        >>> from neuralq_envs.job_shop.kernels import lay_out
        >>> from neuralq_envs.job_shop.problem import JobShop, new_plan
        >>> shop = JobShop([2, 3], [[2], [2]], [(), ()], [[3]]).arrays
        >>> plan = new_plan(shop)
        >>> lay_out(shop, plan)
        >>> draw(shop, plan).shape
        (54, 640, 3)
    """
    heights = 2 * shop.capacities * _UNIT
    tasks = _ROW * len(shop.durations)
    picture = blank(int(tasks + (heights + _GAP).sum()), _WIDTH)
    scale = _WIDTH / (_SHOWN * shop.facts[0])
    edges = np.minimum(np.round(np.arange(plan.usage.shape[2] + 1) * scale), _WIDTH).astype(int)
    for i, (start, duration) in enumerate(zip(plan.start.tolist(), shop.durations.tolist(), strict=True)):
        picture[_ROW * i : _ROW * i + _ROW - 1, edges[start] : edges[start + duration]] = INK
    bottom = tasks
    for k, p in np.ndindex(*shop.capacities.shape):
        bottom += int(heights[k, p]) + _GAP
        line = bottom - int(shop.capacities[k, p]) * _UNIT
        for t in range(int(plan.length[0])):
            top = bottom - min(int(plan.usage[k, p, t]) * _UNIT, int(heights[k, p]))
            picture[max(top, line) : bottom, edges[t] : edges[t + 1]] = BLUE
            picture[top:line, edges[t] : edges[t + 1]] = RED
        picture[bottom - 1] = GREY
        picture[line - 1 : line] = INK
    return picture

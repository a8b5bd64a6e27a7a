"""A repair, frame by frame: tasks as bars and pools as bands, moved by a style sheet alone, with a way to stop it."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.figures import COLOURS
from neuralq.systems.job_shop.trials import Repaired
from neuralq_envs.job_shop.kernels import Plan, ShopArrays, apply_repair, lay_out
from neuralq_envs.job_shop.problem import JobShop, new_plan, new_repairs

__all__ = ["Frame", "frames_of", "repair_film"]

_WIDTH, _LEFT, _ROW, _UNIT, _GAP = 640, 58, 4, 6, 14
_SECONDS, _FIRST, _LAST = 0.28, 6, 14  # a frame lasts so long; the first and the last one as long as so many
_RED = COLOURS[1]


class Frame(NamedTuple):
    """One schedule.

    Args:
        start: when each task starts, ``[n]``.
        pool: which pool it takes from, ``[n, K]``.
        usage: what is taken of each pool, ``[K, P, length]``.
        changed: tasks that the last repair moved, or took from another pool.
        said: what was done.
    """

    start: NDArray[np.int64]
    pool: NDArray[np.int64]
    usage: NDArray[np.int64]
    changed: tuple[int, ...]
    said: str


def frames_of(problem: JobShop, repaired: Repaired) -> list[Frame]:
    """S0 and the schedule after each repair.

    Example:
        >>> from neuralq.systems.job_shop.trials import repair
        >>> shop = JobShop([2, 3], [[2], [2]], [(), ()], [[3]])
        >>> [frame.start.tolist() for frame in frames_of(shop, repair([shop], "least TRUI")[0])]
        [[0, 0], [3, 0]]
    """
    return list(_frames(problem.arrays, repaired))


def _frames(shop: ShopArrays, repaired: Repaired) -> Iterator[Frame]:
    plan, one = new_plan(shop), new_repairs(1)
    lay_out(shop, plan)
    yield _frame(plan, (), "the first schedule")
    for task, kind, resource, to in repaired.repairs.tolist():
        one.task[0], one.kind[0], one.resource[0], one.to[0] = task, kind, resource, to
        before = int(plan.start[task])
        moved = apply_repair(shop, plan, one, 0)
        if kind == 0:
            yield _frame(plan, (task,), f"task {task} from another pool of type {resource}")
        else:
            along = f", {moved - 1} along with it" if moved > 1 else ""
            yield _frame(plan, tuple(plan.changed[:moved].tolist()), f"task {task}: {to - before:+d}{along}")


def _frame(plan: Plan, changed: tuple[int, ...], said: str) -> Frame:
    return Frame(plan.start.copy(), plan.pool.copy(), plan.usage[:, :, : int(plan.length[0])].copy(), changed, said)


def repair_film(name: str, problem: JobShop, frames: list[Frame]) -> str:
    """Every frame over the last, and a box to tick that stops it; whoever asked for less motion sees the last one.

    Args:
        name: prefix of every name in the style sheet; unique within a page; letters, digits and ``-``.
        problem: what is repaired.
        frames: its schedules (`frames_of`).

    Example:
        >>> from neuralq.systems.job_shop.trials import repair
        >>> shop = JobShop([2, 3], [[2], [2]], [(), ()], [[3]])
        >>> film = repair_film("two", shop, frames_of(shop, repair([shop], "least TRUI")[0]))
        >>> film.count("<g class="), "task 0: +3" in film
        (2, True)
    """
    holds = np.ones(len(frames))
    holds[0], holds[-1] = _FIRST, _LAST
    ends = np.cumsum(holds)
    whole = float(ends[-1]) * _SECONDS
    shop = problem.arrays
    scale = (_WIDTH - _LEFT - 4) / max(frame.usage.shape[2] for frame in frames)
    height = _top(shop, shop.capacities.size) + 4
    style = "".join(
        f"@keyframes {name}-{i}{{{_visible(100 * (end - hold) / ends[-1], 100 * end / ends[-1])}}}"
        f".{name}-{i}{{animation:{name}-{i} {whole:.2f}s step-end infinite}}"
        for i, (end, hold) in enumerate(zip(ends.tolist(), holds.tolist(), strict=True))
    )
    still = f"@media (prefers-reduced-motion:reduce){{.{name}-{len(frames) - 1}{{visibility:visible!important}}}}"
    drawn = "".join(
        f'<g class="moving {name}-{i}" visibility="hidden">{_drawn(shop, frame, i, len(frames) - 1, scale)}</g>'
        for i, frame in enumerate(frames)
    )
    stop = f'<input type="checkbox" id="{name}-stop"> <label for="{name}-stop">stop</label>'
    lengths = (frames[0].usage.shape[2], frames[-1].usage.shape[2])
    said = f"{len(frames) - 1} repairs, length {lengths[0]} at first and {lengths[1]} in the end"
    held = f".{name}-all .moving{{animation-timing-function:step-end}}"
    return (
        f'<div class="film">{stop}\n<style>{held}{style}{still}</style>\n'
        f'<svg class="{name}-all" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" role="img" '
        f'aria-label="{escape(said)}">{_fixed(shop)}{drawn}</svg></div>'
    )


def _visible(begin: float, end: float) -> str:
    first = "0%{visibility:hidden}" if begin > 0 else ""
    last = f"{end:.3f}%,100%{{visibility:hidden}}" if end < 100 else "100%{visibility:visible}"
    return f"{first}{begin:.3f}%{{visibility:visible}}{last}"


def _top(shop: ShopArrays, bands: int) -> int:
    """Where a band begins, counted from the first pool; each is one and a half times as high as its capacity."""
    heights = [3 * c * _UNIT // 2 + _GAP for c in shop.capacities.ravel().tolist()[:bands]]
    return 22 + _ROW * len(shop.durations) + sum(heights)


def _fixed(shop: ShopArrays) -> str:
    """Names of the pools."""
    parts = []
    for b, (k, p) in enumerate(np.ndindex(*shop.capacities.shape)):
        line = _top(shop, b + 1) - int(shop.capacities[k, p]) * _UNIT
        parts.append(
            f'<text x="0" y="{line + 15}" font-size="11" fill="var(--soft)">type {k}, {"ab"[p] if p < 2 else p}</text>'
        )
    return "".join(parts)


def _drawn(shop: ShopArrays, frame: Frame, number: int, total: int, scale: float) -> str:
    """Tasks, those that were moved in another colour; then the bands, with what is in excess in red."""
    still: list[str] = []
    moved: list[str] = []
    for i, (start, duration) in enumerate(zip(frame.start.tolist(), shop.durations.tolist(), strict=True)):
        x, width = _LEFT + start * scale, duration * scale
        (moved if i in frame.changed else still).append(f"M{x:.1f} {20 + _ROW * i}h{width:.1f}v3h-{width:.1f}z")
    text = f"repair {number} of {total}: {frame.said}" if number else frame.said
    parts = [
        f'<text x="{_LEFT}" y="12" font-size="12" fill="var(--ink)">{escape(text)}</text>',
        f'<path d="{"".join(still)}" fill="var(--soft)"/>',
        f'<path d="{"".join(moved)}" fill="{COLOURS[2]}"/>' if moved else "",
    ]
    for b, (k, p) in enumerate(np.ndindex(*shop.capacities.shape)):
        bottom, capacity = _top(shop, b + 1), int(shop.capacities[k, p])
        usage = frame.usage[k, p]
        line = bottom - capacity * _UNIT
        highest = 3 * capacity // 2
        parts.append(f'<path d="{_steps(np.minimum(usage, capacity), bottom, scale)}" fill="{COLOURS[4]}"/>')
        above = np.minimum(usage, highest) - capacity
        if (above > 0).any():
            parts.append(f'<path d="{_steps(np.maximum(above, 0), line, scale)}" fill="{_RED}"/>')
        parts.append(f'<path d="M{_LEFT} {line}H{_WIDTH - 4}" stroke="var(--ink)" stroke-width="1"/>')
    return "".join(parts)


def _steps(heights: NDArray[np.int64], bottom: int, scale: float) -> str:
    """An area under steps, as a path."""
    path, level = [f"M{_LEFT} {bottom}"], 0
    for t, height in enumerate([*heights.tolist(), 0]):
        if height != level:
            path.append(f"H{_LEFT + t * scale:.1f}V{bottom - height * _UNIT}")
            level = height
    return "".join(path) + "z"

"""Some minutes of the elevators as an animation: cars in their shafts, and everybody who waits, the longer the redder.

SVG moved by a style sheet alone, in the manner of `neuralq_envs.pole_film`, whose page style it uses. Whoever asked for
less motion sees the first moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from neuralq.systems.elevators.controllers import Controller, play
from neuralq_envs.elevators.building import MOVING, open_building
from neuralq_envs.elevators.kernels import FLOOR_SECONDS
from neuralq_envs.elevators.passengers import Passengers

__all__ = ["Scene", "elevator_film", "record"]

_SPEED = 6
"""How much faster than life."""
_FLOOR, _SHAFT, _LABEL, _DOT, _WIDTH = 21, 24, 20, 8, 420
_PATIENT, _ANGRY = (86, 180, 233), (213, 94, 0)
_ANGRY_AFTER = 60.0  # seconds


@dataclass(frozen=True, eq=False)
class Scene:
    """What happened in a building from one second to another.

    Args:
        caption: stands above it.
        num_floors: F.
        begin: first second.
        end: last second.
        height: where each car is at each second between, in floors, ``[S, C]``.
        load: what share of each car is full, ``[S, C]``.
        floor: on which floor each of those waits who wait in that time, ``[P]``.
        arrival: since when, ``[P]``.
        boarded: until when, ``[P]``.
    """

    caption: str
    num_floors: int
    begin: float
    end: float
    height: NDArray[np.float64]
    load: NDArray[np.float64]
    floor: NDArray[np.int64]
    arrival: NDArray[np.float64]
    boarded: NDArray[np.float64]


def record(caption: str, controller: Controller, passengers: Passengers, begin: float, end: float) -> Scene:
    """Plays an hour in the building of four cars and ten floors, and keeps the seconds from ``begin`` to ``end``.

    Example:
        >>> from neuralq.systems.elevators.controllers import LQF, new_controller
        >>> from neuralq_envs.elevators.passengers import given_passengers
        >>> scene = record("one", new_controller(LQF), given_passengers([(0, 5), (9, 3)]), 0.0, 10.0)
        >>> scene.height[:, 0].round(2).tolist()  # five floors, 1.45 s each, and there it stands
        [0.0, 0.69, 1.38, 2.07, 2.76, 3.45, 4.14, 4.83, 5.0, 5.0, 5.0]
    """
    building = open_building(passengers)
    seconds = np.arange(begin, end + 1.0)
    height, load = (np.zeros((len(seconds), len(building.floor))) for _ in range(2))
    for i, second in enumerate(seconds.tolist()):
        play(building, controller, second)
        to_go = np.clip((building.event - second) / FLOOR_SECONDS, 0.0, 1.0)
        height[i] = building.floor + np.where(building.phase == MOVING, building.direction * (1.0 - to_go), 0.0)
        load[i] = building.aboard / 20
    boarded = np.where(np.isnan(building.boarded), np.inf, building.boarded)
    there = (building.arrival < end) & (boarded > begin)
    return Scene(
        caption, len(building.waiting), begin, end, height, load,
        building.origin[there], building.arrival[there], boarded[there],
    )  # fmt: skip


def elevator_film(name: str, scenes: Sequence[Scene]) -> str:
    """The scenes one below the other, and a box to tick that stops them all.

    Args:
        name: prefix of every name in the style sheet; unique within a page; letters, digits and ``-``.
        scenes: what is shown.
    """
    parts = [_scene(f"{name}-{i}", scene) for i, scene in enumerate(scenes)]
    stop = f'<input type="checkbox" id="{name}-stop"> <label for="{name}-stop">stop</label>'
    return "\n".join([f'<div class="film">{stop}', *parts, "</div>"])


def _scene(name: str, scene: Scene) -> str:
    top = _FLOOR * scene.num_floors + 6
    grid = "".join(
        f'<path d="M{_LABEL - 4} {_y(scene, f) + _FLOOR - 1}H{_WIDTH}" stroke="var(--line)"/>'
        f'<text x="{_LABEL - 8}" y="{_y(scene, f) + 15}" font-size="11" text-anchor="end" fill="var(--soft)">{f}</text>'
        for f in range(scene.num_floors)
    )
    cars = [_car(f"{name}-c{c}", scene, c) for c in range(scene.height.shape[1])]
    people = _people(f"{name}-p", scene)
    style = "".join(part[0] for part in (*cars, *people))
    drawn = "".join(part[1] for part in (*cars, *people))
    seconds = (scene.end - scene.begin) / _SPEED
    return (
        f"<style>{style}.{name}{{animation-duration:{seconds:.2f}s}}</style>\n<p><span>{escape(scene.caption)}</span></p>\n"
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {top}" role="img" '
        f'aria-label="{escape(scene.caption)}">{grid}{drawn.replace("@@", name)}</svg>'
    )


def _y(scene: Scene, floor: float) -> float:
    """Top of a floor in the picture."""
    return 2 + _FLOOR * (scene.num_floors - 1 - floor)


def _car(name: str, scene: Scene, car: int) -> tuple[str, str]:
    """Style and element of a car, whose filling is its load."""
    at = 100 * np.arange(len(scene.height)) / (len(scene.height) - 1)
    y = _FLOOR * (scene.num_floors - 1 - scene.height[:, car])
    moves = _frames(at, y, "transform:translate(0,{:.1f}px)")
    fills = _frames(at, scene.load[:, car], "transform:scaleY({:.2f})")
    style = (
        f"@keyframes {name}{{{moves}}}@keyframes {name}l{{{fills}}}"
        f".{name}{{animation-name:{name};transform:translate(0,{y[0]:.1f}px)}}"
        f".{name}l{{animation-name:{name}l;transform:scaleY({scene.load[0, car]:.2f})}}"
    )
    x = _LABEL + car * _SHAFT + 2
    drawn = (
        f'<g class="moving @@ {name}"><rect x="{x}" y="4" width="{_SHAFT - 6}" height="{_FLOOR - 5}" rx="2" '
        f'fill="none" stroke="var(--ink)" stroke-width="1.5"/><g transform="translate(0,{_FLOOR - 2})">'
        f'<rect class="moving @@ {name}l" x="{x + 2}" y="-{_FLOOR - 7}" width="{_SHAFT - 10}" height="{_FLOOR - 9}" '
        f'fill="var(--ink)"/></g></g>'
    )
    return style, drawn


def _people(name: str, scene: Scene) -> list[tuple[str, str]]:
    """Style and element of everybody who waits; each keeps the place that was free when they came."""
    taken: dict[tuple[int, int], float] = {}
    first = _LABEL + scene.height.shape[1] * _SHAFT + 8
    found = []
    for i, (floor, came, went) in enumerate(zip(scene.floor.tolist(), scene.arrival, scene.boarded, strict=True)):
        place = next(k for k in range(len(scene.floor) + 1) if taken.get((floor, k), -1.0) <= came)
        taken[floor, place] = went
        x = first + _DOT * place
        if x > _WIDTH - _DOT / 2:
            continue  # beyond the picture: so many wait there
        drawn = f'<circle class="moving @@ {name}{i}" cx="{x}" cy="{_y(scene, floor) + 14}" r="3.3"/>'
        found.append((_person(f"{name}{i}", scene, float(came), float(went)), drawn))
    return found


def _person(name: str, scene: Scene, came: float, went: float) -> str:
    """There from one moment to another, and redder all the time."""

    def at(second: float) -> float:
        return 100 * (min(max(second, scene.begin), scene.end) - scene.begin) / (scene.end - scene.begin)

    def colour(second: float) -> str:
        share = min(max(second - came, 0.0) / _ANGRY_AFTER, 1.0)
        return "#" + "".join(f"{round((1 - share) * a + share * b):02x}" for a, b in zip(_PATIENT, _ANGRY, strict=True))

    seen = max(came, scene.begin)
    gone = min(went, scene.end)
    red = came + _ANGRY_AFTER
    frames = [] if came <= scene.begin else [f"0%,{at(came):.2f}%{{opacity:0}}"]
    frames.append(f"{at(came) + 0.01:.2f}%{{opacity:1;fill:{colour(seen)}}}")
    if seen < red < gone:
        frames.append(f"{at(red):.2f}%{{fill:{colour(red)}}}")
    frames.append(f"{at(gone):.2f}%{{opacity:1;fill:{colour(gone)}}}")
    if went < scene.end:
        frames.append(f"{at(gone) + 0.01:.2f}%,100%{{opacity:0}}")
    opacity = 1 if came <= scene.begin else 0
    return (
        f"@keyframes {name}{{{''.join(frames)}}}.{name}{{animation-name:{name};opacity:{opacity};fill:{colour(seen)}}}"
    )


def _frames(at: NDArray[np.float64], values: NDArray[np.float64], text: str) -> str:
    """The moments of an animation, without those that lie on the line between their neighbours."""
    bends = np.abs(np.diff(values, 2)) > 1e-9
    kept = np.concatenate([[True], bends, [True]])
    return "".join(f"{when:.2f}%{{{text.format(value)}}}" for when, value in zip(at[kept], values[kept], strict=True))

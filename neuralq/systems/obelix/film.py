"""A trial from above as an animation moved by a style sheet alone, with a way to stop it."""

from __future__ import annotations

import math
from html import escape

import numpy as np
from numpy.typing import NDArray

from neuralq.figures import COLOURS
from neuralq.systems.obelix.kernels import FIND, PUSH, UNWEDGE
from neuralq_envs.obelix_kernels import BOX_RADIUS, ROBOT_RADIUS, SIDE, SONARS

__all__ = ["BEHAVIOUR_COLOURS", "room_film"]

BEHAVIOUR_COLOURS = {FIND: COLOURS[0], PUSH: COLOURS[2], UNWEDGE: COLOURS[1]}
_SECONDS_PER_STEP, _HOLD_SECONDS, _METRE = 0.16, 1.2, 40
_REACH = 0.9 + ROBOT_RADIUS
_NAMES = {FIND: "find", PUSH: "push", UNWEDGE: "unwedge"}


def room_film(name: str, caption: str, film: NDArray[np.float64], coloured: bool = True) -> str:
    """One trial in motion; the robot has the colour of the behaviour in control.

    Args:
        name: prefix of every name in the style sheet; letters, digits and ``-``.
        caption: stands above it.
        film: robot (3), boxes (8), behaviour and bits of each step, ``[F, 13]``.
        coloured: whether there are behaviours.

    Example:
        >>> room_film("one", "A trial", np.zeros((3, 13))).count("@keyframes")
        6
    """
    whole = len(film) * _SECONDS_PER_STEP + _HOLD_SECONDS
    at = np.asarray(100 * np.arange(len(film)) * _SECONDS_PER_STEP / whole, np.float64)
    heading = np.degrees(np.unwrap(film[:, 2]))
    robot = [
        f"transform:{_moved(*place)} rotate({-angle:.1f}deg)" for place, angle in zip(film[:, :2], heading, strict=True)
    ]
    motions = {"r": _frames(at, robot)}
    for i in range(4):
        motions[f"b{i}"] = _frames(at, [f"transform:{_moved(*place)}" for place in film[:, 3 + 2 * i : 5 + 2 * i]])
    colours = [BEHAVIOUR_COLOURS[int(one)] if coloured else COLOURS[6] for one in film[:, 11]]
    motions["c"] = _frames(at, [f"fill:{colour}" for colour in colours])
    style = "".join(
        f"@keyframes {name}-{part}{{{frames}}}.{name}-{part}{{animation:{name}-{part} {whole:.2f}s linear infinite}}"
        for part, frames in motions.items()
    )
    style += f".{name}-c{{animation-timing-function:step-end}}"
    legend = "".join(
        f'<span style="color:{colour}">&#9679; {_NAMES[one]}</span> ' for one, colour in BEHAVIOUR_COLOURS.items()
    )
    return (
        f'<div class="film"><input type="checkbox" id="{name}-stop"> <label for="{name}-stop">stop</label>'
        f"<style>{style}</style>\n<p><span>{escape(caption)}</span><span>{legend if coloured else ''}</span></p>\n"
        f"{_picture(name, escape(caption))}</div>"
    )


def _picture(name: str, caption: str) -> str:
    size = round(SIDE * _METRE)
    boxes = "".join(
        f'<circle class="moving {name}-b{i}" r="{BOX_RADIUS * _METRE}" fill="var(--line)" stroke="var(--soft)"/>'
        for i in range(4)
    )
    fans = "".join(
        f'<path d="M0 0L{_REACH * _METRE * math.cos(a):.1f} {-_REACH * _METRE * math.sin(a):.1f}" '
        f'stroke="var(--soft)" stroke-width="1" stroke-dasharray="2 3"/>'
        for a in np.radians(SONARS)
    )
    radius = ROBOT_RADIUS * _METRE
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-2 -2 {size + 4} {size + 4}" role="img" '
        f'style="max-width:30rem" aria-label="{caption}"><rect width="{size}" height="{size}" fill="none" '
        f'stroke="var(--soft)" stroke-width="2"/>{boxes}<g class="moving {name}-r">{fans}'
        f'<circle class="moving {name}-c" r="{radius}"/>'
        f'<path d="M0 0H{radius}" stroke="white" stroke-width="3"/></g></svg>'
    )


def _moved(x: float, y: float) -> str:
    return f"translate({x * _METRE:.1f}px,{(SIDE - y) * _METRE:.1f}px)"


def _frames(at: NDArray[np.float64], values: list[str]) -> str:
    moments = "".join(f"{when:.2f}%{{{value}}}" for when, value in zip(at, values, strict=True))
    return moments + f"100%{{{values[-1]}}}"

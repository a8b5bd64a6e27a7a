"""Trials of the pole as animations: SVG elements moved by a style sheet alone, in real time, with a way to stop them.

They need no script and take their colours from the page (``--ink``, ``--soft``, ``--line``), so they are light or dark
as the page is. Whoever asked for less motion sees the first moment of each trial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

__all__ = ["FILM_STYLE", "Scene", "pole_film"]

_STEPS_PER_SECOND = 50
_EVERY = 2  # steps between two moments of the animation; in between it is interpolated
_HOLD_SECONDS = 1.2  # a trial that ended stays for a while before it starts again
_METRE, _WIDTH, _HEIGHT, _GROUND = 120, 640, 164, 150

FILM_STYLE = """
.film { display: block; }
.film svg { display: block; width: 100%; height: auto; }
.film p { display: flex; justify-content: space-between; gap: 1rem; margin: .7rem 0 0; max-width: none; }
.film .end { color: var(--soft); opacity: 0; white-space: nowrap; }
.film .moving { animation-timing-function: linear; animation-iteration-count: infinite; }
.film label { font-size: .92rem; cursor: pointer; }
.film input:checked ~ * .moving { animation-play-state: paused; }
@media (prefers-reduced-motion: reduce) {
  .film .moving { animation: none !important; }
  .film label, .film input { display: none; }
}
@media print { .film .moving { animation: none !important; } .film label, .film input { display: none; } }
"""
"""What a page that shows films adds to its style sheet."""


@dataclass(frozen=True, eq=False)
class Scene:
    """One trial, or as much of it as is shown.

    Args:
        caption: stands above it.
        states: x, ẋ, θ, θ̇ at each step, ``[F, 4]``.
        fallen: whether the pole has fallen after the last of them.
        colour: of the pole.

    Raises:
        ValueError: no states, or other than four numbers each.
    """

    caption: str
    states: NDArray[np.float64]
    fallen: bool
    colour: str

    def __post_init__(self) -> None:
        if self.states.ndim != 2 or self.states.shape[1] != 4 or not len(self.states):
            raise ValueError(f"states must have shape [F, 4] with F of at least 1, got {self.states.shape}")


def pole_film(name: str, scenes: Sequence[Scene]) -> str:
    """The scenes one below the other, each beginning again when it has ended, and a box to tick that stops them all.

    Args:
        name: prefix of every name in the style sheet; unique within a page; letters, digits and ``-``.
        scenes: what is shown.

    Example:
        >>> film = pole_film("two", [Scene("falls", np.zeros((20, 4)), True, "#0072B2")])
        >>> film.count("@keyframes"), "falls" in film
        (3, True)
    """
    parts = [_scene(f"{name}-{i}", scene) for i, scene in enumerate(scenes)]
    stop = f'<input type="checkbox" id="{name}-stop"> <label for="{name}-stop">stop</label>'
    return "\n".join([f'<div class="film">{stop}', *parts, "</div>"])


def _scene(name: str, scene: Scene) -> str:
    """One trial: its style sheet, what is said of it, and the picture."""
    seconds = len(scene.states) / _STEPS_PER_SECOND
    verdict = "fallen" if scene.fallen else "still up"
    return (
        f"<style>{_style(name, scene)}</style>\n<p><span>{escape(scene.caption)}</span>"
        f'<span class="end moving {name}-e">{verdict} after {seconds:.1f} s</span></p>\n'
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(scene.caption)}; {verdict} after {seconds:.1f} s">{_picture(name, scene.colour)}</svg>'
    )


def _style(name: str, scene: Scene) -> str:
    """Where cart and pole are at each moment, and when the trial has ended."""
    moments = scene.states[::_EVERY]
    seconds = len(scene.states) / _STEPS_PER_SECOND
    whole = seconds + _HOLD_SECONDS
    at = 100 * np.arange(len(moments)) * _EVERY / _STEPS_PER_SECOND / whole  # per cent of the loop
    cart = _frames(at, [f"transform:translate({value:.1f}px,0)" for value in _METRE * moments[:, 0]])
    pole = _frames(at, [f"transform:rotate({value:.1f}deg)" for value in np.degrees(moments[:, 2])])
    ended = 100 * seconds / whole
    return (
        f"@keyframes {name}-x{{{cart}}}@keyframes {name}-a{{{pole}}}"
        f"@keyframes {name}-e{{0%,{ended:.2f}%{{opacity:0}}{ended + 0.01:.2f}%,100%{{opacity:1}}}}"
        + "".join(f".{name}-{part}{{animation-name:{name}-{part};animation-duration:{whole:.2f}s}}" for part in "xae")
    )


def _picture(name: str, colour: str) -> str:
    """The track with its ends, the cart on it and the pole on that."""
    middle = _WIDTH // 2
    ends = "".join(
        f'<path d="M{middle + side * 2.4 * _METRE:.0f} {_GROUND - 14}v22" stroke="var(--soft)" stroke-width="2"/>'
        for side in (-1, 1)
    )
    return (
        f'<path d="M8 {_GROUND}H{_WIDTH - 8}" stroke="var(--line)" stroke-width="3"/>{ends}'
        f'<g transform="translate({middle} {_GROUND - 18})"><g class="moving {name}-x">'
        f'<rect x="-25" y="0" width="50" height="13" rx="3" fill="var(--soft)"/>'
        f'<circle cx="-14" cy="14" r="4" fill="var(--ink)"/><circle cx="14" cy="14" r="4" fill="var(--ink)"/>'
        f'<path class="moving {name}-a" d="M0 0V-{_METRE - 8}" stroke="{colour}" stroke-width="7" '
        f'stroke-linecap="round"/><circle r="4" fill="var(--ink)"/></g></g>'
    )


def _frames(at: NDArray[np.float64], values: list[str]) -> str:
    """The moments of an animation; the last one holds until the loop ends."""
    moments = "".join(f"{when:.2f}%{{{value}}}" for when, value in zip(at, values, strict=True))
    return moments + f"100%{{{values[-1]}}}"

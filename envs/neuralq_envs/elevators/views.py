"""The building as text and as a picture: shafts, cars with their load, and who waits, the longer the darker."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq_envs.canvas import BLUE, GREY, INK, Colour, blank, disk, stroke, write
from neuralq_envs.elevators.building import MOVING, OPENING, SETTLED, Building

__all__ = ["picture", "text"]

_FLOOR, _SHAFT, _MARGIN, _PERSON = 40, 44, 34, 12  # pixels
_MOST_DRAWN = 16  # people on a floor
_PATIENT, _ANGRY = np.array([86, 180, 233]), np.array([160, 30, 0])
_ANGRY_AFTER = 60.0  # seconds


def text(building: Building, deciding: int) -> str:
    """A line a floor: the load of each car, ^ or v where it moves, in brackets where it stands, ? where it decides."""
    b = building
    lines = []
    for f in reversed(range(len(b.waiting))):
        cars = "".join(f"|{_car_text(b, c, deciding) if b.floor[c] == f else '':^6}" for c in range(len(b.floor)))
        people = ""
        if b.waiting[f]:
            longest = b.clock[SETTLED] - b.arrival[b.first[f]]
            people = f" {b.waiting[f]} waiting, {longest:.0f} s"
        lines.append(f"{f:2d} {cars}|{people}")
    arrived = int(np.count_nonzero(~np.isnan(b.left)))
    return "\n".join([*lines, f"{b.clock[SETTLED]:.0f} s, {arrived} of {len(b.arrival)} have arrived", ""])


def _car_text(b: Building, c: int, deciding: int) -> str:
    if c == deciding:
        return f"?{b.aboard[c]}{'^' if b.direction[c] > 0 else 'v'}"
    if b.phase[c] == MOVING:
        return f"{b.aboard[c]}{'^' if b.direction[c] > 0 else 'v'}"
    return f"[{b.aboard[c]}]" if b.phase[c] >= OPENING else str(b.aboard[c])


def picture(building: Building, deciding: int) -> NDArray[np.uint8]:
    """Shafts to the left, people to the right of them; the car that decides is framed."""
    b = building
    num_floors, num_cars = len(b.waiting), len(b.floor)
    people_at = _MARGIN + num_cars * _SHAFT + 10
    image = blank(num_floors * _FLOOR + 4, people_at + _MOST_DRAWN * _PERSON + 10)
    for f in range(num_floors):
        ground = (num_floors - f) * _FLOOR
        stroke(image, np.array([[ground, 0.0], [ground, image.shape[1] - 1.0]]), GREY, 2)
        write(image, str(f), (ground - 18, 14), INK, 3)
        passenger = b.first[f]
        for i in range(min(int(b.waiting[f]), _MOST_DRAWN)):
            colour = _shade(b.clock[SETTLED] - b.arrival[passenger])
            disk(image, (ground - 8, people_at + _PERSON * (i + 0.5)), 5, colour)
            passenger = b.behind[passenger]
    for c in range(num_cars):
        _draw_car(image, b, c, deciding)
    return image


def _draw_car(image: NDArray[np.uint8], b: Building, c: int, deciding: int) -> None:
    left = _MARGIN + c * _SHAFT + 4
    top = (len(b.waiting) - 1 - int(b.floor[c])) * _FLOOR + 5
    image[top : top + _FLOOR - 6, left : left + _SHAFT - 8] = INK if c == deciding else BLUE
    if c != deciding and b.phase[c] >= OPENING:
        image[top + 3 : top + _FLOOR - 9, left + 3 : left + _SHAFT - 11] = (150, 175, 225)
    write(image, str(b.aboard[c]), (top + _FLOOR // 2 - 3, left + _SHAFT // 2 - 4), (255, 255, 255), 3)


def _shade(wait: float) -> Colour:
    """From patient to angry within a minute."""
    share = min(max(float(wait), 0.0) / _ANGRY_AFTER, 1.0)
    red, green, blue = ((1 - share) * _PATIENT + share * _ANGRY).astype(int).tolist()
    return red, green, blue

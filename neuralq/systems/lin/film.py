"""A play from above as an animation moved by a style sheet alone: the board, and which sensors are lit."""

from __future__ import annotations

from html import escape

import numpy as np
from numpy.typing import NDArray

from neuralq.figures import COLOURS
from neuralq.systems.lin.trainings import Film
from neuralq_envs.lin_world.board import new_world
from neuralq_envs.lin_world.kernels import ATE, CAUGHT, CLEARED
from neuralq_envs.lin_world.sensors import ENEMY_BIT, OBSTACLE_BIT, REACH, SENSOR_PLACES

__all__ = ["board_film", "ending", "num_eaten"]

_SECONDS, _HOLD_SECONDS, _CELL, _MOST_ENERGY = 0.22, 1.5, 16, 80
_SIZE = 25 * _CELL
_FOOD, _ENEMY, _AGENT = COLOURS[2], COLOURS[1], COLOURS[0]


def num_eaten(film: Film) -> int:
    """Meals of the play.

    Example:
        >>> outcomes = np.array([0, ATE, CAUGHT])
        >>> num_eaten(Film(*np.zeros((2, 3, 3), int), outcomes, np.zeros((3, 145)), np.zeros((15, 2))))
        1
    """
    return int(np.isin(film.outcomes, (ATE, CLEARED)).sum())


def ending(film: Film) -> str:
    """How the play ended.

    Example:
        >>> ending(Film(*np.zeros((2, 1, 3), int), np.array([CLEARED]), np.zeros((1, 145), np.int8), np.zeros((15, 2))))
        'done'
    """
    last = film.outcomes[-1]
    return "done" if last == CLEARED else "caught" if last == CAUGHT else "starved"


def board_film(name: str, caption: str, film: Film) -> str:
    """One play in motion; small dots are sensors, for food and for enemies, and are filled while they are lit.

    Args:
        name: prefix of every name in the style sheet; letters, digits and ``-``.
        caption: stands above it.
        film: of a play.

    Example:
        >>> film = Film(*np.zeros((2, 1, 3), int), np.array([0]), np.zeros((1, 145), np.int8), np.zeros((15, 2), int))
        >>> board_film("one", "A play", film._replace(enemies=np.zeros((1, 4, 2), int))).count("<circle")
        104
    """
    count = len(film.outcomes)
    whole = count * _SECONDS + _HOLD_SECONDS
    at = np.asarray(100 * np.arange(count) * _SECONDS / whole, np.float64)
    style = [f".{name}-all .moving{{animation-duration:{whole:.2f}s}}"]
    drawn = []
    for i, (row, column) in enumerate(film.meals.tolist()):
        there = np.ones(count, np.bool_)
        eaten = np.flatnonzero(np.isin(film.outcomes, (ATE, CLEARED)) & (film.agent[:, :2] == (row, column)).all(1))
        there[eaten[0] if eaten.size else count :] = False
        style.append(_switched(f"{name}-f{i}", at, there))
        place = f'cx="{(column + 0.5) * _CELL:g}" cy="{(row + 0.5) * _CELL:g}"'
        drawn.append(f'<circle class="moving {name}-f{i}" {place} r="4.5" fill="{_FOOD}"/>')
    for i in range(film.enemies.shape[1]):
        style.append(_moved(f"{name}-e{i}", at, film.enemies[:, i]))
        drawn.append(f'<circle class="moving {name}-e{i}" r="6" fill="{_ENEMY}"/>')
    sensors = []
    for i, (down, right) in enumerate(SENSOR_PLACES[:OBSTACLE_BIT]):
        is_enemy = i >= ENEMY_BIT  # the two kinds stand in the same places: side by side in the picture
        style.append(_switched(f"{name}-s{i}", at, film.bits[:, i] == 1))
        x, y, colour = right * _CELL + (3 if is_enemy else -3), down * _CELL, _ENEMY if is_enemy else _FOOD
        sensors.append(
            f'<circle class="moving {name}-s{i}" cx="{x}" cy="{y}" r="2.4" fill="{colour}" stroke="var(--ink)" '
            f'stroke-width=".7"/>'
        )
    style.append(_moved(f"{name}-a", at, film.agent[:, :2]))
    style.append(_energy(f"{name}-w", at, film.agent[:, 2]))
    agent = f'<circle r="6.5" fill="{_AGENT}"/><path d="M-3 0H3M0 -3V3" stroke="white" stroke-width="1.6"/>'
    return (
        f'<div class="film"><input type="checkbox" id="{name}-stop"> <label for="{name}-stop">stop</label>'
        f"<style>{''.join(style)}</style>\n<p><span>{escape(caption)}</span><span>{_legend()}</span></p>\n"
        f'<svg class="{name}-all" xmlns="http://www.w3.org/2000/svg" viewBox="-2 -2 {_SIZE + 4} {_SIZE + 18}" '
        f'role="img" style="max-width:32rem" aria-label="{escape(caption)}">{_board()}{"".join(drawn)}'
        f'<g class="moving {name}-a">{agent}{"".join(sensors)}</g>'
        f'<rect class="moving {name}-w" y="{_SIZE + 6}" width="{_SIZE}" height="7" fill="{_AGENT}"/></svg></div>'
    )


def _legend() -> str:
    kinds = (("agent", _AGENT), ("food", _FOOD), ("enemy", _ENEMY))
    return " ".join(f'<span style="color:{colour}">&#9679; {kind}</span>' for kind, colour in kinds)


def _board() -> str:
    """Obstacles as one path."""
    obstacles = new_world().obstacles[REACH:-REACH, REACH:-REACH]
    squares = "".join(f"M{column * _CELL} {row * _CELL}h16v16h-16z" for row, column in np.argwhere(obstacles == 1))
    return (
        f'<path d="{squares}" fill="var(--line)"/><rect width="{_SIZE}" height="{_SIZE}" fill="none" '
        'stroke="var(--soft)" stroke-width="2"/>'
    )


def _moved(name: str, at: NDArray[np.float64], cells: NDArray[np.int64]) -> str:
    """From cell to cell; what does not move for a while is not repeated."""
    kept = np.ones(len(cells), np.bool_)
    kept[1:-1] = (cells[1:-1] != cells[:-2]).any(1) | (cells[1:-1] != cells[2:]).any(1)
    places = [
        f"transform:translate({(column + 0.5) * _CELL:g}px,{(row + 0.5) * _CELL:g}px)" for row, column in cells.tolist()
    ]
    frames = "".join(f"{when:.2f}%{{{place}}}" for when, place, k in zip(at, places, kept, strict=True) if k)
    return f"@keyframes {name}{{{frames}100%{{{places[-1]}}}}}.{name}{{animation-name:{name};{places[0]}}}"


def _energy(name: str, at: NDArray[np.float64], energy: NDArray[np.int64]) -> str:
    shares = [f"transform:scaleX({min(max(one, 0) / _MOST_ENERGY, 1.0):.3f})" for one in energy.tolist()]
    frames = "".join(f"{when:.2f}%{{{share}}}" for when, share in zip(at, shares, strict=True))
    return f"@keyframes {name}{{{frames}100%{{{shares[-1]}}}}}.{name}{{animation-name:{name};{shares[0]}}}"


def _switched(name: str, at: NDArray[np.float64], on: NDArray[np.bool_]) -> str:
    """Visible or not, from one moment to the next."""
    changes = [0, *(np.flatnonzero(np.diff(on)) + 1).tolist()]
    frames = "".join(f"{at[k]:.2f}%{{opacity:{int(on[k])}}}" for k in changes)
    motion = f"animation-name:{name};animation-timing-function:step-end!important;opacity:{int(on[0])}"
    return f"@keyframes {name}{{{frames}100%{{opacity:{int(on[-1])}}}}}.{name}{{{motion}}}"

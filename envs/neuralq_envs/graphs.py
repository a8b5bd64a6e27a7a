"""Pictures of small models that are no grids: states as labelled disks, what leads where as lines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neuralq_envs.canvas import BLUE, GREY, INK, PAPER, blank, disk, frame, stroke, write

__all__ = ["GraphScene"]

_PITCH, _RADIUS = 56, 18  # pixels


@dataclass(frozen=True)
class GraphScene:
    r"""States at places, lines between them; terminal states are squares.

    Args:
        labels: one short label per state, in capitals and digits.
        places: (row, column) of each state in steps of 56 pixels.
        edges: pairs of states to join; one that would pass over a state is drawn as an arc.
        ends: the states drawn as squares.

    Raises:
        ValueError: another number of places than labels.

    Example:
        >>> scene = GraphScene(("A", "B"), ((0, 0), (0, 1)), ((0, 1),), (1,))
        >>> scene.text(0)
        '[A] B\n'
        >>> scene.pixels(0).shape
        (56, 112, 3)
    """

    labels: tuple[str, ...]
    places: tuple[tuple[int, int], ...]
    edges: tuple[tuple[int, int], ...] = ()
    ends: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if len(self.places) != len(self.labels):
            raise ValueError(f"each of the {len(self.labels)} states needs a place, got {len(self.places)} places")

    def text(self, state: int | None) -> str:
        """The labels from left to right, that of the state in brackets."""
        order = sorted(range(len(self.labels)), key=lambda s: self.places[s][::-1])
        return " ".join(f"[{self.labels[s]}]" if s == state else self.labels[s] for s in order) + "\n"

    def pixels(self, state: int | None) -> NDArray[np.uint8]:
        """The graph, the state filled blue."""
        picture = self._empty_scene.copy()
        if state is not None:
            self._draw_state(picture, state, here=True)
        return picture

    @cached_property
    def _empty_scene(self) -> NDArray[np.uint8]:
        rows, columns = (max(place[i] for place in self.places) + 1 for i in (0, 1))
        picture = blank(rows * _PITCH, columns * _PITCH)
        for one, other in self.edges:
            stroke(picture, self._line(one, other), GREY)
        for s in range(len(self.labels)):
            self._draw_state(picture, s, here=False)
        return picture

    def _draw_state(self, picture: NDArray[np.uint8], s: int, here: bool) -> None:
        row, column = self._centre(s)
        if s in self.ends:
            top, left = int(row) - _RADIUS + 4, int(column) - _RADIUS + 4
            square = picture[top : top + 2 * _RADIUS - 7, left : left + 2 * _RADIUS - 7]
            square[:] = BLUE if here else GREY
            frame(square, INK, width=2)
        else:
            disk(picture, (row, column), _RADIUS, INK)
            disk(picture, (row, column), _RADIUS - 2, BLUE if here else PAPER)
        label = self.labels[s]
        write(picture, label, (row, column), PAPER if here else INK, scale=2 if len(label) > 1 else 3)

    def _centre(self, s: int) -> tuple[float, float]:
        return (self.places[s][0] + 0.5) * _PITCH, (self.places[s][1] + 0.5) * _PITCH

    def _line(self, one: int, other: int) -> NDArray[np.float64]:
        ends = np.array([self._centre(one), self._centre(other)])
        middle = ends.mean(axis=0)
        passes_over = any(
            np.hypot(*(np.array(self._centre(s)) - middle)) < _RADIUS
            for s in range(len(self.labels))
            if s not in (one, other)
        )
        if not passes_over:
            return ends
        along = np.linspace(0, 1, 21)[:, None]
        line: NDArray[np.float64] = ends[0] + along * (ends[1] - ends[0])
        line[:, :1] -= 4 * along * (1 - along) * (_PITCH / 2 - 4)
        return line

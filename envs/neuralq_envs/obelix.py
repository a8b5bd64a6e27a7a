"""OBELIX: a robot of eight sonars in a room of round boxes, which it is to find, to push, and not to get stuck at.

Mechanics and the 18 bits are in `neuralq_envs.obelix_kernels`. A push earns 1, being refused costs 3.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Discrete, MultiBinary
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice
from neuralq_envs.canvas import BLUE, GREY, INK, RED, blank, disk, frame, stroke
from neuralq_envs.obelix_kernels import (
    BOX_RADIUS,
    NUM_BITS,
    NUM_MOVES,
    ROBOT_RADIUS,
    SIDE,
    SONARS,
    Room,
    move,
    new_room,
    sense,
    settle,
    sonar_range,
)

__all__ = ["ObelixEnv", "make"]

_METRE = 40  # pixels
_CELL = 0.25  # metres to a sign of the text


class ObelixEnv(gymnasium.Env[Any, Any]):
    """The robot in its room; observations are its 18 bits, the lowest first.

    Actions: forward 0.2 m, 22.5 degrees to the left and to the right, 45 to the left and to the right. ``info`` has
    whether a box was pushed and whether the robot is stuck.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.

    Raises:
        ValueError: another render mode.

    Source: Mahadevan & Connell 1992; sizes and the layout of rooms are ours.

    Example:
        >>> env = ObelixEnv()
        >>> env.reset(seed=0)[0].shape, env.step(0)[1]
        ((18,), 0.0)
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        self.render_mode = render_mode
        self.observation_space, self.action_space = MultiBinary(NUM_BITS), Discrete(NUM_MOVES)
        self._room: Room | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.int8], dict[str, Any]]:
        """Another room, or ``options["robot"]`` (x, y, heading in radians) and ``options["boxes"]`` (four of x, y).

        Raises:
            ValueError: one of the two alone, of another shape, or what overlaps or is not inside the room.
        """
        super().reset(seed=seed)
        room = new_room()
        if options:
            _arrange(room, options)
        else:
            while not settle(room, self.np_random.random(11)):
                pass
        self._room = room
        return self._bits(), {"pushed": False, "stuck": False}

    def step(self, action: int) -> tuple[NDArray[np.int8], float, bool, bool, dict[str, Any]]:
        """One move; 1 for a push, −3 for being refused.

        Raises:
            ResetNeeded: before the first reset.
            ValueError: another action.
        """
        if self._room is None:
            raise ResetNeeded("there is no room yet: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be a whole number from 0 to {NUM_MOVES - 1}, got {action!r}")
        pushed = bool(move(self._room, int(action)))
        stuck = bool(self._room.stuck[0])
        return self._bits(), 1.0 if pushed else -3.0 if stuck else 0.0, False, False, {"pushed": pushed, "stuck": stuck}

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode or before a reset."""
        if self._room is None or self.render_mode is None:
            return None
        return _text(self._room) if self.render_mode == "ansi" else _picture(self._room)

    @property
    def room(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Robot (x, y, heading) and boxes ``[4, 2]``, as copies.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self._room is None:
            raise ResetNeeded("there is no room yet: call reset() first")
        return self._room.robot.copy(), self._room.boxes.copy()

    def _bits(self) -> NDArray[np.int8]:
        assert self._room is not None
        return np.array([sense(self._room) >> i & 1 for i in range(NUM_BITS)], np.int8)


def make(render_mode: str | None = None, **given: Any) -> ObelixEnv:
    """What ``gymnasium.make("neuralq/Obelix-v0")`` calls.

    Example:
        >>> make().reset(seed=1)[0].dtype
        dtype('int8')
    """
    return ObelixEnv(render_mode, **given)


def _arrange(room: Room, options: dict[str, Any]) -> None:
    """The room as the options have it."""
    given: dict[str, ArrayLike | None] = {name: options.get(name) for name in ("robot", "boxes")}
    for name, shape in (("robot", room.robot.shape), ("boxes", room.boxes.shape)):
        values = np.array(given[name], np.float64) if given[name] is not None else np.zeros(0)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"options[{name!r}] must be finite numbers of shape {list(shape)}, got {given[name]!r}")
        getattr(room, name)[:] = values
    discs = [(*room.robot[:2], ROBOT_RADIUS), *((x, y, BOX_RADIUS) for x, y in room.boxes)]
    for i, (x, y, radius) in enumerate(discs):
        if not (radius <= x <= SIDE - radius and radius <= y <= SIDE - radius):
            raise ValueError(f"a disc of radius {radius} at ({x:g}, {y:g}) is not inside the room of {SIDE:g} m")
        for other_x, other_y, other_radius in discs[:i]:
            if math.hypot(x - other_x, y - other_y) < radius + other_radius:
                raise ValueError(f"the discs at ({x:g}, {y:g}) and ({other_x:g}, {other_y:g}) overlap")


def _text(room: Room) -> str:
    """The room from above, a sign for a quarter of a metre: boxes, and the robot as an arrow."""
    count = round(SIDE / _CELL)
    rows = [[" "] * count for _ in range(count)]
    for row in range(count):
        for column in range(count):
            x, y = (column + 0.5) * _CELL, (count - row - 0.5) * _CELL
            if (np.hypot(*(room.boxes - (x, y)).T) < BOX_RADIUS).any():
                rows[row][column] = "O"
    x, y, heading = room.robot.tolist()
    arrow = ">^<v"[round(heading / (math.pi / 2)) % 4]
    rows[min(max(count - 1 - int(y / _CELL), 0), count - 1)][min(int(x / _CELL), count - 1)] = arrow
    edge = "+" + "-" * count + "+"
    stuck = ", stuck" if room.stuck[0] else ""
    inside = ["|" + "".join(row) + "|" for row in rows]
    return "\n".join(
        [edge, *inside, edge, f"robot at ({x:.2f}, {y:.2f}), {math.degrees(heading):.0f} degrees{stuck}", ""]
    )


def _picture(room: Room) -> NDArray[np.uint8]:
    """The room from above with what each sonar sees."""
    size = round(SIDE * _METRE)
    picture = blank(size, size)

    def at(x: float, y: float) -> tuple[float, float]:
        return size - 1 - y * _METRE, x * _METRE

    x, y, heading = room.robot.tolist()
    for degrees in SONARS:
        reach = min(float(sonar_range(room, degrees)), 0.9) + ROBOT_RADIUS
        angle = heading + math.radians(degrees)
        tip = at(x + reach * math.cos(angle), y + reach * math.sin(angle))
        stroke(picture, np.clip(np.array([at(x, y), tip]), 0, size - 1), RED, 1)
    for box in room.boxes:
        disk(picture, at(*box), BOX_RADIUS * _METRE, GREY)
    disk(picture, at(x, y), ROBOT_RADIUS * _METRE, BLUE)
    nose = at(x + ROBOT_RADIUS * math.cos(heading), y + ROBOT_RADIUS * math.sin(heading))
    stroke(picture, np.array([at(x, y), nose]), INK, 3)
    frame(picture, INK, 2)
    return picture

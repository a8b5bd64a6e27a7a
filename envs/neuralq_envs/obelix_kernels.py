"""A room with round boxes and a robot that can push them: how it moves, and what its 18 bits say.

The room is 8 × 8 m; four boxes are discs of radius 0.3 m, the robot one of 0.25 m. It goes 0.2 m forward or turns on
the spot. A box in the way moves out along the line of centres until it touches; where it cannot, for a wall or for
another box, nothing moves and the robot is stuck.

Bits 2k and 2k + 1 are NEAR (an echo within 0.45 m of the robot's rim) and FAR (beyond that, within 0.9 m) of sonar k,
from the left to the right: ±105, ±75, ±33 and ±11 degrees, each a fan of three rays. Bit 16 is BUMP (a box or the wall
within 0.08 m ahead), bit 17 STUCK (the last thing tried was to go forward, and it was refused).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel

__all__ = [
    "BOX_RADIUS",
    "BUMP",
    "FORWARD",
    "FRONT_NEAR",
    "NUM_BITS",
    "NUM_MOVES",
    "ROBOT_RADIUS",
    "SIDE",
    "SONARS",
    "STUCK",
    "TURNS",
    "Room",
    "move",
    "new_room",
    "sense",
    "settle",
    "sonar_range",
]

SIDE, BOX_RADIUS, ROBOT_RADIUS, STRIDE = 8.0, 0.3, 0.25, 0.2  # metres
NUM_BOXES, NUM_BITS, NUM_MOVES = 4, 18, 5
FORWARD = 0
TURNS = (0.0, 22.5, -22.5, 45.0, -45.0)
"""Degrees of each move; to the left is positive."""
SONARS = (105.0, 75.0, 33.0, 11.0, -11.0, -33.0, -75.0, -105.0)
"""Degrees from straight ahead."""
FAN = 7.0
"""Degrees between the middle ray of a sonar and the two beside it."""
BUMP, STUCK = 1 << 16, 1 << 17
FRONT_NEAR = 1 << 4 | 1 << 6 | 1 << 8 | 1 << 10
_NEAR, _FAR, _TOUCH = 0.45, 0.9, 0.08
_MOVED = 1e-6  # a box that is only rounded away has not been pushed
_SLACK = 1e-9
_DEGREE = math.pi / 180


class Room(NamedTuple):
    """Where everything is, in metres and radians.

    Args:
        robot: x, y and heading, ``[3]``.
        boxes: their centres, ``[4, 2]``.
        stuck: 1 where the last thing tried was refused, ``[1]``.
        aside: room for where boxes would go, ``[4, 2]``.
    """

    robot: NDArray[np.float64]
    boxes: NDArray[np.float64]
    stuck: NDArray[np.int64]
    aside: NDArray[np.float64]


def new_room() -> Room:
    """An empty record; `settle` or a caller fills it.

    Example:
        >>> new_room().boxes.shape
        (4, 2)
    """
    return Room(np.zeros(3), np.zeros((NUM_BOXES, 2)), np.zeros(1, np.int64), np.zeros((NUM_BOXES, 2)))


@lean_kernel
def settle(room: Room, drawn: NDArray[np.float64]) -> bool:
    """Puts boxes and robot where ``drawn`` says, and returns whether none of them overlap.

    Args:
        room: written.
        drawn: eleven numbers in [0, 1): x and y of each box, then of the robot, then its heading.

    Example:
        >>> room = new_room()
        >>> settle(room, np.zeros(11)), settle(room, np.array([0, 0, 0, 1, 1, 0, 1, 1, 0.5, 0.5, 0]))
        (False, True)
    """
    for i in range(NUM_BOXES):
        for k in range(2):
            room.boxes[i, k] = BOX_RADIUS + (SIDE - 2 * BOX_RADIUS) * drawn[2 * i + k]
    for k in range(2):
        room.robot[k] = ROBOT_RADIUS + (SIDE - 2 * ROBOT_RADIUS) * drawn[2 * NUM_BOXES + k]
    room.robot[2] = 2 * math.pi * drawn[2 * NUM_BOXES + 2]
    room.stuck[0] = 0
    for i in range(NUM_BOXES):
        if math.hypot(room.boxes[i, 0] - room.robot[0], room.boxes[i, 1] - room.robot[1]) < BOX_RADIUS + ROBOT_RADIUS:
            return False
        for j in range(i):
            if math.hypot(room.boxes[i, 0] - room.boxes[j, 0], room.boxes[i, 1] - room.boxes[j, 1]) < 2 * BOX_RADIUS:
                return False
    return True


@lean_kernel
def move(room: Room, action: int) -> bool:
    """Goes forward (0) or turns (1 and 2: 22.5 degrees to the left and right, 3 and 4: 45); whether a box was pushed.

    Example:
        >>> room = new_room()
        >>> room.robot[:] = 4.0, 4.0, 0.0
        >>> room.boxes[:] = [[4.6, 4.0], [1, 1], [1, 7], [7, 1]]
        >>> move(room, FORWARD), room.robot[:2].round(6).tolist(), room.boxes[0].round(6).tolist()
        (True, [4.2, 4.0], [4.75, 4.0])
    """
    room.stuck[0] = 0
    if action != FORWARD:
        room.robot[2] = (room.robot[2] + TURNS[action] * _DEGREE) % (2 * math.pi)
        return False
    x = room.robot[0] + STRIDE * math.cos(room.robot[2])
    y = room.robot[1] + STRIDE * math.sin(room.robot[2])
    if not _inside(x, y, ROBOT_RADIUS):
        room.stuck[0] = 1
        return False
    pushed = False
    for i in range(NUM_BOXES):
        dx, dy = room.boxes[i, 0] - x, room.boxes[i, 1] - y
        apart = math.hypot(dx, dy)
        room.aside[i, 0], room.aside[i, 1] = room.boxes[i, 0], room.boxes[i, 1]
        if apart < BOX_RADIUS + ROBOT_RADIUS:
            farther = (BOX_RADIUS + ROBOT_RADIUS) / apart
            room.aside[i, 0], room.aside[i, 1] = x + farther * dx, y + farther * dy
            pushed = pushed or BOX_RADIUS + ROBOT_RADIUS - apart > _MOVED
            if not _inside(room.aside[i, 0], room.aside[i, 1], BOX_RADIUS):
                room.stuck[0] = 1
    for i in range(NUM_BOXES):
        for j in range(i):
            apart = math.hypot(room.aside[i, 0] - room.aside[j, 0], room.aside[i, 1] - room.aside[j, 1])
            if apart < 2 * BOX_RADIUS - _SLACK:
                room.stuck[0] = 1
    if room.stuck[0] == 1:
        return False
    room.robot[0], room.robot[1] = x, y
    for i in range(NUM_BOXES):
        room.boxes[i, 0], room.boxes[i, 1] = room.aside[i, 0], room.aside[i, 1]
    return pushed


@lean_kernel
def sense(room: Room) -> int:
    """The 18 bits as one number.

    Example:
        A box 0.35 m before the rim: both middle sonars say NEAR, all else is far away.

        >>> room = new_room()
        >>> room.robot[:] = 4.0, 4.0, 0.0
        >>> room.boxes[:] = [[4.9, 4.0], [1, 1], [1, 7], [7, 1]]
        >>> bin(sense(room))
        '0b101000000'
    """
    bits = 0
    for k in range(len(SONARS)):
        reach = sonar_range(room, SONARS[k])
        if reach < _NEAR:
            bits |= 1 << (2 * k)
        elif reach < _FAR:
            bits |= 1 << (2 * k + 1)
    x = room.robot[0] + _TOUCH * math.cos(room.robot[2])
    y = room.robot[1] + _TOUCH * math.sin(room.robot[2])
    touches = not _inside(x, y, ROBOT_RADIUS)
    for i in range(NUM_BOXES):
        if math.hypot(room.boxes[i, 0] - x, room.boxes[i, 1] - y) < BOX_RADIUS + ROBOT_RADIUS:
            touches = True
    if touches:
        bits |= BUMP
    if room.stuck[0] == 1:
        bits |= STUCK
    return bits


@lean_kernel
def sonar_range(room: Room, degrees: float) -> float:
    """Metres from the robot's rim to the nearest echo in the fan of the sonar that looks so far to the left.

    Example:
        >>> room = new_room()
        >>> room.robot[:] = 4.0, 4.0, 0.0
        >>> room.boxes[:] = [[5.0, 4.0], [1, 1], [1, 7], [7, 1]]
        >>> round(sonar_range(room, 0.0), 6)
        0.45
    """
    nearest = np.inf
    for side in range(-1, 2):
        angle = room.robot[2] + (degrees + side * FAN) * _DEGREE
        nearest = min(nearest, _ray(room, math.cos(angle), math.sin(angle)))
    return nearest - ROBOT_RADIUS


@lean_kernel
def _ray(room: Room, dx: float, dy: float) -> float:
    """Metres from the robot's centre to the wall or a box, in one direction."""
    x, y = room.robot[0], room.robot[1]
    reach = np.inf
    if dx > 0.0:
        reach = min(reach, (SIDE - x) / dx)
    elif dx < 0.0:
        reach = min(reach, -x / dx)
    if dy > 0.0:
        reach = min(reach, (SIDE - y) / dy)
    elif dy < 0.0:
        reach = min(reach, -y / dy)
    for i in range(NUM_BOXES):
        across, up = room.boxes[i, 0] - x, room.boxes[i, 1] - y
        along = across * dx + up * dy
        beside = BOX_RADIUS * BOX_RADIUS - (across * across + up * up - along * along)
        if along > 0.0 and beside > 0.0:
            reach = min(reach, along - math.sqrt(beside))
    return reach


@lean_kernel
def _inside(x: float, y: float, radius: float) -> bool:
    return radius - _SLACK <= x <= SIDE - radius + _SLACK and radius - _SLACK <= y <= SIDE - radius + _SLACK

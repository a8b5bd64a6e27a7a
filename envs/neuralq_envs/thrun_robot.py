"""A robot that has to come near a target, which it knows in its own frame: how far ahead and how far to the left.

The state is (x, y) in metres, x ahead and y to the left. Forward takes .35 off x; a turn by 25 degrees to the left
turns the target by 25 degrees to the right about the robot, and the other way round. The target is reached within .45 m
ahead, which earns 1; it is lost behind the robot or beyond 4.2 m, which earns −1 (a target within .45 m behind the
robot is lost). Steps in between earn nothing.

Source: after Thrun 1996, whose robot had a camera and sonars; two numbers, the moves and their sizes are ours.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice
from neuralq_envs.canvas import BLUE, GREEN, GREY, INK, RED, blank, disk, stroke

__all__ = [
    "FAR",
    "FORWARD",
    "LEFT",
    "MAX_STEPS",
    "NEAR",
    "NUM_MOVES",
    "RIGHT",
    "STRIDE",
    "TURN",
    "ThrunRobotEnv",
    "by_geometry",
    "draw_targets",
    "make",
    "outcomes",
    "successors",
]

FORWARD, LEFT, RIGHT = range(3)
NUM_MOVES = 3
STRIDE, TURN = 0.35, math.radians(25.0)
NEAR, FAR = 0.45, 4.2
MAX_STEPS = 30
_NEAREST, _FARTHEST, _ASIDE = 1.0, 4.0, math.radians(60.0)  # where targets are at the start
_REACH = FAR + STRIDE  # no move brings a target that is in view farther away
_METRE = 40  # pixels
_CELL = 0.3  # metres to a row of the text; a column is half of that


def successors(s: ArrayLike, a: int) -> NDArray[np.float64]:
    """Where the target is after a move, ``[*n, 2]`` to ``[*n, 2]``.

    Args:
        s: where it is, ahead and to the left.
        a: 0 forward, 1 left, 2 right.

    Raises:
        ValueError: another move.

    Example:
        >>> successors([1.0, 0.5], FORWARD).tolist(), successors([1.0, 0.0], LEFT).round(3).tolist()
        ([0.65, 0.5], [0.906, -0.423])
    """
    check_choice("a", a, (FORWARD, LEFT, RIGHT))
    target = np.asarray(s, np.float64)
    if a == FORWARD:
        return np.asarray(target - (STRIDE, 0.0))
    angle = TURN if a == LEFT else -TURN
    turned = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return np.asarray(target @ turned.T)


def outcomes(s: ArrayLike) -> NDArray[np.float64]:
    """What arriving there earns, ``[*n, 2]`` to ``[*n]``: 1 reached, −1 lost, 0 to go on.

    Example:
        >>> outcomes([[0.4, 0.1], [-0.1, 0.1], [4.0, 2.0], [1.0, 0.0]]).tolist()
        [1.0, -1.0, -1.0, 0.0]
    """
    target = np.asarray(s, np.float64)
    distance, behind = np.hypot(target[..., 0], target[..., 1]), target[..., 0] < 0
    return np.where(behind | (distance > FAR), -1.0, np.where(distance < NEAR, 1.0, 0.0))


def by_geometry(s: ArrayLike) -> NDArray[np.int64]:
    """The move of whoever sees where the target is: turn to it if that leaves it more nearly ahead, else forward.

    Example:
        >>> by_geometry([[1.0, 0.1], [1.0, 1.0], [1.0, -1.0]]).tolist()
        [0, 1, 2]
    """
    target = np.asarray(s, np.float64)
    bearing = np.arctan2(target[..., 1], target[..., 0])
    return np.where(np.abs(bearing) <= TURN / 2, FORWARD, np.where(bearing > 0, LEFT, RIGHT))


def draw_targets(num: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Targets as episodes begin with: 1 to 4 m away and within 60 degrees of straight ahead, ``[num, 2]``.

    Example:
        >>> outcomes(draw_targets(5, np.random.default_rng(0))).tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0]
    """
    distance, bearing = rng.uniform((_NEAREST, -_ASIDE), (_FARTHEST, _ASIDE), (num, 2)).T
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)


class ThrunRobotEnv(gymnasium.Env[Any, Any]):
    """The robot and its target; observations are metres ahead and to the left.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.

    Raises:
        ValueError: another render mode.

    Example:
        >>> env = ThrunRobotEnv()
        >>> env.reset(options={"target": (0.7, 0.0)})[0].tolist(), env.step(FORWARD)[1:3]
        ([0.7, 0.0], (1.0, True))
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        self.render_mode = render_mode
        self.observation_space, self.action_space = Box(-_REACH, _REACH, (2,), np.float64), Discrete(NUM_MOVES)
        self._target: NDArray[np.float64] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """A target 1 to 4 m away within 60 degrees of straight ahead, or ``options["target"]``.

        Raises:
            ValueError: a target that is not two numbers, or that is reached or lost already.
        """
        super().reset(seed=seed)
        if options is not None and "target" in options:
            given = np.array(options["target"], np.float64)
            if given.shape != (2,) or not np.isfinite(given).all() or outcomes(given) != 0:
                raise ValueError(
                    f"options['target'] must be metres ahead and to the left, in front of the robot and {NEAR:g} to "
                    f"{FAR:g} m away, got {options['target']!r}"
                )
            self._target = given
        else:
            (self._target,) = draw_targets(1, self.np_random)
        return self._target.copy(), {}

    def step(self, action: int) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Forward (0), 25 degrees to the left (1) or to the right (2); ``info`` says whether the target is reached.

        Raises:
            ResetNeeded: before the first reset, or when the target is reached or lost.
            ValueError: another action.
        """
        if self._target is None or outcomes(self._target) != 0:
            raise ResetNeeded("the target is reached or lost, or there is none yet: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0 (forward), 1 (left) or 2 (right), got {action!r}")
        self._target = successors(self._target, int(action))
        reward = float(outcomes(self._target))
        return self._target.copy(), reward, reward != 0.0, False, {"is_success": reward > 0.0}

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode or before a reset."""
        if self._target is None or self.render_mode is None:
            return None
        return _text(self._target) if self.render_mode == "ansi" else _picture(self._target)


def make(render_mode: str | None = None, **given: Any) -> ThrunRobotEnv:
    """What ``gymnasium.make("neuralq/ThrunRobot-v0")`` calls.

    Example:
        >>> make().reset(seed=0)[0].shape
        (2,)
    """
    return ThrunRobotEnv(render_mode, **given)


def _text(target: NDArray[np.float64]) -> str:
    """What the robot has ahead, seen from above: itself at the bottom, what is near as dots, the target."""
    ahead = np.arange(FAR, -_CELL / 2, -_CELL)
    aside = np.arange(FAR, -FAR - _CELL / 4, -_CELL / 2)
    distance = np.hypot(ahead[:, None], aside)
    signs = np.where(distance > FAR, " ", np.where(distance < NEAR, ":", "."))
    signs[-1, len(aside) // 2] = "^"
    row, column = np.abs(ahead - target[0]).argmin(), np.abs(aside - target[1]).argmin()
    signs[row, column] = "X"
    x, y = target.tolist()
    said = {1.0: ", reached", -1.0: ", lost", 0.0: ""}[float(outcomes(target))]
    side = "left" if y >= 0 else "right"
    place = f"target {x:+.2f} m ahead, {abs(y):.2f} m to the {side}{said}"
    return "\n".join([*("".join(line).rstrip() for line in signs), place, ""])


def _picture(target: NDArray[np.float64]) -> NDArray[np.uint8]:
    """From above: the half disk in which a target is in view, where it is reached, the robot and the target."""
    height, width = round((FAR + 0.6) * _METRE), round(2 * (FAR + 0.4) * _METRE)
    ground = round((FAR + 0.2) * _METRE)
    picture = blank(height, width)
    here = (float(ground), width / 2)
    for radius, colour in ((FAR, GREY), (NEAR, GREEN)):
        disk(picture, here, radius * _METRE, colour)
    picture[ground + 1 :] = blank(1, 1)
    nose = np.array([here, (here[0] - 0.25 * _METRE, here[1])])
    disk(picture, here, 0.15 * _METRE, BLUE)
    stroke(picture, nose, INK, 3)
    at = np.clip(np.array([here[0] - target[0] * _METRE, here[1] - target[1] * _METRE]), 0, (height - 1, width - 1))
    disk(picture, (float(at[0]), float(at[1])), 0.12 * _METRE, RED)
    return picture

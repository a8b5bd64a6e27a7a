"""A pole on a cart that is pushed left or right, seen through 162 boxes: the task of the first actor-critic.

The state is continuous, the learner sees which of 162 boxes it is in, so the boxes are not Markov and there is no exact
model. A reward of −1 comes when the pole has fallen, and nothing before.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Discrete
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice
from neuralq_envs.canvas import BLUE, GREY, INK, blank, disk, stroke
from neuralq_envs.pole_kernels import NUM_BOXES, State, box_of, has_fallen, pole_step

__all__ = ["BSA_FRICTION", "PoleBoxesEnv", "make"]

BSA_FRICTION = (0.0005, 0.000002)
"""Friction of the cart on its track and of the pole in its hinge, as Barto, Sutton and Anderson (1983) have them."""

_METRE = 110  # pixels
_TRACK = 2.6  # metres to either side that are drawn
_COLUMNS, _ROWS = 53, 4  # of the text: ten columns a metre


class PoleBoxesEnv(gymnasium.Env[Any, Any]):
    """The pole through boxes; observations are their numbers, ``info["state"]`` is x, ẋ, θ, θ̇.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.
        cart_friction: μ_c of the cart on its track, at least 0.
        pole_friction: μ_p of the pole in its hinge, at least 0.
        start_spread: each number of the first state is uniform between − and + this; 0 starts upright and at rest.

    Raises:
        ValueError: another render mode, or a negative number.

    Source: Michie & Chambers 1968; Barto, Sutton & Anderson 1983.

    Example:
        >>> env = PoleBoxesEnv()
        >>> env.reset(seed=0)[0], env.step(1)[1:3]
        (85, (0.0, False))
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        cart_friction: float = 0.0,
        pole_friction: float = 0.0,
        start_spread: float = 0.0,
    ) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        given = {"cart_friction": cart_friction, "pole_friction": pole_friction, "start_spread": start_spread}
        for name, value in given.items():
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")
        self.render_mode = render_mode
        self.observation_space, self.action_space = Discrete(NUM_BOXES), Discrete(2)
        self._friction = (float(cart_friction), float(pole_friction))
        self._spread = float(start_spread)
        self._state: State | None = None
        self._fallen = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """Starts upright, or from ``options["state"]`` (x, ẋ, θ, θ̇), which must not have fallen.

        Raises:
            ValueError: a state that is not four finite numbers, or one that has fallen.
        """
        super().reset(seed=seed)
        if options is not None and "state" in options:
            self._state = _checked(options["state"])
        elif self._spread > 0:
            x, x_dot, theta, theta_dot = self.np_random.uniform(-self._spread, self._spread, 4).tolist()
            self._state = (x, x_dot, theta, theta_dot)
        else:
            self._state = (0.0, 0.0, 0.0, 0.0)
        self._fallen = False
        return box_of(*self._state), {"state": np.array(self._state)}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Pushes left (0) or right (1) for 0.02 s.

        Raises:
            ResetNeeded: before the first reset, or after the pole has fallen.
            ValueError: another action.
        """
        if self._state is None or self._fallen:
            raise ResetNeeded("the pole has fallen, or has not been set up yet: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0 (push left) or 1 (push right), got {action!r}")
        self._state = pole_step(*self._state, int(action), *self._friction)
        self._fallen = bool(has_fallen(self._state[0], self._state[2]))
        reward = -1.0 if self._fallen else 0.0
        return box_of(*self._state), reward, self._fallen, False, {"state": np.array(self._state)}

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode or before a reset."""
        if self._state is None or self.render_mode is None:
            return None
        return _text(self._state, self._fallen) if self.render_mode == "ansi" else _picture(self._state)


def make(render_mode: str | None = None, **given: Any) -> PoleBoxesEnv:
    """What ``gymnasium.make("neuralq/PoleBoxes-v0")`` calls.

    Example:
        >>> make(start_spread=0.05).reset(seed=1)[0] in range(162)
        True
    """
    return PoleBoxesEnv(render_mode, **given)


def _checked(state: ArrayLike) -> State:
    values = np.asarray(state, dtype=np.float64)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise ValueError(f"options['state'] must be four finite numbers (x, ẋ, θ, θ̇), got {state!r}")
    x, x_dot, theta, theta_dot = values.tolist()
    if has_fallen(x, theta):
        raise ValueError(f"options['state'] has fallen: |x| must be at most 2.4 and |θ| at most 0.2094, got {state!r}")
    return x, x_dot, theta, theta_dot


def _text(state: State, fallen: bool) -> str:
    """The pole leaning over its cart, ten columns a metre, and the numbers below."""
    x, _, theta, _ = state
    rows = [[" "] * _COLUMNS for _ in range(_ROWS)]
    middle = round((x + _TRACK) * 10)
    sign = "|" if abs(theta) < 0.03 else "/" if theta > 0 else "\\"
    for i, row in enumerate(rows):
        height = (_ROWS - i) / _ROWS  # metres above the hinge
        column = middle + round(10 * height * np.sin(theta))
        if 0 <= column < _COLUMNS:
            row[column] = sign
    track = ["-"] * _COLUMNS
    for column, mark in zip(range(middle - 1, middle + 2), "[#]", strict=True):
        if 0 <= column < _COLUMNS:
            track[column] = mark
    lines = ["".join(row).rstrip() for row in rows] + ["".join(track)]
    ending = ", fallen" if fallen else ""
    return "\n".join(
        [*lines, f"x {x:+.2f} m, angle {np.degrees(theta):+.1f} degrees, box {box_of(*state)}{ending}", ""]
    )


def _picture(state: State) -> NDArray[np.uint8]:
    """The cart on its track with the ends of it marked, and the pole at its true length."""
    x, _, theta, _ = state
    ground, height = 150, 180
    picture = blank(height, round(2 * _TRACK * _METRE))
    stroke(picture, np.array([[ground, 0.0], [ground, picture.shape[1] - 1.0]]), GREY, 3)
    for end in (-2.4, 2.4):
        column = (end + _TRACK) * _METRE
        stroke(picture, np.array([[ground - 12.0, column], [ground + 12.0, column]]), GREY, 3)
    column = (x + _TRACK) * _METRE
    left, right = max(round(column) - 22, 0), max(round(column) + 22, 0)
    picture[ground - 18 : ground - 4, left:right] = INK
    hinge = np.array([ground - 18.0, column])
    tip = hinge + _METRE * np.array([-np.cos(theta), np.sin(theta)])
    stroke(picture, np.stack([hinge, tip]), BLUE, 6)
    disk(picture, (float(hinge[0]), float(hinge[1])), 5.0, INK)
    return picture

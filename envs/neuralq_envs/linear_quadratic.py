"""A mass on a line that is brought to rest, with quadratic costs: every value and every slope is known in closed form.

The state is position and velocity, s_t = A s_tm1 + B u with A = [[1, .2], [0, .9]] and B = (0, .3), and the reward is
−s_tm1ᵀ C s_tm1 with C = diag(1, .1). Three actions: push left (u = −1), follow the law u = −K s with K = (.8, 1), push
right (u = 1). Whoever pushes once and follows the law from then on earns

    Q(s, a) = −sᵀ C s − γ s₁ᵀ P s₁,    ∂Q/∂s = −2 C s − 2 γ A_aᵀ P s₁

where s₁ is the next state, A_a how it depends on s, and P solves P = C + γ Lᵀ P L with L = A − B K.

Made for slopes that are explained (Mitchell & Thrun 1993), which can be checked here.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import scipy.linalg
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice, check_discount, check_positive
from neuralq_envs.canvas import BLUE, GREY, INK, blank, disk, stroke

__all__ = [
    "GAMMA",
    "LAW",
    "PUSH",
    "LinearQuadraticEnv",
    "action_value_slopes",
    "action_values",
    "make",
    "rewards",
    "successors",
]

PUSH_LEFT, LAW, PUSH = range(3)
GAMMA = 0.9
_A = np.array([[1.0, 0.2], [0.0, 0.9]])
_B = np.array([0.0, 0.3])
_C = np.diag([1.0, 0.1])
_K = np.array([0.8, 1.0])
_END = 100.0  # of the line
# The law turns a velocity v at position x into .6 v - .24 x, a push into .9 v at most .3 more: 60 is never passed.
_FASTEST = 60.0
_HIGHEST = np.array([_END + 0.2 * _FASTEST, _FASTEST])
_REACH = 3.0  # of the picture, in units of the state
_SIZE = 240  # pixels
_COLUMNS = 61


def successors(s: ArrayLike, a: int) -> NDArray[np.float64]:
    """The states that follow, ``[*n, 2]`` to ``[*n, 2]``.

    Args:
        s: states.
        a: 0 push left, 1 follow the law, 2 push right.

    Raises:
        ValueError: another action.

    Example:
        >>> successors([1.0, 0.0], PUSH).tolist(), successors([1.0, 0.0], LAW).tolist()
        ([1.0, 0.3], [1.0, -0.24])
    """
    matrix, push = _dynamics(a)
    return np.asarray(np.asarray(s, np.float64) @ matrix.T + push)


def rewards(s: ArrayLike) -> NDArray[np.float64]:
    """What leaving these states earns, whatever is done, ``[*n, 2]`` to ``[*n]``.

    Example:
        >>> rewards([1.0, 2.0]).tolist()
        -1.4
    """
    states = np.asarray(s, np.float64)
    return np.asarray(-np.einsum("...i,ij,...j->...", states, _C, states))


def action_values(s: ArrayLike, a: int, gamma: float = GAMMA) -> NDArray[np.float64]:
    """Q(s, a) of taking ``a`` once and following the law from then on, ``[*n, 2]`` to ``[*n]``.

    Raises:
        ValueError: another action, or a γ outside [0, 1].

    Example:
        One step by hand with γ = 0: −(1² + .1 · 2²).

        >>> action_values([1.0, 2.0], PUSH, gamma=0.0).tolist()
        -1.4
    """
    after = successors(s, a)
    later = np.einsum("...i,ij,...j->...", after, _cost_to_go(gamma), after)
    return np.asarray(rewards(s) - gamma * later)


def action_value_slopes(s: ArrayLike, a: int, gamma: float = GAMMA) -> NDArray[np.float64]:
    """∂Q/∂s of `action_values`, ``[*n, 2]`` to ``[*n, 2]``.

    Raises:
        ValueError: another action, or a γ outside [0, 1].

    Example:
        >>> action_value_slopes([1.0, 2.0], PUSH, gamma=0.0).tolist()
        [-2.0, -0.4]
    """
    matrix, _ = _dynamics(a)
    return np.asarray(-2 * np.asarray(s, np.float64) @ _C - 2 * gamma * successors(s, a) @ _cost_to_go(gamma) @ matrix)


class LinearQuadraticEnv(gymnasium.Env[Any, Any]):
    """The mass on its line; observations are position and velocity. Only the ends of the line, at ±100, truncate.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.
        start_spread: both numbers of the first state are uniform between − and + this.

    Raises:
        ValueError: another render mode, or a spread that is not above 0.

    Example:
        >>> env = LinearQuadraticEnv()
        >>> env.reset(options={"state": (1.0, 2.0)})[0].tolist(), env.step(LAW)[1]
        ([1.0, 2.0], -1.4)
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, start_spread: float = 1.0) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        check_positive("start_spread", start_spread)
        self.render_mode = render_mode
        self.observation_space = Box(-_HIGHEST, _HIGHEST, dtype=np.float64)
        self.action_space = Discrete(3)
        self._spread = float(start_spread)
        self._state: NDArray[np.float64] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Starts anywhere within the spread, or in ``options["state"]``.

        Raises:
            ValueError: a state that is not a position on the line and a velocity within ±60.
        """
        super().reset(seed=seed)
        if options is not None and "state" in options:
            given = np.array(options["state"], np.float64)
            if given.shape != (2,) or not (np.abs(given) <= (_END, _FASTEST)).all():
                raise ValueError(
                    f"options['state'] must be a position within ±{_END:g} and a velocity within ±{_FASTEST:g}, "
                    f"got {options['state']!r}"
                )
            self._state = given
        else:
            self._state = self.np_random.uniform(-self._spread, self._spread, 2)
        return self._state.copy(), {}

    def step(self, action: int) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Pushes left (0), follows the law (1) or pushes right (2).

        Raises:
            ResetNeeded: before the first reset, or beyond the end of the line.
            ValueError: another action.
        """
        if self._state is None or abs(self._state[0]) > _END:
            raise ResetNeeded("the mass is off its line, or has not been set up yet: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0 (push left), 1 (follow the law) or 2 (push right), got {action!r}")
        reward = float(rewards(self._state))
        self._state = successors(self._state, int(action))
        return self._state.copy(), reward, False, bool(abs(self._state[0]) > _END), {}

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode or before a reset."""
        if self._state is None or self.render_mode is None:
            return None
        return _text(self._state) if self.render_mode == "ansi" else _picture(self._state)


def make(render_mode: str | None = None, **given: Any) -> LinearQuadraticEnv:
    """What ``gymnasium.make("neuralq/LinearQuadratic-v0")`` calls.

    Example:
        >>> make(start_spread=0.5).reset(seed=0)[0].shape
        (2,)
    """
    return LinearQuadraticEnv(render_mode, **given)


def _dynamics(a: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What the next state is of the present one, and what is added."""
    check_choice("a", a, (PUSH_LEFT, LAW, PUSH))
    return (_A - np.outer(_B, _K), 0 * _B) if a == LAW else (_A, (a - 1) * _B)


def _cost_to_go(gamma: float) -> NDArray[np.float64]:
    """P."""
    check_discount("gamma", gamma)
    law, _ = _dynamics(LAW)
    return np.asarray(scipy.linalg.solve_discrete_lyapunov(np.sqrt(gamma) * law.T, _C))


def _text(state: NDArray[np.float64]) -> str:
    """The line with its middle and the mass, and the numbers below."""
    position, velocity = state.tolist()
    line = ["-"] * _COLUMNS
    line[_COLUMNS // 2] = "+"
    column = _COLUMNS // 2 + round(position / _REACH * (_COLUMNS // 2))
    sign = "o" if abs(velocity) < 0.05 else ">" if velocity > 0 else "<"
    line[min(max(column, 0), _COLUMNS - 1)] = sign
    return "".join(line) + f"\nposition {position:+.2f}, velocity {velocity:+.2f}\n"


def _picture(state: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Position across, velocity upwards, and where the law would lead in twenty steps."""
    picture = blank(_SIZE, _SIZE)
    middle = _SIZE / 2
    stroke(picture, np.array([[middle, 0.0], [middle, _SIZE - 1.0]]), GREY)
    stroke(picture, np.array([[0.0, middle], [_SIZE - 1.0, middle]]), GREY)
    path = [state]
    for _ in range(20):
        path.append(successors(path[-1], LAW))
    points = middle + np.clip(np.array(path)[:, ::-1] * [-1.0, 1.0] / _REACH, -1, 1) * (middle - 8)
    stroke(picture, points, INK, 1)
    disk(picture, (float(points[0, 0]), float(points[0, 1])), 6.0, BLUE)
    return picture

"""One step of many Mountain Cars or Acrobots: compiled loops, each operation in Gymnasium's order.

State, step counts and observations are written in place; the arrays of a step are the caller's. Each step looks at
every environment before it moves any, so a refused step has changed nothing. It answers with the first environment that
cannot be stepped, or -1: ``environment`` where its episode is over, ``num_envs + environment`` where its action is not
one of 0, 1, 2.

Mountain Car (Moore 1990; Sutton & Barto 2018, example 10.1): v ← v + 0.001 (a − 1) − 0.0025 cos 3x, x ← x + v, both
clipped, and the left wall stops the car. Acrobot (Sutton 1996; Sutton & Barto 1998, section 11.3):
one fourth-order Runge-Kutta step of 0.2 s, then angles wrapped to [−π, π] and velocities clipped.

Rounding is part of the claim: arms that start 1e-16 apart part company within an episode. Sines, cosines and powers
are the C library's, as they are in Gymnasium; nothing is reordered or fused.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel

__all__ = ["acrobot_step", "mountain_car_step", "refused_env"]

_PI = math.pi
_MAX_VELOCITY_1 = 4 * math.pi
_MAX_VELOCITY_2 = 9 * math.pi


@lean_kernel
def refused_env(actions: NDArray[np.int64], over: NDArray[np.bool_]) -> int:
    """The first environment that is over (its number), or with a wrong action (``N +`` its number), else -1.

    Args:
        actions: ``[N]``.
        over: whether the episode has ended, ``[N]``.

    Example:
        >>> refused_env(np.array([0, 3]), np.array([False, False]))
        3
    """
    for i in range(len(over)):
        if over[i]:
            return i
    for i in range(len(actions)):
        if actions[i] < 0 or actions[i] > 2:
            return len(over) + i
    return -1


@lean_kernel
def mountain_car_step(
    state: NDArray[np.float64],
    steps: NDArray[np.int64],
    over: NDArray[np.bool_],
    observation: NDArray[np.float32],
    actions: NDArray[np.int64],
    limit: int,
    goal_velocity: float,
    reward: NDArray[np.float64],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
) -> int:
    """Steps every car: reward −1, terminated once x ≥ 0.5 with v ≥ ``goal_velocity``.

    Args:
        state: position and velocity, ``[N, 2]``; overwritten.
        steps: of the running episodes, ``[N]``; overwritten.
        over: whether an episode has ended, ``[N]``; overwritten.
        observation: the state rounded to float32, ``[N, 2]``; overwritten.
        actions: 0 pushes left, 1 does not push, 2 pushes right, ``[N]``.
        limit: steps after which an episode is truncated.
        goal_velocity: least velocity at the goal.
        reward: written, ``[N]``.
        terminated: written, ``[N]``.
        truncated: written, ``[N]``.

    Example:
        >>> state, observation, two = np.array([[0.48, 0.05]]), np.zeros((1, 2), np.float32), np.zeros((2, 1), bool)
        >>> over, reward = np.zeros(1, bool), np.zeros(1)
        >>> mountain_car_step(
        ...     state, np.zeros(1, np.int64), over, observation, np.array([1]), 200, 0.0, reward, two[0], two[1])
        -1
        >>> round(float(state[0, 0]), 6), two.tolist()  # 0.48 + 0.05 - 0.0025 cos(1.44)
        (0.529674, [[True], [False]])
    """
    refused = refused_env(actions, over)
    if refused >= 0:
        return refused
    for i in range(len(over)):
        position, velocity = state[i, 0], state[i, 1]
        velocity += (actions[i] - 1) * 0.001 + math.cos(3 * position) * (-0.0025)
        velocity = min(max(velocity, -0.07), 0.07)
        position += velocity
        position = min(max(position, -1.2), 0.6)
        if position == -1.2 and velocity < 0:
            velocity = 0.0
        state[i, 0], state[i, 1] = position, velocity
        observation[i, 0], observation[i, 1] = position, velocity
        steps[i] += 1
        reward[i] = -1.0
        terminated[i] = position >= 0.5 and velocity >= goal_velocity
        truncated[i] = steps[i] >= limit
        over[i] = terminated[i] or truncated[i]
    return -1


@lean_kernel
def _accelerations(
    theta1: float, theta2: float, dtheta1: float, dtheta2: float, torque: float, two: float
) -> tuple[float, float]:
    """Angular accelerations of both links (m = l = I = 1, centres at 0.5, g = 9.8), the equations of the book."""
    cos2, sin2 = math.cos(theta2), math.sin(theta2)
    d1 = 0.25 + (1.0 + 0.25 + cos2) + 1.0 + 1.0
    d2 = (0.25 + 0.5 * cos2) + 1.0
    phi2 = 0.5 * 9.8 * math.cos(theta1 + theta2 - _PI / 2.0)
    phi1 = (
        -0.5 * math.pow(dtheta2, two) * sin2 - dtheta2 * dtheta1 * sin2 + 1.5 * 9.8 * math.cos(theta1 - _PI / 2) + phi2
    )
    ddtheta2 = (torque + d2 / d1 * phi1 - 0.5 * math.pow(dtheta1, two) * sin2 - phi2) / (
        0.25 + 1.0 - math.pow(d2, two) / d1
    )
    return -(d2 * ddtheta2 + phi1) / d1, ddtheta2


@lean_kernel
def _wrapped(angle: float) -> float:
    """The same angle in [−π, π]."""
    while angle > _PI:
        angle = angle - 2 * _PI
    while angle < -_PI:
        angle = angle + 2 * _PI
    return angle


@lean_kernel
def acrobot_step(
    state: NDArray[np.float64],
    steps: NDArray[np.int64],
    over: NDArray[np.bool_],
    observation: NDArray[np.float32],
    actions: NDArray[np.int64],
    limit: int,
    two: float,
    reward: NDArray[np.float64],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
) -> int:
    """Steps every arm: reward −1, or 0 with termination once the tip is above the bar, −cos θ₁ − cos(θ₁ + θ₂) > 1.

    Args:
        state: both angles and both angular velocities, ``[N, 4]``; overwritten.
        steps: of the running episodes, ``[N]``; overwritten.
        over: whether an episode has ended, ``[N]``; overwritten.
        observation: cosine and sine of θ₁ and of θ₂, and the velocities, ``[N, 6]``; overwritten.
        actions: torque + 1, ``[N]``.
        limit: steps after which an episode is truncated.
        two: the exponent 2.0, which must not be known when this is compiled: x² would become x · x, and the C
            library's power, which Gymnasium takes, differs from that in the last bit once in a thousand.
        reward: written, ``[N]``.
        terminated: written, ``[N]``.
        truncated: written, ``[N]``.

    Example:
        >>> state, observation, flags = np.zeros((1, 4)), np.zeros((1, 6), np.float32), np.zeros((2, 1), bool)
        >>> over, reward = np.zeros(1, bool), np.zeros(1)
        >>> acrobot_step(
        ...     state, np.zeros(1, np.int64), over, observation, np.array([1]), 500, 2.0, reward, flags[0], flags[1])
        -1
        >>> bool(np.abs(state).max() < 1e-12), reward.tolist()  # hanging down without torque is an equilibrium
        (True, [-1.0])
    """
    refused = refused_env(actions, over)
    if refused >= 0:
        return refused
    h, half = 0.2, 0.1
    for i in range(len(over)):
        torque = actions[i] - 1.0
        x1, x2, v1, v2 = state[i, 0], state[i, 1], state[i, 2], state[i, 3]
        a1, a2 = _accelerations(x1, x2, v1, v2, torque, two)
        u1, u2 = v1 + half * a1, v2 + half * a2
        b1, b2 = _accelerations(x1 + half * v1, x2 + half * v2, u1, u2, torque, two)
        w1, w2 = v1 + half * b1, v2 + half * b2
        c1, c2 = _accelerations(x1 + half * u1, x2 + half * u2, w1, w2, torque, two)
        z1, z2 = v1 + h * c1, v2 + h * c2
        d1, d2 = _accelerations(x1 + h * w1, x2 + h * w2, z1, z2, torque, two)
        theta1 = _wrapped(x1 + h / 6.0 * (v1 + 2 * u1 + 2 * w1 + z1))
        theta2 = _wrapped(x2 + h / 6.0 * (v2 + 2 * u2 + 2 * w2 + z2))
        dtheta1 = min(max(v1 + h / 6.0 * (a1 + 2 * b1 + 2 * c1 + d1), -_MAX_VELOCITY_1), _MAX_VELOCITY_1)
        dtheta2 = min(max(v2 + h / 6.0 * (a2 + 2 * b2 + 2 * c2 + d2), -_MAX_VELOCITY_2), _MAX_VELOCITY_2)
        state[i, 0], state[i, 1], state[i, 2], state[i, 3] = theta1, theta2, dtheta1, dtheta2
        cos1 = math.cos(theta1)
        observation[i, 0], observation[i, 1] = cos1, math.sin(theta1)
        observation[i, 2], observation[i, 3] = math.cos(theta2), math.sin(theta2)
        observation[i, 4], observation[i, 5] = dtheta1, dtheta2
        steps[i] += 1
        terminated[i] = -cos1 - math.cos(theta2 + theta1) > 1.0
        reward[i] = 0.0 if terminated[i] else -1.0
        truncated[i] = steps[i] >= limit
        over[i] = terminated[i] or truncated[i]
    return -1

"""The pole on a cart: one step of its equations, when it has fallen, and which of the 162 boxes it is in.

With friction μ_c of the cart on its track and μ_p of the pole in its hinge, F the push and m, M, l the masses of the
pole and of both and half the pole's length (Barto, Sutton & Anderson 1983, appendix):

* θ̈ = (g sin θ − cos θ · f − μ_p θ̇ / (m l)) / (l (4/3 − m cos² θ / M)), f = (F + m l θ̇² sin θ − μ_c sgn ẋ) / M
* ẍ = f − m l θ̈ cos θ / M

in Euler steps of 0.02 s: positions move by the old velocities. Without friction every number is Gymnasium's CartPole's,
operation for operation.
"""

from __future__ import annotations

import math

from neuralq.jit import lean_kernel

__all__ = ["NUM_BOXES", "box_of", "has_fallen", "pole_step"]

State = tuple[float, float, float, float]
"""x (m), ẋ (m/s), θ (rad, 0 is upright, to the right is positive), θ̇ (rad/s)."""

NUM_BOXES = 162
"""3 of x, times 3 of ẋ, times 6 of θ, times 3 of θ̇."""

_GRAVITY, _POLE, _BOTH, _HALF_LENGTH, _PUSH, _SECONDS = 9.8, 0.1, 1.1, 0.5, 10.0, 0.02
_POLE_LENGTH = _POLE * _HALF_LENGTH
_MOST_X = 2.4
_MOST_ANGLE = 12 * 2 * math.pi / 360
_DEGREE = math.pi / 180


@lean_kernel
def pole_step(
    x: float, x_dot: float, theta: float, theta_dot: float, action: int, cart_friction: float, pole_friction: float
) -> State:
    """The state 0.02 s later, pushed by 10 N to the left (action 0) or to the right (1).

    Example:
        >>> [round(value, 4) for value in pole_step(0.0, 0.0, 0.0, 0.0, 1, 0.0, 0.0)]
        [0.0, 0.1951, 0.0, -0.2927]
    """
    force = _PUSH if action == 1 else -_PUSH
    sine, cosine = math.sin(theta), math.cos(theta)
    rubbing = cart_friction if x_dot > 0.0 else -cart_friction if x_dot < 0.0 else 0.0
    f = (force + _POLE_LENGTH * (theta_dot * theta_dot) * sine - rubbing) / _BOTH
    theta_acceleration = (_GRAVITY * sine - cosine * f - pole_friction * theta_dot / _POLE_LENGTH) / (
        _HALF_LENGTH * (4.0 / 3.0 - _POLE * (cosine * cosine) / _BOTH)
    )
    x_acceleration = f - _POLE_LENGTH * theta_acceleration * cosine / _BOTH
    return (
        x + _SECONDS * x_dot,
        x_dot + _SECONDS * x_acceleration,
        theta + _SECONDS * theta_dot,
        theta_dot + _SECONDS * theta_acceleration,
    )


@lean_kernel
def has_fallen(x: float, theta: float) -> bool:
    """Whether the cart is beyond 2.4 m or the pole beyond 12 degrees, to either side.

    Example:
        >>> has_fallen(-2.4, 0.2), has_fallen(2.41, 0.0), has_fallen(0.0, -0.21)
        (False, True, True)
    """
    return x < -_MOST_X or x > _MOST_X or theta < -_MOST_ANGLE or theta > _MOST_ANGLE


@lean_kernel
def box_of(x: float, x_dot: float, theta: float, theta_dot: float) -> int:
    """The number of the state's box: x + 3 ẋ + 9 θ + 54 θ̇, each by the interval that it is in.

    The bounds are ±0.8 m, ±0.5 m/s, −6°, −1°, 0°, 1°, 6° and ±50°/s; a bound belongs to the interval above it, and
    whatever is beyond the last one, to the outermost.

    Source: Michie & Chambers 1968; Barto, Sutton & Anderson 1983, whose boxes these are.

    Example:
        >>> box_of(0.0, 0.0, 0.0, 0.0), box_of(-2.0, -1.0, -0.2, -1.0), box_of(2.0, 1.0, 0.2, 1.0)
        (85, 0, 161)
    """
    box = 0 if x < -0.8 else 1 if x < 0.8 else 2
    box += 0 if x_dot < -0.5 else 3 if x_dot < 0.5 else 6
    if theta < -6.0 * _DEGREE:
        box += 0
    elif theta < -_DEGREE:
        box += 9
    elif theta < 0.0:
        box += 18
    elif theta < _DEGREE:
        box += 27
    elif theta < 6.0 * _DEGREE:
        box += 36
    else:
        box += 45
    return box + (0 if theta_dot < -50.0 * _DEGREE else 54 if theta_dot < 50.0 * _DEGREE else 108)

"""Three benign problems on which dynamic programming with a smooth regressor can fail (Boyan & Moore 1995).

Continuous gridworld: the unit square, four steps of .05, cost .5 a step, the goal in the north-east corner. The
cost-to-go is a staircase under the plane 20 − 10x − 10y, so a quadratic regressor could hardly have an easier target;
yet value iteration that is refitted at every step may grow without bound, on some grids and not on others.

Puddle world: the same square with two puddles (geometry and penalty of Sutton 1996): capsules of radius .1 around the
segments (.1, .75)–(.45, .75) and (.45, .4)–(.45, .8). A step costs 1, and 400 times the depth of the state it leads
to: the distance to the nearest edge, inside the deeper puddle where they overlap. The goal is x + y ≥ 1.9. Sutton's
Gaussian noise of the steps is left out, so that the problem is deterministic.

Car on the hill: the track of Moore & Atkeson 1995 with the dynamics, the step of .1 s and the bounds of Ernst, Geurts &
Wehenkel 2005 (section 5.1.1 and appendix C):

    h(p) = p² + p  (p < 0),   p / √(1 + 5p²)  (p ≥ 0)
    p̈ = u / (m (1 + h'²)) − g h' / (1 + h'²) − ṗ² h' h'' / (1 + h'²),    u = ±4, m = 1, g = 9.81

The goal is p > 1 with |ṗ| ≤ 3; leaving the track on the left, or going faster than 3, ends the episode too. They reward
success with 1 and failure with −1 under γ = .95. As a cost-to-go it is the time to the top in seconds, and a failure
costs 10, which is our choice: more than any success, which takes a few seconds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_positive
from neuralq.types import Floats
from neuralq_envs.counterexamples.continuous import ContinuousModel, Steps

__all__ = ["car_on_the_hill", "gridworld", "puddle_depth", "puddle_world"]

_STEP = 0.05
_SLACK = 1e-9  # 19 steps of .05 are .95 up to rounding, and must count as the goal
_MOVES = _STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
_COMPASS = ("east", "west", "north", "south")
_PUDDLES = np.array([[[0.10, 0.75], [0.45, 0.75]], [[0.45, 0.40], [0.45, 0.80]]])
_PUDDLE_RADIUS = 0.1
_GRAVITY, _THRUST, _MAX_SPEED = 9.81, 4.0, 3.0
_SECONDS, _NUM_SUBSTEPS = 0.1, 100


def gridworld() -> ContinuousModel:
    """The continuous gridworld has J(x, y) = ½ (⌈(.95 − x)/.05⌉⁺ + ⌈(.95 − y)/.05⌉⁺).

    Source: Boyan & Moore 1995.

    Example:
        >>> gridworld().cost_to_go(np.array([[0.0, 0.0], [0.95, 0.2], [1.0, 1.0]])).tolist()
        [19.0, 7.5, 0.0]
    """
    return ContinuousModel(
        name="gridworld",
        low=np.zeros(2),
        high=np.ones(2),
        action_names=_COMPASS,
        step=_moving(_in_corner, lambda successor: np.full(successor.shape[:-1], 0.5)),
        is_goal=_in_corner,
        cost_to_go=_corner_cost,
        title="Continuous gridworld",
        source="Boyan & Moore 1995",
        known="Fitted value iteration with quadratic features diverges on the 16 × 16 grid and not on 21 × 21.",
    )


def puddle_world() -> ContinuousModel:
    """The puddle world costs 1 a step and 400 times the depth in a puddle on arrival.

    Source: Boyan & Moore 1995; geometry of Sutton 1996, without the noise.

    Example:
        >>> puddle_world().step(np.array([[0.25, 0.75]])).cost.round(6).tolist()  # on the middle line: depth .1
        [[41.0, 41.0, 21.0, 21.0]]
    """
    return ContinuousModel(
        name="puddle-world",
        low=np.zeros(2),
        high=np.ones(2),
        action_names=_COMPASS,
        step=_moving(_beyond_diagonal, lambda successor: 1.0 + 400.0 * puddle_depth(successor)),
        is_goal=_beyond_diagonal,
        title="Puddle world",
        source="Boyan & Moore 1995; Sutton 1996",
        known="The puddles make J kinked, and no quadratic comes near it.",
    )


def puddle_depth(states: Floats) -> Floats:
    """How deep in the puddles a state lies: its distance to the edge, 0 outside, ``[..., 2] -> [...]``.

    Source: Sutton 1996.

    Example:
        >>> puddle_depth(np.array([[0.45, 0.75], [0.0, 0.75], [0.05, 0.75]])).round(6).tolist()
        [0.1, 0.0, 0.05]
    """
    along = _PUDDLES[:, 1] - _PUDDLES[:, 0]
    offset = states[..., None, :] - _PUDDLES[:, 0]
    share = np.clip((offset * along).sum(axis=-1) / (along**2).sum(axis=-1), 0.0, 1.0)
    distance = np.linalg.norm(offset - share[..., None] * along, axis=-1)
    depth: Floats = np.maximum(_PUDDLE_RADIUS - distance, 0.0).max(axis=-1)
    return depth


def car_on_the_hill(failure_cost: float = 10.0) -> ContinuousModel:
    """A car too weak for the slope must back up first; the cost is the time to the top in seconds.

    Args:
        failure_cost: what leaving the track, or going too fast, costs.

    Raises:
        ValueError: a cost that is not above 0.

    Source: Moore & Atkeson 1995; dynamics of Ernst, Geurts & Wehenkel 2005, section 5.1.1.

    Example:
        >>> steps = car_on_the_hill().step(np.array([[-0.5, 0.0], [0.95, 2.0], [-0.95, -2.5]]))
        >>> steps.ended.tolist(), steps.cost.tolist()[2]
        ([[False, False], [True, True], [True, True]], [10.0, 10.0])
    """
    check_positive("failure_cost", failure_cost)

    def step(states: Floats) -> Steps:
        successor = _drive(states)
        p, speed = successor[..., 0], np.abs(successor[..., 1])
        failed = (p < -1) | (speed > _MAX_SPEED)
        return Steps(successor, np.where(failed, failure_cost, _SECONDS), failed | (p > 1))

    return ContinuousModel(
        name="car-on-the-hill",
        low=np.array([-1.0, -_MAX_SPEED]),
        high=np.array([1.0, _MAX_SPEED]),
        action_names=("left", "right"),
        step=step,
        is_goal=lambda states: (states[:, 0] > 1) & (np.abs(states[:, 1]) <= _MAX_SPEED),
        title="Car on the hill",
        source="Moore & Atkeson 1995; Ernst, Geurts & Wehenkel 2005",
        known="J jumps along the curve between states that make it up at once and states that must back up.",
    )


def _moving(is_goal: Callable[[Floats], NDArray[np.bool_]], cost: Callable[[Floats], Floats]) -> Callable[..., Steps]:
    """Steps of fixed length that stop at the walls of the unit square."""

    def step(states: Floats) -> Steps:
        successor = np.clip(states[:, None, :] + _MOVES, 0.0, 1.0)
        ended = is_goal(successor.reshape(-1, 2)).reshape(successor.shape[:-1])
        return Steps(successor, cost(successor), ended)

    return step


def _in_corner(states: Floats) -> NDArray[np.bool_]:
    nearest: Floats = states.min(axis=-1)
    return np.greater_equal(nearest, 0.95 - _SLACK)


def _beyond_diagonal(states: Floats) -> NDArray[np.bool_]:
    total: Floats = states.sum(axis=-1)
    return np.greater_equal(total, 1.9 - _SLACK)


def _corner_cost(states: Floats) -> Floats:
    steps = np.maximum(np.ceil((0.95 - _SLACK - states) / _STEP), 0.0)
    cost: Floats = 0.5 * steps.sum(axis=-1)
    return cost


def _drive(states: Floats) -> Floats:
    """Where both thrusts lead in .1 s, by Euler steps of .001 s as published, ``[n, 2] -> [n, 2, 2]``."""
    p = np.repeat(states[:, :1], 2, axis=1)
    v = np.repeat(states[:, 1:], 2, axis=1)
    thrust = np.array([-_THRUST, _THRUST])
    width = _SECONDS / _NUM_SUBSTEPS
    for _ in range(_NUM_SUBSTEPS):
        root = np.sqrt(1 + 5 * p * p)
        slope = np.where(p < 0, 2 * p + 1, root**-3)
        bend = np.where(p < 0, 2.0, -15 * p * root**-5)
        acceleration = (thrust - _GRAVITY * slope - v * v * slope * bend) / (1 + slope**2)
        p, v = p + width * v, v + width * acceleration
    return np.stack([p, v], axis=-1)

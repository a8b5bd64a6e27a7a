"""The spiral of Tsitsiklis and Van Roy: discrete updates over the closed form, up to its end in finite time."""

from __future__ import annotations

import numpy as np

from neuralq.lab.figures.drawing import EXACT, Drawing, Panel, Series
from neuralq.lab.linear.process import linear_process
from neuralq.types import Floats
from neuralq_envs.counterexamples.spiral import SpiralValue, blow_up_time, spiral, theta_at

__all__ = ["figure_spiral", "spiral_updates"]


def spiral_updates(step_size: float, largest: float = 1e6) -> Floats:
    """θ before each expected TD(0) update on the spiral and after the last, until ‖V‖ passes ``largest``, ``[k + 1]``.

    Source: Tsitsiklis & Van Roy 1997.

    Example:
        >>> len(spiral_updates(1e-4)) - 1
        68
    """
    problem = spiral()
    assert problem.value is not None
    process = linear_process(problem)
    theta, path = np.zeros(1), [0.0]
    while True:
        v = problem.value.values(theta)
        if np.linalg.norm(v) > largest:
            return np.array(path)
        error = process.r + process.gamma * (process.P @ v) - v
        theta = theta + step_size * problem.value.jacobian(theta).T @ (process.D * error)
        path.append(float(theta[0]))


def figure_spiral(step_sizes: tuple[float, ...] = (1e-4, 1e-5)) -> Drawing:
    """With one parameter on-policy TD spirals to infinity at a finite time, as its closed form says.

    Args:
        step_sizes: α of the discrete updates.

    Source: Tsitsiklis & Van Roy 1997.

    Example:
        >>> round(figure_spiral((1e-4,)).known["t*"], 12)
        0.006355595572
    """
    end, curve = blow_up_time(), SpiralValue(0.05)
    t = end * (1 - np.geomspace(1, 1e-6, 160))
    theta = np.array([theta_at(time) for time in t])
    shown = np.linspace(0, 26, 260)
    in_plane = [Series("V(θ), closed form", *_plane(shown, curve), "dashed", EXACT)]
    in_time = [Series("closed form", t / end, theta, "dashed", EXACT)]
    for colour, step_size in enumerate(step_sizes):
        updates = spiral_updates(step_size)
        passed = updates[updates <= 26]
        if colour == 0:
            in_plane.insert(0, Series(f"updates, α = {step_size:g}", *_plane(passed, curve), "points", 0))
        x = step_size / end * np.arange(float(len(updates)))
        thin = slice(None, None, max(1, len(x) // 28))
        in_time.append(Series(f"updates, α = {step_size:g}", x[thin], updates[thin], ("points", "rings")[colour % 2],
                             colour))  # fmt: skip
    return Drawing(
        name="spiral",
        title="One parameter, on-policy: TD spirals to infinity",
        source="Tsitsiklis & Van Roy 1997",
        caption="ε = 0.05, γ = 0.9, three states in a cycle, all true values 0 (the centre). Left: the values of the "
        "three states in the plane where they sum to 0. Right: θ against time αk; in continuous time it is infinite "
        f"at t* = {end:.6g}. Dashed, exact: closed form. Points: expected TD(0) updates. Nothing is sampled.",
        panels=(
            Panel("values", "first coordinate of V", "second coordinate of V", tuple(in_plane), same_units=True,
                  x_limits=(-620, 540), y_limits=(-560, 460), legend="lower left"),
            Panel("the parameter", "time / t*", "θ", tuple(in_time), verticals=((1.0, "t*"),), legend="upper left",
                  x_limits=(0, 1.25), y_limits=(0, 150)),
        ),
        height=3.6,
        known={"t*": end},
    )  # fmt: skip


def _plane(theta: Floats, curve: SpiralValue) -> tuple[Floats, Floats]:
    """V(θ) in orthonormal coordinates of the plane in which values sum to 0."""
    v = np.array([curve.values(np.array([one])) for one in theta])
    return v @ np.array([2.0, -1, -1]) / np.sqrt(6), v @ np.array([0.0, 1, -1]) / np.sqrt(2)

"""Fitted value iteration on the continuous grid world of Boyan and Moore, with four regressors."""

from __future__ import annotations

import numpy as np

from neuralq.lab.figures.drawing import EXACT, Drawing, Panel, Series
from neuralq.lab.fitted.diagnosis import diagnose_fitted
from neuralq.lab.fitted.iteration import fitted_iteration
from neuralq.lab.fitted.regressors import LeastSquares, LocallyWeighted, NearestNeighbours, Regressor
from neuralq_envs.counterexamples.boyan_moore import gridworld
from neuralq_envs.counterexamples.continuous import grid_support

__all__ = ["figure_fitted"]

_CASES: tuple[tuple[str, Regressor, float], ...] = (
    ("quadratic, γ = 1", LeastSquares(), 1.0),
    ("quadratic, γ = 0.99", LeastSquares(), 0.99),
    ("nearest neighbour, γ = 1", NearestNeighbours(), 1.0),
    ("local lines (LWR), γ = 1", LocallyWeighted(0.1), 1.0),
)


def figure_fitted(num_per_side: int = 16, num_iterations: int = 500) -> Drawing:
    """Fitted value iteration on the continuous grid world: a good basis diverges, averages do not.

    Args:
        num_per_side: of the grid of support points.
        num_iterations: sweeps.

    Source: Boyan & Moore 1995; Gordon 1995.

    Example:
        >>> drawing = figure_fitted(num_iterations=12)
        >>> round(float(drawing.panels[0].curve("quadratic, γ = 1").y[-1]), 4)
        6.0722
    """
    model = gridworld()
    support = grid_support(model, num_per_side)
    curves, sizes = _curves(num_per_side, num_iterations)
    growth = diagnose_fitted(model, support, LeastSquares()).ray_growth
    top = curves[0]
    if growth is not None and len(top.x) > 60:
        tail = top.x[-60:]
        curves.append(
            Series(f"predicted growth {growth:.5f}", tail, top.y[-60] * growth ** (tail - tail[0]) * 3, "dashed", EXACT)
        )
    assert model.cost_to_go is not None
    exact = float(model.cost_to_go(support).max())
    return Drawing(
        name="fitted",
        title="Fitted value iteration: a good basis diverges",
        source="Boyan & Moore 1995; Gordon 1995",
        caption=f"Continuous grid world, support {num_per_side} × {num_per_side}, start at 0. Solid: largest |V| over "
        "the support after each sweep. Dotted: the largest exact cost-to-go. Dashed, moved up for the eye: the growth "
        "that the eigenvalue of the fitted backup predicts at the final greedy policy. The exact cost lies near a "
        "plane, which the quadratic basis contains; at γ = 0.99 it stays bounded without coming to rest. "
        "Nothing is sampled.",
        panels=(
            Panel(
                "",
                "sweeps",
                "max |V|",
                tuple(curves),
                y_scale="log",
                y_limits=(0.3, 3e9),
                horizontals=((exact, "exact cost-to-go"),),
                legend="upper left",
            ),
        ),
        height=3.8,
        known={"growth": float("nan") if growth is None else growth, "exact": exact, **sizes},
    )


def _curves(num_per_side: int, num_iterations: int) -> tuple[list[Series], dict[str, float]]:
    """Largest |V| after every sweep with each regressor, and after the last."""
    model = gridworld()
    support = grid_support(model, num_per_side)
    curves: list[Series] = []
    sizes: dict[str, float] = {}
    for colour, (label, regressor, gamma) in enumerate(_CASES):
        # A tolerance that only a sweep without any change meets.
        ran = fitted_iteration(model, support, regressor, num_iterations=num_iterations, gamma=gamma, tolerance=1e-300)
        largest = np.pad(ran.max_abs, (0, num_iterations - ran.iterations), mode="edge")  # where nothing moves any more
        x = np.arange(len(largest), dtype=np.float64)
        if colour == 2:  # nearest neighbours and lines lie on each other
            curves.append(Series(label, x[5::20], largest[5::20], "rings", colour))
        else:
            curves.append(Series(label, x, largest, colour=colour))
        sizes[label] = float(ran.max_abs[-1])
    return curves, sizes

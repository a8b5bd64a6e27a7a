"""Baird's hall: how many sweeps TD and the residual gradient need, counted and predicted.

At γ = 1 the residual gradient multiplies the error by I − αG, G = (I − U)ᵀ(I − U)/n, with

    λ_k = (2 − 2 cos ω_k)/n,    u_k(i) = cos((i − ½) ω_k),    ω_k = (2k − 1)π/(2n + 1),

and α = 2/(λ_1 + λ_n) shrinks the slowest direction by (κ − 1)/(κ + 1), κ = λ_n/λ_1. The error starts at 1 in every
state, so after many sweeps k it is c u_1(1) ((κ − 1)/(κ + 1))ᵏ, c the share of u_1 in it.
"""

from __future__ import annotations

import numpy as np

from neuralq.checks import check_choice, check_whole
from neuralq.lab.figures.drawing import EXACT, Drawing, Panel, Series
from neuralq.lab.linear.process import linear_process
from neuralq.lab.methods import method as method_named
from neuralq.lab.methods.record import Piece
from neuralq_envs.counterexamples.hall import hall

__all__ = ["figure_hall", "modal_sweeps", "predicted_sweeps", "sweeps_until"]

_SIZES = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48)


def sweeps_until(num_states: int, gamma: float, method: str, tolerance: float = 0.01) -> int:
    """Expected sweeps of a method on the hall until no value is off by more than the tolerance, counted by sweeping.

    Args:
        num_states: n.
        gamma: γ.
        method: ``"td"`` with α = n, or ``"residual"`` with the best constant step size 2/(λ_min + λ_max).
        tolerance: largest error that is left.

    Raises:
        ValueError: another method.

    Example:
        >>> sweeps_until(12, 1.0, "td"), sweeps_until(12, 1.0, "residual")
        (12, 605)
    """
    problem = hall(num_states, gamma)
    exact = linear_process(problem).v
    M, c = _hall_update(num_states, gamma, method)
    w, count = np.zeros(num_states), 0
    while np.abs(w - exact).max() > tolerance:
        w, count = M @ w + c, count + 1
    return count


def _hall_update(num_states: int, gamma: float, method: str) -> Piece:
    check_choice("method", method, ("td", "residual"))
    problem, chosen = hall(num_states, gamma), method_named(method)
    assert chosen.expected is not None
    expected = chosen.expected(linear_process(problem), chosen.checked({}))
    assert expected.generator is not None
    if method == "td":
        return expected.at(np.zeros(num_states), problem.step_size)
    eigenvalues = np.linalg.eigvalsh(expected.generator[0])
    return expected.at(np.zeros(num_states), float(2 / (eigenvalues[0] + eigenvalues[-1])))


def predicted_sweeps(num_states: int, tolerance: float = 0.01) -> float:
    """Sweeps that the residual gradient needs in a hall at γ = 1, from its slowest direction in closed form.

    Raises:
        ValueError: fewer than one state.

    Example:
        >>> round(predicted_sweeps(12), 1)  # 605 are counted
        604.6
    """
    check_whole("num_states", num_states)
    n = num_states
    omega = np.pi / (2 * n + 1)
    u = np.cos((np.arange(1, n + 1) - 0.5) * omega)
    slow, fast = (2 - 2 * np.cos((2 * k - 1) * omega) for k in (1, n))
    share = u.sum() / (u @ u)
    return float(np.log(share * u[0] / tolerance) / np.log((fast + slow) / (fast - slow)))


def modal_sweeps(num_states: int, gamma: float, tolerance: float = 0.01) -> float:
    """Sweeps that the residual gradient needs on the hall, from the sum of its eigenmodes, without sweeping.

    Raises:
        ValueError: fewer than one state, or γ outside [0, 1].

    Example:
        >>> modal_sweeps(12, 1.0)
        605.0
    """
    M, _ = _hall_update(num_states, gamma, "residual")
    factors, modes = np.linalg.eigh(M)
    share = modes.T @ linear_process(hall(num_states, gamma)).v

    def error(k: int) -> float:
        return float(np.abs(modes @ (factors**k * share)).max())

    low, high = 0, 1
    while error(high) > tolerance:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if error(middle) > tolerance else (low, middle)
    return float(high)


def figure_hall(sizes: tuple[int, ...] = _SIZES) -> Drawing:
    """On the hall TD needs n sweeps and the residual gradient a number that grows as n².

    Args:
        sizes: n.

    Source: Baird 1995.

    Example:
        >>> figure_hall((6, 12)).panels[0].curve("residual gradient", "points").y.tolist()[-1]
        605.0
    """
    n = np.array(sizes, dtype=np.float64)
    counted = {
        (gamma, name): np.array([sweeps_until(size, gamma, name) for size in sizes], dtype=np.float64)
        for gamma in (1.0, 0.9)
        for name in ("td", "residual")
    }
    predicted = np.array([predicted_sweeps(size) for size in sizes])

    def points(gamma: float) -> tuple[Series, ...]:
        return (
            Series("direct (TD)", n, counted[gamma, "td"], "points", 0),
            Series("residual gradient", n, counted[gamma, "residual"], "points", 1),
        )

    direct = Series("n", n, n, "dashed", 0)
    slowest = Series("slowest mode, closed form", n, predicted, "dashed", 1)
    guide = Series("slope 2", n, predicted[-1] * (n / n[-1]) ** 2, "dotted", EXACT)
    soon = np.minimum(n, np.ceil(np.log(0.01) / np.log(0.9)))  # farther states are worth less than the tolerance
    direct_soon = Series("n, or 44", n, soon, "dashed", 0)
    spectral = Series("all modes", n, np.array([modal_sweeps(size, 0.9) for size in sizes]), "dashed", 1)
    limits = (0.7 * n.min(), 2.0 * predicted.max())
    return Drawing(
        name="hall",
        title="The residual gradient is slow: n² sweeps where TD needs n",
        source="Baird 1995",
        caption="Sweeps until every value is within 0.01 of the exact one, a table, counted by sweeping (points). TD "
        "uses α = n, the residual gradient its best constant step size 2/(λmin + λmax). Dashed, exact: n for TD, or 44 "
        "where γ⁴⁴ < 0.01 comes first; for the residual gradient at γ = 1 what the least eigenvalue, "
        "2 - 2cos(π/(2n+1)) over n, predicts, at γ = 0.9 the sum of all eigenmodes. Nothing is sampled.",
        panels=(
            Panel("γ = 1", "number of states n", "sweeps", (*points(1.0), direct, slowest, guide), "log", "log",
                  y_limits=limits, legend="upper left"),
            Panel("γ = 0.9", "number of states n", "", (*points(0.9), direct_soon, spectral), "log", "log",
                  y_limits=limits, legend="upper left"),
        ),
    )  # fmt: skip

"""Baird's star once more: five representations of it, and how much λ or φ cures it.

With P² = P on the star, TD(λ) is TD(0) with the discount γ(1 − λ)/(1 − γλ), so its threshold in γ gives one in λ. The
residual update has G = Xᵀ(I − φγP)ᵀ D (I − γP)X; on the two symmetric modes its determinant is positive and its trace
is linear in φ. With n upper states and g = (n + 9)/(2n + 5):

    λ* = (γ − g) / (γ (1 − g)),        φ* = ((2n + 5)γ − (n + 9)) / (γ (5γn − 2n − 5(1 − γ))).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from neuralq.checks import check_discount
from neuralq.lab.figures.drawing import EXACT, Drawing, Panel, Series
from neuralq.lab.trial import run
from neuralq.lab.verdicts.critical import scan
from neuralq.types import Floats
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.baird import critical_gamma

__all__ = [
    "figure_critical_curves",
    "figure_representations",
    "star_critical_lambda",
    "star_critical_phi",
]


def star_critical_lambda(gamma: float, num_upper: int = 6) -> float:
    """Expected TD(λ) on the star converges iff λ > λ* = (γ − g)/(γ(1 − g)); 0 where every λ does.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> round(star_critical_lambda(0.99), 12) == round(61 / 66, 12)
        True
    """
    check_discount("gamma", gamma)
    g = critical_gamma(num_upper)
    return (gamma - g) / (gamma * (1 - g)) if gamma > g else 0.0


def star_critical_phi(gamma: float, num_upper: int = 6) -> float:
    """Expected residual(φ) on the star converges iff φ > φ*; 0 where every φ does.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> round(star_critical_phi(0.99), 8)
        0.10473002
    """
    check_discount("gamma", gamma)
    n = num_upper
    if gamma <= critical_gamma(n):
        return 0.0
    return ((2 * n + 5) * gamma - (n + 9)) / (gamma * (5 * gamma * n - 2 * n - 5 * (1 - gamma)))


def figure_critical_curves(num_upper: int = 6, num_gammas: int = 9, num_steps: int = 200_000) -> Drawing:
    """How much λ, or φ, the star needs at each γ: closed form, scan and training agree.

    Args:
        num_upper: n, at least 5.
        num_gammas: where the boundary is scanned, and expected updates are run on both sides of it.
        num_steps: of these runs.

    Source: Baird 1995; the closed forms are derived here.

    Example:
        >>> drawing = figure_critical_curves(num_gammas=2, num_steps=1000)
        >>> round(drawing.known["λ* at γ = 0.99"], 6), round(drawing.known["φ* at γ = 0.99"], 6)
        (0.924242, 0.10473)
    """
    begin = critical_gamma(num_upper)
    fine = np.linspace(begin, 0.999, 120)
    coarse = np.linspace(begin + 0.012, 0.99, num_gammas)
    parts: list[tuple[str, str, str, Callable[[float, int], float]]] = [
        ("TD(λ)", "td", "lambda_", star_critical_lambda),
        ("residual(φ)", "residual", "phi", star_critical_phi),
    ]
    panels = []
    for title, method, option, exact in parts:
        symbol = {"lambda_": "λ", "phi": "φ"}[option]
        found = np.array([scan(star(num_upper, g), option, method).boundaries[0] for g in coarse])
        gap = 0.1 * found.max()
        trained = [_trained(num_upper, coarse, found + side * gap, method, option, num_steps) for side in (-1, 1)]
        (fell_at, fell), (grew_at, grew) = (np.concatenate([side[kind] for side in trained], axis=1) for kind in (0, 1))
        panels.append(
            Panel(title, "γ", symbol, (
                Series("run converges", fell_at, fell, "rings", 0),
                Series("run diverges", grew_at, grew, "points", 1),
                Series("scan", coarse, found, "points", 2),
                Series(f"{symbol}*(γ), closed form", fine, np.array([exact(g, num_upper) for g in fine]), "dashed",
                      EXACT),
            ), legend="upper left", y_limits=(-0.09 * found.max(), 1.3 * found.max())),
        )  # fmt: skip
    return Drawing(
        name="critical-curves",
        title="How much λ, or φ, the star needs",
        source="Baird 1995 (the star); closed forms derived here",
        caption=f"Expected updates on the star with n = {num_upper}; below γ = (n + 9)/(2n + 5) = {begin:.4f} nothing "
        "is needed. Dashed, exact: closed form. Triangles: boundary by scanning eigenvalues. Open circles (errors "
        f"fell) and squares (errors grew): {num_steps:,} expected updates at α = 0.01 a little above and below. "
        "Nothing is sampled.",
        panels=tuple(panels),
        known={"λ* at γ = 0.99": star_critical_lambda(0.99, num_upper),
               "φ* at γ = 0.99": star_critical_phi(0.99, num_upper)},
    )  # fmt: skip


def _trained(
    num_upper: int, gammas: Floats, values: Floats, method: str, option: str, num_steps: int
) -> tuple[Floats, Floats]:
    """(γ, value) of the runs that converged ``[2, k]`` and of those that diverged ``[2, m]``."""
    inside = (values >= 0) & (values <= 1)
    converged: list[tuple[float, float]] = []
    diverged: list[tuple[float, float]] = []
    for g, value in zip(gammas[inside], values[inside], strict=True):
        ran = run(star(num_upper, float(g)), method, num_steps, options={option: float(value)})
        grew = bool(ran.diverged[0]) or ran.rmsve[-1, 0] > ran.rmsve[len(ran.rmsve) // 2, 0]
        (diverged if grew else converged).append((g, value))
    return np.array(converged).reshape(-1, 2).T, np.array(diverged).reshape(-1, 2).T


def figure_representations(num_steps: int = 4000, after: int = 300, seed: int = 0) -> Drawing:
    """One expected update on the star, five representations: what was predicted, what happened, what is exact.

    Args:
        num_steps: sweeps.
        after: sweeps after which values are shown.
        seed: of the networks' initial weights.

    Source: Baird 1995; Sutton & Barto 2018, equation 11.9.

    Example:
        >>> drawing = figure_representations(num_steps=20, after=10)
        >>> [curve.label for curve in drawing.panels[0].curves][:3]
        ['table', 'linear', 'action-input']
    """
    from neuralq.lab.networks.representations import run_representations  # needs PyTorch

    results, early = (run_representations(star(), steps, seed=seed) for steps in (num_steps, after))
    curves, predicted, values = [], [], []
    for colour, (result, short) in enumerate(zip(results, early, strict=True)):
        x = np.arange(len(result.rmsve), dtype=np.float64)
        thin = np.unique(np.linspace(0, len(x) - 1, 90).round().astype(int))
        curves.append(Series(result.representation, x[thin], result.rmsve[thin], colour=colour))
        known = np.log10(result.rmsve[0]) + x * np.log10(result.predicted_growth)
        kept = thin[known[thin] < 12][::5]
        label = f"{result.representation}, predicted"
        predicted.append(Series(label, x[kept], 10.0 ** known[kept], "dashed", colour, listed=False))
        states = np.arange(1.0, len(short.values) + 1)
        values.append(Series(short.representation, states, short.values, "points", colour))
    predicted.append(Series("predicted", np.full(1, np.nan), np.full(1, np.nan), "dashed", EXACT))
    exact = results[0].exact_values
    states = np.arange(1.0, len(exact) + 1)
    return Drawing(
        name="star-five",
        title="One update, five representations, one exact answer",
        source="Baird 1995; Sutton & Barto 2018, equation 11.9",
        caption="Expected semi-gradient sweeps on the star, γ = 0.99, α = 0.01. Left: value error (solid) and the "
        "growth predicted before the first sweep (dashed), which holds everywhere for table and linear features and "
        f"only near the initial weights for the networks. Right: values of the seven states after {after} sweeps; "
        "dashed: the exact answer. Nothing is sampled but the networks' initial weights (one hidden layer of 16 "
        "rectified units).",
        panels=(
            Panel("value error", "sweeps", "√VE", (*curves, *predicted), y_scale="log", y_limits=(0.01, 1e12),
                  legend="upper right", legend_columns=2),
            Panel(f"values after {after} sweeps", "state (7 is the lower one)", "V(s)",
                  (*values, Series("exact", states, exact, "dashed", EXACT)), y_scale="symlog", y_limits=(-8, 3e4),
                  legend="upper left", legend_columns=2),
        ),
    )  # fmt: skip

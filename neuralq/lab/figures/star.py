"""Figures 11.2, 11.5 and 11.6 of Sutton & Barto 2018: Baird's star under TD(0), TDC and emphatic TD.

The left panels show what single transitions do along one chain, over many seeds. Each seed is a product of random
matrices, so the mean of its weights and of its squared errors are known exactly (`neuralq.lab.verdicts.moments`): with
m_j and V_j the first and second moment of θ in row j,

    m_j ← Σ_{k: i→j} p_k M_k m_i,            V_j ← Σ_{k: i→j} p_k M_k V_i M_kᵀ.

The right panels average the same sampled update over all transitions, and hold it against powers of the matrix derived
by hand. Solid: run. Dashed: exact.
"""

from __future__ import annotations

import numpy as np

from neuralq.lab.figures.drawing import EXACT, Drawing, Panel, Series
from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import stream
from neuralq.lab.methods import Method
from neuralq.lab.methods import method as method_named
from neuralq.lab.methods.emphatic import expected_emphatic_run
from neuralq.lab.methods.operators import covariance, td
from neuralq.lab.methods.record import Options
from neuralq.lab.trial import run
from neuralq.lab.verdicts.moments import evolve
from neuralq.lab.verdicts.update_maps import update_maps
from neuralq.types import Floats, Indices
from neuralq_envs.counterexamples import Problem, star

__all__ = ["figure_11_2", "figure_11_5", "figure_11_6", "sampled_weights"]

_BAND = (0.1, 0.9)
_WEIGHTS = (("w1 to w6 (mean)", 0), ("w7", 1), ("w8", 2))


def figure_11_2(num_steps: int = 1000, num_seeds: int = 200, seed: int = 0) -> Drawing:
    """Semi-gradient off-policy TD(0) drives the weights of the star to infinity, sampled and expected alike.

    Args:
        num_steps: updates, and sweeps.
        num_seeds: chains.
        seed: of all of them.

    Source: Sutton & Barto 2018, figure 11.2.

    Example:
        >>> right = figure_11_2(num_steps=1000, num_seeds=2).panels[1]
        >>> round(float(right.curve("w8").y[-1]), 6)
        335.001209
    """
    left, right = _sampled_and_expected("td", {}, 0.01, (num_steps, num_seeds, seed), with_errors=False)
    return Drawing(
        name="sb-11-2",
        title="Off-policy TD(0) diverges on Baird's star",
        source="Sutton & Barto 2018, figure 11.2",
        caption=f"α = 0.01, γ = 0.99, from w = (1, 1, 1, 1, 1, 1, 10, 1). Left: single transitions of the behaviour's "
        f"chain, mean (solid) and 10-90% band of {num_seeds} seeds; dashed: the exact mean along that chain. Right: "
        "the sampled update averaged over all 49 transitions (solid); dashed: powers of the derived matrix I - αA.",
        panels=(left, right),
    )


def figure_11_5(num_steps: int = 1000, num_seeds: int = 200, seed: int = 0) -> Drawing:
    """TDC brings the projected Bellman error of the star to 0, while the value error stays almost 2.

    Args:
        num_steps: updates, and sweeps.
        num_seeds: chains.
        seed: of all of them.

    Source: Sutton & Barto 2018, figure 11.5.

    Example:
        >>> right = figure_11_5(num_steps=1000, num_seeds=2).panels[1]
        >>> round(float(right.curve("√VE").y[-1]), 6)
        1.935465
    """
    left, right = _sampled_and_expected(
        "tdc", {"beta_over_alpha": 10.0}, 0.005, (num_steps, num_seeds, seed), with_errors=True
    )
    return Drawing(
        name="sb-11-5",
        title="TDC is stable on the star, and slow",
        source="Sutton & Barto 2018, figure 11.5",
        caption=f"α = 0.005, β = 0.05, γ = 0.99. Left: single transitions of the behaviour's chain, {num_seeds} seeds; "
        "of the weights the mean, of the errors the root of the mean square (solid) and the 10-90% band; dashed: the "
        "same moments, exact. Right: the sampled update averaged over all transitions (solid); dashed: powers of the "
        "derived matrix.",
        panels=(left, right),
    )


def figure_11_6(num_sweeps: int = 1000, num_seeds: int = 200, seed: int = 0) -> Drawing:
    """Expected emphatic TD solves the star, but no sampled run shows it: the follow-on has no variance.

    Args:
        num_sweeps: sweeps, and updates.
        num_seeds: chains.
        seed: of all of them.

    Source: Sutton & Barto 2018, figure 11.6.

    Example:
        >>> left = figure_11_6(num_sweeps=200, num_seeds=2).panels[0]
        >>> round(float(left.curve("√VE").y[100]), 4)
        0.9567
    """
    problem = star()
    process = linear_process(problem)
    alpha, steps = 0.03, np.arange(num_sweeps + 1.0)
    path = expected_emphatic_run(process, problem.initial_weights, alpha, num_sweeps)
    value = np.sqrt((path @ process.X.T) ** 2 @ process.D)  # not through C, whose rounding would show on a log scale
    M, _ = _expected(method_named("etd"), process, {}, alpha)
    stationary = _powers(M, problem.initial_weights, steps.astype(int))
    shown = slice(None, None, max(1, num_sweeps // 250))
    grouped, limit = _grouped(path), _grouped(stationary)
    curves = [Series(label, steps[shown], grouped[shown, i], colour=i) for label, i in _WEIGHTS]
    curves += [
        Series(f"{label}, limit", steps[shown], limit[shown, i], "dotted", colour=i, listed=False)
        for label, i in _WEIGHTS
    ]
    curves.append(Series("√VE", steps, value, colour=3))
    left = Panel("expected sweeps", "sweeps", "weight or error", tuple(curves), legend="upper right", legend_columns=2)
    sampled = run(problem, "etd", num_sweeps, alpha, "markov", num_seeds, seed)
    low, middle, high = sampled.quantiles((0.1, 0.5, 0.9)).T
    x = sampled.steps.astype(np.float64)
    right = Panel(
        "single transitions", "updates", "√VE",
        (Series("median of seeds", x, middle, colour=4, low=low, high=high),
         Series("expected", steps, value, "dashed", colour=EXACT)),
        y_scale="log", y_limits=(1e-3, 3e5), legend="lower right",
    )  # fmt: skip
    return Drawing(
        name="sb-11-6",
        title="Emphatic TD: right on average, unusable in samples",
        source="Sutton & Barto 2018, figure 11.6",
        caption=f"α = 0.03, γ = 0.99. Left: expected sweeps with the exact conditional emphasis, which starts at the "
        f"interest (solid); dotted: with the emphasis it tends to. Both are exact. Right: ETD(0) along the behaviour's "
        f"chain, median and 10-90% band of {num_seeds} seeds, which the expected run (dashed) says nothing about: the "
        "second moment of the follow-on grows by 7γ² = 6.86 per step.",
        panels=(left, right),
    )


def sampled_weights(
    problem: Problem, chosen: Method, options: Options, step_size: float, steps: Indices, num_seeds: int,
    seed: int,
) -> Floats:  # fmt: skip
    """θ of every seed after the given numbers of updates along the behaviour's chain, ``[R, N, size]``.

    Args:
        problem: what is learned.
        chosen: the method.
        options: all its options.
        step_size: α.
        steps: rising, the first 0, ``[R]``.
        num_seeds: N.
        seed: of all of them.

    Raises:
        ValueError: the method has no sampled update.

    Example:
        >>> td_zero = method_named("td")
        >>> sampled_weights(star(), td_zero, td_zero.checked({}), 0.01, np.array([0, 5]), 3, 0).shape
        (2, 3, 8)
    """
    if chosen.learner is None:
        raise ValueError(f"{chosen.title} has no update from single transitions; choose a method that has one")
    process = linear_process(problem)
    learner = chosen.learner(process, np.tile(problem.initial_weights, (num_seeds, 1)), options)
    wanted, path = set(steps.tolist()), [learner.theta.copy()]
    for step, sample in enumerate(stream(process, "markov", num_seeds, np.random.default_rng(seed)), start=1):
        learner.update(sample, step_size)
        if step in wanted:
            path.append(learner.theta.copy())
        if step == steps[-1]:
            break
    return np.array(path)


def _sampled_and_expected(
    name: str, given: Options, alpha: float, sizes: tuple[int, int, int], with_errors: bool
) -> tuple[Panel, Panel]:
    """The two panels of a figure of the book."""
    num_steps, num_seeds, seed = sizes
    problem, chosen = star(), method_named(name)
    process, options = linear_process(problem), chosen.checked(given)
    maps = update_maps(process, chosen, options, alpha)
    theta = np.concatenate([problem.initial_weights, np.zeros(maps.M.shape[1] - process.num_weights)])
    steps = np.unique(np.linspace(0, num_steps, 201).round().astype(np.int64))
    d, x = process.num_weights, steps.astype(np.float64)
    seeds = sampled_weights(problem, chosen, options, alpha, steps, num_seeds, seed)[:, :, :d]
    mean, second = evolve(maps, theta, steps)
    left = _weight_curves(x, _grouped(seeds), _grouped(mean[:, :d]))
    swept = _powers(maps.mean()[0], theta, steps)[:, :d]
    exact = _powers(_expected(chosen, process, options, alpha)[0], theta, steps)[:, :d]
    right = _weight_curves(x, _grouped(swept)[:, None], _grouped(exact))
    if with_errors:
        for colour, (label, Q) in enumerate(_error_forms(process).items(), start=3):
            of_seeds = np.einsum("rni,ij,rnj->rn", seeds, Q, seeds)
            left += _with_exact(label, colour, x, np.sqrt(of_seeds.mean(axis=1)), np.sqrt(of_seeds),
                                np.sqrt(np.einsum("rij,ij->r", second[:, :d, :d], Q)))  # fmt: skip
            ours, known = (np.sqrt(np.einsum("ri,ij,rj->r", w, Q, w)) for w in (swept, exact))
            right += _with_exact(label, colour, x, ours, None, known)
    nowhere = np.full(1, np.nan)
    for curves in (left, right):
        curves.append(Series("exact", nowhere, nowhere, "dashed", colour=EXACT))
    y_limits = (-4.2, 12.8) if with_errors else None
    both = (
        Panel(title, x_label, y_label, tuple(curves), y_limits=y_limits,
              legend="upper right" if with_errors else "upper left", legend_columns=3 if with_errors else 1)
        for title, x_label, y_label, curves in (
            ("single transitions", "updates", "weight" + " or error" * with_errors, left),
            ("expected update", "sweeps", "", right),
        )
    )  # fmt: skip
    first, second_panel = both
    return first, second_panel


def _weight_curves(x: Floats, seeds: Floats, exact: Floats) -> list[Series]:
    """Mean and band of the seeds ``[R, N, 3]`` and the exact mean ``[R, 3]``."""
    curves = []
    for label, i in _WEIGHTS:
        band = seeds[:, :, i] if seeds.shape[1] > 1 else None
        curves += _with_exact(label, i, x, seeds[:, :, i].mean(axis=1), band, exact[:, i])
    return curves


def _with_exact(label: str, colour: int, x: Floats, ours: Floats, seeds: Floats | None, exact: Floats) -> list[Series]:
    low, high = (None, None) if seeds is None else np.quantile(seeds, _BAND, axis=1)
    return [
        Series(label, x, ours, colour=colour, low=low, high=high),
        Series(f"{label}, exact", x, exact, "dashed", colour=EXACT, listed=False),
    ]


def _grouped(weights: Floats) -> Floats:
    """Mean of the six upper weights, w7 and w8: ``[..., 8] -> [..., 3]``."""
    return np.stack([weights[..., :6].mean(axis=-1), weights[..., 6], weights[..., 7]], axis=-1)


def _error_forms(process: Process) -> dict[str, Floats]:
    """Squared errors as quadratic forms of w, for a problem whose values are all 0."""
    A, C = td(process)[0], covariance(process)
    return {"√VE": C, "√PBE": A.T @ np.linalg.pinv(C, rcond=1e-12, hermitian=True) @ A}


def _expected(chosen: Method, process: Process, given: Options, alpha: float) -> tuple[Floats, Floats]:
    assert chosen.expected is not None
    expected = chosen.expected(process, chosen.checked(given))
    return expected.at(np.zeros(expected.size), alpha)


def _powers(M: Floats, theta: Floats, steps: Indices) -> Floats:
    """Mᵏ θ for rising k, ``[R, size]``; the star has no rewards and so no constants."""
    found = []
    for before, k in zip([0, *steps[:-1].tolist()], steps.tolist(), strict=True):
        theta = np.linalg.matrix_power(M, k - before) @ theta
        found.append(theta)
    return np.array(found)

"""One and two states: Kolter's fixed point that is arbitrarily bad, and Sarsa that chatters."""

from __future__ import annotations

import numpy as np

from neuralq.lab.figures.drawing import EXACT, Drawing, Panel, Series
from neuralq.lab.figures.star import sampled_weights
from neuralq.lab.linear.process import linear_process
from neuralq.lab.methods import method as method_named
from neuralq.lab.methods.operators import td
from neuralq.lab.trial import run
from neuralq.types import Floats
from neuralq_envs.counterexamples.chattering import chattering, greedy_share, policy_fixed_points
from neuralq_envs.counterexamples.kolter import critical_probability, kolter

__all__ = ["figure_chattering", "figure_kolter"]


def figure_kolter(
    epsilons: tuple[float, ...] = (0.01, 0.001), num_steps: int = 5000, num_seeds: int = 100, seed: int = 0
) -> Drawing:
    """The off-policy TD fixed point of Kolter's two states is arbitrarily bad near p*.

    Args:
        epsilons: ε; of the first also the samples are drawn.
        num_steps: transitions of each LSTD solution.
        num_seeds: solutions.
        seed: of all of them.

    Source: Kolter 2011.

    Example:
        >>> drawing = figure_kolter((0.01,), num_steps=100, num_seeds=2)
        >>> round(drawing.known["p* at ε = 0.01"], 6)
        0.684386
    """
    curves, tested = [], np.linspace(0.30, 0.98, 18)
    for colour, epsilon in enumerate(epsilons):
        star = critical_probability(epsilon)
        near = np.concatenate([np.geomspace(1e-4, 0.1, 50), np.linspace(0.1, 1, 90)])
        p = np.unique(np.concatenate([star - (star - 0.2) * near, star + (0.99 - star) * near]))
        left, right = p < star, p > star  # at p* itself there is no fixed point
        exact = np.full(len(p), np.nan)
        exact[left | right] = _fixed_point_errors(p[left | right], epsilon)
        label = f"fixed point, ε = {epsilon:g}"
        curves += [
            Series(label, p[left], exact[left], "dashed", colour),
            Series(f"{label}, beyond", p[right], exact[right], "dashed", colour, listed=False),
        ]
    low, middle, high = _lstd_errors(tested, epsilons[0], num_steps, num_seeds, seed)
    curves.insert(0, Series(f"LSTD, ε = {epsilons[0]:g}", tested, middle, "points", 0, low, high))
    best = Series("best weight, ε = " + f"{epsilons[0]:g}", np.array([0.2, 0.99]), np.full(2, _best_error(epsilons[0])),
                 "dotted", EXACT)  # fmt: skip
    known = {f"p* at ε = {epsilon:g}": critical_probability(epsilon) for epsilon in epsilons}
    growth = _kolter_growth(tested, epsilons[0])
    return Drawing(
        name="kolter",
        title="An off-policy fixed point can be arbitrarily bad",
        source="Kolter 2011",
        caption="γ = 0.99, p how often the behaviour visits the first state, features within ε of the values. Left: "
        f"error of the TD fixed point, both states alike, exact (dashed), and of LSTD from {num_steps} transitions, "
        f"median and 10-90% band of {num_seeds} seeds; dotted: the best weight. Right, ε = {epsilons[0]:g}: factor per "
        "expected TD(0) update at α = 0.1, measured (points), and 1 - αA(p), exact (dashed). At p* "
        "the matrix A changes its sign: TD diverges beyond.",
        panels=(
            Panel("error of the fixed point", "p", "RMS error of the values", (*curves, best), y_scale="log",
                  y_limits=(2e-4, 30), verticals=((critical_probability(epsilons[0]), "p*"),), legend="upper left"),
            Panel("growth of TD(0)", "p", "factor per update", growth, horizontals=((1.0, ""),),
                  verticals=((critical_probability(epsilons[0]), "p*"),), legend="upper left"),
        ),
        known=known,
    )  # fmt: skip


def _operators(p: Floats, epsilon: float) -> tuple[Floats, Floats]:
    """A and b at each p, ``([k], [k])``: both are linear in how often the first state is visited."""
    ends = [td(linear_process(kolter(end, epsilon))) for end in (0.25, 0.75)]
    A, b = (np.array([end[i].item() for end in ends]) for i in (0, 1))
    first = (p - 0.25) / 0.5
    return (1 - first) * A[0] + first * A[1], (1 - first) * b[0] + first * b[1]


def _fixed_point_errors(p: Floats, epsilon: float) -> Floats:
    """RMS error at w = b/A, ``[k]``: both states count alike."""
    A, b = _operators(p, epsilon)
    process = linear_process(kolter(0.5, epsilon))
    return _even_errors(process.X, (b / A)[:, None], process.v)


def _even_errors(X: Floats, w: Floats, v: Floats) -> Floats:
    """Root mean square error of the values, all states alike, for weights ``[N, d]``, ``[N]``."""
    errors: Floats = np.sqrt(((w @ X.T - v) ** 2).mean(axis=1))
    return errors


def _best_error(epsilon: float) -> float:
    process = linear_process(kolter(0.5, epsilon))
    w = np.linalg.pinv(process.X) @ process.v
    return float(_even_errors(process.X, w[None, :], process.v)[0])


def _lstd_errors(tested: Floats, epsilon: float, num_steps: int, num_seeds: int, seed: int) -> Floats:
    """Quantiles over seeds, ``[3, k]``."""
    found = []
    for p in tested:
        problem = kolter(float(p), epsilon)
        process = linear_process(problem)
        weights = run(problem, "lstd", num_steps, None, "iid", num_seeds, seed).weights
        found.append(np.quantile(_even_errors(process.X, weights, process.v), (0.1, 0.5, 0.9)))
    return np.array(found).T


def _kolter_growth(tested: Floats, epsilon: float) -> tuple[Series, ...]:
    """The ratio of the second change of w to the first, and 1 − αA."""
    measured, alpha = [], 0.1
    for p in tested:
        w = run(kolter(float(p), epsilon), "td", 2, alpha).path[:, 0]
        measured.append((w[2] - w[1]) / (w[1] - w[0]))
    fine = np.linspace(tested[0], tested[-1], 60)
    exact = 1 - alpha * _operators(fine, epsilon)[0]
    return (
        Series("measured", tested, np.array(measured), "points", 2),
        Series("exact", fine, exact, "dashed", EXACT),
    )


def figure_chattering(num_steps: int = 20_000, num_seeds: int = 40, seed: int = 0) -> Drawing:
    """Sarsa chatters where no policy is consistent with its own weight, for the exact share of time.

    Args:
        num_steps: updates at the small step size.
        num_seeds: runs.
        seed: of all of them.

    Source: after Gordon 1996.

    Example:
        >>> round(figure_chattering(num_steps=100, num_seeds=2).known["share of a"], 6)
        0.685185
    """
    w_a, w_b = policy_fixed_points()
    problem, sarsa = chattering(), method_named("sarsa")
    coarse, fine = (
        sampled_weights(problem, sarsa, sarsa.defaults, alpha, np.arange(last + 1), num_seeds, seed)[:, :, 0]
        for last, alpha, seed in ((400, 0.01, seed), (num_steps, 0.001, seed + 1))
    )
    x = np.arange(len(coarse), dtype=np.float64)
    low, high = np.quantile(coarse, (0.1, 0.9), axis=1)
    wait = num_steps // 10  # until w has come down to 0
    counted = np.cumsum(fine[wait:] <= 0, axis=0) / np.arange(1, num_steps - wait + 2)[:, None]
    every = np.unique(np.linspace(0, len(counted) - 1, 240).round().astype(int))
    share = np.quantile(counted[every], (0.1, 0.5, 0.9), axis=1)
    at = (every + wait).astype(np.float64)
    return Drawing(
        name="chattering",
        title="No weight is consistent with its own policy: Sarsa chatters",
        source="after Gordon 1996",
        caption="One state, two actions that end the episode, Q = (w, 2w), ε = 0.1. Left: Sarsa at α = 0.01, one seed "
        f"(line) and the 10-90% band of {num_seeds}; dashed: where w would go if its greedy action stayed. Right: "
        f"share of updates after the first {wait} in which a is greedy, α = 0.001, median and band of {num_seeds} "
        f"seeds; dashed: the exact share of the sliding limit, {greedy_share():.6f}.",
        panels=(
            Panel("the weight", "updates", "w", (
                Series("sampled", x, coarse[:, 0], colour=0, low=low, high=high),
                Series("limit if a stays greedy", x[[0, -1]], np.full(2, w_a), "dashed", 1),
                Series("limit if b stays greedy", x[[0, -1]], np.full(2, w_b), "dashed", 2),
            ), y_limits=(-0.65, 1.3), legend="upper right"),
            Panel("greedy action", "updates", "share of time with a greedy", (
                Series("sampled", at, share[1], colour=0, low=share[0], high=share[2]),
                Series("exact", at[[0, -1]], np.full(2, greedy_share()), "dashed", EXACT),
            ), y_limits=(0.6, 0.78)),
        ),
        known={"share of a": greedy_share()},
    )  # fmt: skip

"""What a diagnosis says, in one word, in numbers, and in a paragraph that a student understands.

The word is decided in this order, with ρ the growth per step of the mean:

    neutral                              |ρ − 1| ≤ 1e-9, or the weights drift by a constant in every step
    diverges                             ρ > 1
    mean-stable but variance diverges    ρ < 1, but the second moment grows (sampled updates only)
    stable but poor fixed point          all of that is fine, but the fixed point is farther from the true values than
                                         any on-policy TD(0) solution could be (see `POOR`)
    converges

and for updates whose pieces change with the weights, by where the run from the initial weights leads: it settles in a
piece (converges), leaves every bound (diverges), or switches for ever within bounds (chatters).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from neuralq.lab.linear.sampling import Sampling
from neuralq.lab.methods.record import Options
from neuralq.lab.plain import fields_of, plain
from neuralq.types import Floats

__all__ = ["POOR", "Diagnosis", "Region", "Verdict", "is_poor"]


Verdict = Literal[
    "converges",
    "diverges",
    "mean-stable but variance diverges",
    "stable but poor fixed point",
    "chatters",
    "neutral",
]

MOST_REGIONS = 64
"""Pieces of one run that are kept; of a run that goes through more, the last ones."""

POOR = 10.0
"""Largest ratio of errors ever tolerated: 1/√(1 − γ²), the bound of on-policy TD(0), passes it from γ = .995 on."""


@dataclass(frozen=True, eq=False)
class Region:
    """One piece that a piecewise update passed through: a greedy policy.

    Args:
        spectral_radius: growth per step while it lasts.
        fixed_point: θ where it would settle; None where it has no single one.
        consistent: whether that fixed point lies in the region itself.
    """

    spectral_radius: float
    fixed_point: Floats | None
    consistent: bool


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a method will do on a problem, known before training.

    Args:
        problem: its name.
        method: its title.
        options: of the method, all of them.
        step_size: α.
        sampling: ``"expected"``, ``"iid"`` or ``"markov"``.
        converges: whether it settles, variance included; a poor fixed point counts as settled.
        verdict: in a word.
        spectral_radius: growth of the mean per application of the update, on what it moves; one application of a hard
            target network is a whole period. 0 where nothing moves.
        second_moment_radius: growth of the second moment per sampled update; for ETD that of its follow-on F. None
            for the expected update, for methods that remember earlier transitions, and for piecewise ones.
        step_size_bound: every smaller step size converges in the mean; infinite where the step size does not matter,
            0 where not even the smallest do. For piecewise updates while the last piece stays; None where they chatter.
        step_size_bound_second_moment: every smaller step size has a settled variance; None where that is not known.
        oscillates: whether the leading mode turns: its factor is complex or negative.
        doubling_time: sampled updates (or sweeps) in which a growing error doubles; None where it does not grow.
        eigenvalues: factors per application on what the update moves, largest modulus first; inside the unit disc is
            stable.
        rank: dimension of what the expected update moves.
        fixed_point: w where the mean stays if it starts at the problem's initial weights (of many fixed points the one
            that belongs to them), whether or not it is stable, ``[d]``. None where there is none.
        fixed_point_error: its RMSVE; None where it or the true values do not exist.
        best_error: the least RMSVE that any weights have.
        distance_to_singularity: σ_min / σ_max of I − M on what moves (of A, for a flow). Near 0 the fixed point is at
            the mercy of small changes (Kolter 2011).
        drift: length of what every step adds where no point is fixed; 0 where one is.
        scale: size of values, the larger of the RMS of the true ones and of the initial error; None without true ones.
        local: whether the values are not linear in the weights, so that all this holds near the initial ones only.
        updates: sampled updates that one application stands for.
        regions: pieces that a piecewise update passed through, the last one last; empty for linear ones.
        follow_on: whether the second moment is that of ETD's follow-on instead of that of the weights.
        flow: whether the change per update is proportional to α, so that what grows at one α grows at every.
    """

    problem: str
    method: str
    options: Options
    step_size: float
    sampling: Sampling
    converges: bool
    verdict: Verdict
    spectral_radius: float
    second_moment_radius: float | None
    step_size_bound: float | None
    step_size_bound_second_moment: float | None
    oscillates: bool
    doubling_time: float | None
    eigenvalues: NDArray[np.complex128]
    rank: int
    fixed_point: Floats | None
    fixed_point_error: float | None
    best_error: float | None
    distance_to_singularity: float
    drift: float = 0.0
    scale: float | None = None
    local: bool = False
    updates: int = 1
    regions: tuple[Region, ...] = ()
    follow_on: bool = False
    flow: bool = True

    def rounded(self, error: float | None) -> float | None:
        """An error as it is shown: 0 where it is what rounding leaves of values of this size."""
        return 0.0 if error is not None and error < 1e-9 * max(self.scale or 0.0, 1.0) else error

    @property
    def rates(self) -> NDArray[np.complex128]:
        """(1 − factor)/α, for a flow the eigenvalues of its matrix A; one with a real part below 0 grows at every α."""
        return (1 - self.eigenvalues) / self.step_size

    def explain(self) -> str:
        """A paragraph with the numbers that decide.

        Example:
            >>> from neuralq.lab.verdicts.diagnosis import diagnose
            >>> from neuralq_envs.counterexamples import star
            >>> print(diagnose(star()).explain())  # doctest: +ELLIPSIS
            TD(0) on baird with α = 0.01 diverges. ... doubles every 290 sweeps...
        """
        sentences = [
            f"{_title(self)} on {self.problem} with α = {self.step_size:g}{_settings(self)} "
            f"{_HEADLINES[self.verdict]}.",
            *_growth(self),
            *_variance(self),
            *_bounds(self),
            *_solution(self),
            *_pieces(self),
        ]
        if self.local:
            sentences.append(
                "The values are not linear in the weights, so this holds only near the initial weights; "
                "recompute it along training."
            )
        return " ".join(sentences)

    def plain(self) -> dict[str, Any]:
        """Everything as text and numbers, as JSON takes it."""
        factors = self.eigenvalues[np.isfinite(self.eigenvalues)]
        return {**fields_of(self, *_PLAIN), "eigenvalues": plain(factors), "explanation": self.explain()}


_PLAIN = (
    *("problem", "method", "options", "sampling", "verdict", "converges", "step_size", "spectral_radius"),
    *("second_moment_radius", "step_size_bound", "step_size_bound_second_moment", "doubling_time", "fixed_point_error"),
    *("best_error", "distance_to_singularity", "drift", "oscillates", "rank", "updates", "local", "fixed_point"),
)
_HEADLINES: dict[Verdict, str] = {
    "converges": "converges",
    "diverges": "diverges",
    "mean-stable but variance diverges": "is stable on average, but its variance diverges",
    "stable but poor fixed point": "is stable, but settles on poor values",
    "chatters": "chatters: it neither settles nor grows",
    "neutral": "is neutral: it neither dies out nor grows exponentially",
}


def is_poor(error: float | None, best: float | None, scale: float | None, gamma: float) -> bool:
    """Whether a fixed point is farther from v than TD(0) could be on its own distribution: ‖v − Xw‖ > best/√(1 − γ²).

    The factor is capped at `POOR`, and a millionth of ``scale``, the size of values, is left to rounding.

    Source: Tsitsiklis & Van Roy 1997, theorem 1 with λ = 0, in the sharper form for orthogonal projections.

    Example:
        >>> is_poor(2.0, 1.0, 5.0, 0.9), is_poor(2.4, 1.0, 5.0, 0.9)  # 1/√.19 = 2.29
        (False, True)
    """
    if error is None or best is None or scale is None:
        return False
    factor = min(1 / math.sqrt(1 - gamma**2), POOR) if gamma < 1 else POOR
    return error > factor * best + 1e-6 * scale


_SYMBOLS = {"lambda_": "λ", "beta_over_alpha": "β/α", "eta": "η", "phi": "φ", "tau": "τ", "beta": "β"}


def _title(one: Diagnosis) -> str:
    """The name of the method with its λ filled in: TD(0)."""
    return one.method.replace("(λ", f"({one.options['lambda_']:g}") if "lambda_" in one.options else one.method


def _settings(one: Diagnosis) -> str:
    shown = [(name, value) for name, value in one.options.items() if value != 0 and name != "lambda_"]
    given = [
        "β = γ" if (name, value) == ("beta", -1.0) else f"{_SYMBOLS.get(name, name)} = {value:g}"
        for name, value in shown
    ]
    sampled = {"expected": "", "iid": ", on independent transitions,", "markov": ", along a chain,"}[one.sampling]
    return (f" ({', '.join(given)})" if given else "") + sampled


def _growth(one: Diagnosis) -> list[str]:
    if one.drift > 0:
        return [
            f"No weights are a fixed point: every step adds a part of length {one.drift:.3g} that nothing takes back, "
            "so the weights drift linearly and for ever."
        ]
    if len(one.eigenvalues) == 0:
        return ["The expected update moves nothing at all."]
    per = "sweep" if one.sampling == "expected" else "update"
    per = f"period of {one.updates} updates" if one.updates > 1 else per
    unit = "sweeps" if per == "sweep" else "updates"
    radius, turning = one.spectral_radius, " while it swings from side to side" if one.oscillates else ""
    if one.verdict == "chatters" or (one.verdict == "neutral" and one.regions):
        return []
    if one.doubling_time is not None:
        return [
            f"Its leading error is multiplied by {radius:.7g} in every {per}{turning}: "
            f"it doubles every {one.doubling_time:.3g} {unit}."
        ]
    if one.verdict == "neutral":
        return [f"Its leading factor per {per} is {radius:.12g}: an error of that kind stays as large as it is."]
    if radius == 0:
        return [f"The mean error is gone after the first {per}."]
    text = f"Its slowest error is multiplied by {radius:.7g} in every {per}{turning}"
    if radius > 0.5:
        text += f": it halves every {one.updates * math.log(2) / -math.log(radius):.3g} {unit}"
    return [f"{text}."]


def _variance(one: Diagnosis) -> list[str]:
    second = one.second_moment_radius
    if second is None or one.drift > 0:
        return []
    what = "The mean square of its follow-on" if one.follow_on else "The mean square of the weights' error"
    if second >= 1:
        return [
            f"{what} is multiplied by {second:.7g} per update: single runs scatter ever more widely"
            + (", although their average behaves." if one.spectral_radius < 1 else ".")
        ]
    return [f"{what} is multiplied by {second:.7g} per update, so the scatter between runs settles too."]


def _bounds(one: Diagnosis) -> list[str]:
    bound, second, out = one.step_size_bound, one.step_size_bound_second_moment, []
    if bound is None or one.drift > 0:
        return []
    if bound == 0:
        worst = float(one.rates.real.min(initial=math.inf))
        if one.spectral_radius < 1 or (one.flow and worst > 0):
            out.append("Small step sizes do not converge, so no range from 0 up is safe.")
        elif not one.flow:
            out.append("The smallest step sizes do not converge either, so no range from 0 up is safe.")
        elif one.sampling == "markov":
            out.append("Smaller steps only diverge more slowly.")
        else:
            reason = f"the matrix of the expected update has an eigenvalue with the real part {min(worst, 0.0):.4g}"
            out.append(f"No step size helps: {reason}, so smaller steps only diverge more slowly.")
    elif math.isinf(bound):
        out.append("The step size does not matter.")
    else:
        out.append(f"The mean converges for every step size below {bound:.6g}.")
        if second is not None:
            out.append(f"The variance settles for every step size below {second:.6g}.")
    return out


def _solution(one: Diagnosis) -> list[str]:
    out = []
    rests = bool(one.regions) and one.verdict == "diverges"
    if one.fixed_point_error is not None and one.best_error is not None and not rests:
        subject = "The fixed point is" if one.converges else "The fixed point, which it does not reach, is"
        error, best = one.rounded(one.fixed_point_error), one.rounded(one.best_error)
        out.append(f"{subject} {error:.4g} (RMS) from the true values; the best weights are {best:.4g} from them.")
    if 0 < one.distance_to_singularity < 1e-3 and one.sampling == "expected":
        out.append(
            f"The equations for the fixed point are nearly singular (σ_min/σ_max = {one.distance_to_singularity:.1e}): "
            "a small change of the data may move it far."
        )
    return out


def _pieces(one: Diagnosis) -> list[str]:
    if not one.regions:
        return []
    num = len(one.regions)
    consistent = sum(region.consistent and region.spectral_radius < 1 for region in one.regions)
    pieces = f"{num}{' or more' if num >= MOST_REGIONS else ''} {'piece' if num == 1 else 'pieces'}"
    if one.verdict == "diverges" and one.fixed_point is not None:
        return ["The run rests where it starts, but only there: from weights a little beside it, it grows."]
    if one.verdict == "diverges" and num == 1:
        return ["The run grows without ever leaving its first piece."]
    if one.verdict == "diverges":
        return [f"The run went through {pieces} and grows all the same."]
    if one.verdict == "chatters":
        holds = f"only {consistent} of them contain" if consistent else "none of them contains"
        return [
            f"The run went through {pieces} (greedy policies), and {holds} the point that it would settle at: "
            "each pulls the weights over the border into another, and they slide along it."
        ]
    if one.verdict == "neutral":
        return [f"After {pieces} the run still creeps in one direction, too slowly to tell where it leads."]
    settles = "stays in the first piece" if num == 1 else f"went through {pieces}"
    return [f"The run {settles} and settles {'there' if num == 1 else 'in the last one'}."]

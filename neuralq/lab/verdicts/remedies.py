"""What to change so that learning converges, the best remedy first, with what each costs.

For an unstable problem every kind of remedy is tried at the same step size: more λ, longer returns, a penalty, a part
of the residual gradient, a target network, a second time scale, another method, another distribution of updates. Of a
parameter the smallest change that makes the expected update converge is found by a scan, and a tenth of the way on is
recommended, because a run on the edge of stability takes for ever. Remedies are ranked by their diagnosis: how fast
the error shrinks, how far its fixed point lies from the true values, and whether single runs scatter without bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neuralq.checks import check_positive
from neuralq.lab.linear.process import linear_process
from neuralq.lab.linear.spectrum import visible_process
from neuralq.lab.methods import Method, method
from neuralq.lab.methods.record import Options
from neuralq.lab.plain import fields_of
from neuralq.lab.verdicts.critical import CRITICAL_PARAMETERS, scan
from neuralq.lab.verdicts.diagnosis import Diagnosis, diagnose
from neuralq.lab.verdicts.moments import known_second_moment
from neuralq_envs.counterexamples import Problem
from neuralq_envs.counterexamples.chains import stationary_distribution

__all__ = ["Remedy", "prescribe", "usual_method"]

_FROM_LOW = ("lambda_", "num_steps", "eta", "phi", "period", "beta_over_alpha")
_FROM_HIGH = ("tau",)
_OTHER_METHODS = ("gtd2", "tdrc", "htd", "etd", "lstd", "greedy-gq")
_WAY_ON = 0.1  # share of the stable interval that is left between the recommendation and its edge

_CHANGES = {
    "lambda_": ("look further along the trajectory: λ = {value:.3g} in TD(λ)", "from λ = {edge:.4g} on"),
    "num_steps": ("bootstrap later: n = {value:.0f} steps in n-step TD", "from n = {edge:.0f} on"),
    "eta": ("shrink the weights by a penalty: η = {value:.3g} in ridge TD", "from η = {edge:.4g} on"),
    "phi": ("follow the residual gradient for a part: φ = {value:.3g}", "from φ = {edge:.4g} on"),
    "period": ("bootstrap from frozen weights: copy them every {value:.0f} updates", "from {edge:.0f} updates on"),
    "tau": ("bootstrap from slowly moving weights: τ = {value:.3g}", "below τ = {edge:.4g}"),
    "beta_over_alpha": (
        "correct the gradient with a second time scale: TDC with β/α = {value:.3g}",
        "from β/α = {edge:.4g} on",
    ),
}
"""What to do and where that begins to converge, in words."""


@dataclass(frozen=True, eq=False)
class Remedy:
    """A change after which learning converges.

    Args:
        kind: the parameter that changes, or ``"step_size"``, ``"distribution"`` or ``"method"``.
        change: what to do, in words.
        margin: where that begins to converge, in words; None where nothing was scanned.
        problem: on which it is diagnosed: the same one, but for ``"distribution"``.
        method: name of the method to use.
        options: of that method.
        step_size: α.
        critical: edge of stability in the parameter; None where nothing was scanned.
        diagnosis: of the expected update after the change.
        second_moment_radius: growth of the mean square along a chain; None where it is not known. 1 or more: single
            runs scatter without bound.
    """

    kind: str
    change: str
    margin: str | None
    problem: Problem
    method: str
    options: Options
    step_size: float
    critical: float | None
    diagnosis: Diagnosis
    second_moment_radius: float | None

    @property
    def updates_to_tenth(self) -> float:
        """Updates in which the slowest error shrinks to a tenth."""
        radius = self.diagnosis.spectral_radius
        if radius >= 1:
            return math.inf
        return (
            self.diagnosis.updates * math.log(10) / -math.log(radius) if radius > 0 else float(self.diagnosis.updates)
        )

    @property
    def scatters(self) -> bool:
        """Whether the variance of single runs is known to grow."""
        return self.second_moment_radius is not None and self.second_moment_radius >= 1

    def explain(self) -> str:
        """The change and what it costs, in words."""
        found = self.diagnosis
        where = "" if self.margin is None else f" (it converges {self.margin})"
        text = f"{self.change[0].upper()}{self.change[1:]}{where}."
        if found.spectral_radius == 0:
            text += " The mean is right after one application."
        elif found.spectral_radius < 1:
            text += f" The slowest error shrinks to a tenth in {_round(self.updates_to_tenth)} updates."
        if found.fixed_point_error is not None and found.best_error is not None:
            error, best = found.rounded(found.fixed_point_error), found.rounded(found.best_error)
            text += f" It ends {error:.3g} (RMS) from the true values; the best weights are {best:.3g} from them."
        if self.scatters:
            text += " Single runs scatter ever more widely: only the average converges."
        return text

    def plain(self) -> dict[str, Any]:
        """The change and what it costs as text and numbers, as JSON takes it."""
        return {
            **fields_of(
                self, "kind", "change", "margin", "method", "options", "step_size", "critical", "updates_to_tenth"
            ),
            **fields_of(self.diagnosis, "spectral_radius", "fixed_point_error", "best_error"),
            **fields_of(self, "second_moment_radius", "scatters"),
            "explanation": self.explain(),
        }


def usual_method(problem: Problem) -> str:
    """The name of the method that a problem is about: TD, or for control Q-learning, Sarsa where it is on-policy.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> usual_method(star())
        'td'
    """
    return ("sarsa" if problem.exploration is not None else "q-learning") if problem.control else "td"


def prescribe(problem: Problem, step_size: float | None = None) -> list[Remedy]:
    """Changes that make learning converge on a problem where it does not, best first; none where it does.

    First come those whose single runs settle, then the smaller error of the fixed point (in steps of: about the best
    possible, within ten times, worse), then the faster.

    Args:
        problem: what is learned, by TD(0), or by Q-learning (Sarsa where it is on-policy) if it is a control problem.
        step_size: α of every remedy; the problem's own by default.

    Raises:
        ValueError: a step size that is not above 0, or values that are not linear in the weights.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> remedies = prescribe(star())
        >>> {remedy.kind for remedy in remedies} >= {"lambda_", "eta", "phi", "period", "tau", "num_steps"}
        True
        >>> all(remedy.diagnosis.converges for remedy in remedies)
        True
    """
    alpha = problem.step_size if step_size is None else step_size
    check_positive("step_size", alpha)
    if problem.value is not None:
        raise ValueError(
            f"the values of {problem.name} are not linear in its weights: diagnose describes them locally, but what "
            "would make them converge is not known from that"
        )
    base = usual_method(problem)
    trouble = diagnose(problem, base, alpha)
    if trouble.converges:
        return []
    found = [*_smaller_steps(problem, base, trouble), *_other_methods(problem, alpha)]
    if not problem.control:
        found += [*_parameters(problem, alpha), *_on_policy(problem, alpha)]
    return sorted((one for one in found if one is not None), key=_rank)


def _rank(remedy: Remedy) -> tuple[bool, int, float]:
    found = remedy.diagnosis
    if found.fixed_point_error is None or found.best_error is None:
        grade = 2
    else:
        slack = 1e-6 * (found.scale or 1.0)
        grade = sum(found.fixed_point_error > factor * found.best_error + slack for factor in (1.5, 10.0))
    return remedy.scatters, grade, remedy.updates_to_tenth


def _parameters(problem: Problem, alpha: float) -> Iterator[Remedy | None]:
    for parameter in (*_FROM_LOW, *_FROM_HIGH):
        found = scan(problem, parameter, step_size=alpha)
        if not found.stable:
            continue
        low, high = found.stable[0] if parameter in _FROM_LOW else found.stable[-1]
        edge, far = (low, high) if parameter in _FROM_LOW else (high, low)
        value = _some_way_on(CRITICAL_PARAMETERS[parameter].spacing, edge, far)
        words = (text.format(value=value, edge=edge) for text in _CHANGES[parameter])
        yield _remedy(parameter, problem, method(found.method), {parameter: value}, alpha, edge, *words)


def _some_way_on(spacing: str, edge: float, far: float) -> float:
    if spacing == "log":
        return float(edge * (far / edge) ** _WAY_ON)
    if spacing == "whole":
        return float(min(edge + max(1, math.ceil(_WAY_ON * edge)), far))
    return edge + _WAY_ON * (far - edge)


def _smaller_steps(problem: Problem, base: str, trouble: Diagnosis) -> Iterator[Remedy | None]:
    bound = trouble.step_size_bound
    if bound is not None and 0 < bound <= trouble.step_size:
        smaller = bound / 2
        change, margin = f"take smaller steps: α = {smaller:.3g}", f"below α = {bound:.4g}"
        yield _remedy("step_size", problem, method(base), {}, smaller, bound, change, margin)


def _other_methods(problem: Problem, alpha: float) -> Iterator[Remedy | None]:
    for name in _OTHER_METHODS:
        one = method(name)
        if (one.rows == "pairs") is problem.control:
            yield _remedy("method", problem, one, {}, alpha, None, f"use another method: {one.title}")


def _on_policy(problem: Problem, alpha: float) -> Iterator[Remedy | None]:
    pi = problem.target_policy
    try:
        d = stationary_distribution(problem.mdp, pi)
    except ValueError:
        return  # the target policy has no distribution of its own
    follows = replace(problem, behaviour_policy=pi, state_distribution=d)
    change = "update on-policy: act by the target policy, so that states are updated as often as it visits them"
    yield _remedy("distribution", follows, method("td"), {}, alpha, None, change)


def _remedy(
    kind: str,
    problem: Problem,
    chosen: Method,
    options: Options,
    alpha: float,
    edge: float | None,
    change: str,
    margin: str | None = None,
) -> Remedy | None:
    """The remedy, if its diagnosis says that it is one."""
    try:
        found = diagnose(problem, chosen, alpha, "expected", **options)
    except (ValueError, np.linalg.LinAlgError):
        return None  # the method has no solution here (γ = 1 without end, singular equations)
    if not found.converges:
        return None
    if chosen.memory_growth is not None:
        second: float | None = chosen.memory_growth(visible_process(linear_process(problem))[0], found.options)
    else:
        second = known_second_moment(problem, chosen, found.options, alpha, "markov")
    return Remedy(kind, change, margin, problem, chosen.name, found.options, alpha, edge, found, second)


def _round(updates: float) -> str:
    return f"{updates:,.0f}" if updates < 1e6 else f"{updates:.2g}"

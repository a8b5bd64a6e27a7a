"""How a tabular learner acts and how far it steps: small frozen settings, turned into numbers that kernels read."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_fraction, check_positive, check_whole

__all__ = [
    "ActingCode",
    "EpsilonGreedy",
    "KToTheQ",
    "Policy",
    "PolicyLike",
    "Power",
    "RandomPolicy",
    "SearchThenConverge",
    "Softmax",
    "StepCode",
    "StepSizeLike",
    "UpperConfidence",
    "Visits",
    "acting_code",
    "check_expectation",
    "step_code",
]

EPSILON_GREEDY, K_TO_THE_Q, SOFTMAX, UPPER_CONFIDENCE, RANDOM = range(5)
CONSTANT, VISITS, POWER, LISTED, SEARCHING = range(5)

TIES = ("random", "lowest")


class ActingCode(NamedTuple):
    """A policy as kernels read it: the parameter at step t is ``first + slope · min(t, num_steps)``."""

    kind: int
    first: float
    slope: float
    num_steps: int
    random_ties: bool


class StepCode(NamedTuple):
    """A step-size rule as kernels read it; ``scale`` is the number of visits after which `SearchThenConverge` turns."""

    kind: int
    value: float
    listed: NDArray[np.float64]
    scale: float = 1.0


@dataclass(frozen=True)
class EpsilonGreedy:
    """The best action with probability 1 − ε, else any legal one; ε may fall linearly to ``final``.

    Args:
        epsilon: ε at the first step, in [0, 1].
        final: ε from step ``num_steps`` on; None for a constant ε.
        num_steps: length of the way from ``epsilon`` to ``final``.
        ties: equally good actions are drawn from (``"random"``) or the lowest is taken (``"lowest"``). A table that
            starts at one value has nothing but ties: the lowest action for ever is a poor explorer.
    """

    epsilon: float = 0.1
    final: float | None = None
    num_steps: int = 0
    ties: str = "random"

    def __post_init__(self) -> None:
        check_fraction("epsilon", self.epsilon, "0 is greedy, 1 is uniform")
        check_choice("ties", self.ties, TIES)
        if self.final is not None:
            check_fraction("final", self.final)
            check_whole("num_steps", self.num_steps)

    def code(self) -> ActingCode:
        """Numbers for kernels."""
        slope = 0.0 if self.final is None else (self.final - self.epsilon) / self.num_steps
        return ActingCode(EPSILON_GREEDY, float(self.epsilon), slope, self.num_steps, self.ties == "random")


@dataclass(frozen=True)
class KToTheQ:
    """P(a|s) = k^Q(s,a) / Σ_b k^Q(s,b), with k growing by ``growth`` at every step (Mitchell 1997, section 13.3.5).

    Args:
        k: at the first step, above 0; above 1 it exploits.
        growth: added to k at every step, at least 0.
    """

    k: float = 2.0
    growth: float = 0.0

    def __post_init__(self) -> None:
        check_positive("k", self.k)
        if not (math.isfinite(self.growth) and self.growth >= 0):
            raise ValueError(f"growth must be a finite number of at least 0, got {self.growth}")

    def code(self) -> ActingCode:
        """Numbers for kernels."""
        return ActingCode(K_TO_THE_Q, float(self.k), float(self.growth), np.iinfo(np.int64).max, False)


@dataclass(frozen=True)
class Softmax:
    """P(a|s) in proportion to exp(Q(s,a) / temperature); the temperature may fall linearly to ``final``.

    Args:
        temperature: at the first step, above 0.
        final: from step ``num_steps`` on; None for a constant temperature.
        num_steps: length of the way.
    """

    temperature: float = 1.0
    final: float | None = None
    num_steps: int = 0

    def __post_init__(self) -> None:
        check_positive("temperature", self.temperature)
        if self.final is not None:
            check_positive("final", self.final)
            check_whole("num_steps", self.num_steps)

    def code(self) -> ActingCode:
        """Numbers for kernels."""
        slope = 0.0 if self.final is None else (self.final - self.temperature) / self.num_steps
        return ActingCode(SOFTMAX, float(self.temperature), slope, self.num_steps, False)


@dataclass(frozen=True)
class UpperConfidence:
    """The action with the largest Q(s,a) + c √(ln(1 + N(s)) / N(s,a)); untried ones first (Auer et al. 2002, UCB1).

    Args:
        c: width of the confidence interval, at least 0.
        ties: ``"random"`` or ``"lowest"``.
    """

    c: float = math.sqrt(2.0)
    ties: str = "random"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.c) and self.c >= 0):
            raise ValueError(f"c must be a finite number of at least 0, got {self.c}")
        check_choice("ties", self.ties, TIES)

    def code(self) -> ActingCode:
        """Numbers for kernels."""
        return ActingCode(UPPER_CONFIDENCE, float(self.c), 0.0, 0, self.ties == "random")


@dataclass(frozen=True)
class RandomPolicy:
    """Every legal action with the same probability."""

    def code(self) -> ActingCode:
        """Numbers for kernels."""
        return ActingCode(RANDOM, 0.0, 0.0, 0, False)


Policy = EpsilonGreedy | KToTheQ | Softmax | UpperConfidence | RandomPolicy
PolicyLike = Policy | str

_NAMED: dict[str, Policy] = {
    "epsilon-greedy": EpsilonGreedy(),
    "greedy": EpsilonGreedy(0.0),
    "k-to-the-q": KToTheQ(),
    "softmax": Softmax(),
    "ucb": UpperConfidence(),
    "random": RandomPolicy(),
}


def acting_code(policy: PolicyLike) -> ActingCode:
    """A policy, or the name of one with its default parameters, as kernels read it.

    Raises:
        ValueError: a name that is not known.

    Example:
        >>> acting_code("epsilon-greedy").first
        0.1
    """
    if isinstance(policy, str):
        name = policy.replace("_", "-")
        check_choice("policy", name, _NAMED)
        policy = _NAMED[name]
    return policy.code()


def check_expectation(rule: str, policy: ActingCode) -> None:
    """Refuse expected Sarsa for a policy that is no distribution.

    Raises:
        ValueError: confidence bounds.

    Example:
        >>> check_expectation("expected-sarsa", acting_code("softmax"))
    """
    if rule == "expected-sarsa" and policy.kind == UPPER_CONFIDENCE:
        raise ValueError(
            "expected Sarsa needs the policy's probabilities, and confidence bounds have none; "
            'use "epsilon-greedy", "softmax", "k-to-the-q" or "random"'
        )


@dataclass(frozen=True)
class Visits:
    """α_n = 1 / (1 + n), n counting the visits of the pair up to this update, so the first is 1/2 (Mitchell 13.11)."""


@dataclass(frozen=True)
class Power:
    """α_n = n^−ω. Robbins and Monro's conditions hold for 1/2 < ω ≤ 1.

    Args:
        omega: ω, above 0.
    """

    omega: float = 0.8

    def __post_init__(self) -> None:
        check_positive("omega", self.omega)


@dataclass(frozen=True)
class SearchThenConverge:
    """α_n = α / (1 + (n − 1) / τ): near α for the first τ visits of a pair, then as α τ / n (Darken & Moody 1990).

    Args:
        first: α, of the first visit, above 0 and at most 1.
        visits: τ, above 0.
    """

    first: float = 0.5
    visits: float = 100.0

    def __post_init__(self) -> None:
        check_positive("first", self.first)
        check_fraction("first", self.first, "1 is the rule for deterministic worlds")
        check_positive("visits", self.visits)


StepSizeLike = (
    float | str | Visits | Power | SearchThenConverge | Sequence[float] | NDArray[np.float64] | Callable[[int], float]
)
"""A number; ``"visits"``, ``"one-over-n"`` or ``"deterministic"`` (α = 1); `Power`, `SearchThenConverge`; the α of the
first, second, … visit of a pair (the last one stays); or a function of the visit count n = 1, 2, …"""

_STEP_NAMES = ("visits", "one-over-n", "deterministic")
_MOST_TABULATED = 1_000_000


def step_code(step_size: StepSizeLike, num_steps: int) -> StepCode:
    """A step-size rule as kernels read it.

    Args:
        step_size: the rule.
        num_steps: no pair is visited more often than this; functions are tabulated so far (at most a million).

    Raises:
        ValueError: a name that is not known, or a step size outside [0, 1].

    Example:
        >>> step_code("visits", 10).kind, step_code(lambda n: 1 / n, 3).listed.round(2).tolist()
        (1, [1.0, 0.5, 0.33])
    """
    none = np.zeros(0)
    if isinstance(step_size, str):
        check_choice("step_size", step_size, _STEP_NAMES)
        if step_size == "deterministic":
            return StepCode(CONSTANT, 1.0, none)
        return StepCode(VISITS, 0.0, none) if step_size == "visits" else StepCode(POWER, 1.0, none)
    if isinstance(step_size, Visits):
        return StepCode(VISITS, 0.0, none)
    if isinstance(step_size, Power):
        return StepCode(POWER, float(step_size.omega), none)
    if isinstance(step_size, SearchThenConverge):
        return StepCode(SEARCHING, float(step_size.first), none, float(step_size.visits))
    if callable(step_size):
        listed = np.array([step_size(n) for n in range(1, min(num_steps, _MOST_TABULATED) + 1)], dtype=np.float64)
    elif np.ndim(step_size) == 0:
        check_fraction("step_size", float(step_size), "1 is the rule for deterministic worlds")  # type: ignore[arg-type]
        return StepCode(CONSTANT, float(step_size), none)  # type: ignore[arg-type]
    else:
        listed = np.array(step_size, dtype=np.float64).reshape(-1)
    bad = np.flatnonzero(~((listed >= 0) & (listed <= 1)))
    if bad.size or not listed.size:
        got = f"{listed[bad[0]]} at visit {bad[0] + 1}" if bad.size else "an empty list"
        raise ValueError(f"step sizes must lie in [0, 1], got {got}")
    return StepCode(LISTED, 0.0, listed)

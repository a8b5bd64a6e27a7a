"""What can be said of a tabular learner, and which of it belongs to which algorithm, schedule and policy."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from neuralq.checks import check_choice, check_fraction, check_positive, check_whole

__all__ = ["ALGORITHMS", "TabularSettings"]

ALGORITHMS = {
    "q-learning": (),
    "sarsa": (),
    "expected-sarsa": (),
    "double": (),
    "n-step": ("n", "rule"),
    "q-lambda": ("lambda_", "rule", "trace"),
    "dyna": ("num_planning", "kappa"),
    "prioritized-sweeping": ("num_planning", "threshold", "max_outcomes"),
    "td-lambda": ("lambda_", "trace"),
    "r-learning": ("beta",),
}
"""The algorithms, each with the settings that it alone, or with few others, has."""

_RULES = {
    "n-step": ("q-learning", "sarsa", "expected-sarsa"),
    "q-lambda": ("watkins", "peng", "naive", "sarsa", "expected-sarsa"),
}
_TRACES = {"q-lambda": ("accumulating", "replacing"), "td-lambda": ("accumulating", "replacing", "true-online")}
_SCHEDULES: dict[str, tuple[str, ...]] = {
    "constant": ("step_size",),
    "one-over-n": (),
    "power": ("power",),
    "search-then-converge": ("step_size", "turn_visits"),
}
_POLICIES: dict[str, tuple[str, ...]] = {
    "epsilon-greedy": (),
    "k-to-the-q": ("k", "k_growth"),
    "softmax": ("temperature",),
    "ucb": ("confidence",),
    "random": (),
}


@dataclass(frozen=True)
class TabularSettings:
    """How a `TabularLearner` learns. What is none belongs to another algorithm, or has the default that is named.

    Args:
        algorithm: "q-learning", "sarsa", "expected-sarsa", "double", "n-step", "q-lambda", "dyna",
            "prioritized-sweeping", "td-lambda" (values of the states under the random policy; of others:
            `neuralq.tabular.td_lambda`) or "r-learning" (reward per step, in worlds without end).
        simulate: whether the environment's model is simulated inside the compiled loop; none where it has one that does
            what the environment does, else the environment is stepped.
        schedule: of the step size α by visits n of a pair: "constant", "one-over-n" (1/n), "power" (1/n^ω) or
            "search-then-converge" (α / (1 + (n − 1)/τ)); none for the one whose α, ω or τ is set, else for power.
        step_size: α of "constant" (0.1) and of the first visits in "search-then-converge" (0.5).
        power: ω of "power", in (0.5, 1] for convergence (0.55; 0.5 with "double", 0.8 with "td-lambda").
        turn_visits: τ of "search-then-converge": the visits after which α falls as 1/n (100).
        policy: "epsilon-greedy" (ε of the run), "k-to-the-q" (Mitchell 13.3.5), "softmax", "ucb" (a bonus for pairs
            that were visited rarely) or "random"; none for epsilon-greedy, and random with "td-lambda".
        k: of "k-to-the-q" at the first step, above 1 to exploit (1.5).
        k_growth: what k grows by at every step (0.001).
        temperature: of "softmax" (1).
        confidence: c of the bonus c √(ln(1 + N(s)) / N(s, a)) of "ucb" (1.41).
        initial_q: the value that every pair begins with, in the environment's units; above the true ones it explores.
        n: rewards in a target of "n-step" (4).
        rule: what "n-step" bootstraps from ("q-learning", "sarsa", "expected-sarsa"), and how "q-lambda" cuts its
            traces ("watkins", "peng", "naive"), or that it learns on-policy ("sarsa", "expected-sarsa").
        lambda_: λ of "q-lambda" and "td-lambda" (0.8).
        trace: "accumulating" or "replacing", with "td-lambda" also "true-online" (replacing).
        num_planning: imagined updates after each step of "dyna" and "prioritized-sweeping" (10).
        kappa: κ of Dyna-Q+'s bonus κ √τ for pairs not taken for τ steps (0: Dyna-Q).
        threshold: errors up to this are left alone by "prioritized-sweeping" (0.0001).
        max_outcomes: room for different outcomes of a pair where no model tells how many there are (32).
        beta: step size of the reward per step in "r-learning" (0.01).
    """

    algorithm: str = "q-learning"
    simulate: bool | None = None
    schedule: str | None = None
    step_size: float | None = None
    power: float | None = None
    turn_visits: float | None = None
    policy: str | None = None
    k: float | None = None
    k_growth: float | None = None
    temperature: float | None = None
    confidence: float | None = None
    initial_q: float = 0.0
    n: int | None = None
    rule: str | None = None
    lambda_: float | None = None
    trace: str | None = None
    num_planning: int | None = None
    kappa: float | None = None
    threshold: float | None = None
    max_outcomes: int | None = None
    beta: float | None = None

    def __post_init__(self) -> None:
        """Refuse values outside their range and settings that would be ignored."""
        check_choice("algorithm", self.algorithm, ALGORITHMS)
        for name, choices in (("schedule", _SCHEDULES), ("policy", _POLICIES)):
            if getattr(self, name) is not None:
                check_choice(name, getattr(self, name), choices)
        self._refuse_ignored("algorithm", self.algorithm, ALGORITHMS)
        self._refuse_ignored("schedule", self.plan["schedule"], _SCHEDULES)
        self._refuse_ignored("policy", self.plan["policy"], _POLICIES)
        plan = self.plan
        if self.algorithm in _RULES:
            check_choice("rule", plan["rule"], _RULES[self.algorithm])
        if self.algorithm in _TRACES:
            check_choice("trace", plan["trace"], _TRACES[self.algorithm])
        _check_numbers(plan)
        self._check_goes_together(plan)

    def _refuse_ignored(self, what: str, chosen: str, known: dict[str, tuple[str, ...]]) -> None:
        for name in {name for names in known.values() for name in names} - set(known[chosen]):
            if getattr(self, name) is not None:
                having = [one for one, names in known.items() if name in names]
                raise ValueError(
                    f"{name} would be ignored with {what}={chosen!r}; it is for {', '.join(having)}: leave it out, or "
                    f"set {what}"
                )

    def _check_goes_together(self, plan: dict[str, Any]) -> None:
        if self.algorithm == "td-lambda" and plan["policy"] != "random":
            raise ValueError(
                f"td-lambda predicts what the random policy earns, got policy={self.policy!r}; leave policy out, "
                "predict another with neuralq.tabular.td_lambda and under_policy, or choose an algorithm that acts"
            )
        expects = self.algorithm == "expected-sarsa" or plan["rule"] == "expected-sarsa"
        if expects and plan["policy"] == "ucb":
            raise ValueError(
                "expected Sarsa needs the policy's probabilities, and confidence bounds have none; use "
                "policy='epsilon-greedy', 'softmax', 'k-to-the-q' or 'random'"
            )
        if plan["trace"] == "true-online" and plan["schedule"] != "constant":
            raise ValueError("true online TD(λ) is derived for a constant step size; use schedule='constant'")
        if self.algorithm == "prioritized-sweeping" and (self.schedule or self.step_size is not None):
            raise ValueError(
                "prioritized sweeping backs up its whole model of a pair at once and has no step size; leave schedule "
                "and step_size out"
            )

    @property
    def acts(self) -> bool:
        """Whether what is learned says what to do; the values of states do not."""
        return self.algorithm != "td-lambda"

    @property
    def discounts(self) -> bool:
        """Whether discounted values of actions are learned, those that have an exact answer beside them in runs."""
        return self.algorithm not in ("td-lambda", "r-learning")

    @property
    def plan(self) -> dict[str, Any]:
        """Every setting with its value, those that nobody set with their defaults.

        Example:
            >>> TabularSettings(algorithm="dyna").plan["num_planning"]
            10
        """
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        plan = {**_DEFAULTS, **_OF_ALGORITHM.get(self.algorithm, {})}
        named = "search-then-converge" if given["turn_visits"] else "constant" if given["step_size"] else None
        schedule = given["schedule"] or named or plan["schedule"]
        plan |= {"step_size": 0.5 if schedule == "search-then-converge" else 0.1, "schedule": schedule}
        return plan | {name: value for name, value in given.items() if value is not None}


_DEFAULTS: dict[str, Any] = {
    "simulate": None,
    "schedule": "power",
    "power": 0.55,
    "turn_visits": 100.0,
    "policy": "epsilon-greedy",
    "k": 1.5,
    "k_growth": 1e-3,
    "temperature": 1.0,
    "confidence": math.sqrt(2.0),
    "n": 4,
    "rule": None,
    "lambda_": 0.8,
    "trace": None,
    "num_planning": 10,
    "kappa": 0.0,
    "threshold": 1e-4,
    "max_outcomes": 32,
    "beta": 0.01,
}
_OF_ALGORITHM: dict[str, dict[str, Any]] = {
    "double": {"power": 0.5},
    "n-step": {"rule": "q-learning"},
    "q-lambda": {"rule": "watkins", "trace": "replacing"},
    "td-lambda": {"policy": "random", "trace": "replacing", "power": 0.8},
    "r-learning": {"schedule": "constant"},
}


def _check_numbers(plan: dict[str, Any]) -> None:
    for name in ("lambda_", "step_size", "beta"):
        check_fraction(name, plan[name])
    for name in ("step_size", "power", "turn_visits", "k", "temperature", "beta"):
        check_positive(name, plan[name])
    for name in ("n", "max_outcomes"):
        check_whole(name, plan[name])
    check_whole("num_planning", plan["num_planning"], 0)
    for name in ("kappa", "threshold", "k_growth", "confidence"):
        if not (math.isfinite(plan[name]) and plan[name] >= 0):
            raise ValueError(f"{name} must be a finite number of at least 0, got {plan[name]}")
    if not math.isfinite(plan["initial_q"]):
        raise ValueError(f"initial_q must be finite, got {plan['initial_q']}")

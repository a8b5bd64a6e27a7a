"""Runs by gradient TD: what they may be told, QRC(λ) with its published numbers or GQ(λ), and how they are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import torch
from torch import nn

from neuralq.checks import check_choice, check_fraction, check_positive
from neuralq.learners.annealing import falls_over
from neuralq.learners.gradient.correction import HeadCorrection, TangentCorrection
from neuralq.learners.gradient.learner import GradientQLearner
from neuralq.learners.gradient.step import GradientTDSettings
from neuralq.learners.kind import LearnerKind, Parts, Representation, Traits
from neuralq.q import ActionInputQ, ActionOutputQ, DuelingQ, MaskedQ, SeparateQ
from neuralq.q.engine import Engine
from neuralq.rules import epsilon_greedy
from neuralq.types import QFunction

__all__ = ["GRADIENT", "GradientSettings", "gradient_learner", "started_at_zero"]

_DEFAULTS: dict[str, dict[str, Any]] = {
    "qrc": {"lambda_": 0.8, "beta": 1.0, "cut": "watkins"},
    "gq": {"lambda_": 0.0, "beta": 0.0, "target_epsilon": 0.0},
}
_IGNORED = {
    "qrc": {"target_epsilon": "bootstraps from the best action; use method='gq' or leave"},
    "gq": {"cut": "cuts its traces by the importance ratio of its target policy; leave"},
}


@dataclass(frozen=True)
class GradientSettings:
    """How a `GradientQLearner` learns in a run. What is None is filled in with the method's own value.

    Args:
        method: "qrc" (QRC(λ), Elelimy et al. 2025) or "gq" (GQ(λ), Maei & Sutton 2010; with λ = 0 and a greedy target
            policy it is Greedy-GQ, Maei et al. 2010).
        lambda_: λ in [0, 1]; None for 0.8 (qrc), 0 (gq, whose traces grow with 1/μ: λ/μ below 1 keeps them bounded).
        step_size: α of the values.
        step_size_h: α_h of the second function; None for a tenth of the step size, as published for qrc.
        beta: β ≥ 0, how strongly the second function is pulled to 0; None for 1 (qrc), 0 (gq).
        cut: of qrc's traces, "watkins" (at exploring actions) or "naive" (never); None for "watkins".
        target_epsilon: ε of gq's ε-greedy target policy; None for 0, the greedy one.
        normalise_observations: by their running mean and spread; None does so unless they are state indices.
        scale_rewards: by the running spread of their discounted sum.
        anneal: whether both step sizes fall linearly to 0 over the run's steps.

    Raises:
        ValueError: for values outside their range, or that the method has no use for.

    Source: the defaults of QRC(λ) are those of Elelimy et al. 2025 on MinAtar: α = 1e-4, α_h = 1e-5, β = 1, λ = 0.8,
    observations normalised and rewards scaled. Of GQ(λ) on networks no numbers are published.

    Example:
        >>> settings = GradientSettings()
        >>> settings.lambda_, settings.step_size_h, settings.beta
        (0.8, 1e-05, 1.0)
        >>> GradientSettings(method="gq").beta
        0.0
    """

    method: str = "qrc"
    lambda_: float | None = None
    step_size: float = 1e-4
    step_size_h: float | None = None
    beta: float | None = None
    cut: str | None = None
    target_epsilon: float | None = None
    normalise_observations: bool | None = None
    scale_rewards: bool = True
    anneal: bool = False

    def __post_init__(self) -> None:
        """Fill in what is left out; refuse values outside their range and those that would be ignored."""
        check_choice("method", self.method, _DEFAULTS)
        for name, reason in _IGNORED[self.method].items():
            if (value := getattr(self, name)) is not None:
                raise ValueError(f"{name}={value!r} would be ignored: method={self.method!r} {reason} {name} out")
        check_positive("step_size", self.step_size)
        for name, value in {"step_size_h": round(0.1 * self.step_size, 15), **_DEFAULTS[self.method]}.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        check_fraction("target_epsilon", self.target_epsilon or 0.0)
        _ = self.rule  # checks the rest

    @property
    def rule(self) -> GradientTDSettings:
        """The settings of the learner itself."""
        assert self.lambda_ is not None and self.step_size_h is not None and self.beta is not None
        return GradientTDSettings(
            "tdc", self.lambda_, self.step_size, self.step_size_h, self.beta, self.cut or "watkins"
        )


def started_at_zero(q: QFunction) -> QFunction:
    """``q`` itself with all its values 0: a table or linear function at 0, a network with its last layer at 0.

    The layers below keep the weights they were drawn with, so that a network has something to learn from.

    Example:
        >>> from neuralq.q import MLP
        >>> started_at_zero(ActionOutputQ((4,), 2, MLP((8,)), rng=0)).all(torch.ones(4)).tolist()
        [0.0, 0.0]
    """
    inner: Any = q.inner if isinstance(q, MaskedQ) else q
    if isinstance(inner, DuelingQ):
        last: list[nn.Module] = [inner.value.layers[-1], inner.advantage.layers[-1]]
    elif isinstance(inner, ActionInputQ | SeparateQ | ActionOutputQ):
        last = [cast(Any, inner.trunk).layers[-1]]
    else:
        last = [inner]
    for module in last:
        for p in module.parameters():
            p.data = torch.zeros_like(p)
    return q


def gradient_learner(
    engine: Engine,
    settings: GradientSettings,
    head: QFunction,
    reward_scale: float = 1.0,
    total_steps: int | None = None,
) -> GradientQLearner:
    """QRC(λ) with ``head`` for its second function; GQ(λ) finds its own in the tangent space of the values.

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> gradient_learner(TorchEngine(TableQ(2, 2), Loss()), GradientSettings(), TableQ(2, 2)).num_updates
        0
    """
    steps = falls_over(settings, total_steps)
    if settings.method == "qrc":
        head_correction = HeadCorrection(head)
        return GradientQLearner(engine, head_correction, settings.rule, 1, reward_scale, total_steps=steps)
    policy = partial(epsilon_greedy, epsilon=settings.target_epsilon or 0.0)
    return GradientQLearner(engine, TangentCorrection(engine), settings.rule, 1, reward_scale, policy, steps)


def _build(parts: Parts) -> GradientQLearner:
    head = started_at_zero(parts.another())
    return gradient_learner(parts.engine, parts.settings, head, parts.reward_scale, parts.total_steps)


def _on_table(given: Mapping[str, Any]) -> dict[str, Any]:
    """Large steps that fall to 0, with short traces: with long ones some runs never leave the start of CliffWalking."""
    short = {"lambda_": 0.3} if given.get("method", "qrc") == "qrc" else {}
    return {"step_size": 0.1, "anneal": True, **short}


def _check(settings: GradientSettings, representation: Representation) -> None:
    if representation.engine == "compiled":
        raise ValueError(
            "engine='compiled' has no kernels for gradient TD, whose steps need three gradients; use engine='auto'"
        )


GRADIENT = LearnerKind(
    name="gradient",
    title="gradient TD: QRC(λ), or GQ(λ)",
    source="Maei & Sutton 2010; Elelimy et al. 2025",
    settings=GradientSettings,
    build=_build,
    experience="steps",
    traits=lambda s: Traits(s.step_size, lambda_=s.rule.lambda_),
    normalises=lambda s: (s.normalise_observations, s.scale_rewards),
    check=_check,
    place=5,
    step_sizes=("step_size", "step_size_h"),
    on_table=_on_table,
    space={
        "step_size": {"from": 1e-5, "to": 3e-3, "scale": "log"},
        "step_size_h": {"from": 1e-6, "to": 1e-3, "scale": "log"},
        "beta": {"from": 0.1, "to": 3.0, "scale": "log"},
        "lambda_": {"from": 0.0, "to": 0.95},
        "anneal": [True, False],
    },
)

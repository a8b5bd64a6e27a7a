"""Streaming deep reinforcement learning: every step is learned from once, when it happens, and then forgotten.

No replay, no batches, no target network. What makes that stable (Elsayed, Vasan & Mahmood 2024) is that each step's
size is bounded by what it would do to the prediction (`neuralq.rules.streaming`), together with normalised layers
without a scale of their own, a sparse start, and observations and rewards of unit spread (`Interaction`'s
normalisation). The trace is that of `neuralq.rules.traces`, and where it is cut has two answers:

* "watkins": before the gradient of an exploring action is added. What came before did not lead to it by the greedy
  policy, but the action itself is followed greedily and keeps its place. With frozen weights the sum of increments is
  exactly that of the forward view (Watkins 1989);
* "published": after the update with an exploring action, as in Stream Q(λ)'s program. The error of the exploring step
  still reaches everything before it, and the exploring action gets nothing of what follows it.

A state value is a representation with one action: then the maximum is V(s'), the only action is greedy, nothing is cut
and `StreamingLearner` is streaming TD(λ).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq import rules
from neuralq.checks import check_choice, check_discount, check_fraction, check_positive
from neuralq.learners import state
from neuralq.learners.annealing import falls_over
from neuralq.learners.kind import LearnerKind, Parts, Traits
from neuralq.learners.learner import Update
from neuralq.learners.traces import streaming_kernels as kernels
from neuralq.q.engine import Engine
from neuralq.q.single_row import SingleRowNetwork, runs_single_row
from neuralq.rules import streaming as bounds
from neuralq.types import Transition

__all__ = ["STREAMING", "StreamingLearner", "StreamingSettings"]

_SQUARES_CHECKED_EVERY = 64  # steps; the tensor operations look at each, the kernel leaves that to this file
_BOUNDS = ("obgd", "adaptive-obgd", "intentional")


@dataclass(frozen=True)
class StreamingSettings:
    """How a `StreamingLearner` learns. What is None takes its published value.

    Args:
        lambda_: λ in [0, 1].
        bound: "obgd" or "adaptive-obgd" (Stream Q(λ); Elsayed, Vasan & Mahmood 2024), or "intentional" (Intentional
            Q(λ), 2026).
        step_size: α of ObGD (1), or the fraction η of the error that an intentional step is to remove (0.25).
        kappa: κ of both ObGD bounds (2): at most 1/κ of the error is removed.
        beta2: β₂ of the adaptive and the intentional step (0.999).
        cut: "watkins" (exact) or "published" (as Stream Q(λ)'s program does).
        normalise_observations: by their running mean and spread; None does so unless they are state indices.
        scale_rewards: by the running spread of their discounted sum.
        anneal: whether the step size falls linearly to 0 over the run's steps.

    Raises:
        ValueError: for values outside their range, or that the bound has no use for.

    Example:
        >>> settings = StreamingSettings(bound="intentional")
        >>> settings.eta_or_alpha, settings.second_moment_decay
        (0.25, 0.999)
    """

    lambda_: float = 0.8
    bound: str = "obgd"
    step_size: float | None = None
    kappa: float | None = None
    beta2: float | None = None
    cut: str = "watkins"
    normalise_observations: bool | None = None
    scale_rewards: bool = True
    anneal: bool = False

    def __post_init__(self) -> None:
        """Refuse values outside their range and those that would be ignored."""
        check_fraction("lambda_", self.lambda_, "for Monte Carlo use lambda_=1")
        check_choice("bound", self.bound, _BOUNDS)
        check_choice("cut", self.cut, ("watkins", "published"))
        check_positive("step_size", self.eta_or_alpha)
        check_positive("kappa", self.overshoot_bound)
        check_fraction("beta2", self.second_moment_decay)
        if not 0 < self.second_moment_decay < 1:
            raise ValueError(f"beta2 must lie strictly between 0 and 1, got {self.beta2}")
        if self.kappa is not None and self.bound == "intentional":
            raise ValueError("kappa would be ignored with bound='intentional'; its step_size is the fraction removed")
        if self.beta2 is not None and self.bound == "obgd":
            raise ValueError("beta2 would be ignored with bound='obgd'; use bound='adaptive-obgd' or leave it out")

    @property
    def eta_or_alpha(self) -> float:
        """η of the intentional step, α of the others."""
        return (0.25 if self.bound == "intentional" else 1.0) if self.step_size is None else self.step_size

    @property
    def overshoot_bound(self) -> float:
        """κ."""
        return 2.0 if self.kappa is None else self.kappa

    @property
    def second_moment_decay(self) -> float:
        """β₂."""
        return 0.999 if self.beta2 is None else self.beta2


class _Steps:
    """The trace, what bounds the step along it, and the step; on any device, or compiled on a CPU."""

    def __init__(self, engine: Engine, settings: StreamingSettings, discount: float) -> None:
        values = engine.flat.values
        self.engine, self.settings = engine, settings
        self.gamma_lambda = discount * settings.lambda_
        self.z = torch.zeros_like(values)
        self.v = torch.zeros_like(values) if settings.bound != "obgd" else values.new_zeros(0)
        self.means = torch.tensor([0.0, 1.0], dtype=torch.float64, device=values.device)
        self.decay = values.new_zeros(())
        if values.device.type == "cpu":  # the same memory, as the kernels see it
            self._memory: Any = tuple(x.numpy() for x in (values, self.z, self.v, engine.flat.grad, self.means))
            self._decay: Any = self.decay.numpy()
        alpha, kappa, beta2 = settings.eta_or_alpha, settings.overshoot_bound, settings.second_moment_decay
        self._alpha, self._rest = alpha, (kappa, beta2, 1.0 - self.gamma_lambda)

    def advance(self, delta: Tensor, t: int, share: float = 1.0) -> None:
        """Decay the trace, add ``flat.grad`` and move the weights: step ``t``, from 1, by a share of the step size."""
        settings = self.settings
        alpha, kappa, beta2 = share * settings.eta_or_alpha, settings.overshoot_bound, settings.second_moment_decay
        grad = self.engine.flat.grad
        self.z.copy_(rules.accumulate(self.z, grad, self.decay))
        if settings.bound == "obgd":
            step = bounds.obgd(self.z, delta, alpha, kappa)
        elif settings.bound == "adaptive-obgd":
            step, v = bounds.adaptive_obgd(self.z, delta, self.v, t, alpha, kappa, beta2)
            self.v.copy_(v)
        else:
            step, v, means = bounds.intentional(
                self.z, grad, delta, self.v, self.means, t, self.gamma_lambda, alpha, beta2
            )
            self.v.copy_(v)
            self.means.copy_(means)
        self.engine.flat.values.add_(step)

    def advance_compiled(self, delta: float, t: int, share: float = 1.0) -> None:
        """As `advance`, in two passes over the memory."""
        if self.settings.bound == "intentional" and self.gamma_lambda == 1:  # a mean that the kernel does not keep
            self.advance(torch.tensor(delta, dtype=self.z.dtype), t, share)
            return
        step = (_BOUNDS.index(self.settings.bound), share * self._alpha, *self._rest)
        arguments: Any = (*self._memory, float(self._decay), delta, *step, t)
        kernels.advance(*arguments)
        if t % _SQUARES_CHECKED_EVERY == 0 and self.settings.bound != "obgd" and not kernels.is_finite(self._memory[2]):
            self.engine.flat.values.fill_(math.nan)

    def clear(self) -> None:
        self.z.zero_()
        self.decay.zero_()

    def state_dict(self) -> dict[str, Tensor]:
        state = {"z": self.z, "decay": self.decay, "means": self.means}
        return state if self.settings.bound == "obgd" else {**state, "v": self.v}


class StreamingLearner:
    """Q(λ) on one stream, one step at a time, with a bounded step; TD(λ) where there is one action.

    Args:
        engine: values and gradients of the representation.
        settings: how to learn.
        discount: γ, which the intentional step needs for its running mean; bootstraps use each transition's own.
        reward_scale: rewards are multiplied by it, so values are too.
        kind: "torch" computes on any device with tensor operations; "auto" and "compiled" on a CPU with compiled
            kernels, altogether for `ActionOutputQ`, elsewhere for the step along the trace.
        total_steps: environment steps over which the step size falls, where it does.

    Raises:
        ValueError: for "compiled" on another device, and a step size that falls over no number of steps.

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> learner = StreamingLearner(TorchEngine(TableQ(3, 1), Loss()), StreamingSettings(lambda_=0.5), discount=1.0)
        >>> def step(s, r, s_next, last):
        ...     row = torch.tensor
        ...     discount = 0.0 if last else 1.0
        ...     return Transition(*map(row, ([s], [0], [1.0], [r], [discount], [s_next], [last])))
        >>> _ = learner.update(step(0, 0.0, 1, False))
        >>> _ = learner.update(step(1, 12.0, 2, True))  # ‖z‖₁ = 1.5, M = 2 · 12 · 1.5 = 36, 12/36 = 1/3
        >>> [round(q, 3) for q in learner.engine.all(torch.arange(3))[:, 0].tolist()]
        [0.167, 0.333, 0.0]
    """

    def __init__(
        self,
        engine: Engine,
        settings: StreamingSettings,
        discount: float = 0.99,
        reward_scale: float = 1.0,
        kind: str = "auto",
        total_steps: int | None = None,
    ) -> None:
        check_discount("discount", discount)
        check_choice("kind", kind, ("auto", "torch", "compiled"))
        on_cpu = engine.flat.values.device.type == "cpu"
        if kind == "compiled" and not on_cpu:
            raise ValueError(f"kernels are compiled for a CPU, not for {engine.flat.values.device}; use kind='torch'")
        self.engine = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self.num_updates = 0
        self._steps = _Steps(engine, settings, discount)
        self._falls_over = falls_over(settings, total_steps)
        self._parts = {"parameters": engine.flat, "steps": self._steps}
        self._compiled = kind != "torch" and on_cpu
        self._network = SingleRowNetwork(engine) if self._compiled and runs_single_row(engine.q) else None

    @property
    def _share(self) -> float:
        """Of the step size, at the next update; each is a step."""
        return 1.0 if self._falls_over is None else max(0.0, 1.0 - self.num_updates / self._falls_over)

    @property
    def engine_name(self) -> str:
        """What computes: "compiled" kernels altogether, "torch", or "compiled and torch", each a part."""
        if self._network is not None:
            return "compiled"
        return "compiled and torch" if self._compiled else "torch"

    def values(self, s: Tensor) -> Tensor:
        """Action values ``[N, *obs] -> [N, A]`` for acting, the quick way where there is one."""
        return self.engine.all(s) if self._network is None else self._network.values(s)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """Learn from one step of the stream, ``[1]``; nothing if its weight is 0: it was not taken.

        Raises:
            ValueError: for more than one row: steps of parallel streams have no order in which to be learned from.
        """
        if transition.a_tm1.shape != (1,):
            raise ValueError(
                f"a streaming learner takes one step at a time, rows of shape (1,), got {tuple(transition.a_tm1.shape)}"
            )
        if weight is not None and float(weight[0]) == 0:
            nothing = self.engine.flat.values.new_zeros(1)
            return Update(nothing, nothing.clone())
        seen = self._update_compiled(transition) if self._compiled else self._update(transition)
        self.num_updates += 1
        return seen

    def _seen(self, transition: Transition) -> tuple[Tensor, Tensor, Tensor]:
        """Q(s, a) ``[]``, the one-step target ``[]`` and whether a was greedy ``[]``; leaves the gradient behind."""
        dtype = self.engine.flat.values.dtype
        r_t = transition.r_t.to(dtype) * self.reward_scale
        target = rules.q_learning(r_t, transition.discount_t.to(dtype), self.engine.all(transition.s_t))[0]
        value = self.engine.value_gradient(transition.s_tm1[0], transition.a_tm1[0])
        return value, target, rules.is_greedy(self.engine.all(transition.s_tm1), transition.a_tm1)[0]

    def _update(self, transition: Transition) -> Update:
        """One step as tensor operations; nothing waits for the device."""
        steps, exact = self._steps, self.settings.cut == "watkins"
        value, target, greedy = self._seen(transition)
        if exact:
            steps.z.copy_(rules.cut(steps.z, ~greedy))
        delta = target - value
        steps.advance(delta, self.num_updates + 1, self._share)
        last = transition.last_t[0]
        steps.z.copy_(rules.cut(steps.z, last if exact else last | ~greedy))
        steps.decay.copy_(transition.discount_t[0] * self.settings.lambda_)
        return Update(delta[None], target[None])

    def _update_compiled(self, transition: Transition) -> Update:
        """The same with compiled kernels."""
        steps, exact = self._steps, self.settings.cut == "watkins"
        discount_t = transition.discount_t.item()
        if self._network is not None:
            r_t = transition.r_t.item() * self.reward_scale
            value, target, greedy = self._network.learn(transition, r_t, discount_t)
        else:
            seen = self._seen(transition)
            value, target, greedy = float(seen[0]), float(seen[1]), bool(seen[2])
        if exact and not greedy:
            steps.z.zero_()
        delta = target - value
        steps.advance_compiled(delta, self.num_updates + 1, self._share)
        if transition.last_t.item() or not (exact or greedy):
            steps.z.zero_()
        steps.decay.fill_(discount_t * self.settings.lambda_)
        seen_both = torch.from_numpy(np.array([delta, target]))
        return Update(seen_both[:1], seen_both[1:])

    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict


def _build(parts: Parts) -> StreamingLearner:
    kernels = "auto" if parts.kernels == "compiled" else parts.kernels  # on other devices torch stands in
    return StreamingLearner(
        parts.engine, parts.settings, parts.discount, parts.reward_scale, kernels, parts.total_steps
    )


STREAMING = LearnerKind(
    name="streaming",
    title="Q(λ) on one stream, each step bounded by what it would do (Stream Q(λ))",
    source="Elsayed, Vasan & Mahmood 2024",
    settings=StreamingSettings,
    build=_build,
    experience="steps",
    traits=lambda s: Traits(s.eta_or_alpha, plain_steps=False, lambda_=s.lambda_),
    normalises=lambda s: (s.normalise_observations, s.scale_rewards),
    place=4,
    step_sizes=("step_size",),
    on_table=lambda given: {"step_size": 0.1, "lambda_": 0.5, "anneal": True},
    space={
        "lambda_": {"from": 0.3, "to": 0.98},
        "bound": ["obgd", "adaptive-obgd"],
        "step_size": {"from": 0.1, "to": 3.0, "scale": "log"},
        "kappa": {"from": 1.1, "to": 5.0, "scale": "log"},
        "anneal": [True, False],
    },
)

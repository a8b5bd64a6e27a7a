"""TD(λ) in the backward view: one step at a time with eligibility traces, on any representation.

The trace z remembers which weights the recent predictions came from; each TD error moves them all. Three facts decide
whether that is right, and each is an index: the trace decays by the discount *into* s_tm1 (that of the previous
transition), an exploring action cuts it *before* its own gradient is added (Watkins, 1989), and it is dropped *after*
the last step of a stream. With values held fixed over an episode the increments add up to those of the forward view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuralq import rules
from neuralq.checks import check_choice, check_fraction, check_positive
from neuralq.learners import state
from neuralq.learners.annealing import LinearFall, falls_over
from neuralq.learners.kind import LearnerKind, Traits
from neuralq.learners.learner import Update
from neuralq.learners.traces.memory import Traces
from neuralq.q.engine import Engine
from neuralq.q.masked import MaskedQ
from neuralq.q.table_and_linear import LinearQ, TableQ
from neuralq.types import Transition

__all__ = ["ONLINE", "OnlineLearner", "OnlineSettings", "PredictionLearner"]


@dataclass(frozen=True)
class OnlineSettings:
    """How an `OnlineLearner` or `PredictionLearner` learns.

    Args:
        lambda_: λ in [0, 1].
        step_size: α of the plain gradient step θ += α δ z.
        trace: "accumulating", "replacing" (Singh & Sutton, 1996), or "dutch" with the true online increment (van Seijen
            & Sutton, 2014), which is defined for tables and linear features only.
        cut: "watkins" drops the trace at exploring actions, "naive" never does. Control only.
        anneal: whether the step size falls linearly to 0 over the run's steps. Control only.
    """

    lambda_: float = 0.8
    step_size: float = 1e-3
    trace: str = "accumulating"
    cut: str = "watkins"
    anneal: bool = False

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fraction("lambda_", self.lambda_, "for Monte Carlo use lambda_=1")
        check_positive("step_size", self.step_size)
        check_choice("trace", self.trace, ("accumulating", "replacing", "dutch"))
        check_choice("cut", self.cut, ("watkins", "naive"))
        if self.trace == "dutch" and self.cut == "naive":
            raise ValueError("the true online increment is not derived for uncut Q(λ); leave cut='watkins'")
        if self.trace == "dutch" and self.anneal:
            raise ValueError("dutch traces are derived for a constant step size; leave anneal out")


class _Core:
    """What control and prediction share: a trace for every environment and output, and the step along it."""

    def __init__(self, engine: Engine, settings: OnlineSettings, num_envs: int, num_outputs: int) -> None:
        inner = engine.q.inner if isinstance(engine.q, MaskedQ) else engine.q
        if settings.trace == "dutch" and not isinstance(inner, TableQ | LinearQ):
            raise ValueError(
                "dutch traces and the true online increment hold for tables and linear features only, got "
                f"{type(inner).__name__}; use trace='accumulating'"
            )
        self.engine, self.settings = engine, settings
        values = engine.flat.values
        shapes = {"z": (num_outputs, values.numel()), "v_old": (num_outputs,)}  # v_old: V before the last update
        self.traces = Traces(settings.lambda_, num_envs, values, shapes)
        # The same memory, one row for each environment's output.
        self._z, self._v_old = self.traces.z["z"].view(-1, values.numel()), self.traces.z["v_old"].view(-1)

    def increment(
        self,
        transition: Transition,
        discount_t: Tensor,
        outputs: Tensor,
        targets: Tensor,
        v_t: Tensor,
        explored: Tensor | None = None,
        rho_tm1: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """What to add to the weights ``[d]``, and the errors of ``outputs``, all ``[N·k]``; the traces move on."""
        total, errors = torch.zeros_like(self.engine.flat.values), torch.zeros_like(targets)
        k = len(targets) // len(discount_t)
        for j in range(len(targets)):
            i = j // k
            if weight is not None and weight[i] == 0:
                continue
            z = self._z[j]
            if explored is not None:
                z.masked_fill_(explored[i], 0.0)
            v_tm1 = self.engine.value_gradient(transition.s_tm1[i], outputs[j])
            grad = self.engine.flat.grad
            trace = self._grown(z, grad, self.traces.decay[i])
            if rho_tm1 is not None:
                # The ratio multiplies the whole trace, once: z = ρ(γλz + ∇V); the increment uses δ unweighted.
                trace = rho_tm1[i] * trace
            z.copy_(trace)
            delta = targets[j] - v_tm1
            errors[j] = delta
            if self.settings.trace == "dutch":
                alpha = self.settings.step_size
                total += rules.true_online_increment(trace, grad, delta, v_tm1, self._v_old[j], alpha)
            else:
                total += self.settings.step_size * delta * trace
            self._v_old[j] = v_t[j]
        self.traces.close(discount_t, transition.last_t, None if weight is None else weight != 0)
        return total, errors

    def _grown(self, z: Tensor, grad: Tensor, decay: Tensor) -> Tensor:
        """The trace ``[d]`` decayed, with the gradient."""
        if self.settings.trace == "dutch":
            return rules.dutch(z, grad, decay, self.settings.step_size)
        return (rules.accumulate if self.settings.trace == "accumulating" else rules.replace)(z, grad, decay)


class OnlineLearner:
    """Q(λ) with eligibility traces: Watkins' exact cut, or naive.

    Environments learn side by side: gradients are taken at the same weights and the increments are summed.

    Args:
        engine: values and gradients of the representation.
        settings: how to learn.
        num_envs: parallel environments N; row i of every transition is environment i.
        reward_scale: rewards are multiplied by it, so values are too.
        total_steps: environment steps over which the step size falls, where it does.

    Raises:
        ValueError: for dutch traces on a network, and a step size that falls over no number of steps.

    Example:
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> settings = OnlineSettings(lambda_=0.5, step_size=1.0)
        >>> learner = OnlineLearner(TorchEngine(TableQ(3, 1), Loss()), settings)
        >>> def step(s, r, s_next, last):
        ...     row = torch.tensor
        ...     discount = 0.0 if last else 1.0
        ...     return Transition(*map(row, ([s], [0], [1.0], [r], [discount], [s_next], [last])))
        >>> _ = learner.update(step(0, 0.0, 1, False))
        >>> _ = learner.update(step(1, 8.0, 2, True))
        >>> learner.engine.all(torch.arange(3))[:, 0].tolist()
        [4.0, 8.0, 0.0]
    """

    def __init__(
        self,
        engine: Engine,
        settings: OnlineSettings,
        num_envs: int = 1,
        reward_scale: float = 1.0,
        total_steps: int | None = None,
    ) -> None:
        self.engine = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self.num_updates = 0
        self._core = _Core(engine, settings, num_envs, 1)
        self._parts: dict[str, Any] = {"parameters": engine.flat, "traces": self._core.traces}
        steps = falls_over(settings, total_steps)
        self._fall = None if steps is None else LinearFall(steps, engine.flat.values)
        if self._fall is not None:
            self._parts["fall"] = self._fall

    def increment(self, transition: Transition, weight: Tensor | None = None) -> tuple[Tensor, Update]:
        """What `update` would add to the weights ``[d]``; the traces move on, the weights do not."""
        dtype = self.engine.flat.values.dtype
        q_t = self.engine.all(transition.s_t)
        r_t, discount_t = transition.r_t.to(dtype) * self.reward_scale, transition.discount_t.to(dtype)
        targets = rules.q_learning(r_t, discount_t, q_t)
        explored = None
        if self.settings.cut == "watkins":
            explored = ~rules.is_greedy(self.engine.all(transition.s_tm1), transition.a_tm1)
        rows = transition.a_tm1, targets, q_t.amax(-1)
        total, errors = self._core.increment(transition, discount_t, *rows, explored, weight=weight)
        return total, Update(errors, targets)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """Learn from one step of every environment, ``[N]``; environments of weight 0 did not move."""
        total, seen = self.increment(transition, weight)
        if self._fall is not None:
            total = total * self._fall.advance(torch.ones_like(seen.errors) if weight is None else weight)
        self.engine.flat.values.add_(total)
        self.num_updates += 1
        return seen

    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict


class PredictionLearner:
    """TD(λ) prediction of one or several values at once, on or off policy.

    The representation is a `QFunction` whose "actions" are the k outputs: ``all(s)`` is ``[*n, k]``.

    Args:
        engine: values and gradients of the representation.
        settings: how to learn; ``cut`` and ``anneal`` have no meaning for prediction and must stay at their defaults.
        num_envs: parallel streams N; row i of every transition is environment i.

    Raises:
        ValueError: for dutch traces on a network, or a ``cut`` or ``anneal`` that is not the default.

    Example:
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> learner = PredictionLearner(TorchEngine(TableQ(2, 2), Loss()), OnlineSettings(step_size=0.5))
        >>> row = torch.tensor
        >>> step = Transition(row([0]), row([0]), row([1.0]), row([[1.0, 4.0]]), row([0.0]), row([1]), row([True]))
        >>> _ = learner.update(step)
        >>> learner.engine.all(torch.tensor(0)).tolist()
        [0.5, 2.0]
    """

    def __init__(self, engine: Engine, settings: OnlineSettings, num_envs: int = 1) -> None:
        if settings.cut != "watkins":
            raise ValueError("prediction has no exploring actions to cut at; leave cut at its default")
        if settings.anneal:
            raise ValueError("prediction has no budget over which its step size could fall; leave anneal out")
        self.engine = engine
        self.settings = settings
        self.num_updates = 0
        self._core = _Core(engine, settings, num_envs, engine.q.num_actions)
        self._parts = {"parameters": engine.flat, "traces": self._core.traces}

    def increment(self, transition: Transition, rho_tm1: Tensor | None = None) -> tuple[Tensor, Update]:
        """What `update` would add to the weights ``[d]``; the traces move on, the weights do not."""
        v_t = self.engine.all(transition.s_t)
        r_t = transition.r_t.to(v_t.dtype).reshape(len(v_t), -1).expand_as(v_t)
        discount_t = transition.discount_t.to(v_t.dtype)
        targets = rules.one_step(r_t, discount_t[:, None].expand_as(v_t), v_t)
        outputs = torch.arange(v_t.shape[1], device=v_t.device).expand_as(v_t)
        rows = outputs.reshape(-1), targets.reshape(-1), v_t.reshape(-1)
        total, errors = self._core.increment(transition, discount_t, *rows, rho_tm1=rho_tm1)
        return total, Update(errors.view_as(targets), targets)

    def update(self, transition: Transition, rho_tm1: Tensor | None = None) -> Update:
        """Learn from one step of every environment.

        Args:
            transition: rows ``[N]``; ``r_t`` is ``[N]``, or ``[N, k]`` for k different rewards.
            rho_tm1: importance ratio π/μ of the action taken, ``[N]``; None for on-policy learning.

        Raises:
            ValueError: for ratios with dutch traces, whose increment is derived for on-policy learning.
        """
        if rho_tm1 is not None and self.settings.trace == "dutch":
            raise ValueError("the true online increment is on-policy; use accumulating traces with importance ratios")
        total, seen = self.increment(transition, rho_tm1)
        self.engine.flat.values.add_(total)
        self.num_updates += 1
        return seen

    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict


ONLINE = LearnerKind(
    name="online",
    title="Q(λ) with eligibility traces, step by step",
    source="Watkins 1989; van Seijen & Sutton 2014",
    settings=OnlineSettings,
    build=lambda parts: OnlineLearner(parts.engine, parts.settings, 1, parts.reward_scale, parts.total_steps),
    experience="steps",
    traits=lambda s: Traits(s.step_size, lambda_=s.lambda_),
    place=3,
    step_sizes=("step_size",),
    on_table=lambda given: {"step_size": 0.1, "lambda_": 0.5, "anneal": given.get("trace") != "dutch"},
    space={
        "step_size": {"from": 1e-4, "to": 1e-2, "scale": "log"},
        "lambda_": {"from": 0.0, "to": 0.95},
        "cut": ["watkins", "naive"],
        "anneal": [True, False],
    },
)

"""TD(λ) in the backward view: one step at a time with eligibility traces, on any representation.

The trace z remembers which weights the recent predictions came from; each TD error moves them all. Three facts decide
whether that is right, and each is an index: the trace decays by the discount *into* s_tm1 (that of the previous
transition), an exploring action cuts it *before* its own gradient is added (Watkins, 1989), and it is dropped *after*
the last step of a stream. With values held fixed over an episode the increments add up to those of the forward view.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuralq import rules
from neuralq.checks import check_choice, check_fraction, check_positive
from neuralq.learners.kind import LearnerKind, Traits
from neuralq.learners.learner import Update
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
    """

    lambda_: float = 0.8
    step_size: float = 1e-3
    trace: str = "accumulating"
    cut: str = "watkins"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fraction("lambda_", self.lambda_, "for Monte Carlo use lambda_=1")
        check_positive("step_size", self.step_size)
        check_choice("trace", self.trace, ("accumulating", "replacing", "dutch"))
        check_choice("cut", self.cut, ("watkins", "naive"))
        if self.trace == "dutch" and self.cut == "naive":
            raise ValueError("the true online increment is not derived for uncut Q(λ); leave cut='watkins'")


class _Traces:
    """Traces ``[N, k, d]`` with the decay that is due and the value before the last update, per environment."""

    def __init__(self, engine: Engine, settings: OnlineSettings, num_envs: int, num_outputs: int) -> None:
        inner = engine.q.inner if isinstance(engine.q, MaskedQ) else engine.q
        if settings.trace == "dutch" and not isinstance(inner, TableQ | LinearQ):
            raise ValueError(
                "dutch traces and the true online increment hold for tables and linear features only, got "
                f"{type(inner).__name__}; use trace='accumulating'"
            )
        self.settings = settings
        values = engine.flat.values
        self.z = values.new_zeros(num_envs, num_outputs, values.numel())
        self.decay = values.new_zeros(num_envs)
        self.v_old = values.new_zeros(num_envs, num_outputs)

    def grow(self, env_index: int, output: int, grad: Tensor) -> Tensor:
        """Decay and add the gradient; returns the trace ``[d]``."""
        z, decay = self.z[env_index, output], self.decay[env_index]
        if self.settings.trace == "accumulating":
            z = rules.accumulate(z, grad, decay)
        elif self.settings.trace == "replacing":
            z = rules.replace(z, grad, decay)
        else:
            z = rules.dutch(z, grad, decay, self.settings.step_size)
        self.z[env_index, output] = z
        return z

    def increment(self, env_index: int, output: int, z: Tensor, grad: Tensor, delta: Tensor, v_tm1: Tensor) -> Tensor:
        """What this environment and output add to the weights, ``[d]``."""
        if self.settings.trace != "dutch":
            return self.settings.step_size * delta * z
        v_old = self.v_old[env_index, output]
        return rules.true_online_increment(z, grad, delta, v_tm1, v_old, self.settings.step_size)

    def close(self, env_index: int, discount_t: Tensor, v_t: Tensor, last: Tensor) -> None:
        """Remember the discount into the next state; drop everything after the last step of a stream.

        ``last`` is not asked whether it is true: an accelerator would have to be waited for.
        """
        self.decay[env_index] = discount_t * self.settings.lambda_
        self.v_old[env_index] = v_t
        for state in (self.z, self.decay, self.v_old):
            state[env_index].masked_fill_(last, 0.0)

    def clear(self) -> None:
        for state in (self.z, self.decay, self.v_old):
            state.zero_()

    def state_dict(self) -> dict[str, Any]:
        return {"z": self.z, "decay": self.decay, "v_old": self.v_old}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for mine, saved in ((self.z, state["z"]), (self.decay, state["decay"]), (self.v_old, state["v_old"])):
            mine.copy_(torch.as_tensor(saved))


class _TraceLearner:
    """What control and prediction share: the step along the traces, and where the state lives."""

    def __init__(self, engine: Engine, traces: _Traces) -> None:
        self.engine = engine
        self.traces = traces
        self.num_updates = 0

    def apply(self, increment: Tensor) -> None:
        self.engine.flat.values.add_(increment)
        self.num_updates += 1

    def state_dict(self) -> dict[str, Any]:
        return {
            "num_updates": self.num_updates,
            "parameters": self.engine.flat.values,
            "traces": self.traces.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.num_updates = int(state["num_updates"])
        self.engine.flat.load(torch.as_tensor(state["parameters"]))
        self.traces.load_state_dict(state["traces"])


class OnlineLearner:
    """Q(λ) with eligibility traces: Watkins' exact cut, or naive.

    Environments learn side by side: gradients are taken at the same weights and the increments are summed.

    Args:
        engine: values and gradients of the representation.
        settings: how to learn.
        num_envs: parallel environments N; row i of every transition is environment i.
        reward_scale: rewards are multiplied by it, so values are too.

    Raises:
        ValueError: for dutch traces on a network.

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

    def __init__(self, engine: Engine, settings: OnlineSettings, num_envs: int = 1, reward_scale: float = 1.0) -> None:
        self.engine = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self._core = _TraceLearner(engine, _Traces(engine, settings, num_envs, 1))

    @property
    def num_updates(self) -> int:
        """Updates so far."""
        return self._core.num_updates

    def increment(self, transition: Transition, weight: Tensor | None = None) -> tuple[Tensor, Update]:
        """What `update` would add to the weights ``[d]``; the traces move on, the weights do not."""
        traces, dtype = self._core.traces, self.engine.flat.values.dtype
        q_t = self.engine.all(transition.s_t)
        r_t = transition.r_t.to(dtype) * self.reward_scale
        discount_t = transition.discount_t.to(dtype)
        targets = rules.q_learning(r_t, discount_t, q_t)
        explored = ~rules.is_greedy(self.engine.all(transition.s_tm1), transition.a_tm1)
        total = torch.zeros_like(self.engine.flat.values)
        errors = torch.zeros_like(targets)
        for env_index in range(len(targets)):
            if weight is not None and weight[env_index] == 0:
                continue
            if self.settings.cut == "watkins":
                traces.z[env_index].masked_fill_(explored[env_index], 0.0)
            q = self.engine.value_gradient(transition.s_tm1[env_index], transition.a_tm1[env_index])
            grad = self.engine.flat.grad
            z = traces.grow(env_index, 0, grad)
            errors[env_index] = targets[env_index] - q
            total += traces.increment(env_index, 0, z, grad, errors[env_index], q)
            traces.close(env_index, discount_t[env_index], q_t[env_index].amax(), transition.last_t[env_index])
        return total, Update(errors, targets)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """Learn from one step of every environment, ``[N]``; environments of weight 0 did not move."""
        total, seen = self.increment(transition, weight)
        self._core.apply(total)
        return seen

    def begin_streams(self) -> None:
        """Drop every trace."""
        self._core.traces.clear()

    def state_dict(self) -> dict[str, Any]:
        """Parameters, traces and counters."""
        return self._core.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self._core.load_state_dict(state)


class PredictionLearner:
    """TD(λ) prediction of one or several values at once, on or off policy.

    The representation is a `QFunction` whose "actions" are the k outputs: ``all(s)`` is ``[*n, k]``.

    Args:
        engine: values and gradients of the representation.
        settings: how to learn; ``cut`` has no meaning for prediction and must stay at its default.
        num_envs: parallel streams N; row i of every transition is environment i.

    Raises:
        ValueError: for dutch traces on a network, or a ``cut`` that is not the default.

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
        self.engine = engine
        self.settings = settings
        self.num_outputs = engine.q.num_actions
        self._core = _TraceLearner(engine, _Traces(engine, settings, num_envs, self.num_outputs))

    @property
    def num_updates(self) -> int:
        """Updates so far."""
        return self._core.num_updates

    def increment(self, transition: Transition, rho_tm1: Tensor | None = None) -> tuple[Tensor, Update]:
        """What `update` would add to the weights ``[d]``; the traces move on, the weights do not."""
        traces, dtype = self._core.traces, self.engine.flat.values.dtype
        v_t = self.engine.all(transition.s_t)
        r_t = transition.r_t.to(dtype).reshape(len(v_t), -1).expand_as(v_t)
        discount_t = transition.discount_t.to(dtype)
        targets = rules.one_step(r_t, discount_t[:, None].expand_as(v_t), v_t)
        total = torch.zeros_like(self.engine.flat.values)
        errors = torch.zeros_like(targets)
        for env_index in range(len(targets)):
            for output in range(self.num_outputs):
                v = self.engine.value_gradient(transition.s_tm1[env_index], torch.tensor(output, device=v_t.device))
                grad = self.engine.flat.grad
                z = traces.grow(env_index, output, grad)
                if rho_tm1 is not None:
                    # The ratio multiplies the whole trace, once: z = ρ(γλz + ∇V); the increment uses δ unweighted.
                    z = rho_tm1[env_index] * z
                    traces.z[env_index, output] = z
                errors[env_index, output] = targets[env_index, output] - v
                total += traces.increment(env_index, output, z, grad, errors[env_index, output], v)
            traces.close(env_index, discount_t[env_index], v_t[env_index], transition.last_t[env_index])
        return total, Update(errors, targets)

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
        self._core.apply(total)
        return seen

    def begin_streams(self) -> None:
        """Drop every trace."""
        self._core.traces.clear()

    def state_dict(self) -> dict[str, Any]:
        """Parameters, traces and counters."""
        return self._core.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self._core.load_state_dict(state)


ONLINE = LearnerKind(
    name="online",
    title="Q(λ) with eligibility traces, step by step",
    source="Watkins 1989; van Seijen & Sutton 2014",
    settings=OnlineSettings,
    build=lambda parts: OnlineLearner(parts.engine, parts.settings, 1, parts.reward_scale),
    experience="steps",
    traits=lambda s: Traits(s.step_size, lambda_=s.lambda_),
    place=3,
)

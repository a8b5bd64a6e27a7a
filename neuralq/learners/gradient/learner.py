"""Gradient-TD learning, on any representation: GTD2, TDC, TDRC, GQ(λ), Greedy-GQ and QRC(λ), one step at a time.

Semi-gradient TD follows the gradient of no function, so off-policy it may diverge; these methods descend the squared
projected Bellman error with the help of a second function h that estimates the expected TD error. Both updates are
written out in `neuralq.learners.gradient.step`, the choices of h in `neuralq.learners.gradient.correction`.

| method | `GradientTDSettings` | h |
|---|---|---|
| GTD2(λ) | method="gtd2", beta=0 | `TangentCorrection` |
| TDC(λ) = GTD(λ) | beta=0 | `TangentCorrection` |
| TDRC(λ) | beta=1, equal step sizes | `TangentCorrection` |
| GQ(λ) | beta=0, with a target policy | `TangentCorrection` |
| Greedy-GQ | beta=0, lambda_=0 | `TangentCorrection` |
| QRC(λ) | the defaults | `HeadCorrection` |

The indices are those of `neuralq.learners.traces.learner`: a trace decays by the discount *into* s_tm1, an exploring
action cuts it *before* its own gradient is added, it is dropped *after* the last step of a stream.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from neuralq import rules
from neuralq.learners import state
from neuralq.learners.annealing import LinearFall
from neuralq.learners.gradient.correction import Correction
from neuralq.learners.gradient.differentiation import greedy_value
from neuralq.learners.gradient.step import GradientStep, GradientTDSettings, TDStep
from neuralq.learners.learner import Update
from neuralq.q.compiled import MlpEngine
from neuralq.q.engine import Engine
from neuralq.types import Transition

__all__ = ["GradientPredictionLearner", "GradientQLearner"]


class GradientPredictionLearner:
    """Off-policy prediction of state values that does not diverge: GTD2(λ), TDC(λ) = GTD(λ), TDRC(λ).

    Args:
        engine: values of a representation with one "action", the value of the state.
        correction: the second function; its parameters are learned along.
        settings: how to learn; ``cut`` has no meaning for prediction and must stay at its default.
        num_envs: parallel streams N, one row of every transition each; with λ = 0 any number of rows will do.

    Raises:
        ValueError: if the representation has several outputs, or ``cut`` is not the default.

    Source: Sutton et al. 2009; Maei 2011 (λ, ρ); Ghiassian et al. 2020 (TDRC).

    Example:
        >>> from neuralq.learners.gradient.correction import TangentCorrection
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> engine = TorchEngine(TableQ(2, 1), Loss())
        >>> settings = GradientTDSettings(lambda_=0.0, step_size=0.5, step_size_h=0.5)
        >>> learner = GradientPredictionLearner(engine, TangentCorrection(engine), settings)
        >>> row = torch.tensor
        >>> step = Transition(row([0]), row([0]), row([1.0]), row([4.0]), row([0.5]), row([1]), row([False]))
        >>> _ = learner.update(step)  # δ = 4, h = 0
        >>> _ = learner.update(step)  # δ = 2, h = 2: V(0) += ½·2, V(1) −= ½·½·2
        >>> engine.all(torch.arange(2))[:, 0].tolist()
        [3.0, -0.5]
    """

    def __init__(self, engine: Engine, correction: Correction, settings: GradientTDSettings, num_envs: int = 1) -> None:
        if engine.q.num_actions != 1:
            raise ValueError(
                f"state values are a function with one output, got {engine.q.num_actions}; for action values use "
                "GradientQLearner"
            )
        if settings.cut != "watkins":
            raise ValueError("prediction has no exploring actions to cut at; leave cut at its default")
        self.engine = engine
        self.settings = settings
        self.num_updates = 0
        self._core = GradientStep(engine, correction, settings, num_envs)
        self._parts = {"parameters": engine.flat, "h": correction.values, "traces": self._core.traces}

    def increments(
        self, transition: Transition, rho_tm1: Tensor | None = None, weight: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Update]:
        """What `update` would add to the values ``[d]`` and to h ``[k]``; the traces move on, the weights do not."""
        dtype = self.engine.flat.values.dtype
        a = torch.zeros_like(transition.a_tm1)
        r_t, discount_t = transition.r_t.to(dtype), transition.discount_t.to(dtype)
        one = torch.ones_like(r_t)
        bootstrap = rules.weighted_value(discount_t, self.engine.q.at(transition.s_t, a))
        seen = TDStep(
            s=transition.s_tm1,
            a=a,
            q=self.engine.q.at(transition.s_tm1, a),
            bootstrap=bootstrap,
            target=r_t + bootstrap.detach(),
            rho=one if rho_tm1 is None else rho_tm1.to(dtype),
            trace_decay=one,
        )
        return self._core.increments(transition, seen, weight)

    def update(self, transition: Transition, rho_tm1: Tensor | None = None, weight: Tensor | None = None) -> Update:
        """Learn from one step of every environment, ``[N]``; the increments of the environments are summed.

        Args:
            transition: rows ``[N]``; ``a_tm1`` is not looked at.
            rho_tm1: importance ratio π/μ of the action taken, ``[N]``; None for on-policy learning.
            weight: factor of each row's increment, ``[N]``; a row of weight 0 is no experience.

        Raises:
            ValueError: if there are traces and the number of rows is not that of the environments.
        """
        increment, increment_h, seen = self.increments(transition, rho_tm1, weight)
        self.engine.flat.values.add_(increment)
        self._core.correction.values.add_(increment_h)
        self.num_updates += 1
        return seen

    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict


class GradientQLearner:
    """Control by gradient TD: QRC(λ) and Greedy-GQ bootstrap from the best action, GQ(λ) from a given policy.

    * QRC(λ): the default settings and a `HeadCorrection`. Exploring actions cut the traces before their own gradient
      is added (the authors' program does so one step later, after the update).
    * Greedy-GQ: λ = 0, β = 0 and a `TangentCorrection`.
    * GQ(λ): β = 0, a `TangentCorrection` and a ``policy``; traces are multiplied by π/μ of the action taken.

    Args:
        engine: action values of any representation.
        correction: the second function, with as many actions; its parameters are learned along.
        settings: how to learn.
        num_envs: parallel streams N, one row of every transition each; with λ = 0 any number of rows will do.
        reward_scale: rewards are multiplied by it, so values are too.
        policy: target policy from action values to probabilities, not differentiated; None for the greedy one.
        total_steps: environment steps over which both step sizes fall linearly to 0; None for constant ones.

    Raises:
        ValueError: for a ``policy`` with ``cut="naive"``: its traces are cut by the importance ratio.

    Source: Maei & Sutton 2010 (GQ(λ)); Maei et al. 2010 (Greedy-GQ); Elelimy et al. 2025 (QRC(λ)).

    Example:
        >>> from neuralq.learners.gradient.correction import HeadCorrection
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> settings = GradientTDSettings(lambda_=0.5, step_size=0.5, step_size_h=0.25)
        >>> correction = HeadCorrection(TableQ(2, 1))
        >>> learner = GradientQLearner(TorchEngine(TableQ(2, 1), Loss()), correction, settings)
        >>> row = torch.tensor
        >>> step = Transition(row([0]), row([0]), row([1.0]), row([4.0]), row([0.0]), row([1]), row([True]))
        >>> _ = learner.update(step)  # δ = 4
        >>> learner.engine.all(torch.arange(2))[:, 0].tolist(), correction.values.tolist()
        ([2.0, 0.0], [1.0, 0.0])
    """

    def __init__(
        self,
        engine: Engine,
        correction: Correction,
        settings: GradientTDSettings,
        num_envs: int = 1,
        reward_scale: float = 1.0,
        policy: Callable[[Tensor], Tensor] | None = None,
        total_steps: int | None = None,
    ) -> None:
        if policy is not None and settings.cut != "watkins":
            raise ValueError("with a target policy the importance ratio cuts the traces; leave cut at its default")
        self.engine = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self.policy = policy
        self.num_updates = 0
        self._core = GradientStep(engine, correction, settings, num_envs)
        self._parts: dict[str, Any] = {"parameters": engine.flat, "h": correction.values, "traces": self._core.traces}
        self._fall = None if total_steps is None else LinearFall(total_steps, engine.flat.values)
        if self._fall is not None:
            self._parts["fall"] = self._fall

    @property
    def engine_name(self) -> str:
        """What computes: "torch", or where there are kernels for values "compiled and torch"."""
        return "compiled and torch" if isinstance(self.engine, MlpEngine) else "torch"

    def _trace_decay(self, transition: Transition, like: Tensor) -> Tensor:
        """How much of the older traces survives the action taken, ``[N]``."""
        if not self.settings.lambda_ or (self.settings.cut == "naive" and self.policy is None):
            return torch.ones_like(like)
        q_tm1 = self.engine.all(transition.s_tm1)
        if self.policy is None:
            return rules.is_greedy(q_tm1, transition.a_tm1).to(like.dtype)
        chosen = self.policy(q_tm1).gather(-1, transition.a_tm1[:, None])[:, 0]
        return chosen / transition.mu_tm1.to(like.dtype)

    def increments(self, transition: Transition, weight: Tensor | None = None) -> tuple[Tensor, Tensor, Update]:
        """What `update` would add to the values ``[d]`` and to h ``[k]``; the traces move on, the weights do not."""
        dtype = self.engine.flat.values.dtype
        r_t, discount_t = transition.r_t.to(dtype) * self.reward_scale, transition.discount_t.to(dtype)
        q_t = self.engine.q.all(transition.s_t)
        if self.policy is None:
            v_t = greedy_value(q_t)
        else:
            v_t = rules.weighted_value(self.policy(q_t.detach()), q_t).sum(-1)
        bootstrap = rules.weighted_value(discount_t, v_t)
        seen = TDStep(
            s=transition.s_tm1,
            a=transition.a_tm1,
            q=self.engine.q.at(transition.s_tm1, transition.a_tm1),
            bootstrap=bootstrap,
            target=r_t + bootstrap.detach(),
            rho=torch.ones_like(r_t),
            trace_decay=self._trace_decay(transition, r_t),
        )
        return self._core.increments(transition, seen, weight)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """Learn from one step of every environment, ``[N]``; increments are summed, rows of weight 0 did not move."""
        increment, increment_h, seen = self.increments(transition, weight)
        if self._fall is not None:
            share = self._fall.advance(torch.ones_like(seen.errors) if weight is None else weight)
            increment, increment_h = share * increment, share * increment_h
        self.engine.flat.values.add_(increment)
        self._core.correction.values.add_(increment_h)
        self.num_updates += 1
        return seen

    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict

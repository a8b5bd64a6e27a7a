"""Residual-gradient learning (Baird 1995): descend the squared Bellman residual itself, on any representation.

With δ = r + γ V' − V, the direct (semi-gradient) and the residual-gradient directions are

    W_d = δ ∇V,      W_rg = δ (∇V − γ ∇V'),      and residual(φ) takes  (1 − φ) W_d + φ W_rg = δ (∇V − φ γ ∇V').

φ = 1 is gradient descent on a sum of squares, so it cannot diverge at a small step size; φ = 0 is TD. Where the world
is random, one successor in both factors makes the objective E[δ²], which counts the variance of the target as an error
and pulls neighbouring values together. An independent second successor V'' in the gradient makes it (E δ)², the
Bellman error. Even that may be small without the values being right (Sutton & Barto 2018, section 11.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neuralq import rules
from neuralq.checks import check_choice, check_fraction, check_positive
from neuralq.learners import state
from neuralq.learners.gradient.differentiation import gradient, greedy_value, module_parameters
from neuralq.learners.learner import Update
from neuralq.q.engine import Engine
from neuralq.rules.shapes import check_same_shape
from neuralq.types import Transition

__all__ = ["ResidualGradientLearner", "ResidualGradientSettings", "adaptive_phi"]


def adaptive_phi(direct: Tensor, residual: Tensor) -> float:
    """The mixture at which the direct direction just stops to undo the residual gradient's work.

    ``φ = clip(W_d·W_rg / ((W_d − W_rg)·W_rg), 0, 1)``, and 0 where the denominator is 0. Where the two directions form
    an obtuse angle, this φ makes (1 − φ) W_d + φ W_rg orthogonal to W_rg, so that the squared residual does not grow.
    Where they form an acute one, any φ will do: the formula gives 0, or 1 if W_d·W_rg exceeds |W_rg|².

    Args:
        direct: W_d, ``[d]``.
        residual: W_rg, ``[d]``.

    Returns:
        φ in [0, 1].

    Raises:
        ValueError: if the shapes differ.

    Source: Baird 1995, section 4.

    Example:
        >>> adaptive_phi(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 1.0]))  # −1 / (−1 − 2)
        0.3333333333333333
    """
    check_same_shape("direct", direct, "residual", residual)
    along = float((direct * residual).sum())
    denominator = float(((direct - residual) * residual).sum())
    if denominator == 0:
        return 0.0
    return min(max(along / denominator, 0.0), 1.0)


@dataclass(frozen=True)
class ResidualGradientSettings:
    """How a `ResidualGradientLearner` learns.

    Args:
        phi: φ in [0, 1]: 1 is the residual gradient, 0 is semi-gradient TD; or "adaptive" for `adaptive_phi` of running
            averages of both directions.
        step_size: α.
        trace_rate: share of the newest direction in those averages, in (0, 1]; unused unless φ is adaptive.

    Raises:
        ValueError: for values outside their range.

    Example:
        >>> ResidualGradientSettings(phi="adaptive").trace_rate
        0.1
    """

    phi: float | str = 1.0
    step_size: float = 1e-3
    trace_rate: float = 0.1

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        if isinstance(self.phi, str):
            check_choice("phi", self.phi, ("adaptive",))
        else:
            check_fraction("phi", self.phi, "0 is TD, 1 the residual gradient")
        check_positive("step_size", self.step_size)
        check_positive("trace_rate", self.trace_rate)
        check_fraction("trace_rate", self.trace_rate)


class ResidualGradientLearner:
    """Residual(φ) on single steps, streams side by side or replayed samples: the mean direction of the rows.

    A representation with one output is a state value (prediction, on or off policy); with several, the successor is
    worth its best action (Q-learning).

    Args:
        engine: values of the representation.
        settings: how to learn.
        reward_scale: rewards are multiplied by it, so values are too.

    Source: Baird 1995.

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> settings = ResidualGradientSettings(step_size=0.5)
        >>> learner = ResidualGradientLearner(TorchEngine(TableQ(2, 1), Loss()), settings)
        >>> row = torch.tensor
        >>> step = Transition(row([0]), row([0]), row([1.0]), row([4.0]), row([0.5]), row([1]), row([False]))
        >>> _ = learner.update(step)  # δ = 4: V(0) += ½·4, V(1) −= ½·½·4
        >>> learner.engine.all(torch.arange(2))[:, 0].tolist()
        [2.0, -1.0]
    """

    def __init__(self, engine: Engine, settings: ResidualGradientSettings, reward_scale: float = 1.0) -> None:
        self.engine = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self.num_updates = 0
        self._parameters = module_parameters(engine.q)
        self._direct = torch.zeros_like(engine.flat.values)
        self._residual = torch.zeros_like(engine.flat.values)
        self._parts = {"parameters": engine.flat, "direct": self._direct, "residual": self._residual}

    def _bootstrap(self, transition: Transition) -> Tensor:
        """γ times the value of the successor, with its graph, ``[B]``."""
        discount_t = transition.discount_t.to(self.engine.flat.values.dtype)
        return rules.weighted_value(discount_t, greedy_value(self.engine.q.all(transition.s_t)))

    def directions(
        self, transition: Transition, weight: Tensor | None = None, independent: Transition | None = None
    ) -> tuple[Tensor, Tensor, Update]:
        """W_d and W_rg ``[d]``, averaged over the rows; changes nothing. Arguments as for `update`."""
        a = torch.zeros_like(transition.a_tm1) if self.engine.q.num_actions == 1 else transition.a_tm1
        q = self.engine.q.at(transition.s_tm1, a)
        bootstrap = self._bootstrap(transition)
        other = bootstrap
        if independent is not None:
            same_state = torch.equal(independent.s_tm1, transition.s_tm1)
            # The value of a state asks for no action: off policy, the second one is drawn from the target policy.
            if not same_state or (self.engine.q.num_actions > 1 and not torch.equal(independent.a_tm1, a)):
                raise ValueError("the second sample must leave the same states by the same actions, got others")
            other = self._bootstrap(independent)
        target = transition.r_t.to(q.dtype) * self.reward_scale + bootstrap.detach()
        delta = target - q.detach()
        factor = delta
        if weight is not None:
            check_same_shape("weight", weight, "r_t", transition.r_t)
            weight = weight.to(q)
            factor = torch.where(weight == 0, 0.0, delta * weight)
        direct = gradient((factor * q).mean(), self._parameters)
        return direct, direct - gradient((factor * other).mean(), self._parameters), Update(delta, target)

    def update(
        self, transition: Transition, weight: Tensor | None = None, independent: Transition | None = None
    ) -> Update:
        """One step along residual(φ).

        Args:
            transition: rows ``[B]``, or one step of every stream.
            weight: factor of each row, ``[B]``: importance ratios π/μ of state values, priorities, or 0 for rows that
                are no experience.
            independent: a second draw of the successor of every row, from the same state and action (for state values
                from the same state, by the target policy); its ``s_t`` and ``discount_t`` give γ V''.

        Raises:
            ValueError: if ``weight`` has another shape, or the second sample leaves another state.
        """
        direct, residual, seen = self.directions(transition, weight, independent)
        phi = self.phi(direct, residual)
        self.engine.flat.values.add_((1 - phi) * direct + phi * residual, alpha=self.settings.step_size)
        self.num_updates += 1
        return seen

    def phi(self, direct: Tensor, residual: Tensor) -> float:
        """φ of this step: the fixed one, or `adaptive_phi` of the running averages, which take the step in."""
        if not isinstance(self.settings.phi, str):
            return float(self.settings.phi)
        self._direct.lerp_(direct, self.settings.trace_rate)
        self._residual.lerp_(residual, self.settings.trace_rate)
        return adaptive_phi(self._direct, self._residual)

    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict

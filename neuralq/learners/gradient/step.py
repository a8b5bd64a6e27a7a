"""One step of gradient TD: the traces, the update of the values and that of the second function.

With δ = r + γ V' − V, a second function h ≈ E[δ] (see `neuralq.learners.gradient.correction`) and the traces

    z^w ← γλ z^w + ∇V,      z^h ← γλ z^h + h,      z^θ ← γλ z^θ + ∇h,

−z^h ∇δ estimates minus the gradient of half the squared projected λ-error ("gtd2"). At the best h, h ∇V equals δ z^w
in the mean, and putting that in its place gives TD(λ) and a correction ("tdc"):

    gtd2:  θ += α [h ∇V + c],       tdc:  θ += α [δ z^w + c],       c = (z^h − h) ∇V − z^h γ ∇V',
    both:  θ_h += α_h [δ z^θ − h ∇h − β θ_h].

With λ = 0, c is the familiar −γ h ∇V'. Where h lives in the tangent space of a network, θ also gets
−α [δ z^c − h ∇²V h], z^c ← γλ z^c + ∇²V h. The importance ratio of a state value multiplies its whole traces,
z ← ρ(γλ z + ∇V), and the h in c.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neuralq import rules
from neuralq.checks import check_choice, check_fraction, check_positive
from neuralq.learners.gradient.correction import Correction
from neuralq.learners.gradient.differentiation import gradient_rows, module_parameters
from neuralq.learners.learner import Update
from neuralq.learners.traces.memory import Traces
from neuralq.q.engine import Engine
from neuralq.types import Transition

__all__ = ["GradientStep", "GradientTDSettings", "TDStep"]


@dataclass(frozen=True)
class GradientTDSettings:
    """How a gradient-TD learner learns. The defaults are those of QRC(λ) (Elelimy et al. 2025).

    Args:
        method: "tdc" (TD with a correction) or "gtd2" (the gradient as it is).
        lambda_: λ in [0, 1].
        step_size: α of the values.
        step_size_h: α_h of the second function.
        beta: β ≥ 0, how strongly h is pulled to 0; 0 for TDC, GTD2, GQ(λ), 1 for TDRC and QRC(λ).
        cut: "watkins" drops the trace at exploring actions, "naive" never does. Q-learning only.

    Raises:
        ValueError: for values outside their range.

    Example:
        >>> GradientTDSettings(method="gtd2", beta=0.0).lambda_
        0.8
    """

    method: str = "tdc"
    lambda_: float = 0.8
    step_size: float = 1e-4
    step_size_h: float = 1e-5
    beta: float = 1.0
    cut: str = "watkins"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_choice("method", self.method, ("tdc", "gtd2"))
        check_fraction("lambda_", self.lambda_, "for Monte Carlo use lambda_=1")
        check_positive("step_size", self.step_size)
        check_positive("step_size_h", self.step_size_h)
        if self.beta != 0:
            check_positive("beta", self.beta)
        check_choice("cut", self.cut, ("watkins", "naive"))


@dataclass(frozen=True, slots=True)
class TDStep:
    """What one step of N streams means to a learner.

    Args:
        s: states left, ``[N, *obs]``.
        a: actions taken, ``[N]``.
        q: their values, ``[N]``, with their graph.
        bootstrap: γ times the value of the successor, ``[N]``, with its graph.
        target: reward plus bootstrap, ``[N]``, without.
        rho: factor of the whole traces, this step included, ``[N]``.
        trace_decay: factor of what the traces held before, besides γλ, ``[N]``.
    """

    s: Tensor
    a: Tensor
    q: Tensor
    bootstrap: Tensor
    target: Tensor
    rho: Tensor
    trace_decay: Tensor


class GradientStep:
    """What prediction and control share: the traces, and both updates.

    Args:
        engine: values of the representation.
        correction: the second function.
        settings: how to learn.
        num_envs: parallel streams.
    """

    def __init__(self, engine: Engine, correction: Correction, settings: GradientTDSettings, num_envs: int) -> None:
        self.engine = engine
        self.correction = correction
        self.settings = settings
        self.parameters = module_parameters(engine.q)
        self.num_envs = num_envs
        d, k = engine.flat.values.numel(), correction.values.numel()
        shapes = {"grad": (d,), **({"curvature": (d,)} if correction.tangent else {"h": (1,), "h_grad": (k,)})}
        # Without λ there is nothing to remember.
        self.traces = Traces(settings.lambda_, num_envs, engine.flat.values, shapes if settings.lambda_ else {})

    def increments(self, transition: Transition, seen: TDStep, weight: Tensor | None) -> tuple[Tensor, Tensor, Update]:
        """What to add to the values ``[d]`` and to h ``[k]``; the traces move on."""
        if self.settings.lambda_ and len(seen.q) != self.num_envs:
            raise ValueError(
                f"this learner has traces for {self.num_envs} streams, got a transition of {len(seen.q)} rows; set "
                "num_envs, or lambda_=0 to learn from independent samples"
            )
        weight = torch.ones_like(seen.target) if weight is None else weight.to(seen.target)
        moved = weight != 0
        delta = seen.target - seen.q.detach()
        grad = gradient_rows(seen.q, self.parameters)
        estimate = self.correction.estimate(seen.s, seen.a, seen.q, grad)
        h = estimate.h
        z = self._grown("grad", grad, seen, moved)
        main = delta[:, None] * z if self.settings.method == "tdc" else h[:, None] * grad
        if estimate.curvature is not None:
            # h is linear in its own parameters, and its gradient is ∇V: the trace of h needs no memory of old h.
            z_h_grad, z_h = z, z @ self.correction.values
            z_curvature = self._grown("curvature", estimate.curvature, seen, moved)
            main = main - delta[:, None] * z_curvature + h[:, None] * estimate.curvature
        else:
            z_h_grad = self._grown("h_grad", estimate.grad, seen, moved)
            z_h = self._grown("h", h[:, None], seen, moved)[:, 0]
        grad_t = gradient_rows(seen.bootstrap, self.parameters)
        direction = main + (z_h - seen.rho * h)[:, None] * grad - z_h[:, None] * grad_t
        regression = delta[:, None] * z_h_grad - h[:, None] * estimate.grad
        # A row that is no experience may have no legal action; 0 · −∞ would be NaN, so it is replaced and not weighted.
        along = weight @ torch.where(moved[:, None], direction, 0.0)
        along_h = weight @ torch.where(moved[:, None], regression, 0.0)
        along_h = along_h - weight.sum() * self.settings.beta * self.correction.values
        if self.settings.lambda_:
            self.traces.close(transition.discount_t, transition.last_t, moved)
        return (
            self.settings.step_size * along,
            self.settings.step_size_h * along_h,
            Update(torch.where(moved, delta, 0.0), seen.target),
        )

    def _grown(self, name: str, fresh: Tensor, seen: TDStep, moved: Tensor) -> Tensor:
        """The trace ``ρ (trace_decay · decay · z + fresh)``, ``[N, k]``; it is kept where the environment moved."""
        if not self.settings.lambda_:
            return seen.rho[:, None] * fresh
        z = self.traces.z
        before = rules.cut(z[name], seen.trace_decay == 0)
        grown = seen.rho[:, None] * rules.accumulate(before, fresh, self.traces.decay * seen.trace_decay)
        z[name] = torch.where(moved[:, None], grown, z[name])
        return grown

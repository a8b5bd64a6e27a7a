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

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuralq import rules
from neuralq.checks import check_choice, check_fraction, check_positive
from neuralq.learners.gradient.correction import Correction
from neuralq.learners.gradient.differentiation import gradient_rows, module_parameters
from neuralq.learners.learner import Update
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
        keep: factor of what the traces held before, ``[N]``.
    """

    s: Tensor
    a: Tensor
    q: Tensor
    bootstrap: Tensor
    target: Tensor
    rho: Tensor
    trace_decay: Tensor


class _Traces:
    """Named traces ``[environments, *]`` with the decay that is due; without λ there is nothing to remember."""

    def __init__(self, lambda_: float, widths: Mapping[str, int], like: Tensor, num_envs: int) -> None:
        self.lambda_ = lambda_
        self.num_envs = num_envs
        self.z = {name: like.new_zeros(num_envs, width) for name, width in widths.items()} if lambda_ else {}
        self.decay = like.new_zeros(num_envs)

    def check(self, num_rows: int) -> None:
        if self.lambda_ and num_rows != self.num_envs:
            raise ValueError(
                f"this learner has traces for {self.num_envs} streams, got a transition of {num_rows} rows; set "
                "num_envs, or lambda_=0 to learn from independent samples"
            )

    def grow(self, name: str, fresh: Tensor, seen: TDStep, moved: Tensor) -> Tensor:
        """``ρ (keep · decay · z + fresh)`` where the environment moved, ``[N, k]``."""
        if not self.lambda_:
            return seen.rho[:, None] * fresh
        before = rules.cut(self.z[name], seen.trace_decay == 0)
        grown = seen.rho[:, None] * rules.accumulate(before, fresh, self.decay * seen.trace_decay)
        self.z[name] = torch.where(moved[:, None], grown, self.z[name])
        return grown

    def close(self, transition: Transition, moved: Tensor) -> None:
        """The discount into the next state is due; everything is dropped after the last step of a stream."""
        if not self.lambda_:
            return
        ends = transition.last_t & moved
        due = self.lambda_ * transition.discount_t.to(self.decay.dtype)
        self.decay = torch.where(moved, due, self.decay).masked_fill(ends, 0.0)
        self.z = {name: rules.cut(z, ends) for name, z in self.z.items()}

    def clear(self) -> None:
        for trace in (*self.z.values(), self.decay):
            trace.zero_()

    def state_dict(self) -> dict[str, Any]:
        return {"decay": self.decay, **self.z}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.decay.copy_(torch.as_tensor(state["decay"]))
        for name, trace in self.z.items():
            trace.copy_(torch.as_tensor(state[name]))


class GradientStep:
    """What prediction and control share: both updates, and where the state lives.

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
        self.num_updates = 0
        d, k = engine.flat.values.numel(), correction.values.numel()
        widths = {"grad": d, **({"curvature": d} if correction.tangent else {"h": 1, "h_grad": k})}
        self.traces = _Traces(settings.lambda_, widths, engine.flat.values, num_envs)

    def increments(self, transition: Transition, seen: TDStep, weight: Tensor | None) -> tuple[Tensor, Tensor, Update]:
        """What to add to the values ``[d]`` and to h ``[k]``; the traces move on."""
        self.traces.check(len(seen.q))
        weight = torch.ones_like(seen.target) if weight is None else weight.to(seen.target)
        moved = weight != 0
        delta = seen.target - seen.q.detach()
        grad = gradient_rows(seen.q, self.parameters)
        estimate = self.correction.estimate(seen.s, seen.a, seen.q, grad)
        h = estimate.h
        z = self.traces.grow("grad", grad, seen, moved)
        main = delta[:, None] * z if self.settings.method == "tdc" else h[:, None] * grad
        if estimate.curvature is not None:
            # h is linear in its own parameters, and its gradient is ∇V: the trace of h needs no memory of old h.
            z_h_grad, z_h = z, z @ self.correction.values
            z_curvature = self.traces.grow("curvature", estimate.curvature, seen, moved)
            main = main - delta[:, None] * z_curvature + h[:, None] * estimate.curvature
        else:
            z_h_grad = self.traces.grow("h_grad", estimate.grad, seen, moved)
            z_h = self.traces.grow("h", h[:, None], seen, moved)[:, 0]
        grad_t = gradient_rows(seen.bootstrap, self.parameters)
        direction = main + (z_h - seen.rho * h)[:, None] * grad - z_h[:, None] * grad_t
        regression = delta[:, None] * z_h_grad - h[:, None] * estimate.grad
        # A row that is no experience may have no legal action; 0 · −∞ would be NaN, so it is replaced and not weighted.
        along = weight @ torch.where(moved[:, None], direction, 0.0)
        along_h = weight @ torch.where(moved[:, None], regression, 0.0)
        along_h = along_h - weight.sum() * self.settings.beta * self.correction.values
        self.traces.close(transition, moved)
        return (
            self.settings.step_size * along,
            self.settings.step_size_h * along_h,
            Update(torch.where(moved, delta, 0.0), seen.target),
        )

    def apply(self, increment: Tensor, increment_h: Tensor) -> None:
        """Take the step."""
        self.engine.flat.values.add_(increment)
        self.correction.values.add_(increment_h)
        self.num_updates += 1

    def state_dict(self) -> dict[str, Any]:
        """Parameters, those of h, traces and counters."""
        return {
            "num_updates": self.num_updates,
            "parameters": self.engine.flat.values,
            "h": self.correction.values,
            "traces": self.traces.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self.num_updates = int(state["num_updates"])
        self.engine.flat.load(torch.as_tensor(state["parameters"]))
        self.correction.load(torch.as_tensor(state["h"]))
        self.traces.load_state_dict(state["traces"])

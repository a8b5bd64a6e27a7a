"""The tangent kernel of a run that has no model: what sampled transitions say about the next updates.

For B transitions (s_i, a_i, r_i, s'_i) and the greedy a'_i, one plain gradient step of size α on their mean squared
error, targets held fixed, changes Q(x) by (α/B) Σ_j K(x, x_j) δ_j, at the samples as well as at their successors. So
their own errors follow

    δ  ←  (I − (α/B)(K − Γ K')) δ,      Γ = diag γ_i,
    K_ij = K((s_i, a_i), (s_j, a_j)),   K'_ij = K((s'_i, a'_i), (s_j, a_j)),

which is U = I − αK D (I − γP) with D = 1/B and each successor in place of its expectation. What is left out: that
successors are samples, that B transitions are not all there are, that greedy actions, kernel and sampled states change,
curvature, momentum and adaptive step sizes, and λ-returns, target networks and n-step targets, all of which stabilise.
It is therefore a *local* alarm about one-step updates without a target network, never a proof.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import Tensor

from neuralq.checks import check_positive
from neuralq.exact import Prediction, predict_expected_td
from neuralq.lab.networks.expected import QModule
from neuralq.lab.networks.tangent_kernel import jacobian_of_few
from neuralq.lab.plain import plain
from neuralq.types import Floats, Transition

__all__ = ["SampleDiagnosis", "diagnose_sample"]


_NOISE = 0.5  # over √B, of the largest eigenvalue: what an eigenvalue may be off by chance, by a rule of thumb


@dataclass(frozen=True, eq=False)
class SampleDiagnosis:
    """What the next one-step updates would do to the errors of a sample of transitions.

    Args:
        num_samples: B.
        rank: of their kernel.
        step_size: α.
        growth: spectral radius of I − (α/B)(K − ΓK'): factor per plain gradient step.
        min_real_eigenvalue: smallest Re of the eigenvalues of (K − ΓK')/B; below 0 no step size makes errors shrink.
        largest_eigenvalue: largest |λ| of them.
        step_size_bound: every smaller α makes the sample's errors shrink; 0 if none does.
        discount_share: the share of the discounts, scanned upwards from 0, at which some error first stops shrinking;
            1 if that does not happen up to the discounts as they are.
        overlap: mean of K'_ii / K_ii where the episode goes on: how much an update of a value moves the successor's
            value with it. For a table 0, but for pairs that lead to themselves; 1 if a network cannot tell the two
            apart.
        largest_value: max |Q| over samples and successors.
        mean_error: mean |δ|.
        scope: always ``"local"``.
    """

    num_samples: int
    rank: int
    step_size: float
    growth: float
    min_real_eigenvalue: float
    largest_eigenvalue: float
    step_size_bound: float
    discount_share: float
    overlap: float
    largest_value: float
    mean_error: float
    scope: Literal["local"] = "local"

    @property
    def unstable(self) -> bool:
        """Whether errors grow at every step size, by more than the noise of a sample."""
        return self.min_real_eigenvalue < -_noise(self.num_samples) * self.largest_eigenvalue

    @property
    def too_large_step(self) -> bool:
        """Whether the step overshoots: errors would shrink, but only with a smaller one."""
        return not self.unstable and self.growth > 1 and self.step_size * self.largest_eigenvalue > 1

    @property
    def verdict(self) -> Literal["grows", "shrinks", "step size too large"]:
        """What plain one-step updates would do to these errors from here, apart from a sample's noise."""
        if self.unstable:
            return "grows"
        return "step size too large" if self.too_large_step else "shrinks"

    def plain(self) -> dict[str, Any]:
        """The verdict and its numbers, as JSON takes them."""
        return {"verdict": self.verdict, **plain(asdict(self))}

    def explain(self) -> str:
        """One paragraph for someone who watches a run."""
        head = (
            f"On {self.num_samples} recent transitions an update of a value moves the value that it is "
            f"bootstrapped from by {100 * self.overlap:.0f}% as much."
        )
        if self.verdict == "grows":
            middle = (
                f"Plain one-step updates would let some errors grow by {self.growth:.6g} per step, whatever the step "
                f"size; with discounts below {self.discount_share:.2g} of what they are they would shrink."
            )
        elif self.verdict == "shrinks" and self.growth < 1:
            middle = f"Plain one-step updates shrink their errors (factor {self.growth:.9g} per step)."
        elif self.verdict == "shrinks":
            middle = f"Nothing grows by more than the chance in such a sample (factor {self.growth:.9g} per step)."
        else:
            middle = (
                f"The step size {self.step_size:.3g} is too large for plain updates: below {self.step_size_bound:.3g} "
                "their errors would shrink."
            )
        return f"{head} {middle} {_CAVEAT}"


_CAVEAT = (
    "This is local, and made of a sample: it leaves out curvature, momentum, λ-returns and target networks, which "
    "stabilise."
)


def diagnose_sample(
    q: QModule, transition: Transition, step_size: float, *, reward_scale: float = 1.0
) -> SampleDiagnosis:
    """What plain one-step Q-learning from these transitions would do to their errors, around the present weights.

    Args:
        q: any `QFunction` module; it is only read.
        transition: at least 2 of them, with any leading axes.
        step_size: α of a plain gradient step on ½ mean δ².
        reward_scale: by which the learner multiplies rewards.

    Raises:
        ValueError: fewer than 2 transitions, or a step size that is not above 0.

    Example:
        >>> from neuralq.q import LinearQ
        >>> q = LinearQ(1, 1)  # w → 2w (Tsitsiklis & Van Roy): 1 leads to 2, and 2 to itself
        >>> x, a, one = torch.tensor([[1.0], [2.0]]), torch.zeros(2, dtype=torch.int64), torch.ones(2)
        >>> step = Transition(x, a, one, 0 * one, 0.9 * one, torch.tensor([[2.0], [2.0]]), one < 0)
        >>> found = diagnose_sample(q, step, step_size=0.1)
        >>> round(found.min_real_eigenvalue, 5), round(found.growth, 5), found.verdict  # A = (5 − 6γ) / 2
        (-0.2, 1.02, 'grows')
    """
    check_positive("step_size", step_size)
    flat = _rows(transition)
    num_samples = len(flat.a_tm1)
    if num_samples < 2:
        raise ValueError(f"a diagnosis needs at least 2 transitions, got {num_samples}")
    device = next(q.parameters()).device
    flat = flat.map(lambda x: x.to(device))
    with torch.no_grad():
        q_t = cast(Tensor, q.all(flat.s_t))  # type: ignore[operator]
        q_tm1 = cast(Tensor, q.at(flat.s_tm1, flat.a_tm1)).double()  # type: ignore[operator]
    v_t, a_t = q_t.double().max(-1)
    goes_on = flat.discount_t.double() * torch.isfinite(v_t)
    v_t = v_t.masked_fill(goes_on == 0, 0.0)
    errors = reward_scale * flat.r_t.double() + goes_on * v_t - q_tm1
    here = jacobian_of_few(q, flat.s_tm1, flat.a_tm1)
    there = jacobian_of_few(q, flat.s_t, a_t) * (goes_on != 0).to(here.dtype)[:, None]
    kernel, ahead = ((x @ here.T).double().cpu().numpy() for x in (here, there))
    own, shared = np.diag(kernel), np.diag(ahead)
    moves = (goes_on.cpu().numpy() != 0) & (own > 0)
    tolerance = num_samples * float(torch.finfo(here.dtype).eps)
    found, rank = _shrinking(kernel, ahead, goes_on.cpu().numpy(), step_size, tolerance)
    return SampleDiagnosis(
        num_samples=num_samples,
        rank=rank,
        step_size=step_size,
        growth=found.spectral_radius,
        min_real_eigenvalue=found.min_real_eigenvalue,
        largest_eigenvalue=float(np.abs(found.eigenvalues).max(initial=0.0)),
        step_size_bound=found.step_size_bound,
        discount_share=_discount_share(kernel, ahead, goes_on.cpu().numpy(), tolerance),
        overlap=float((shared[moves] / own[moves]).mean()) if moves.any() else 0.0,
        largest_value=float(torch.cat([q_tm1, v_t]).abs().max()),
        mean_error=float(errors.abs().mean()),
    )


def _rows(transition: Transition) -> Transition:
    """One leading axis instead of any number of them."""
    axes = transition.a_tm1.dim()
    return transition.map(lambda x: x.reshape(-1, *x.shape[axes:]))


def _operator(kernel: Floats, ahead: Floats, discount: Floats, tolerance: float) -> Floats:
    """(K − ΓK')/B in the directions in which the sample can move, ``[r, r]``: duplicates would only add zeros."""
    sizes, vectors = np.linalg.eigh(kernel)
    basis = vectors[:, sizes > tolerance * max(sizes[-1], 1e-300)]
    operator: Floats = basis.T @ (kernel - discount[:, None] * ahead) @ basis / len(kernel)
    return operator


def _shrinking(
    kernel: Floats, ahead: Floats, discount: Floats, step_size: float, tolerance: float
) -> tuple[Prediction, int]:
    operator = _operator(kernel, ahead, discount, tolerance)
    return predict_expected_td(operator, step_size), len(operator)


def _discount_share(kernel: Floats, ahead: Floats, discount: Floats, tolerance: float) -> float:
    """The least share of the discounts at which an eigenvalue passes to the left, on a grid of hundredths."""
    full = _operator(kernel, ahead, discount, tolerance)
    alone = _operator(kernel, ahead, np.zeros_like(discount), tolerance)
    for share in np.linspace(0.01, 1.0, 100):
        eigenvalues = np.linalg.eigvals(alone + share * (full - alone))
        if eigenvalues.real.min(initial=0.0) < -_noise(len(kernel)) * np.abs(eigenvalues).max(initial=0.0):
            return float(share)
    return 1.0


def _noise(num_samples: int) -> float:
    return _NOISE / float(np.sqrt(num_samples))

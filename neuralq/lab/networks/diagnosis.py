"""What a network will do to its errors from where it stands: the tangent kernel, and what the kernel leaves out.

Let J = ∂Q/∂θ have a row for each cell (a state, or a pair s, a), K = J Jᵀ be the empirical neural tangent kernel
(Jacot et al. 2018), D the weights with which cells are updated and P the target policy's transitions between them. To
first order in the step size α, one expected semi-gradient update does

    ΔQ = α K D δ,      δ = r + γPQ − Q,      so that    Q − Q_π  ←  U (Q − Q_π),    U = I − α K D (I − γP).

* ρ(U), the spectral radius, is the growth per step while K stays as it is. K D (I − γP) and Jᵀ D (I − γP) J have the
  same nonzero eigenvalues: what happens to values and what happens to weights is one thing. Weights move only within
  the span of J's rows of updated cells, so the operator is reduced to it, and ρ ignores what never moves.
* Achiam et al. 2019: if for every cell i  α K_ii d_i < 1  and  (1 + γ) Σ_{j≠i} |K_ij| d_j ≤ (1 − γ) K_ii d_i,  then
  the update contracts the largest error by max_i (1 − α[(1 − γ) K_ii d_i − (1 + γ) Σ_{j≠i} |K_ij| d_j]), for a fixed
  policy as well as for the maximum. It is sufficient and far from necessary.
* The derivative of the expected update by the weights is G = −Jᵀ D (I − γP) J + Σ_s d_s δ_s ∇²Q_s. The kernel has the
  first term only. It says how runs from nearby weights separate, which away from δ = 0 is another question than whether
  errors grow: the second term often makes them separate also where learning goes well. Near δ = 0 both are one.

All of it is *local*: J moves with the weights. A verdict holds for a step, or for as long as a wide network stays lazy;
it has to be made again along training, and nothing here says what a network does in the long run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuralq.checks import check_positive
from neuralq.exact import predict_expected_td
from neuralq.lab.networks.expected import QModule, expected_backup, local_spectrum
from neuralq.lab.networks.tangent_kernel import (
    LocalSystem,
    local_system,
    local_verdict,
    observations_of,
    reduced_operator,
)
from neuralq.q import TableQ
from neuralq_envs.counterexamples import Problem

__all__ = ["NetworkDiagnosis", "diagnose_network"]

_MOST_WEIGHTS = 800  # up to which the eigenvalues of G are a matter of a second


@dataclass(frozen=True, eq=False)
class NetworkDiagnosis:
    """What the expected update does around the present weights of a network, and how far that can be trusted.

    Args:
        num_cells: states or pairs that take part.
        num_parameters: p.
        rank: directions of weight space in which the update can move.
        step_size: α.
        gamma: γ.
        kernel_growth: ρ(U), the factor per step of the slowest or fastest growing error, kernel held fixed.
        kernel_norm: ‖U‖∞, the most that one step can multiply the largest error by, kernel held fixed.
        kernel_rate: largest Re of the eigenvalues of −Jᵀ D (I − γP) J; above 0 no step size makes errors shrink.
        step_size_bound: of the kernel: every smaller α makes errors shrink; 0 if none does.
        oscillates: whether the kernel's leading mode turns.
        doubling_time: steps in which errors double, by the kernel; None where they do not grow.
        eigenvalues: of K D (I − γP) in the directions that move, smallest real part first.
        achiam_holds: Achiam's condition for all cells: the step is a contraction.
        achiam_factor: its contraction factor; a bound on how the largest error changes, also where it exceeds 1.
        achiam_excess: max_i of (1 + γ) Σ_{j≠i} |K_ij| d_j over (1 − γ) K_ii d_i: by how much the condition fails;
            infinite where a cell is bootstrapped from and never updated.
        growth: spectral radius of I + αG, curvature included: the factor per step by which runs from nearby weights
            separate; None where there are too many weights.
        rate: largest Re of the eigenvalues of G; None likewise.
        largest_error: max |δ|, on which the weight of the curvature depends.
        verdict: ``"grows"`` or ``"shrinks"`` where ``kernel_growth`` and ``growth`` (if it is known) say so, else
            ``"unclear"``.
        scope: always ``"local"``.
    """

    num_cells: int
    num_parameters: int
    rank: int
    step_size: float
    gamma: float
    kernel_growth: float
    kernel_norm: float
    kernel_rate: float
    step_size_bound: float
    oscillates: bool
    doubling_time: float | None
    eigenvalues: NDArray[np.complex128]
    achiam_holds: bool
    achiam_factor: float
    achiam_excess: float
    growth: float | None
    rate: float | None
    largest_error: float
    verdict: Literal["grows", "shrinks", "unclear"]
    scope: Literal["local"] = "local"

    def explain(self) -> str:
        """One paragraph for someone who has just met the method."""
        return " ".join([self._kernel_words(), self._achiam_words(), self._curvature_words(), _CAVEAT])

    def _kernel_words(self) -> str:
        head = (
            f"One update moves the {self.num_cells} values together, because they share {self.num_parameters} weights. "
            f"With step size {self.step_size:g} the tangent kernel multiplies the leading error by "
            f"{self.kernel_growth:.7g} per step"
        )
        if self.kernel_growth > 1 + _EVEN:
            turning = ", swinging as it grows" if self.oscillates else ""
            cure = (
                f"a step size below {self.step_size_bound:.3g} would make it shrink"
                if self.step_size_bound > 0
                else "no step size makes it shrink, for raising a value raises its own target by more"
            )
            return f"{head}: it doubles every {self.doubling_time:.3g} steps{turning}, and {cure}."
        if self.kernel_growth < 1 - _EVEN:
            return f"{head}: it shrinks, as it does with every step size below {self.step_size_bound:.3g}."
        return f"{head}: some direction neither grows nor shrinks."

    def _achiam_words(self) -> str:
        if self.achiam_holds:
            return (
                "Every value is moved more by its own update than by all the others together, so the largest error "
                f"shrinks by the factor {self.achiam_factor:.7g} at least, whatever the policy (Achiam's condition)."
            )
        if math.isinf(self.achiam_excess):
            excess = "some value that others learn from is never updated itself"
        elif self.achiam_excess > 1:
            excess = f"the influence between values is {self.achiam_excess:.3g} times too strong for it"
        else:
            excess = "the step size is too large for it"
        return (
            f"Achiam's condition, which would guarantee shrinking, fails: {excess}; that proves nothing by itself, for "
            "the condition is sufficient and not necessary."
        )

    def _curvature_words(self) -> str:
        if self.growth is None:
            return (
                f"With {self.num_parameters} weights the curvature of the network was left out; errors reach "
                f"{self.largest_error:.3g}, and where they are not small it matters."
            )
        if abs(self.growth - self.kernel_growth) < 1e-9:
            return "The curvature adds nothing here: the values are linear in the weights, or there are no errors."
        if self.growth > 1 + _EVEN:
            meaning = "so runs from nearby weights separate, and this verdict goes stale"
            doubling = math.log(2) / math.log(self.growth)
            meaning += f" within some {doubling:.3g} steps; while errors are large that happens in good runs as well"
        else:
            meaning = "so runs from nearby weights come together"
        return (
            "The kernel treats the network as linear. With its curvature, weighted by errors of up to "
            f"{self.largest_error:.3g}, a small change of the weights is multiplied by {self.growth:.7g} per step, "
            f"{meaning}."
        )


_EVEN = 1e-12
_CAVEAT = (
    "All this is local: it was computed at the present weights and holds while they stay near; make it again along "
    "training. It decides little: of fresh networks on random problems 56% diverged after 'grows', 29% after 'unclear' "
    "(docs/divergence.md)."
)


def diagnose_network(
    q: QModule,
    problem: Problem,
    step_size: float | None = None,
    *,
    observations: Tensor | None = None,
    curvature: bool | None = None,
) -> NetworkDiagnosis:
    """What the expected semi-gradient update does to the errors of ``q`` around its present weights.

    Args:
        q: any `QFunction` module: with one output it is taken for V of the target policy, else for Q. It is only read.
        problem: the model, policies, γ and update distribution. Where it is about control, P is that of the present
            greedy policy.
        step_size: α; default: the problem's.
        observations: what ``q`` sees of each state, ``[S, *obs]``; default: the problem's features (state numbers for a
            `TableQ`).
        curvature: whether to include the Hessian term; default: if there are at most 800 parameters.

    Raises:
        ValueError: outputs that are neither one nor one per action, or arguments that do not fit.

    Source: Achiam, Knight & Abbeel 2019, theorem 2 and equation 14 for the kernel.

    Example:
        >>> from neuralq.q import LinearQ
        >>> from neuralq_envs.counterexamples import star
        >>> found = diagnose_network(LinearQ(8, 1), star())
        >>> round(found.kernel_growth, 7), found.achiam_holds, found.verdict, found.scope
        (1.0023925, False, 'grows', 'local')
    """
    alpha = problem.step_size if step_size is None else step_size
    check_positive("step_size", alpha)
    backup = expected_backup(problem, _seen(q, problem, observations), state_values=_is_state_value(q, problem))
    system = local_system(q, backup)
    single = next(q.parameters()).dtype != torch.float64
    kernel = predict_expected_td(reduced_operator(system, 1e-6 if single else 1e-12), alpha)
    num_parameters = system.jacobian.shape[1]
    curved = num_parameters <= _MOST_WEIGHTS if curvature is None else curvature
    moving = local_spectrum(q, backup, 1e-5 if single else 1e-10) if curved else None
    growth = None if moving is None else float(np.abs(1 + alpha * moving).max(initial=0.0))
    factor, excess, small_step = _achiam(system, alpha)
    return NetworkDiagnosis(
        num_cells=len(system.weights),
        num_parameters=num_parameters,
        rank=kernel.rank,
        step_size=alpha,
        gamma=problem.gamma,
        kernel_growth=kernel.spectral_radius,
        kernel_norm=float(np.abs(np.eye(len(system.weights)) - alpha * system.drift).sum(axis=1).max(initial=0.0)),
        kernel_rate=-kernel.min_real_eigenvalue + 0.0,
        step_size_bound=kernel.step_size_bound,
        oscillates=kernel.oscillates,
        doubling_time=kernel.doubling_time,
        eigenvalues=kernel.eigenvalues,
        achiam_holds=small_step and excess <= 1,
        achiam_factor=factor,
        achiam_excess=excess,
        growth=growth,
        rate=None if moving is None else float(moving.real.max()) if len(moving) else 0.0,
        largest_error=float(np.abs(system.errors).max(initial=0.0)),
        verdict=local_verdict(kernel.spectral_radius, growth),
    )


def _is_state_value(q: QModule, problem: Problem) -> bool:
    outputs, actions = cast(int, q.num_actions), problem.mdp.num_actions
    if outputs != actions and (outputs != 1 or problem.learns_q):
        one = "" if problem.learns_q else " (or 1 for state values)"
        raise ValueError(f"q must have one output for each of {actions} actions{one}, got num_actions={outputs}")
    return outputs == 1 and not problem.learns_q


def _seen(q: QModule, problem: Problem, observations: Tensor | None) -> Tensor:
    first = next(q.parameters())
    if observations is None:
        table = isinstance(q, TableQ)
        observations = torch.arange(problem.mdp.num_states) if table else observations_of(problem)
    dtype = first.dtype if observations.dtype.is_floating_point else observations.dtype
    return observations.to(first.device, dtype)


def _achiam(system: LocalSystem, step_size: float) -> tuple[float, float, bool]:
    """The contraction factor, by how much the condition on rows fails, and whether the step is small enough."""
    kernel = np.abs(system.kernel)
    own = np.diag(kernel) * system.weights
    others = (1 + system.gamma) * (kernel @ system.weights - own)
    own_gain = (1 - system.gamma) * own
    factor = float((1 - step_size * (own_gain - others)).max(initial=0.0))
    ratio = np.divide(others, own_gain, out=np.where(others > 0, np.inf, 0.0), where=own_gain > 0)
    return factor, float(ratio.max(initial=0.0)), bool((step_size * own < 1).all() and (own > 0).all())

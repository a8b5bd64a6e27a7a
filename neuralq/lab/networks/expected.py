"""The expected semi-gradient update of any representation, and how it grows where it stands.

All cells are updated at once, each with its weight w, towards its expected target. A cell is a pair (s, a), or a state
where the representation has one output:

    δ(s, a) = r(s, a) + γ Σ_{s'} P(s'|s, a) Σ_{a'} π(a'|s') Q(s', a') − Q(s, a)
    F(θ) = Σ_{s,a} w(s, a) δ(s, a) ∇Q(s, a),    θ ← θ + α F(θ)            (semi-gradient: δ is a constant)

Where a problem is about state values, w(s, a) = d(s) μ(a|s) ρ(s, a) with ρ = π/μ; where it is about Q, w = d(s) μ(a|s),
for a pair needs no ratio for its own action. In control π is greedy in the present Q, ties going to the lowest action.
Terminal states are worth 0 whatever the representation says of them.

The sweep is synchronous: every target is computed before anything moves. For a table or linear features F is linear and
`neuralq.exact.predict_expected_td` says all there is to say. For a network ∂F/∂θ depends on θ; it is

    G = ∂F/∂θ = Σ w(s, a) [ ∇Q ∇δᵀ + δ ∇²Q ],

the second term being absent from the neural tangent kernel. `local_jacobian` and `local_growth` take both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neuralq.checks import check_positive
from neuralq.exact import policy_process
from neuralq.types import Floats
from neuralq_envs.counterexamples import Problem

__all__ = [
    "ExpectedBackup",
    "QModule",
    "expected_backup",
    "expected_td_step",
    "local_growth",
    "local_jacobian",
    "local_spectrum",
]

QModule = nn.Module  # with `all` and `at`: a module that is a `neuralq.types.QFunction`


@dataclass(frozen=True, eq=False)
class ExpectedBackup:
    """The numbers of a counterexample as tensors, with what the representation sees of each state.

    A is the number of the representation's outputs: the model's actions, or 1 for state values.

    Args:
        observations: one row per state, ``[S, *obs]``.
        weights: how often each cell is updated, ratio included, ``[S, A]``.
        rewards: r(s, a), ``[S, A]``.
        transitions: P(s'|s, a), ``[S, A, S]``, row discounts included.
        target_policy: π(a|s), ``[S, A]``; 0 in a terminal state, which is worth nothing.
        gamma: γ.
        legal: which actions exist, ``[S, A]``, bool; none in a terminal state.
        greedy: whether the target policy is greedy in the present Q instead.
        exploration: ε of a behaviour that is ε-greedy in the present Q; None: ``weights`` stay.
    """

    observations: Tensor
    weights: Tensor
    rewards: Tensor
    transitions: Tensor
    target_policy: Tensor
    gamma: float
    legal: Tensor
    greedy: bool = False
    exploration: float | None = None

    def policy(self, q: Tensor) -> Tensor:
        """The target policy at these values, ``[S, A] -> [S, A]``; rows of terminal states are 0."""
        if self.greedy:
            return self._greedy(q)
        return self.target_policy if self.exploration is None else self._exploring(q, self.exploration)

    def update_weights(self, q: Tensor) -> Tensor:
        """How often each cell is updated at these values, ``[S, A] -> [S, A]``."""
        if self.exploration is None:
            return self.weights
        return self.weights.sum(-1, keepdim=True) * self._exploring(q, self.exploration)

    def state_values(self, q: Tensor) -> Tensor:
        """V(s) = Σ_a π(a|s) Q(s, a), ``[S, A] -> [S]``; 0 in a terminal state."""
        pi = self.policy(q)
        return (pi * q.masked_fill(pi == 0, 0.0)).sum(-1)  # a masked action is worth −∞, and 0 · −∞ is not 0

    def errors(self, q: Tensor) -> Tensor:
        """δ(s, a) of every cell, ``[S, A] -> [S, A]``; 0 where no action exists."""
        delta = self.rewards + self.gamma * (self.transitions @ self.state_values(q)) - q
        return delta.masked_fill(~self.legal, 0.0)

    def _greedy(self, q: Tensor) -> Tensor:
        best = q.detach().masked_fill(~self.legal, -torch.inf).argmax(-1)  # the lowest of several
        return nn.functional.one_hot(best, q.shape[-1]).to(q.dtype) * self.legal

    def _exploring(self, q: Tensor, epsilon: float) -> Tensor:
        uniform = self.legal / self.legal.sum(-1, keepdim=True).clamp(min=1)
        return (1 - epsilon) * self._greedy(q) + epsilon * uniform.to(q.dtype)


def expected_backup(problem: Problem, observations: Tensor, *, state_values: bool = False) -> ExpectedBackup:
    """A counterexample becomes tensors for a representation that sees ``observations`` (one row per state).

    Args:
        problem: states, policies and how often each state is updated.
        observations: ``[S, *obs]``.
        state_values: whether the representation has one output, V(s), instead of one per action.

    Raises:
        ValueError: another number of observations than states, or state values of a problem about Q.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> expected_backup(star(), torch.arange(7)).weights[0].tolist()  # a dashed pair does not count
        [0.0, 0.14285714285714285]
        >>> expected_backup(star(), torch.arange(7), state_values=True).weights[0].tolist()
        [0.14285714285714285]
    """
    model = problem.mdp
    if len(observations) != model.num_states:
        raise ValueError(
            f"observations must have one row for each of {model.num_states} states, got {len(observations)}"
        )
    arrays = _state_arrays(problem) if state_values else _pair_arrays(problem)
    weights, rewards, transitions, policy, legal = (torch.from_numpy(np.ascontiguousarray(x)) for x in arrays)
    return ExpectedBackup(
        observations, weights, rewards, transitions, policy * legal, problem.gamma, legal, problem.control,
        problem.exploration,
    )  # fmt: skip


def _state_arrays(problem: Problem) -> tuple[NDArray[np.generic], ...]:
    if problem.learns_q:
        raise ValueError(
            "this problem has features of state-action pairs: give the representation one output per action"
        )
    P_pi, r_pi = policy_process(problem.mdp, problem.target_policy)
    active = ~problem.mdp.is_terminal[:, None]
    return (
        problem.state_distribution[:, None].copy(), r_pi[:, None], P_pi.toarray()[:, None, :],
        np.ones_like(active, dtype=np.float64), active,
    )  # fmt: skip


def _pair_arrays(problem: Problem) -> tuple[NDArray[np.generic], ...]:
    model = problem.mdp
    shape = (model.num_states, model.num_actions)
    transitions = np.zeros((*shape, model.num_states))
    transitions[model.s_tm1, model.a_tm1] = model.row_discount[:, None] * model.transition.toarray()
    rewards = np.zeros(shape)
    rewards[model.s_tm1, model.a_tm1] = model.reward
    legal = model.legal.copy()
    weights = problem.state_distribution[:, None] * problem.behaviour_policy
    if not problem.learns_q:
        weights = weights * problem.importance_ratio
    return np.where(legal, weights, 0.0), rewards, transitions, problem.target_policy.copy(), legal


def expected_td_step(q: QModule, backup: ExpectedBackup, step_size: float) -> Tensor:
    """One synchronous expected sweep θ ← θ + α F(θ), in place; returns the values from before it, ``[S, A]``.

    Any `QFunction` module will do: autograd gives ∇Q, so a table, linear features and networks run through one code.

    Args:
        q: the representation, in float64.
        backup: from `expected_backup`.
        step_size: α.

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq_envs.counterexamples import star
        >>> q = TableQ(7, 2)
        >>> with torch.no_grad():
        ...     _ = q.weight.fill_(1.0)
        >>> _ = expected_td_step(q, expected_backup(star(), torch.arange(7)), step_size=7.0)
        >>> q.at(torch.tensor(0), torch.tensor(1)).item()  # a full step: 1 becomes its target, γ
        0.99
    """
    parameters = list(q.parameters())
    values: Tensor = q.all(backup.observations)  # type: ignore[operator]
    before = values.detach()
    weighted = backup.update_weights(before) * backup.errors(before)
    directions = torch.autograd.grad(values, parameters, grad_outputs=weighted)
    with torch.no_grad():
        for parameter, direction in zip(parameters, directions, strict=True):
            parameter.add_(direction, alpha=step_size)
    return before


def local_jacobian(q: QModule, backup: ExpectedBackup) -> Floats:
    """G = ∂F/∂θ at the present weights, ``[p, p]``: how a small change of the weights changes the expected update.

    It is the whole derivative, G = −Jᵀ D (I − γP) J + Σ w δ ∇²Q, with J = ∂Q/∂θ and D = diag(w).

    Args:
        q: the representation, with at most some thousand parameters.
        backup: from `expected_backup`.

    Example:
        >>> from neuralq.q import LinearQ
        >>> from neuralq_envs.counterexamples import star
        >>> backup = expected_backup(star(), torch.tensor(star().features), state_values=True)
        >>> round(float(np.linalg.eigvals(local_jacobian(LinearQ(8, 1), backup)).real.max()), 6)
        0.23925
    """
    parameters = list(q.parameters())
    values: Tensor = q.all(backup.observations)  # type: ignore[operator]
    # F keeps its graph through the errors as well as through ∇Q, so its derivative is the full one.
    wide = values.double()
    weighted = (backup.update_weights(wide.detach()) * backup.errors(wide)).to(values.dtype)
    parts = torch.autograd.grad(values, parameters, grad_outputs=weighted, create_graph=True)
    update = torch.cat([part.reshape(-1) for part in parts])
    rows = torch.autograd.grad(update, parameters, grad_outputs=torch.eye(len(update), dtype=update.dtype),
                               is_grads_batched=True, materialize_grads=True)  # fmt: skip
    jacobian: Floats = torch.cat([row.reshape(len(update), -1) for row in rows], dim=1).double().numpy()
    return jacobian


def local_growth(q: QModule, backup: ExpectedBackup, step_size: float) -> float:
    """The spectral radius of I + α ∂F/∂θ at the present weights, without the directions that nothing depends on.

    For a table or linear features it is the growth per step in the long run, from any start. For a network it is
    *local*: it holds while the weights stay close to where they are. It includes the Hessian term δ ∇²Q.

    Args:
        q: the representation, in float64, with at most some thousand parameters.
        backup: from `expected_backup`.
        step_size: α > 0.

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq_envs.counterexamples import star
        >>> round(local_growth(TableQ(7, 2), expected_backup(star(), torch.arange(7)), 0.7), 12)  # 1 − α (1 − γ) / 7
        0.999
    """
    check_positive("step_size", step_size)
    return float(np.abs(1 + step_size * local_spectrum(q, backup)).max(initial=0.0))


def local_spectrum(q: QModule, backup: ExpectedBackup, tolerance: float = 1e-10) -> NDArray[np.complex128]:
    """Eigenvalues of G, without the directions that nothing depends on: those below this share of the largest."""
    eigenvalues = np.linalg.eigvals(local_jacobian(q, backup)).astype(np.complex128)
    moving: NDArray[np.complex128] = eigenvalues[np.abs(eigenvalues) > tolerance * np.abs(eigenvalues).max(initial=0.0)]
    return moving

"""The expected semi-gradient update of any representation, and how it grows where it stands.

All pairs (s, a) are updated at once, each with weight d(s) μ(a|s) ρ(s, a), ρ = π/μ, towards its expected target:

    δ(s, a) = r(s, a) + γ Σ_{s'} P(s'|s, a) Σ_{a'} π(a'|s') Q(s', a') − Q(s, a)
    F(θ) = Σ_{s,a} d(s) μ(a|s) ρ(s, a) δ(s, a) ∇Q(s, a),    θ ← θ + α F(θ)            (semi-gradient: δ is a constant)

The sweep is synchronous: every target is computed before anything moves. For a table or linear features F is linear and
`neuralq.exact.predict_expected_td` says all there is to say. For a network ∂F/∂θ depends on θ; it is

    ∂F/∂θ = Σ w(s, a) [ ∇Q ∇δᵀ + δ ∇²Q ],

the second term being absent from the neural tangent kernel. `local_growth` takes both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_positive
from neuralq_envs.counterexamples import Problem

__all__ = ["ExpectedBackup", "QModule", "expected_backup", "expected_td_step", "local_growth"]

QModule = nn.Module  # with `all` and `at`: a module that is a `neuralq.types.QFunction`


@dataclass(frozen=True, eq=False)
class ExpectedBackup:
    """The numbers of a counterexample as tensors, with what the representation sees of each state.

    Args:
        observations: one row per state, ``[S, *obs]``.
        weights: d(s) μ(a|s) ρ(s, a), ``[S, A]``.
        rewards: r(s, a), ``[S, A]``.
        transitions: P(s'|s, a), ``[S, A, S]``, row discounts included.
        target_policy: π(a|s), ``[S, A]``.
        gamma: γ.
    """

    observations: Tensor
    weights: Tensor
    rewards: Tensor
    transitions: Tensor
    target_policy: Tensor
    gamma: float

    def state_values(self, q: Tensor) -> Tensor:
        """V(s) = Σ_a π(a|s) Q(s, a), ``[S, A] -> [S]``."""
        return (self.target_policy * q).sum(-1)

    def errors(self, q: Tensor) -> Tensor:
        """δ(s, a) of every pair, ``[S, A] -> [S, A]``."""
        return self.rewards + self.gamma * (self.transitions @ self.state_values(q)) - q


def expected_backup(problem: Problem, observations: Tensor) -> ExpectedBackup:
    """A counterexample becomes tensors for a representation that sees ``observations`` (one row per state).

    Raises:
        ValueError: another number of observations than states.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> expected_backup(star(), torch.arange(7)).weights[0].tolist()  # a dashed pair does not count
        [0.0, 0.14285714285714285]
    """
    model = problem.mdp
    shape = (model.num_states, model.num_actions)
    if len(observations) != model.num_states:
        raise ValueError(
            f"observations must have one row for each of {model.num_states} states, got {len(observations)}"
        )
    transitions = np.zeros((*shape, model.num_states))
    transitions[model.s_tm1, model.a_tm1] = model.row_discount[:, None] * model.transition.toarray()
    rewards = np.zeros(shape)
    rewards[model.s_tm1, model.a_tm1] = model.reward
    ratio = problem.importance_ratio
    weights = problem.state_distribution[:, None] * problem.behaviour_policy * ratio
    return ExpectedBackup(
        observations,
        torch.from_numpy(weights),
        torch.from_numpy(rewards),
        torch.from_numpy(transitions),
        torch.tensor(problem.target_policy),
        problem.gamma,
    )


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
    directions = torch.autograd.grad(values, parameters, grad_outputs=backup.weights * backup.errors(before))
    with torch.no_grad():
        for parameter, direction in zip(parameters, directions, strict=True):
            parameter.add_(direction, alpha=step_size)
    return before


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
    parameters = list(q.parameters())
    values: Tensor = q.all(backup.observations)  # type: ignore[operator]
    # F keeps its graph through the errors as well as through ∇Q, so its derivative is the full one.
    pull = backup.weights * backup.errors(values)
    parts = torch.autograd.grad(values, parameters, grad_outputs=pull, create_graph=True)
    update = torch.cat([part.reshape(-1) for part in parts])
    rows = torch.autograd.grad(update, parameters, grad_outputs=torch.eye(len(update), dtype=update.dtype),
                               is_grads_batched=True, materialize_grads=True)  # fmt: skip
    jacobian = torch.cat([row.reshape(len(update), -1) for row in rows], dim=1).numpy()
    eigenvalues = np.linalg.eigvals(jacobian)
    moving = eigenvalues[np.abs(eigenvalues) > 1e-10 * np.abs(eigenvalues).max(initial=0.0)]
    return float(np.abs(1 + step_size * moving).max(initial=0.0))

"""The tangent kernel of any Q-function, and the cells of a finite problem that it couples.

J = ∂Q/∂θ has a row for each cell (a state, or a pair s, a); K = J Jᵀ is the empirical neural tangent kernel (Jacot et
al. 2018): to first order, an update that tells cell j to move by ε moves cell i by ε K_ij.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.func import functional_call, grad, vmap

from neuralq.lab.networks.expected import ExpectedBackup, QModule
from neuralq.types import Floats, Indices
from neuralq_envs.counterexamples import Problem

__all__ = [
    "LocalSystem",
    "jacobian_of_few",
    "local_system",
    "local_verdict",
    "observations_of",
    "reduced_operator",
    "value_jacobian",
]


_AT_ONCE = 256  # rows of J computed together


class _At(nn.Module):
    """`torch.func.functional_call` replaces parameters only where it calls the module itself."""

    def __init__(self, q: nn.Module) -> None:
        super().__init__()
        self.q = q

    def forward(self, s: Tensor, a: Tensor) -> Tensor:
        value: Tensor = self.q.at(s, a)  # type: ignore[operator]
        return value


def value_jacobian(q: QModule, s: Tensor, a: Tensor) -> Tensor:
    """J, the gradient of each value Q(s, a) by all parameters: ``([N, *obs], [N]) -> [N, p]``.

    The order is that of ``q.parameters()``. Parameters and their stored gradients stay as they are.

    Example:
        >>> from neuralq.q import LinearQ
        >>> value_jacobian(LinearQ(2, 1), torch.tensor([[3.0, 4.0]]), torch.tensor([0]))
        tensor([[3., 4.]], dtype=torch.float64)
    """
    module = _At(q)
    parameters = {name: p.detach() for name, p in module.named_parameters()}

    def value(weights: dict[str, Tensor], s_one: Tensor, a_one: Tensor) -> Tensor:
        out: Tensor = functional_call(module, weights, (s_one[None], a_one[None]))  # a batch of one: no index is []
        return out[0]

    rows = vmap(grad(value), in_dims=(None, 0, 0), chunk_size=_AT_ONCE)(parameters, s, a)
    return torch.cat([rows[name].reshape(len(s), -1) for name in parameters], dim=1)


def jacobian_of_few(q: QModule, s: Tensor, a: Tensor) -> Tensor:
    """As `value_jacobian`, by a backward pass for each row: quicker for a few dozen, and without what vmap must load.

    Example:
        >>> from neuralq.q import LinearQ
        >>> jacobian_of_few(LinearQ(2, 1), torch.tensor([[3.0, 4.0]]), torch.tensor([0]))
        tensor([[3., 4.]], dtype=torch.float64)
    """
    module = _At(q)
    weights = {name: p.detach().requires_grad_() for name, p in module.named_parameters()}
    with torch.enable_grad():
        values = functional_call(module, weights, (s, a))
        rows = [
            torch.autograd.grad(one, list(weights.values()), retain_graph=True, materialize_grads=True)
            for one in values
        ]
    return torch.stack([torch.cat([part.reshape(-1) for part in row]) for row in rows])


def observations_of(problem: Problem, kind: Literal["features", "states"] = "features") -> Tensor:
    """What a network sees of each state: the problem's features, ``[S, d]``, or which state it is, one-hot ``[S, S]``.

    Where features belong to pairs, a state shows those of all its actions in a row, ``[S, A·d]``.

    Raises:
        ValueError: another kind.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> observations_of(star()).shape, observations_of(star(), "states").shape
        (torch.Size([7, 8]), torch.Size([7, 7]))
    """
    if kind == "features":
        return torch.tensor(problem.features.reshape(problem.mdp.num_states, -1))
    if kind == "states":
        return torch.eye(problem.mdp.num_states, dtype=torch.float64)
    raise ValueError(f"observations must be 'features' or 'states', got {kind!r}")


@dataclass(frozen=True, eq=False)
class LocalSystem:
    """The cells that matter to an expected update, and how the update couples them at the present weights.

    A cell matters if it is updated or if a cell that matters bootstraps from it; in control every legal one does, for
    it may become the greedy one.

    Args:
        states: of each cell, ``[n]``.
        actions: of each cell, ``[n]``.
        jacobian: J, ``[n, p]``.
        weights: diagonal of D, ``[n]``.
        transitions: P between cells, row discounts included, ``[n, n]``.
        errors: δ, ``[n]``.
        values: Q, ``[n]``.
        gamma: γ.
    """

    states: Indices
    actions: Indices
    jacobian: Floats
    weights: Floats
    transitions: Floats
    errors: Floats
    values: Floats
    gamma: float

    @property
    def kernel(self) -> Floats:
        """K = J Jᵀ, ``[n, n]``."""
        return self.jacobian @ self.jacobian.T

    @property
    def drift(self) -> Floats:
        """K D (I − γP), ``[n, n]``: the update of values is U = I − α times it."""
        return self.kernel @ (self.weights[:, None] * self._ahead)

    @property
    def _ahead(self) -> Floats:
        return np.eye(len(self.weights)) - self.gamma * self.transitions


def local_system(q: QModule, backup: ExpectedBackup) -> LocalSystem:
    """The cells of an expected update with their Jacobian, weights, transitions and errors at the present weights.

    Example:
        >>> from neuralq.lab.networks.expected import expected_backup
        >>> from neuralq.q import TableQ
        >>> from neuralq_envs.counterexamples import star
        >>> system = local_system(TableQ(7, 2), expected_backup(star(), torch.arange(7)))
        >>> system.actions.tolist(), system.weights.round(6).tolist()[:2]  # dashed pairs play no part
        ([1, 1, 1, 1, 1, 1, 1], [0.142857, 0.142857])
    """
    s = backup.observations
    with torch.no_grad():
        values = cast(Tensor, q.all(s)).double().cpu()  # type: ignore[operator]
    policy = backup.policy(values)
    weights, errors = backup.update_weights(values), backup.errors(values)
    num_cells = values.numel()
    coupling = (backup.transitions[..., None] * policy).reshape(num_cells, num_cells).numpy()
    if backup.greedy or backup.exploration is not None:
        kept = backup.legal.reshape(-1).numpy().copy()
    else:
        kept = _reached(coupling, weights.reshape(-1).numpy() > 0)
    cells = np.flatnonzero(kept)
    states, actions = np.divmod(cells, values.shape[1])
    jacobian = value_jacobian(q, s[torch.from_numpy(states).to(s.device)], torch.from_numpy(actions).to(s.device))
    rows = (x.reshape(-1).numpy()[cells] for x in (weights, errors, values))
    return LocalSystem(
        states, actions, jacobian.double().cpu().numpy(), next(rows), coupling[np.ix_(cells, cells)], next(rows),
        next(rows), backup.gamma,
    )  # fmt: skip


def _reached(coupling: Floats, start: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells that are in ``start`` or that one of those depends on."""
    kept = start.copy()
    while True:
        more = kept | (coupling[kept] != 0).any(axis=0)
        if np.array_equal(more, kept):
            return kept
        kept = more


def reduced_operator(system: LocalSystem, rank_tolerance: float = 1e-12) -> Floats:
    """Jᵀ D (I − γP) J within the span of the updated cells' gradients, ``[r, r]``; no update ever leaves that span.

    It has the nonzero eigenvalues of K D (I − γP), without the zeros of directions that cannot move.

    Args:
        system: from `local_system`.
        rank_tolerance: singular values below this share of the largest, per row or column of J, count as 0.

    Example:
        >>> from neuralq.lab.networks.expected import expected_backup
        >>> from neuralq.q import LinearQ
        >>> from neuralq_envs.counterexamples import star
        >>> backup = expected_backup(star(), torch.tensor(star().features), state_values=True)
        >>> reduced_operator(local_system(LinearQ(8, 1), backup)).shape  # eight weights, of which one is redundant
        (7, 7)
    """
    updated = system.weights > 0
    J = system.jacobian
    _, singular, right = np.linalg.svd(J[updated], full_matrices=False)
    if len(singular) == 0 or singular[0] == 0:
        return np.zeros((0, 0))
    span = right[singular > rank_tolerance * max(J.shape) * singular[0]].T
    seen = J @ span
    change = (seen - system.gamma * system.transitions @ seen)[updated]
    operator: Floats = seen[updated].T @ (system.weights[updated, None] * change)
    return operator


def local_verdict(*growths: float | None) -> Literal["grows", "shrinks", "unclear"]:
    """What factors per step say where they agree; those that are not known, None, say nothing.

    Example:
        >>> local_verdict(1.01, None), local_verdict(0.99, 0.98), local_verdict(0.99, 1.01)
        ('grows', 'shrinks', 'unclear')
    """
    known = [growth for growth in growths if growth is not None]
    if all(growth > 1 + 1e-12 for growth in known):  # a spectral radius is known up to rounding
        return "grows"
    return "shrinks" if all(growth < 1 - 1e-12 for growth in known) else "unclear"

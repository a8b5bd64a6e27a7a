"""Baird's hall (Baird 1995): a corridor on which nothing diverges and residual gradients are slow.

States 0..n−1 lead to the next one; leaving the last pays 1 and ends the episode. With a table TD has
A = (I − γU)/n, U the shift to the next state: all its eigenvalues are 1/n, and α = n carries the reward one state back
per sweep, so n sweeps are exact. The residual gradient has (I − γU)ᵀ(I − γU)/n instead. At γ = 1 that matrix is
tridiagonal with the eigenvalues (2 − 2 cos((2k − 1)π/(2n + 1)))/n, k = 1..n, so its condition number is

    sin²((2n − 1)π/(4n + 2)) / sin²(π/(4n + 2))  ≈  16 n²/π²,

and the number of sweeps grows with the square of the length of the hall, that of TD with the length.
"""

from __future__ import annotations

import numpy as np

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["hall", "residual_condition_number"]


def hall(num_states: int = 6, gamma: float = 0.9) -> Problem:
    """A corridor of ``num_states`` states with a table, and a step size at which TD is exact after one sweep each.

    Raises:
        ValueError: fewer than one state, or γ outside [0, 1].

    Example:
        >>> problem = hall(3)
        >>> problem.state_distribution.round(3).tolist(), problem.mdp.termination.tolist()
        ([0.333, 0.333, 0.333], [0.0, 0.0, 1.0])
    """
    check_whole("num_states", num_states)
    n = int(num_states)
    reward = np.zeros((n, 1))
    reward[-1] = 1.0
    model = FiniteMDP.from_arrays([np.eye(n, k=1)], reward, substochastic=True, start=np.eye(n)[0])
    return Problem.from_mdp(
        model,
        np.eye(n),
        gamma=gamma,
        state_distribution=np.full(n, 1 / n),
        initial_weights=np.zeros(n),
        step_size=float(n),
        name="hall",
        title="Baird's hall",
        source="Baird 1995",
        known=f"TD is exact after {n} sweeps. Residual gradients need a number of sweeps that grows as n²: at γ = 1 "
        f"their matrix has the condition number {residual_condition_number(n):.1f}.",
    )


def residual_condition_number(num_states: int) -> float:
    """Condition number of (I − U)ᵀ(I − U): sin²((2n − 1)π/(4n + 2)) / sin²(π/(4n + 2)), for γ = 1.

    Raises:
        ValueError: fewer than one state.

    Example:
        >>> round(residual_condition_number(6), 1)
        64.9
    """
    check_whole("num_states", num_states)
    unit = np.pi / (4 * num_states + 2)
    return float(np.sin((2 * num_states - 1) * unit) ** 2 / np.sin(unit) ** 2)

"""The matrices that expected updates are made of.

A_λ = Xᵀ D (I − γλP)⁻¹ (I − γP) X,    b_λ = Xᵀ D (I − γλP)⁻¹ r        (td_operator of neuralq.exact)
C = Xᵀ D X,    H = γ Xᵀ D P X,    A = C − H
"""

from __future__ import annotations

from neuralq.exact import td_operator
from neuralq.lab.linear.process import Process
from neuralq.types import Floats

__all__ = ["covariance", "cross", "naive_residual", "td"]


def td(process: Process, lambda_: float = 0.0) -> tuple[Floats, Floats]:
    """A_λ ``[d, d]`` and b_λ ``[d]`` of the target policy."""
    return td_operator(process.P, process.r, process.X, process.D, process.gamma, lambda_)


def covariance(process: Process) -> Floats:
    """C = Xᵀ D X, ``[d, d]``."""
    return process.X.T @ (process.D[:, None] * process.X)


def cross(process: Process) -> Floats:
    """H = γ Xᵀ D P X, ``[d, d]``: what the bootstrap feeds back."""
    product: Floats = process.gamma * (process.X.T @ (process.D[:, None] * (process.P @ process.X)))
    return product


def naive_residual(process: Process) -> tuple[Floats, Floats]:
    """E[ρ (x − γx')(x − γx')ᵀ] and E[ρ r (x − γx')]: half the gradient of the mean square TD error."""
    arcs = process.arcs
    after = process.X[arcs.next_row]
    after[arcs.next_row < 0] = 0.0
    back = process.X[arcs.row] - arcs.discount[:, None] * after
    weight = (process.D[arcs.row] * arcs.probability * arcs.rho)[:, None]
    matrix: Floats = back.T @ (weight * back)
    vector: Floats = back.T @ (weight[:, 0] * arcs.reward)
    return matrix, vector

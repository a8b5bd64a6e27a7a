"""The matrices that expected updates are made of.

A_λ = Xᵀ D (I − γλP)⁻¹ (I − γP) X,    b_λ = Xᵀ D (I − γλP)⁻¹ r        (td_operator of neuralq.exact)
C = Xᵀ D X,    H = γ Xᵀ D P X,    A = C − H
"""

from __future__ import annotations

import numpy as np

from neuralq.exact import td_operator
from neuralq.lab.linear.process import Process
from neuralq.lab.methods.chains import Chain, solve_chain
from neuralq.lab.methods.record import Expected, flow
from neuralq.types import Floats

__all__ = ["ahead", "covariance", "cross", "td", "traced_flow"]


def td(process: Process, lambda_: float = 0.0) -> tuple[Floats, Floats]:
    """A_λ ``[d, d]`` and b_λ ``[d]`` of the target policy."""
    return td_operator(process.P, process.r, process.X, process.D, process.gamma, lambda_)


def ahead(process: Process, phi: float = 1.0) -> Floats:
    """X − φγPX, ``[n, d]``: what a row shows less what follows it."""
    difference: Floats = process.X - phi * process.gamma * (process.P @ process.X)
    return difference


def covariance(process: Process) -> Floats:
    """C = Xᵀ D X, ``[d, d]``."""
    return process.X.T @ (process.D[:, None] * process.X)


def cross(process: Process) -> Floats:
    """H = γ Xᵀ D P X, ``[d, d]``: what the bootstrap feeds back."""
    product: Floats = process.gamma * (process.X.T @ (process.D[:, None] * (process.P @ process.X)))
    return product


def traced_flow(
    process: Process, weight: Floats, chain: Chain, discount: float, difference: Floats, reward: Floats
) -> Expected:
    """The flow with G = Xᵀ diag(weight) (I − discount · chain)⁻¹ difference, and g likewise of the reward.

    Args:
        process: the problem.
        weight: how often each row is updated, ``[n]``.
        chain: along which errors are traced, ``[n, n]``.
        discount: of a step along it.
        difference: of features, ``[n, d]``.
        reward: ``[n]``.
    """
    traced = solve_chain(chain, discount, np.column_stack([difference, reward]))
    both = process.X.T @ (weight[:, None] * traced)
    return flow(both[:, :-1], both[:, -1])

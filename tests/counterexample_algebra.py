"""Expected updates assembled from the rows of a problem's model: an oracle that shares nothing with the package."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.lab.problems import Problem

__all__ = ["Floats", "chain", "dense", "fixed_point", "rmspbe", "rmsve", "slowest", "sweeps", "td", "values"]

Floats = NDArray[np.float64]


def dense(p: Problem) -> tuple[Floats, Floats]:
    """P ``[S, A, S]`` and r ``[S, A]``; 0 where an action is not legal."""
    m = p.mdp
    transition, reward = np.zeros((m.num_states, m.num_actions, m.num_states)), np.zeros((m.num_states, m.num_actions))
    for k, row in enumerate(m.transition.toarray()):
        transition[m.s_tm1[k], m.a_tm1[k]] = row
        reward[m.s_tm1[k], m.a_tm1[k]] = m.reward[k]
    return transition, reward


def chain(p: Problem, policy: Floats) -> tuple[Floats, Floats]:
    """P_π ``[S, S]`` and r_π ``[S]``."""
    transition, reward = dense(p)
    return np.einsum("sa,sat->st", policy, transition), (policy * reward).sum(axis=1)


def td(p: Problem, lambda_: float = 0.0) -> tuple[Floats, Floats]:
    """A and b of expected TD(λ)."""
    step, r = chain(p, p.target_policy)
    n, x = len(r), p.features
    weight = x.T @ np.diag(p.state_distribution) @ np.linalg.inv(np.eye(n) - p.gamma * lambda_ * step)
    return weight @ (np.eye(n) - p.gamma * step) @ x, weight @ r


def values(p: Problem) -> Floats:
    step, r = chain(p, p.target_policy)
    return np.linalg.solve(np.eye(len(r)) - p.gamma * step, r)


def fixed_point(p: Problem, lambda_: float = 0.0) -> Floats:
    a, b = td(p, lambda_)
    return np.linalg.lstsq(a, b, rcond=1e-10)[0]


def rmsve(p: Problem, w: Floats, weights: Floats | None = None) -> float:
    d = p.state_distribution if weights is None else weights
    return float(np.sqrt(d @ (p.features @ w - values(p)) ** 2))


def rmspbe(p: Problem, w: Floats) -> float:
    a, b = td(p)
    c = p.features.T @ np.diag(p.state_distribution) @ p.features
    return float(np.sqrt((b - a @ w) @ np.linalg.pinv(c, rcond=1e-10) @ (b - a @ w)))


def slowest(p: Problem) -> float:
    """min Re of the eigenvalues of A on the row space of X: below 0 every step size diverges."""
    right = np.linalg.svd(p.features[p.state_distribution > 0])[2][: np.linalg.matrix_rank(p.features)].T
    return float(np.linalg.eigvals(right.T @ td(p)[0] @ right).real.min())


def sweeps(p: Problem, num: int) -> Floats:
    """Weights after ``num`` expected TD(0) updates."""
    (a, b), w = td(p), p.initial_weights
    for _ in range(num):
        w = w + p.step_size * (b - a @ w)
    return w

"""What methods need of a chain besides products: solving with it, and the chains of policies that depend on weights.

Rows of a process that learns Q are the legal pairs (s, a). The model's own chances s' ~ p(·|s, a) are read off the
behaviour chain, whose actions at s' sum to 1; any policy put behind them gives its chain over pairs. Among equal values
the greedy action is the lowest.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from neuralq.lab.linear.process import Process
from neuralq.types import Floats, Indices

__all__ = [
    "Chain",
    "chain_of",
    "epsilon_greedy",
    "greedy_policy",
    "greedy_values",
    "pairs_of",
    "solve_chain",
    "visits_of",
]

Chain: TypeAlias = Floats | sparse.csr_array


def solve_chain(P: Chain, discount: float, right: Floats, transposed: bool = False) -> Floats:
    """(I − discount · P)⁻¹ right, or (I − discount · Pᵀ)⁻¹ right.

    Args:
        P: ``[n, n]``, dense or sparse.
        discount: a factor below 1, or at most 1 where every episode ends.
        right: ``[n]`` or ``[n, k]``.
        transposed: whether to solve with Pᵀ.

    Raises:
        ValueError: the matrix is singular: a factor of 1 in front of a chain that never ends.

    Example:
        >>> solve_chain(np.array([[0.0, 1.0], [0.0, 0.0]]), 0.5, np.array([0.0, 1.0])).tolist()
        [0.5, 1.0]
    """
    if discount == 0:
        return right.copy()
    try:
        if isinstance(P, np.ndarray):
            dense = np.eye(len(P)) - discount * P
            return np.asarray(np.linalg.solve(dense.T if transposed else dense, right))
        system = sparse.csc_array(sparse.eye_array(P.shape[0]) - discount * P)
        return np.asarray(splu(system).solve(right, trans="T" if transposed else "N"))
    except (np.linalg.LinAlgError, RuntimeError) as error:
        raise ValueError(
            f"the sum over all future steps has no limit: the chain goes on for ever and each step counts {discount:g} "
            "of the one before; a factor below 1 has one"
        ) from error


def pairs_of(process: Process, method: str) -> Indices:
    """Row of every pair, ``[S, A]``, -1 where there is none.

    Raises:
        ValueError: the rows are states, so that there are no actions to compare.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> pairs_of(linear_process(star()), "q-learning")
        Traceback (most recent call last):
        ValueError: q-learning compares actions: ... give the problem features [S, A, d], not [S, d]
    """
    if process.row_of is None:
        raise ValueError(
            f"{method} compares actions: it learns values of state-action pairs; give the problem features [S, A, d], "
            "not [S, d]"
        )
    return process.row_of


def greedy_values(process: Process, row_of: Indices, w: Floats) -> Floats:
    """Q(s, a) at the weights, −∞ for illegal pairs: ``[d] -> [S, A]``, or ``[N, d] -> [N, S, A]`` for many seeds."""
    values = (w @ process.X.T)[..., row_of]
    masked: Floats = np.where(row_of >= 0, values, -np.inf)
    return masked


def greedy_policy(process: Process, row_of: Indices, w: Floats, epsilon: float = 0.0) -> Floats:
    """The ε-greedy policy at the weights, ``[S, A]``: ε is shared among all legal actions, the rest goes to the best.

    Source: Sutton & Barto 2018, section 2.2.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples.chattering import chattering
        >>> process = linear_process(chattering())  # one state, two actions with the features 1 and 2
        >>> greedy_policy(process, process.row_of, np.array([1.0]), epsilon=0.1).round(12).tolist()
        [[0.05, 0.95]]
    """
    return epsilon_greedy(row_of, greedy_values(process, row_of, w).argmax(axis=-1), epsilon)


def epsilon_greedy(row_of: Indices, best: Indices, epsilon: float) -> Floats:
    """The ε-greedy policy of given best actions, ``[S] -> [S, A]``: ε is shared among all legal actions.

    Example:
        >>> epsilon_greedy(np.array([[0, 1], [2, -1]]), np.array([1, 0]), 0.5).tolist()
        [[0.25, 0.75], [1.0, 0.0]]
    """
    legal = row_of >= 0
    policy = np.where(legal, epsilon / np.maximum(legal.sum(axis=1, keepdims=True), 1), 0.0)
    active = np.flatnonzero(legal.any(axis=1))
    policy[active, best[active]] += 1.0 - epsilon
    return policy


def chain_of(process: Process, row_of: Indices, policy: Floats) -> Chain:
    """The chain over pairs under any policy, ``[n, n]``, dense where the process is.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq.mdp import FiniteMDP
        >>> from neuralq_envs.counterexamples import Problem
        >>> mdp = FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[0.0, 0.0]])
        >>> process = linear_process(Problem.from_mdp(mdp, [[[1.0], [2.0]]], gamma=0.9))
        >>> chain_of(process, process.row_of, np.array([[0.25, 0.75]])).tolist()
        [[0.25, 0.75], [0.25, 0.75]]
    """
    chain = sparse.csr_array(_into_states(process, row_of) @ _choices(process, row_of, policy))
    return np.asarray(chain.toarray()) if isinstance(process.P, np.ndarray) else chain


def visits_of(process: Process, row_of: Indices, policy: Floats) -> Floats:
    """How often each pair is visited in the long run when the policy itself acts and episodes start again, ``[n]``.

    Raises:
        ValueError: the policy ends up in one of several separate parts of the model, so that it depends on chance.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples.chattering import chattering
        >>> process = linear_process(chattering())  # one state, two actions with the features 1 and 2
        >>> visits_of(process, process.row_of, np.array([[0.25, 0.75]])).tolist()
        [0.25, 0.75]
    """
    choices = _choices(process, row_of, policy)
    active = np.flatnonzero((row_of >= 0).any(axis=1))
    inside = (choices @ _into_states(process, row_of)).toarray()[np.ix_(active, active)]
    start = np.bincount(process.state, weights=process.start, minlength=len(row_of))[active]
    chain = inside + np.maximum(1.0 - inside.sum(axis=1), 0.0)[:, None] * start
    _, singular, right = np.linalg.svd(chain.T - np.eye(len(chain)))
    if len(singular) > 1 and singular[-2] < 1e-10:
        raise ValueError(
            "the ε-greedy policy ends up in one of several separate parts of the model, so how often it visits each "
            "pair depends on chance; raise epsilon, or learn off-policy from a fixed behaviour (method q-learning)"
        )
    share = np.abs(right[-1]) / np.abs(right[-1]).sum()
    visits: Floats = (choices[active].T @ share) if len(active) else np.zeros(process.num_rows)
    return visits


def _into_states(process: Process, row_of: Indices) -> sparse.csr_array:
    """p(s'|s, a), ``[n, S]``."""
    n = process.num_rows
    belongs = sparse.csr_array((np.ones(n), (np.arange(n), process.state)), shape=(n, len(row_of)))
    return sparse.csr_array(sparse.csr_array(process.P_mu) @ belongs)


def _choices(process: Process, row_of: Indices, policy: Floats) -> sparse.csr_array:
    """A policy as chances of rows given states, ``[S, n]``."""
    s, a = np.nonzero((row_of >= 0) & (policy > 0))
    return sparse.csr_array((policy[s, a], (s, row_of[s, a])), shape=(len(row_of), process.num_rows))

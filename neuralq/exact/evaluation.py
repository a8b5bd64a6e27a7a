"""The exact value of a policy: one sparse linear system.

    V_π = r_π + γ P_π V_π,   P_π(s, s') = Σ_a π(a|s) discount(s, a) P(s'|s, a),   r_π(s) = Σ_a π(a|s) r(s, a)

(I − γ P_π) is factored by sparse LU. With γ = 1 the system has a solution only if the policy ends its episodes from
every state, or brings them to states that no action leads out of to an end and where it earns nothing for ever: those
are worth 0. A policy that does neither is refused, naming a state from which it never ends.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from neuralq.checks import check_discount
from neuralq.mdp import FiniteMDP

__all__ = ["action_values", "evaluate", "policy_process"]


def policy_process(mdp: FiniteMDP, policy: ArrayLike) -> tuple[sparse.csr_array, NDArray[np.float64]]:
    """A policy turns an MDP into a Markov reward process: ``(P_π [S, S], r_π [S])``, row discounts included.

    Args:
        mdp: the model.
        policy: actions ``[S]`` (any number at terminal states) or probabilities ``[S, A]``.

    Raises:
        ValueError: a policy of another shape, that takes an illegal action, or whose probabilities do not sum to 1.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[3.0], [1.0]], substochastic=True)
        >>> P_pi, r_pi = policy_process(mdp, [0, 0])
        >>> P_pi.toarray().tolist(), r_pi.tolist()
        ([[0.0, 1.0], [0.0, 0.0]], [3.0, 1.0])
    """
    pi = _row_probabilities(mdp, np.asarray(policy))
    used = np.flatnonzero(pi)
    shape = (mdp.num_states, mdp.num_rows)
    choose = sparse.csr_array((pi[used], (mdp.s_tm1[used], used)), shape=shape)
    follow = sparse.csr_array((pi[used] * mdp.row_discount[used], (mdp.s_tm1[used], used)), shape=shape)
    return sparse.csr_array(follow @ mdp.transition), np.asarray(choose @ mdp.reward)


def evaluate(mdp: FiniteMDP, policy: ArrayLike, gamma: float) -> NDArray[np.float64]:
    """The exact value V_π of every state, ``[S]``, by sparse LU.

    Args:
        mdp: the model.
        policy: actions ``[S]`` or probabilities ``[S, A]``.
        gamma: γ in [0, 1].

    Raises:
        ValueError: γ outside [0, 1], a policy that `policy_process` refuses, or γ = 1 with a policy that never ends.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 0.0]]], [[3.0], [1.0]], substochastic=True)
        >>> evaluate(mdp, [0, 0], gamma=0.5).tolist()
        [3.5, 1.0]
    """
    check_discount("gamma", gamma)
    P_pi, r_pi = policy_process(mdp, policy)
    if gamma == 1:
        P_pi = _ending(mdp, P_pi, r_pi)
    system = sparse.csc_array(sparse.eye_array(mdp.num_states) - gamma * P_pi)
    return np.asarray(splu(system).solve(r_pi), dtype=np.float64) + 0.0  # no -0.0 for readers to wonder at


def action_values(mdp: FiniteMDP, v: ArrayLike, gamma: float) -> NDArray[np.float64]:
    """One look ahead: Q(s, a) = r(s, a) + γ discount(s, a) Σ_{s'} P(s'|s, a) V(s'), ``[S, A]``, NaN where illegal.

    Args:
        mdp: the model.
        v: state values ``[S]``; those of terminal states should be 0.
        gamma: γ in [0, 1].

    Example:
        >>> action_values(FiniteMDP.from_arrays([[[1.0]]], [[3.0]]), [10.0], gamma=0.5).tolist()
        [[8.0]]
    """
    q = np.full((mdp.num_states, mdp.num_actions), np.nan)
    q[mdp.s_tm1, mdp.a_tm1] = mdp.reward + gamma * mdp.row_discount * (mdp.transition @ np.asarray(v, dtype=float))
    return q


def _row_probabilities(mdp: FiniteMDP, policy: NDArray[np.generic]) -> NDArray[np.float64]:
    """π of every row, ``[K]``."""
    lively = np.flatnonzero(~mdp.is_terminal)
    if policy.shape == (mdp.num_states,):
        action = policy.astype(np.int64)
        outside = lively[
            (action[lively] != policy[lively]) | (action[lively] < 0) | (action[lively] >= mdp.num_actions)
        ]
        illegal = lively[mdp.row_index[lively, np.clip(action[lively], 0, mdp.num_actions - 1)] < 0]
        for bad in (outside, illegal):
            if bad.size:
                raise ValueError(
                    f"policy takes action {policy[bad[0]]:g} in {mdp.state_name(bad[0])}, which is not legal"
                )
        pi = np.zeros(mdp.num_rows)
        pi[mdp.row_index[lively, action[lively]]] = 1.0
        return pi
    if policy.shape != (mdp.num_states, mdp.num_actions):
        raise ValueError(
            f"policy must be actions of shape ({mdp.num_states},) or probabilities of shape "
            f"({mdp.num_states}, {mdp.num_actions}), got shape {policy.shape}"
        )
    table = policy.astype(np.float64)
    legal = mdp.legal
    bad_pairs = np.argwhere(~np.where(legal, table >= 0, table == 0) & ~mdp.is_terminal[:, None])
    if bad_pairs.size:
        s, a = bad_pairs[0]
        what = "a probability" if legal[s, a] else "0, for it is not legal"
        raise ValueError(f"policy[{s}, {a}] must be {what}, got {table[s, a]}")
    total = np.where(legal, table, 0.0).sum(axis=1)
    off = lively[np.abs(total[lively] - 1) > 1e-9]
    if off.size:
        raise ValueError(f"policy in {mdp.state_name(off[0])} must sum to 1, got {total[off[0]]}")
    return np.asarray(table[mdp.s_tm1, mdp.a_tm1])


def _may_end(P_pi: sparse.csr_array) -> NDArray[np.bool_]:
    return np.asarray(P_pi.sum(axis=1)) < 1 - 1e-9


def _leading_to(P_pi: sparse.csr_array, goals: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """States from which, along the arrows, one of ``goals`` can be reached; the goals too."""
    leads_to, found, frontier = P_pi > 0, goals, goals
    while frontier.any():
        frontier = np.asarray(leads_to @ frontier.astype(np.int64) > 0) & ~found
        found = found | frontier
    return found


def _ending(mdp: FiniteMDP, P_pi: sparse.csr_array, r_pi: NDArray[np.float64]) -> sparse.csr_array:
    """P_π with an end in every state where it earns nothing for ever and no action could end the episode, if needed.

    Raises:
        ValueError: from some state no end is reached.
    """
    may_end = _may_end(P_pi)
    ends = _leading_to(P_pi, may_end)
    if ends.all():
        return P_pi
    anything, _ = policy_process(mdp, mdp.legal / np.maximum(1, mdp.legal.sum(axis=1, keepdims=True)))
    at_rest = ~_leading_to(P_pi, r_pi != 0) & ~_leading_to(anything, _may_end(anything))
    ends = _leading_to(P_pi, may_end | at_rest)
    if not ends.all():
        s = int(np.argmin(ends))
        raise ValueError(
            f"with gamma=1 the policy must end every episode, but from {mdp.state_name(s)} it never does; use gamma < 1"
        )
    return sparse.csr_array(sparse.diags_array((~at_rest).astype(np.float64)) @ P_pi)

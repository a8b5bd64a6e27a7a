"""How often a policy visits each state in the long run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from neuralq.mdp import FiniteMDP

__all__ = ["restarting_chain", "stationary_distribution"]

_LARGEST_FACTORED = 2000  # states up to which the equations are factored without a thought
_MOST_STEPS = 5000


def restarting_chain(mdp: FiniteMDP, policy: NDArray[np.float64]) -> sparse.csr_array:
    """The chain of non-terminal states under a policy when every episode that ends starts again, ``[S, S]``.

    An episode that ends, by missing mass, by a row's discount below 1 or by entering a terminal state, goes on in the
    same step from the model's start distribution. Rows and columns of terminal states are empty.

    Example:
        >>> P = [[[0.0, 1.0], [0.0, 0.0]]]
        >>> mdp = FiniteMDP.from_arrays(P, [[0.0], [1.0]], substochastic=True, start=[1.0, 0.0])
        >>> restarting_chain(mdp, np.ones((2, 1))).toarray().tolist()
        [[0.0, 1.0], [1.0, 0.0]]
    """
    weight = policy[mdp.s_tm1, mdp.a_tm1] * mdp.row_discount
    active = ~mdp.is_terminal
    keep = sparse.diags_array(active.astype(np.float64))
    choose = sparse.csr_array((weight, (mdp.s_tm1, np.arange(mdp.num_rows))), shape=(mdp.num_states, mdp.num_rows))
    inside = sparse.csr_array(choose @ mdp.transition @ keep)
    ended = np.where(active, 1.0 - np.asarray(inside.sum(axis=1)).reshape(-1), 0.0)
    ended[np.abs(ended) < 1e-12] = 0.0
    again = sparse.csr_array(ended[:, None]) @ sparse.csr_array(mdp.start_distribution[None, :])
    return sparse.csr_array(inside + again)


def stationary_distribution(mdp: FiniteMDP, policy: NDArray[np.float64]) -> NDArray[np.float64]:
    """The long-run share of time in each state, ``[S]``: d = d P, Σ d = 1, with episodes that start again.

    Raises:
        ValueError: the chain has several recurrent classes that the start distribution reaches, so that the share
            depends on chance.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.5, 0.5]]], [[0.0], [0.0]])
        >>> stationary_distribution(mdp, np.ones((2, 1))).round(12).tolist()
        [0.333333333333, 0.666666666667]
    """
    chain = restarting_chain(mdp, policy)
    recurrent = _recurrent_states(chain, mdp.start_distribution > 0)
    sub = chain[recurrent][:, recurrent]
    n = len(recurrent)
    share = np.ones(n) if n <= 1 else _mixed(sub) if n > _LARGEST_FACTORED else None
    if share is None:  # d (I − P) = 0 without its last equation, the last entry held at 1
        system = sparse.csc_array(sparse.eye_array(n) - sub).T.tocsc()
        head = splu(system[: n - 1, : n - 1]).solve(-system[: n - 1, [n - 1]].toarray().reshape(-1))
        share = np.append(head, 1.0)
    out = np.zeros(mdp.num_states)
    out[recurrent] = np.maximum(share, 0.0)
    distribution: NDArray[np.float64] = out / out.sum()
    return distribution


def _mixed(chain: sparse.csr_array) -> NDArray[np.float64] | None:
    """The limit distribution of a chain, by steps of the lazy chain (P + I)/2; None where it mixes too slowly.

    The factors of a large random graph would be almost dense; but such a graph mixes within some dozen steps.
    """
    back, share = sparse.csr_array(chain.T), np.full(chain.shape[0], 1 / chain.shape[0])
    for _ in range(_MOST_STEPS):
        moved = 0.5 * (share + back @ share)
        moved /= moved.sum()
        if np.abs(moved - share).sum() < 1e-15:
            return np.asarray(moved)
        share = moved
    return None


def _recurrent_states(chain: sparse.csr_array, start: NDArray[np.bool_]) -> NDArray[np.int64]:
    """States of the one closed class that the start leads to."""
    reached, frontier = start.copy(), start
    while frontier.any():
        onward = np.asarray(chain.T @ frontier.astype(np.float64)).reshape(-1) > 0
        frontier = onward & ~reached
        reached = reached | frontier
    _, label = connected_components(chain, directed=True, connection="strong")
    origin, target = chain.nonzero()
    open_classes = set(label[origin[label[origin] != label[target]]].tolist())
    closed = sorted(set(label[reached].tolist()) - open_classes)
    if len(closed) != 1:
        raise ValueError(
            f"the behaviour policy ends up in one of {len(closed)} separate parts of the model, so the share of time "
            "in each state depends on chance; give state_distribution yourself"
        )
    return np.flatnonzero(label == closed[0])

"""The order of updates within an episode: the same rule, on a table, forwards or backwards.

Mitchell (1997, section 13.3.6) observes that the training rule ``Q(s,a) ← r + γ maxₐ' Q(s',a')`` reads the table it
writes, so order matters. From a table of zeros and one reward at the goal, an episode replayed forwards changes only
the last entry of its path; replayed backwards, each update finds its successor already updated, and one episode
carries the reward along the whole path. Step size 1 is the deterministic rule (eq. 13.7), a smaller one averages over
chance (eq. 13.10).
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from neuralq.checks import check_fraction
from neuralq.rules.shapes import check_actions, check_same_shape
from neuralq.rules.targets import one_step

__all__ = ["forward_episode_update", "reverse_episode_update"]


def reverse_episode_update(
    q: Tensor, s_tm1: Tensor, a_tm1: Tensor, r_t: Tensor, discount_t: Tensor, s_t: Tensor, step_size: float = 1.0
) -> Tensor:
    """The table after Q-learning on an episode's transitions, last one first: the reward travels the whole path.

    For t = T-1, …, 0 in turn: ``q[s_tm1, a_tm1] += step_size · (r_t + discount_t · maxₐ q[s_t, a] - q[s_tm1, a_tm1])``,
    each update reading what the ones before it wrote.

    Args:
        q: table, ``[S, A]``, -∞ for illegal actions; not changed.
        s_tm1: states left, ``[T]``, int64.
        a_tm1: actions taken, ``[T]``, int64.
        r_t: rewards, ``[T]``.
        discount_t: γ, or 0 at termination, ``[T]``.
        s_t: states reached, ``[T]``, int64.
        step_size: α in [0, 1]; 1 is the deterministic rule.

    Returns:
        A new table, ``[S, A]``.

    Raises:
        ValueError: if the shapes differ or ``step_size`` is outside [0, 1].

    Source: Mitchell 1997, section 13.3.6 and eq. 13.7, 13.10.

    Example:
        A corridor of three states, reward 100 at its end, γ = .9: one episode fills it.

        >>> path, right = torch.tensor([0, 1, 2]), torch.tensor([0, 0, 0])
        >>> r_t, discount_t = torch.tensor([0.0, 0.0, 100.0]), torch.tensor([0.9, 0.9, 0.0])
        >>> reverse_episode_update(torch.zeros(4, 1), path, right, r_t, discount_t, path + 1)[:, 0]
        tensor([ 81.,  90., 100.,   0.])
    """
    order = range(r_t.shape[0] - 1, -1, -1) if r_t.ndim == 1 else ()
    return _update_in_order(order, q, s_tm1, a_tm1, r_t, discount_t, s_t, step_size)


def forward_episode_update(
    q: Tensor, s_tm1: Tensor, a_tm1: Tensor, r_t: Tensor, discount_t: Tensor, s_t: Tensor, step_size: float = 1.0
) -> Tensor:
    """The table after Q-learning on an episode's transitions in the order they happened: one entry back per episode.

    Arguments, answer and errors as in `reverse_episode_update`; this is what the learner of Mitchell's Table 13.1 does.

    Source: Mitchell 1997, Table 13.1.

    Example:
        >>> path, right = torch.tensor([0, 1, 2]), torch.tensor([0, 0, 0])
        >>> r_t, discount_t = torch.tensor([0.0, 0.0, 100.0]), torch.tensor([0.9, 0.9, 0.0])
        >>> forward_episode_update(torch.zeros(4, 1), path, right, r_t, discount_t, path + 1)[:, 0]
        tensor([  0.,   0., 100.,   0.])
    """
    order = range(r_t.shape[0]) if r_t.ndim == 1 else ()
    return _update_in_order(order, q, s_tm1, a_tm1, r_t, discount_t, s_t, step_size)


def _update_in_order(
    order: Iterable[int],
    q: Tensor,
    s_tm1: Tensor,
    a_tm1: Tensor,
    r_t: Tensor,
    discount_t: Tensor,
    s_t: Tensor,
    step_size: float,
) -> Tensor:
    """Q-learning with ``step_size`` on the rows of an episode, in the given order."""
    check_fraction("step_size", step_size, "1 is the deterministic rule")
    if r_t.ndim != 1 or q.ndim != 2:
        raise ValueError(f"one episode [T] and a table [S, A] are needed, got r_t {list(r_t.shape)}, q {list(q.shape)}")
    for name, tensor in (("discount_t", discount_t), ("s_tm1", s_tm1), ("s_t", s_t)):
        check_same_shape(name, tensor, "r_t", r_t)
    check_actions("a_tm1", a_tm1, "the episode", r_t[:, None])
    table = q.clone()
    states, actions, successors = s_tm1.tolist(), a_tm1.tolist(), s_t.tolist()
    for row in order:
        # The clones are what autograd remembers; the table itself may then be written in place.
        v_t = table[successors[row]].clone().amax()
        old = table[states[row], actions[row]].clone()
        target = one_step(r_t[row], discount_t[row], v_t)
        table[states[row], actions[row]] = torch.lerp(old, target, step_size)
    return table

"""One-step targets: what a single transition says Q(s_tm1, a_tm1) should be.

Every rule here has the form ``r_t + discount_t · V(s_t)`` and differs in what it takes for V(s_t): the best action
(Q-learning), the best action according to a second function (double Q-learning), the policy's average (expected
Sarsa) or the action that was taken next (Sarsa). `discount_t` is γ, or 0 where the world terminated; a time limit
keeps γ, because the state after it still has a value.

Illegal actions carry q = -∞. A terminal successor may have no legal action at all: its value is then -∞ and is
multiplied by a discount of 0, which this module defines as 0 (floating point would say NaN). A state without legal
actions that is *not* terminal is the environment's mistake: its -∞ is passed on, so that it is seen.

Nothing is detached: whether the target is differentiated is the learner's decision. Where several actions tie for the
maximum, the derivative of the maximum is shared equally among them (a subgradient).
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.rules.shapes import check_actions, check_same_shape

__all__ = ["double_q", "expected_sarsa", "expected_value", "one_step", "q_learning", "sarsa", "weighted_value"]


def weighted_value(weight: Tensor, v: Tensor) -> Tensor:
    """``weight · v`` elementwise, where a weight of 0 times a value of -∞ is 0 and not NaN.

    Args:
        weight: any shape, finite.
        v: the same shape; -∞ means "no legal action".

    Finite values keep their exact derivative with respect to ``weight`` even where it is 0.

    Example:
        >>> weighted_value(torch.tensor([0.0, 0.5]), torch.tensor([-torch.inf, 4.0]))
        tensor([0., 2.])
    """
    return weight * v.masked_fill(torch.isneginf(v) & (weight == 0), 0.0)


def one_step(r_t: Tensor, discount_t: Tensor, v_t: Tensor) -> Tensor:
    """The one-step target is the reward plus the discounted value of the successor: ``r_t + discount_t · v_t``.

    Args:
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 at termination, ``[*n]``.
        v_t: value of the successor, ``[*n]``; -∞ is harmless where ``discount_t`` is 0.

    Raises:
        ValueError: if the shapes differ.

    Source: Sutton 1988, TD(0).

    Example:
        >>> one_step(torch.tensor([1.0, 1.0]), torch.tensor([0.5, 0.0]), torch.tensor([4.0, -torch.inf]))
        tensor([3., 1.])
    """
    check_same_shape("discount_t", discount_t, "r_t", r_t)
    check_same_shape("v_t", v_t, "r_t", r_t)
    return r_t + weighted_value(discount_t, v_t)


def q_learning(r_t: Tensor, discount_t: Tensor, q_t: Tensor) -> Tensor:
    """The Q-learning target bootstraps from the best action of the successor: ``r_t + discount_t · maxₐ q_t[a]``.

    Args:
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 at termination, ``[*n]``.
        q_t: action values of the successor, ``[*n, A]``, -∞ for illegal actions.

    Returns:
        Targets, ``[*n]``.

    Raises:
        ValueError: if the leading axes differ.

    Source: Watkins 1989; Mitchell 1997, eq. 13.7.

    Example:
        Mitchell's Figure 13.3: one step right takes Q(s1, right) from 72.9 to 90.

        >>> q_learning(torch.tensor(0.0), torch.tensor(0.9), torch.tensor([66.0, 81.0, 100.0]))
        tensor(90.)
    """
    return one_step(r_t, discount_t, q_t.amax(-1))


def double_q(r_t: Tensor, discount_t: Tensor, q_t_value: Tensor, q_t_selector: Tensor) -> Tensor:
    """Double Q-learning lets one function choose the action and another one value it, against maximisation bias.

    ``r_t + discount_t · q_t_value[argmaxₐ q_t_selector[a]]``; ties are resolved to the lowest index.

    Args:
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 at termination, ``[*n]``.
        q_t_value: values that are believed (the target network), ``[*n, A]``, -∞ for illegal actions.
        q_t_selector: values that choose (the online network), ``[*n, A]``, -∞ for illegal actions.

    Returns:
        Targets, ``[*n]``.

    Raises:
        ValueError: if shapes differ.

    Source: van Hasselt 2010; van Hasselt, Guez, Silver 2016, eq. 4.

    Example:
        >>> double_q(torch.tensor(1.0), torch.tensor(0.5), torch.tensor([10.0, 2.0]), torch.tensor([0.0, 1.0]))
        tensor(2.)
    """
    check_same_shape("q_t_selector", q_t_selector, "q_t_value", q_t_value)
    chosen = q_t_selector.argmax(-1, keepdim=True)
    return one_step(r_t, discount_t, q_t_value.gather(-1, chosen)[..., 0])


def expected_value(q: Tensor, pi: Tensor) -> Tensor:
    """A state is worth the policy's average over its actions: ``Σₐ pi[a] · q[a]``, illegal actions counting nothing.

    Args:
        q: action values, ``[*n, A]``, -∞ for illegal actions.
        pi: probabilities, ``[*n, A]``; 0 for illegal actions (a positive one gives -∞).

    Returns:
        Values, ``[*n]``; 0 where ``pi`` is zero throughout (a state without legal actions).

    Raises:
        ValueError: if the shapes differ.

    Example:
        >>> expected_value(torch.tensor([4.0, 2.0, -torch.inf]), torch.tensor([0.5, 0.5, 0.0]))
        tensor(3.)
    """
    check_same_shape("pi", pi, "q", q)
    return weighted_value(pi, q).sum(-1)


def expected_sarsa(r_t: Tensor, discount_t: Tensor, q_t: Tensor, pi_t: Tensor) -> Tensor:
    """Expected Sarsa bootstraps from the policy's average: ``r_t + discount_t · Σₐ pi_t[a] · q_t[a]``.

    Args:
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 at termination, ``[*n]``.
        q_t: action values of the successor, ``[*n, A]``, -∞ for illegal actions.
        pi_t: the target policy's probabilities there, ``[*n, A]``.

    Returns:
        Targets, ``[*n]``. With a greedy ``pi_t`` this is Q-learning.

    Raises:
        ValueError: if the shapes differ.

    Source: van Seijen, van Hasselt, Whiteson, Wiering 2009, eq. 5.

    Example:
        >>> q_t, pi_t = torch.tensor([4.0, 2.0, -torch.inf]), torch.tensor([0.5, 0.5, 0.0])
        >>> expected_sarsa(torch.tensor(1.0), torch.tensor(0.5), q_t, pi_t)
        tensor(2.5000)
    """
    return one_step(r_t, discount_t, expected_value(q_t, pi_t))


def sarsa(r_t: Tensor, discount_t: Tensor, q_t: Tensor, a_t: Tensor) -> Tensor:
    """Sarsa bootstraps from the action that was taken next: ``r_t + discount_t · q_t[a_t]``.

    Args:
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 at termination, ``[*n]``.
        q_t: action values of the successor, ``[*n, A]``.
        a_t: action taken in the successor, ``[*n]``, int64 (any valid index where ``discount_t`` is 0).

    Returns:
        Targets, ``[*n]``.

    Raises:
        ValueError: if the leading axes differ or ``a_t`` is not int64.

    Source: Rummery & Niranjan 1994.

    Example:
        >>> sarsa(torch.tensor(1.0), torch.tensor(0.5), torch.tensor([4.0, 2.0]), torch.tensor(1))
        tensor(2.)
    """
    check_actions("a_t", a_t, "q_t", q_t)
    return one_step(r_t, discount_t, q_t.gather(-1, a_t[..., None])[..., 0])

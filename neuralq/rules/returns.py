"""Multi-step returns over a rollout: how far the truth is believed before the estimate takes over.

The n-step return is ``Q⁽ⁿ⁾ = r_t + γ r_{t+1} + … + γⁿ⁻¹ r_{t+n-1} + γⁿ V(s_{t+n})``; the λ-return averages them all,
``(1-λ) Σₙ λⁿ⁻¹ Q⁽ⁿ⁾``. It satisfies a recursion, which is how it is computed, backwards over a rollout:

    G_t = r_t + discount_t · [(1-λ_t) v_t + λ_t G_{t+1}]

where row t is one transition and v_t is the value of *its successor*. Mitchell (1997, section 13.5) prints
max Q(s_t, a) inside the bracket, the value of the state that was left; with that the recursion does not equal the sum
it is meant to equal. With the successor it does (the tests show both).

Three things end a return, and each has its own place:
* termination: `discount_t` is 0, nothing is bootstrapped;
* a time limit, an autoreset: `last_t` is true, the row bootstraps fully from its own v_t, for the next row belongs to
  another episode;
* the edge of the rollout: the last row bootstraps from its own v_t, whatever `last_t` says.

λ_t belongs to the mixing of row t with row t+1, so an exploring action cuts in the row *before* the one that took it.
Peng's Q(λ) does not cut at all (`lambda_t` a constant); Watkins' does (`watkins_lambda`).

Under a behaviour policy μ that is not the target policy π, `off_policy_returns` corrects instead of cutting: the
errors ``δ_t = r_t + discount_t · E_π q_t − q_tm1[a_tm1]`` of the rows that follow are added, each times the product of
coefficients c of the actions on the way there. Retrace, tree backup and Q(λ) differ in c alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.checks import check_fraction, check_whole
from neuralq.rules.shapes import check_actions, check_same_shape, check_time_major
from neuralq.rules.targets import weighted_value

__all__ = [
    "is_greedy",
    "lambda_returns",
    "n_step_returns",
    "off_policy_returns",
    "retrace_coefficients",
    "tree_backup_coefficients",
    "watkins_lambda",
]


def lambda_returns(r_t: Tensor, discount_t: Tensor, v_t: Tensor, lambda_t: Tensor | float, last_t: Tensor) -> Tensor:
    """λ-returns of every row of a rollout: ``G_t = r_t + discount_t · [(1-λ_t) v_t + λ_t G_{t+1}]``.

    Where ``last_t`` is true and in the last row, the row bootstraps fully: ``G_t = r_t + discount_t · v_t``.

    Args:
        r_t: rewards, time-major ``[T, *n]``.
        discount_t: γ, or 0 where the world terminated, ``[T, *n]``.
        v_t: value of each row's successor s_t, ``[T, *n]``; -∞ is harmless where it has no weight.
        lambda_t: a number in [0, 1], or one per row ``[T, *n]`` (values in [0, 1] are the caller's care).
        last_t: where the stream breaks, ``[T, *n]``, bool.

    Returns:
        ``[T, *n]`` in the dtype of ``v_t``. λ = 0 gives one-step targets, λ = 1 the return up to the break.

    Raises:
        ValueError: if shapes differ, T is 0, ``last_t`` is not bool, or a number ``lambda_t`` is outside [0, 1].

    Source: Watkins 1989; Peng & Williams 1996, eq. 9; Mitchell 1997, section 13.5 (with s_{t+1} for the printed s_t).

    Example:
        >>> r_t, v_t = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.2, 0.4, 7.0])
        >>> discount_t, last_t = torch.tensor([0.9, 0.9, 0.0]), torch.tensor([False, False, True])
        >>> lambda_returns(r_t, discount_t, v_t, 0.5, last_t)
        tensor([0.3735, 0.6300, 1.0000])
    """
    check_time_major(r_t, discount_t, v_t, last_t)
    if isinstance(lambda_t, Tensor):
        check_same_shape("lambda_t", lambda_t, "r_t", r_t)
        lambda_t = lambda_t.to(v_t.dtype)
    else:
        check_fraction("lambda_t", lambda_t, "for Monte Carlo returns use lambda_t=1")
    # G_t = near_t + carry_t · G_{t+1}: all but the recursion itself is computed for the whole rollout at once.
    carry = (discount_t * lambda_t).masked_fill(_breaks(last_t), 0.0)
    near = r_t + weighted_value(discount_t - carry, v_t)
    return _accumulate_backwards(near, carry)


def n_step_returns(r_t: Tensor, discount_t: Tensor, v_t: Tensor, n: int, last_t: Tensor) -> Tensor:
    """n-step returns of every row: n discounted rewards, then the value of the state reached.

    ``G_t = r_t + discount_t r_{t+1} + … + (discount_t ⋯ discount_{t+n-1}) v_{t+n-1}``. A row with fewer than n rows
    before the stream breaks (``last_t``, the rollout's edge) bootstraps from the v of the row where it breaks.

    Args:
        r_t: rewards, time-major ``[T, *n]``.
        discount_t: γ, or 0 where the world terminated, ``[T, *n]``.
        v_t: value of each row's successor s_t, ``[T, *n]``; -∞ is harmless where the discount is 0.
        n: number of rewards, at least 1; any n ≥ T gives the whole return.
        last_t: where the stream breaks, ``[T, *n]``, bool.

    Returns:
        ``[T, *n]``.

    Raises:
        ValueError: if shapes differ, T is 0, ``last_t`` is not bool, or ``n`` is not a whole number of at least 1.

    Source: Watkins 1989; Mitchell 1997, section 13.5, Q⁽ⁿ⁾.

    Example:
        >>> r_t, v_t = torch.tensor([1.0, 2.0, 4.0]), torch.tensor([8.0, 16.0, 32.0])
        >>> discount_t, last_t = torch.tensor([0.5, 0.5, 0.5]), torch.tensor([False, False, False])
        >>> n_step_returns(r_t, discount_t, v_t, 2, last_t)
        tensor([ 6., 12., 20.])
    """
    check_time_major(r_t, discount_t, v_t, last_t)
    check_whole("n", n)
    num_rows = r_t.shape[0]
    returns = r_t + weighted_value(discount_t, v_t)
    breaks = _breaks(last_t)
    carry = discount_t.masked_fill(breaks, 0.0)
    near = torch.where(breaks, returns, r_t)
    if n >= num_rows:
        return _accumulate_backwards(near, carry)
    for _ in range(n - 1):  # the (k+1)-step return of a row is its reward and the k-step return of the next row
        returns = torch.cat([torch.addcmul(near[:-1], carry[:-1], returns[1:]), returns[-1:]])
    return returns


def is_greedy(q: Tensor, a: Tensor) -> Tensor:
    """Whether each action is one of the best; ties count as greedy: ``q[a] == max q``.

    Args:
        q: action values, ``[*n, A]``, -∞ for illegal actions. Use the very values the behaviour policy saw: a network
            evaluated again in another batch may differ in the last bit.
        a: actions, ``[*n]``, int64.

    Returns:
        bool, ``[*n]``.

    Raises:
        ValueError: if the leading axes differ or ``a`` is not int64.

    Example:
        >>> is_greedy(torch.tensor([[1.0, 3.0, 3.0], [1.0, 3.0, 3.0]]), torch.tensor([2, 0]))
        tensor([ True, False])
    """
    check_actions("a", a, "q", q)
    return q.gather(-1, a[..., None])[..., 0] == q.amax(-1)


def watkins_lambda(lambda_: float, greedy_tm1: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
    """Watkins' λ_t: λ where the action taken *in the successor* s_t is greedy, 0 where it explores.

    Row t mixes with G_{t+1}, the return that follows the action of row t+1; if that action explored, its return says
    nothing about the greedy policy. So ``λ_t = lambda_ · greedy_tm1[t+1]``: the flag of the next row. The exploring
    row keeps its own return, for the action of a row is given, not chosen. The last row has no next action and gets 0
    (`lambda_returns` bootstraps it fully in any case).

    Args:
        lambda_: in [0, 1].
        greedy_tm1: whether the action ``a_tm1`` of each row was greedy in ``s_tm1``, ``[T, *n]``, bool, *not* shifted:
            ``is_greedy(q_tm1, a_tm1)``.
        dtype: of the answer. float64 holds λ unrounded; `lambda_returns` converts to its own dtype.

    Returns:
        ``[T, *n]``, for `lambda_returns`.

    Raises:
        ValueError: if ``lambda_`` is outside [0, 1], or ``greedy_tm1`` has no rows or is not bool.

    Source: Watkins 1989, section 7.5; Sutton & Barto 2018, section 12.10.

    Example:
        The middle row explored: it cuts the row before it.

        >>> watkins_lambda(0.5, torch.tensor([True, False, True, True]), torch.float32)
        tensor([0.0000, 0.5000, 0.5000, 0.0000])
    """
    check_fraction("lambda_", lambda_)
    if greedy_tm1.dtype != torch.bool or greedy_tm1.ndim == 0 or greedy_tm1.shape[0] == 0:
        raise ValueError(
            f"greedy_tm1 must be bool [T, *n] with T of at least 1, got {greedy_tm1.dtype} {list(greedy_tm1.shape)}; "
            f"pass is_greedy(q_tm1, a_tm1)"
        )
    lambda_t = torch.zeros(greedy_tm1.shape, dtype=dtype, device=greedy_tm1.device)
    lambda_t[:-1].masked_fill_(greedy_tm1[1:], lambda_)
    return lambda_t


def off_policy_returns(
    q_tm1: Tensor, r_t: Tensor, discount_t: Tensor, v_t: Tensor, c_tm1: Tensor, last_t: Tensor
) -> Tensor:
    """Off-policy returns add the errors of later rows as far as the coefficients carry: ``G_t = q_tm1 + Δ_t``.

    ``Δ_t = δ_t + discount_t · c_{t+1} · Δ_{t+1}`` and ``δ_t = r_t + discount_t · v_t − q_tm1``, where c_{t+1} belongs
    to the action of the *next* row. A row's own coefficient never touches its own return: its action is given.

    Args:
        q_tm1: Q(s_tm1, a_tm1) of every row, time-major ``[T, *n]``.
        r_t: rewards, ``[T, *n]``.
        discount_t: γ, or 0 where the world terminated, ``[T, *n]``.
        v_t: E_π Q of each row's successor, ``[T, *n]``; -∞ is harmless where ``discount_t`` is 0.
        c_tm1: coefficient of the action ``a_tm1`` of every row, *not* shifted, ``[T, *n]``: `retrace_coefficients`,
            `tree_backup_coefficients`, λ throughout (Q(λ) of Harutyunyan et al.: safe for π near μ only), λ where the
            action is greedy and 0 elsewhere (Watkins), π/μ (importance sampling).
        last_t: where the stream breaks, ``[T, *n]``, bool; nothing is carried over a break or the rollout's edge.

    Returns:
        ``[T, *n]``. With c = 0 these are one-step targets.

    Raises:
        ValueError: if shapes differ, T is 0 or ``last_t`` is not bool.

    Source: Munos et al. 2016, eq. 3 and 4, of which Harutyunyan et al. 2016, Precup et al. 2000 are cases.

    Example:
        δ = (1, 1, 1); the coefficient of the middle row is ½, that of the last row 0.

        >>> one, zero = torch.ones(3), torch.zeros(3)
        >>> off_policy_returns(zero, one, one, zero, torch.tensor([9.0, 0.5, 0.0]), zero > 0)
        tensor([1.5000, 1.0000, 1.0000])
    """
    check_time_major(r_t, discount_t, v_t, last_t)
    check_same_shape("q_tm1", q_tm1, "r_t", r_t)
    check_same_shape("c_tm1", c_tm1, "r_t", r_t)
    delta = r_t + weighted_value(discount_t, v_t) - q_tm1
    # The last row's own coefficient stands in for that of the row after it, which is masked out with every break.
    following = torch.cat([c_tm1[1:], c_tm1[-1:]])
    carry = (discount_t * following).masked_fill(_breaks(last_t), 0.0)
    return q_tm1 + _accumulate_backwards(delta, carry)


def retrace_coefficients(lambda_: float, pi_tm1: Tensor, mu_tm1: Tensor) -> Tensor:
    """Retrace follows an action as far as the target policy would: ``c = λ · min(1, π/μ)``.

    Safe for every π and μ, and as far-reaching as safety allows: where π = μ nothing is cut.

    Args:
        lambda_: in [0, 1].
        pi_tm1: probability of each row's action under the target policy, ``[T, *n]``.
        mu_tm1: and under the policy that took it, ``[T, *n]``, above 0.

    Returns:
        ``[T, *n]`` in the dtype of ``pi_tm1``, for `off_policy_returns`.

    Raises:
        ValueError: if ``lambda_`` is outside [0, 1] or the shapes differ.

    Source: Munos et al. 2016, section 3.2.

    Example:
        >>> retrace_coefficients(0.5, torch.tensor([0.1, 0.8]), torch.tensor([0.4, 0.4]))
        tensor([0.1250, 0.5000])
    """
    check_fraction("lambda_", lambda_)
    check_same_shape("mu_tm1", mu_tm1, "pi_tm1", pi_tm1)
    return lambda_ * (pi_tm1 / mu_tm1.to(pi_tm1.dtype)).clamp(max=1.0)


def tree_backup_coefficients(lambda_: float, pi_tm1: Tensor) -> Tensor:
    """Tree backup follows an action in proportion to its target probability: ``c = λ · π``, whatever the behaviour.

    Args:
        lambda_: in [0, 1].
        pi_tm1: probability of each row's action under the target policy, ``[T, *n]``.

    Returns:
        ``[T, *n]``, for `off_policy_returns`.

    Raises:
        ValueError: if ``lambda_`` is outside [0, 1].

    Source: Precup, Sutton & Singh 2000, section 3; Munos et al. 2016, table 1.

    Example:
        >>> tree_backup_coefficients(0.5, torch.tensor([0.5, 1.0]))
        tensor([0.2500, 0.5000])
    """
    check_fraction("lambda_", lambda_)
    return lambda_ * pi_tm1


def _breaks(last_t: Tensor) -> Tensor:
    """Rows that bootstrap fully: where the stream breaks, and the last row of the rollout."""
    breaks = last_t.clone()
    breaks[-1] = True
    return breaks


def _accumulate_backwards(near: Tensor, carry: Tensor) -> Tensor:
    """``G_t = near_t + carry_t · G_{t+1}`` for all rows by doubling; the last row's ``carry`` must be 0.

    After each pass a row stands for twice as many rows, ``G_t = near_t + carry_t · G_{t+k}``: log₂ T passes over the
    rollout instead of T operations on one row each, which is several times faster for long rollouts of few streams,
    and on an accelerator.
    """
    reach = 1
    while reach < near.shape[0]:
        joined = torch.addcmul(near[:-reach], carry[:-reach], near[reach:])
        near = torch.cat([joined, near[-reach:]])
        carry = torch.cat([carry[:-reach] * carry[reach:], carry[-reach:]])
        reach *= 2
    return near

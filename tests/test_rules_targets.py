"""One-step targets, against hand arithmetic.

Mutants that these tests kill: double Q-learning with selector and value exchanged; the maximum over illegal actions as
0 (wrong where all values are negative); 0 · -∞ = NaN at a terminal successor, in the value and in its derivative;
expected Sarsa as a plain mean.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from neuralq import rules
from neuralq.rules import TargetRule
from neuralq.rules.target_rule import Followed, Seen
from neuralq.types import Transition

INF = torch.inf
Q_T = torch.tensor([[1.0, 4.0, 2.0], [-1.0, -3.0, -INF], [-INF, -INF, -INF]])
R_T = torch.tensor([1.0, 1.0, 1.0])
DISCOUNT_T = torch.tensor([0.5, 0.5, 0.0])


def test_q_learning_by_hand() -> None:
    # 1 + .5·4, 1 + .5·(-1), nothing legal and terminal: the reward
    assert rules.q_learning(R_T, DISCOUNT_T, Q_T).tolist() == [3.0, 0.5, 1.0]


def test_double_q_by_hand() -> None:
    selector = torch.tensor([[0.0, 1.0, 9.0], [0.0, 1.0, -INF], [-INF, -INF, -INF]])
    # the selector picks actions 2 and 1: 1 + .5·2, 1 + .5·(-3)
    assert rules.double_q(R_T, DISCOUNT_T, Q_T, selector).tolist() == [2.0, -0.5, 1.0]


def test_double_q_takes_the_lowest_index_on_ties() -> None:
    target = rules.double_q(torch.tensor(0.0), torch.tensor(1.0), torch.tensor([5.0, 7.0]), torch.tensor([3.0, 3.0]))
    assert target.item() == 5.0


def test_expected_sarsa_by_hand() -> None:
    pi = torch.tensor([[0.5, 0.25, 0.25], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]])
    # 1 + .5·(.5 + 1 + .5), 1 + .5·(-2)
    assert rules.expected_sarsa(R_T, DISCOUNT_T, Q_T, pi).tolist() == [2.0, 0.0, 1.0]
    uniform = torch.full((3, 3), 1 / 3)  # a policy that puts mass on the terminal state's actions does no harm there
    assert rules.expected_sarsa(R_T, DISCOUNT_T, Q_T, uniform)[2].item() == 1.0


def test_sarsa_by_hand() -> None:
    assert rules.sarsa(R_T, DISCOUNT_T, Q_T, torch.tensor([2, 1, 0])).tolist() == [2.0, -0.5, 1.0]


def test_a_dead_end_that_is_not_terminal_is_seen() -> None:
    half = torch.full((3,), 0.5)
    assert rules.q_learning(R_T, half, Q_T)[2].item() == -INF


def test_a_nan_is_never_hidden() -> None:
    nan = torch.full((1, 2), torch.nan)
    assert rules.q_learning(torch.ones(1), torch.zeros(1), nan).isnan().all()


seeds = st.integers(0, 2**32 - 1)


def random_step(seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rewards, discounts (some 0) and action values (some illegal, never all) of 5 × 2 steps and 4 actions."""
    g = torch.Generator().manual_seed(seed)
    r, discount = (torch.rand(5, 2, generator=g, dtype=torch.float64) for _ in range(2))
    q = torch.randn(5, 2, 4, generator=g, dtype=torch.float64)
    illegal = torch.rand(5, 2, 4, generator=g) < 0.4
    illegal[..., 0] = False
    return r, discount.masked_fill(torch.rand(5, 2, generator=g) < 0.3, 0.0), q.masked_fill(illegal, -INF)


@given(seeds)
def test_greedy_expectation_is_q_learning(seed: int) -> None:
    r, discount, q = random_step(seed)
    best = rules.q_learning(r, discount, q)
    for policy in (rules.greedy(q), rules.greedy_random_ties(q), rules.k_to_the_q(q, 1e300)):
        assert (rules.expected_sarsa(r, discount, q, policy) <= best + 1e-9).all()
    torch.testing.assert_close(rules.expected_sarsa(r, discount, q, rules.greedy(q)), best)
    torch.testing.assert_close(rules.sarsa(r, discount, q, q.argmax(-1)), best)
    torch.testing.assert_close(rules.double_q(r, discount, q, q), best)


@given(seeds)
def test_q_learning_contracts_by_the_discount(seed: int) -> None:
    r, discount, q = random_step(seed)
    other = q + torch.randn(q.shape, generator=torch.Generator().manual_seed(seed + 1), dtype=q.dtype)
    gap = (rules.q_learning(r, discount, q) - rules.q_learning(r, discount, other)).abs()
    legal_change = (q - other).nan_to_num(0.0).abs().amax(-1)
    assert (gap <= discount * legal_change + 1e-12).all()


def test_derivatives_are_finite_beside_illegal_actions() -> None:
    q = Q_T.clone().requires_grad_()
    pi = torch.tensor([[0.5, 0.25, 0.25], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]], requires_grad=True)
    rules.q_learning(R_T, DISCOUNT_T, q).sum().backward()
    assert q.grad is not None
    assert q.grad.tolist() == [[0.0, 0.5, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]
    q.grad = None
    rules.expected_sarsa(R_T, DISCOUNT_T, q, pi).sum().backward()
    assert torch.equal(q.grad, DISCOUNT_T[:, None] * pi.detach())
    assert pi.grad is not None and pi.grad.isfinite().all()


def test_mismatched_shapes_are_refused() -> None:
    ones = torch.ones(3)
    for call, message in [
        (lambda: rules.q_learning(ones, ones, torch.ones(3, 1, 2)), "v_t must have the shape of r_t"),
        (lambda: rules.q_learning(ones, ones[:, None], torch.ones(3, 2)), "discount_t must have the shape"),
        (lambda: rules.sarsa(ones, ones, torch.ones(3, 2), torch.zeros(3)), "int64"),
        (lambda: rules.sarsa(ones, ones, torch.ones(3, 2), torch.zeros(3, 1).long()), "leading axes"),
        (lambda: rules.expected_sarsa(ones, ones, torch.ones(3, 2), torch.ones(2)), "pi must have the shape"),
        (lambda: rules.double_q(ones, ones, torch.ones(3, 2), torch.ones(3, 1)), "q_t_selector"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


def test_a_rule_that_follows_an_action_takes_its_value_whatever_the_axes() -> None:
    q_t = torch.tensor([[[1.0, 5.0], [7.0, 2.0]], [[3.0, 4.0], [9.0, 8.0]]], dtype=torch.float64)  # [T, N, A]
    a = torch.tensor([[1, 0], [0, 1]])
    ones = torch.ones(2, 2)
    step = Transition(0 * a, 0 * a, ones, ones, 0.5 * ones, 0 * a, ones < 0)
    rule = TargetRule("given", "what is given", "this test", follows=lambda seen: Followed(a=a))
    target = rule.target(Seen(step, lambda s, frozen: q_t))
    assert target.tolist() == [[1 + 2.5, 1 + 3.5], [1 + 1.5, 1 + 4.0]]
    flat = Transition(*(x.reshape(-1) for x in (0 * a, 0 * a, ones, ones, 0.5 * ones, 0 * a, ones < 0)))
    rule = TargetRule("given", "what is given", "this test", follows=lambda seen: Followed(a=a.reshape(-1)))
    assert rule.target(Seen(flat, lambda s, frozen: q_t.reshape(4, 2))).tolist() == target.reshape(-1).tolist()

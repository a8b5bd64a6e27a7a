"""Off-policy returns against the sum that defines them, and against each other where they must agree.

Mutants that were tried, and die: a row's own coefficient in place of the next row's; the coefficient of the row after
the next; breaks not cut; the discount of the next row in place of the row's own; min(1, π/μ) without the bound, or as
min(1, μ/π).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from neuralq import rules

F64 = torch.float64
T, N, A = 7, 4, 3


class Rollout:
    """A stream of random values in which every kind of end occurs; the chain of states is kept where it is unbroken."""

    def __init__(self, seed: int, break_rate: float = 0.3) -> None:
        rng = np.random.default_rng(seed)
        self.last_t = torch.from_numpy(rng.random((T, N)) < break_rate)
        terminal = self.last_t & torch.from_numpy(rng.random((T, N)) < 0.5)
        self.discount_t = torch.where(terminal, 0.0, torch.from_numpy(rng.uniform(0.5, 1, (T, N))))
        self.r_t = torch.from_numpy(rng.normal(size=(T, N)))
        self.q_tm1 = torch.from_numpy(rng.normal(size=(T, N, A)))
        self.q_t = torch.from_numpy(rng.normal(size=(T, N, A)))
        self.q_t[:-1] = torch.where(self.last_t[:-1, :, None], self.q_t[:-1], self.q_tm1[1:])
        self.a_tm1 = torch.from_numpy(rng.integers(A, size=(T, N)))
        self.mu_tm1 = torch.from_numpy(rng.uniform(0.05, 1, (T, N)))
        self.pi_tm1 = rules.epsilon_greedy(self.q_tm1, 0.3)
        self.pi_t = rules.epsilon_greedy(self.q_t, 0.3)

    def taken(self, values: Tensor) -> Tensor:
        return values.gather(-1, self.a_tm1[..., None])[..., 0]

    def returns(self, c_tm1: Tensor, v_t: Tensor | None = None) -> Tensor:
        v_t = rules.expected_value(self.q_t, self.pi_t) if v_t is None else v_t
        return rules.off_policy_returns(self.taken(self.q_tm1), self.r_t, self.discount_t, v_t, c_tm1, self.last_t)


def by_definition(x: Rollout, c: Any) -> list[list[float]]:
    """Munos et al. 2016, eq. 3: Q + Σ_k (Π_{i<k} γ_i) (Π_{0<i≤k} c_i) δ_k, every product written out."""
    wanted = []
    for t in range(T):
        row = []
        for n in range(N):
            total = float(x.q_tm1[t, n, x.a_tm1[t, n]])
            for k in range(t, T):
                if any(bool(x.last_t[j, n]) for j in range(t, k)):
                    break
                follow = sum(float(x.pi_t[k, n, b]) * float(x.q_t[k, n, b]) for b in range(A))
                taken = float(x.q_tm1[k, n, x.a_tm1[k, n]])
                delta = float(x.r_t[k, n]) + float(x.discount_t[k, n]) * follow - taken
                factor = 1.0
                for j in range(t, k):
                    factor *= float(x.discount_t[j, n])
                for j in range(t + 1, k + 1):
                    factor *= c(j, n)
                total += factor * delta
            row.append(total)
        wanted.append(row)
    return wanted


def coefficient(x: Rollout, rule: str, lambda_: float, t: int, n: int) -> float:
    """Munos et al. 2016, table 1."""
    a = int(x.a_tm1[t, n])
    pi, mu = float(x.pi_tm1[t, n, a]), float(x.mu_tm1[t, n])
    values = [float(v) for v in x.q_tm1[t, n]]
    return {
        "retrace": lambda_ * min(1.0, pi / mu),
        "tree_backup": lambda_ * pi,
        "harutyunyan": lambda_,
        "watkins": lambda_ * (values[a] == max(values)),
        "importance": pi / mu,
    }[rule]


def coefficients(x: Rollout, rule: str, lambda_: float) -> Tensor:
    pi = x.taken(x.pi_tm1)
    if rule == "retrace":
        return rules.retrace_coefficients(lambda_, pi, x.mu_tm1)
    if rule == "tree_backup":
        return rules.tree_backup_coefficients(lambda_, pi)
    if rule == "watkins":
        return lambda_ * rules.is_greedy(x.q_tm1, x.a_tm1).to(F64)
    return pi / x.mu_tm1 if rule == "importance" else torch.full((T, N), lambda_, dtype=F64)


@pytest.mark.parametrize("rule", ["retrace", "tree_backup", "harutyunyan", "watkins", "importance"])
@pytest.mark.parametrize("break_rate", [0.0, 0.3])
def test_the_recursion_is_the_sum(rule: str, break_rate: float) -> None:
    for seed in range(5):
        x = Rollout(seed, break_rate)
        wanted = by_definition(x, lambda t, n, x=x: coefficient(x, rule, 0.8, t, n))
        torch.testing.assert_close(
            x.returns(coefficients(x, rule, 0.8)), torch.tensor(wanted, dtype=F64), rtol=0, atol=1e-10
        )


@given(st.integers(0, 1000), st.floats(0, 1))
def test_with_a_greedy_target_policy_watkins_retrace_and_tree_backup_are_one(seed: int, lambda_: float) -> None:
    x = Rollout(seed)
    pi = x.taken(rules.greedy(x.q_tm1))
    watkins = rules.watkins_lambda(lambda_, rules.is_greedy(x.q_tm1, x.a_tm1), F64)
    wanted = rules.lambda_returns(x.r_t, x.discount_t, x.q_t.amax(-1), watkins, x.last_t)
    for c in (rules.retrace_coefficients(lambda_, pi, x.mu_tm1), rules.tree_backup_coefficients(lambda_, pi)):
        torch.testing.assert_close(x.returns(c, x.q_t.amax(-1)), wanted, rtol=0, atol=1e-10)


@given(st.integers(0, 1000))
def test_lambda_0_is_expected_sarsa_and_on_policy_retrace_with_lambda_1_cuts_nothing(seed: int) -> None:
    x = Rollout(seed)
    one_step = rules.expected_sarsa(x.r_t, x.discount_t, x.q_t, x.pi_t)
    torch.testing.assert_close(x.returns(rules.retrace_coefficients(0.0, x.taken(x.pi_tm1), x.mu_tm1)), one_step)
    on_policy = rules.retrace_coefficients(1.0, x.taken(x.pi_tm1), x.taken(x.pi_tm1))
    assert torch.equal(on_policy, torch.ones(T, N, dtype=F64))


def test_retrace_averages_to_the_target_policys_value() -> None:
    # A bandit met twice: from 0 to a state with two actions of reward 0 and 1, then the end. μ = (0.75, 0.25), π the
    # other way round, Q wrong throughout (0). E_μ[min(1, π/μ) · r] = 0.75 · ⅓ · 0 + 0.25 · 1 · 1: what one application
    # of the operator gives; importance sampling gives the value itself, 0.25 · 3 · 1.
    rng = np.random.default_rng(3)
    a = torch.from_numpy((rng.random(40_000) < 0.25).astype(np.int64))
    mu, pi = torch.tensor([0.75, 0.25], dtype=F64)[a], torch.tensor([0.25, 0.75], dtype=F64)[a]
    zero, one = torch.zeros(2, len(a), dtype=F64), torch.ones(2, len(a), dtype=F64)
    r_t = torch.stack([zero[0], a.to(F64)])
    discount_t = torch.stack([one[0], zero[0]])
    last_t = discount_t == 0
    first = torch.ones(len(a), dtype=F64)
    for c, wanted in ((rules.retrace_coefficients(1.0, pi, mu), 0.25), (pi / mu, 0.75)):
        got = rules.off_policy_returns(zero, r_t, discount_t, zero, torch.stack([first, c]), last_t)[0]
        error = float(got.std()) / len(a) ** 0.5
        assert abs(float(got.mean()) - wanted) < 4 * error


def test_a_terminal_state_without_legal_actions_is_harmless() -> None:
    zero = torch.zeros(2, dtype=F64)
    v_t, discount_t = torch.tensor([1.0, -torch.inf], dtype=F64), torch.tensor([0.5, 0.0], dtype=F64)
    last_t = discount_t == 0
    got = rules.off_policy_returns(zero + 1, zero + 2, discount_t, v_t, zero + 1, last_t)
    assert got.tolist() == [2 + 0.5 * 1 + 0.5 * (2 - 1), 2.0]


@pytest.mark.parametrize(
    ("call", "problem"),
    [
        (lambda x: x.returns(torch.ones(T, N, 1)), "c_tm1"),
        (lambda x: x.returns(torch.ones(T, N), torch.ones(T)), "v_t"),
        (lambda x: rules.retrace_coefficients(1.5, x.mu_tm1, x.mu_tm1), "lambda_"),
        (lambda x: rules.retrace_coefficients(0.5, x.mu_tm1, x.mu_tm1[0]), "mu_tm1"),
        (lambda x: rules.tree_backup_coefficients(-0.5, x.mu_tm1), "lambda_"),
    ],
)
def test_what_makes_no_sense_is_refused(call: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        call(Rollout(0))

"""Policies as probabilities, and drawing from them, against hand arithmetic and SciPy's log-sum-exp.

Mutants that these tests kill: ε spread over all actions instead of the legal ones, or over all but the greedy one;
the highest index on ties; k^q as k·q; overflow at large q or k; a mask applied before multiplying by a negative ln k
(illegal actions win) or by 0 (NaN); sampling that draws an impossible action at u = 0 or u = 1, or the last action too
often.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp
from torch import Tensor

from neuralq.rules import epsilon_greedy, greedy, greedy_random_ties, k_to_the_q, sample, softmax

INF = torch.inf
POLICIES = {
    "greedy": greedy,
    "greedy, random ties": greedy_random_ties,
    "epsilon": lambda q: epsilon_greedy(q, 0.3),
    "epsilon, random ties": lambda q: epsilon_greedy(q, 0.3, random_ties=True),
    "epsilon per row": lambda q: epsilon_greedy(q, torch.full(q.shape[:-1], 0.3)),
    "k = 5": lambda q: k_to_the_q(q, 5.0),
    "k = 1": lambda q: k_to_the_q(q, 1.0),
    "k = 1/5": lambda q: k_to_the_q(q, 0.2),
    "k huge": lambda q: k_to_the_q(q, 1e308),
    "k tiny": lambda q: k_to_the_q(q, 1e-308),
    "softmax": lambda q: softmax(q, 0.5),
    "softmax, cold": lambda q: softmax(q, 1e-320),
    "softmax, hot": lambda q: softmax(q, 1e300),
}


def test_greedy_takes_the_lowest_index() -> None:
    q = torch.tensor([[1.0, 3.0, 3.0], [-INF, -5.0, -INF]])
    assert greedy(q).tolist() == [[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]
    assert greedy_random_ties(q).tolist() == [[0.0, 0.5, 0.5], [0.0, 1.0, 0.0]]


def test_epsilon_is_spread_over_the_legal_actions() -> None:
    """ε = ¼ over 2 legal actions: 1/8 each, the greedy one 3/4 more; with a tie and random ties ½ each."""
    q = torch.tensor([[2.0, 1.0, -INF], [2.0, 2.0, -INF]])
    assert epsilon_greedy(q, 0.25).tolist() == [[0.875, 0.125, 0.0], [0.875, 0.125, 0.0]]
    assert epsilon_greedy(q, 0.25, random_ties=True).tolist() == [[0.875, 0.125, 0.0], [0.5, 0.5, 0.0]]
    per_row = epsilon_greedy(q, torch.tensor([0.0, 1.0]))
    assert per_row.tolist() == [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0]]


def test_k_to_the_q_by_hand() -> None:
    """k = 2 with q = 0, 1, 2: 1 : 2 : 4; k = ½ turns it round; k = 1 is uniform; illegal actions are out."""
    q = torch.tensor([0.0, 1.0, -INF, 2.0], dtype=torch.float64)
    for k, weights in ((2.0, [1, 2, 0, 4]), (0.5, [4, 2, 0, 1]), (1.0, [1, 1, 0, 1])):
        expected = torch.tensor(weights, dtype=torch.float64) / sum(weights)
        torch.testing.assert_close(k_to_the_q(q, k), expected)


def test_softmax_with_temperature_is_k_to_the_q() -> None:
    q = torch.tensor([0.3, -1.0, 2.0, -INF], dtype=torch.float64)
    torch.testing.assert_close(softmax(q, 1 / math.log(7.0)), k_to_the_q(q, 7.0))


def test_nothing_overflows() -> None:
    """Values near the ends of float32: the winner takes all, whatever the sign of ln k; equal values share."""
    q = torch.tensor([3e38, -3e38, -INF, 0.0])
    assert k_to_the_q(q, 10.0).tolist() == [1.0, 0.0, 0.0, 0.0]
    assert k_to_the_q(q, 0.1).tolist() == [0.0, 1.0, 0.0, 0.0]
    torch.testing.assert_close(k_to_the_q(q, 1.0), torch.tensor([1.0, 1.0, 0.0, 1.0]) / 3)
    assert softmax(torch.tensor([1e30, 1e30]), 1e-3).tolist() == [0.5, 0.5]


values = st.lists(st.one_of(st.floats(-100, 100), st.just(-math.inf)), min_size=1, max_size=6).filter(
    lambda row: any(math.isfinite(x) for x in row)
)


@given(values, st.floats(1e-3, 1e3))
def test_k_to_the_q_agrees_with_scipy(row: list[float], k: float) -> None:
    legal = np.array([math.isfinite(x) for x in row])
    logits = np.where(legal, np.where(legal, row, 0.0) * math.log(k), -np.inf)
    expected = np.exp(logits - logsumexp(logits))
    np.testing.assert_allclose(k_to_the_q(torch.tensor(row, dtype=torch.float64), k), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", POLICIES)
@given(values)
def test_rows_sum_to_one_over_the_legal_actions(name: str, row: list[float]) -> None:
    for dtype in (torch.float32, torch.float64):
        q = torch.tensor([row, row[::-1]], dtype=dtype)
        pi = POLICIES[name](q)
        assert pi.dtype == dtype and pi.shape == q.shape
        assert (pi >= 0).all() and pi[torch.isneginf(q)].eq(0).all()
        torch.testing.assert_close(pi.sum(-1), torch.ones(2, dtype=dtype))


@pytest.mark.parametrize("name", POLICIES)
def test_no_legal_action_is_zeros_and_nan_is_nan(name: str) -> None:
    q = torch.tensor([[-INF, -INF], [torch.nan, 1.0], [1.0, 0.0]])
    pi = POLICIES[name](q)
    assert pi[0].tolist() == [0.0, 0.0]
    assert pi[1].isnan().any() and pi[2].isfinite().all()
    for row in (0, 1):
        with pytest.raises(ValueError, match="probabilities must be"):
            sample(pi[row], torch.tensor(0.5))


@pytest.mark.parametrize("name", ["k = 5", "k = 1", "k = 1/5", "softmax"])
def test_derivatives_are_exact_beside_illegal_actions(name: str) -> None:
    legal = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64, requires_grad=True)

    def chances(x: Tensor) -> Tensor:
        return POLICIES[name](torch.cat([x[:2], torch.full((1,), -INF, dtype=x.dtype), x[2:]]))

    assert torch.autograd.gradcheck(chances, (legal,))
    q = torch.tensor([[-INF, -INF], [0.0, -INF]], requires_grad=True)
    POLICIES[name](q).square().sum().backward()
    assert q.grad is not None and q.grad.isfinite().all()


# ------------------------------------------------------------------------------------------------------------- drawing


def test_sample_by_hand() -> None:
    """Cumulative .25, .25, .75, 1: [0, .25) draws 0, [.25, .75) draws 2, [.75, 1) draws 3; never action 1."""
    p = torch.tensor([0.25, 0.0, 0.5, 0.25])
    u = torch.tensor([0.0, 0.2499, 0.25, 0.5, 0.7499, 0.75, 0.9999])
    assert sample(p.expand(7, 4), u).tolist() == [0, 0, 2, 2, 2, 3, 3]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_impossible_is_never_drawn_at_the_ends(dtype: torch.dtype) -> None:
    p = torch.tensor([[0.0, 0.0, 1.0, 0.0], [0.0, 0.5, 0.5, 0.0], [0.0, 1e-30, 0.0, 0.0]], dtype=dtype)
    for u in (0.0, 5e-324, 1e-30, 0.5, 1 - 2**-24, 1 - 2**-53, 1.0):  # the last is 1 - 2⁻⁵³ rounded to float32
        for u_dtype in (torch.float32, torch.float64):
            drawn = sample(p, torch.full((3,), u, dtype=u_dtype))
            assert (p.gather(-1, drawn[:, None]) > 0).all()


@given(st.integers(0, 2**32 - 1))
def test_the_impossible_is_never_drawn_from_many_actions(seed: int) -> None:
    """1,000 actions in float32, most of them impossible, sums off by rounding."""
    rng = np.random.default_rng(seed)
    p = np.where(rng.random((20, 1000)) < 0.02, rng.random((20, 1000)), 0.0)
    p[:, 500] = 1e-6
    p = torch.from_numpy((p / p.sum(-1, keepdims=True)).astype(np.float32))
    u = torch.from_numpy(np.concatenate([np.zeros(5), np.full(5, 1 - 2**-24), rng.random(10)]))
    drawn = sample(p, u)
    assert drawn.dtype == torch.int64 and (p.gather(-1, drawn[:, None]) > 0).all()


def test_frequencies_are_the_probabilities() -> None:
    """An even grid of 100,000 numbers draws every action in exact proportion, up to one at each seam."""
    p = torch.tensor([0.1, 0.0, 0.35, 0.55], dtype=torch.float64)
    u = (torch.arange(100_000, dtype=torch.float64) + 0.5) / 100_000
    counts = torch.bincount(sample(p.expand(100_000, 4), u), minlength=4)
    assert (counts - p * 100_000).abs().max() <= 1


def test_a_row_that_sums_to_less_than_one_is_not_biased() -> None:
    """Half the mass lost to rounding (here: exaggerated) changes nothing: the draw is relative to the sum."""
    assert sample(torch.tensor([0.25, 0.25]), torch.tensor(0.49)).item() == 0
    assert sample(torch.tensor([0.25, 0.25]), torch.tensor(0.51)).item() == 1


def test_bad_input_is_refused() -> None:
    q, half = torch.ones(2, 3), torch.tensor([0.5, 0.5])
    for call, message in [
        (lambda: epsilon_greedy(q, 1.5), "epsilon must lie in"),
        (lambda: epsilon_greedy(q, torch.ones(3)), "epsilon must be a number or match"),
        (lambda: k_to_the_q(q, 0.0), "k must be a finite number above 0"),
        (lambda: softmax(q, 0.0), "temperature must be a finite number above 0"),
        (lambda: sample(q, torch.tensor(0.5)), "u must have the shape"),
        (lambda: sample(q, half + 0.6), r"u in \[0, 1\]"),
        (lambda: sample(q - 2, half), "non-negative"),
        (lambda: sample(q * INF, half), "finite"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()

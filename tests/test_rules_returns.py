"""λ-returns and n-step returns against sums written out from their definitions; planted index bugs must die.

The oracle is Mitchell 1997, section 13.5: Q⁽ⁿ⁾ as a sum of rewards, Q^λ as (1-λ) Σ λⁿ⁻¹ Q⁽ⁿ⁾ (all the weight beyond the
stream's break on the longest return), in float64 Python arithmetic, to 1e-10. Each thing that ends or bends a return is
exercised alone by a stream of its own: termination, truncation, the rollout's edge, an exploring action, λ per row.

The mutants are the keys of `LAMBDA_MUTANTS`, `WATKINS_MUTANTS` and `N_STEP_MUTANTS`: each must fail, on the stream that
exercises it alone, and the harness without a bug must pass. Among them are those found in published code: the
second-to-last row bootstrapped from the final value, truncation taken for termination, the cut one row late, and the
book's misprint (the value of the state that was left).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.rules import is_greedy, lambda_returns, n_step_returns, watkins_lambda

GAMMA = 0.9
NUM_ROWS = 7

# --------------------------------------------------------------------------------------------------- the definition


def horizon(last: np.ndarray, row: int) -> int:
    """How many rewards the longest return from ``row`` can use: up to the break, or to the rollout's edge."""
    breaks = [k for k in range(row, len(last)) if last[k]]
    return (breaks[0] if breaks else len(last) - 1) - row + 1


def q_n(r: np.ndarray, discount: np.ndarray, v: np.ndarray, row: int, n: int) -> float:
    """Q⁽ⁿ⁾ = r + γ r' + … + γⁿ⁻¹ r'' + γⁿ V: every reward times the product of all discounts before it."""
    rewards = [math.prod(discount[row : row + i]) * r[row + i] for i in range(n)]
    return math.fsum(rewards) + math.prod(discount[row : row + n]) * v[row + n - 1]


def q_lambda(r: np.ndarray, discount: np.ndarray, v: np.ndarray, lam: np.ndarray, last: np.ndarray, row: int) -> float:
    """Q^λ: Q⁽ⁿ⁾ weighs (λ ⋯ λ)(1-λ), the longest one takes what is left. With one λ: (1-λ) Σ λⁿ⁻¹ Q⁽ⁿ⁾."""
    longest = horizon(last, row)
    terms = [
        math.prod(lam[row : row + n - 1]) * (1.0 - lam[row + n - 1]) * q_n(r, discount, v, row, n)
        for n in range(1, longest)
    ]
    return math.fsum(terms) + math.prod(lam[row : row + longest - 1]) * q_n(r, discount, v, row, longest)


def stream(name: str, seed: int = 0) -> tuple[Tensor, ...]:
    """A rollout [7, 3] in which only the named thing happens: (r_t, discount_t, v_t, lambda_t, last_t)."""
    rng = np.random.default_rng(seed)
    shape = (NUM_ROWS, 3)
    r, v = rng.normal(size=shape), rng.normal(size=shape)
    discount, lam, last = np.full(shape, GAMMA), np.full(shape, 0.7), np.zeros(shape, bool)
    if name == "termination":
        last[3], discount[3] = True, 0.0
    elif name == "truncation":
        last[3] = True
    elif name == "lambda per row":
        lam = rng.uniform(0.1, 0.9, shape)
    elif name == "discount per row":
        discount = rng.uniform(0.5, 0.95, shape)
    elif name == "everything":
        last = rng.random(shape) < 0.3
        discount = np.where(last & (rng.random(shape) < 0.5), 0.0, rng.uniform(0, 1, shape))
        lam = rng.random(shape)
    elif name == "break in last row":
        last[-1] = True
    elif name == "termination in last row":
        last[-1], discount[-1] = True, 0.0
    else:
        assert name == "edge"
    return tuple(torch.from_numpy(x) for x in (r, discount, v, lam, last))


STREAMS = [
    "edge",
    "termination",
    "truncation",
    "lambda per row",
    "discount per row",
    "break in last row",
    "termination in last row",
]

Rule = Callable[..., Tensor]


def check_lambda(rule: Rule, name: str, seed: int = 0) -> None:
    """``rule`` equals the sum on the named stream, in every row."""
    r, discount, v, lam, last = stream(name, seed)
    arrays = [x.numpy() for x in (r, discount, v, lam, last)]
    expected = [[q_lambda(*(x[:, n] for x in arrays), row) for n in range(3)] for row in range(NUM_ROWS)]
    torch.testing.assert_close(
        rule(r, discount, v, lam, last), torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-10
    )


def check_n_step(rule: Rule, name: str, n: int = 3) -> None:
    """``rule`` equals Q⁽ⁿ⁾ on the named stream, shortened where the stream breaks."""
    r, discount, v, _, last = stream(name)
    arrays = [x.numpy() for x in (r, discount, v)]
    expected = [
        [q_n(*(x[:, k] for x in arrays), row, min(n, horizon(last[:, k].numpy(), row))) for k in range(3)]
        for row in range(NUM_ROWS)
    ]
    torch.testing.assert_close(
        rule(r, discount, v, n, last), torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("name", STREAMS)
def test_lambda_returns_equal_the_sum(name: str) -> None:
    check_lambda(lambda_returns, name)


@pytest.mark.parametrize("seed", range(20))
def test_any_rollout_equals_the_sum(seed: int) -> None:
    check_lambda(lambda_returns, "everything", seed)


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("n", [1, 2, 3, 6, 7, 50])
def test_n_step_returns_equal_the_sum(name: str, n: int) -> None:
    check_n_step(n_step_returns, name, n)


# ------------------------------------------------------------------------------------------ mutants of lambda_returns


def plain(r: Tensor, discount: Tensor, v: Tensor, lam: Tensor, last: Tensor, change: str = "") -> Tensor:
    """The recursion row by row, with one planted bug (or none: then it must pass, or the harness proves nothing)."""
    num_rows = len(r)
    out = torch.zeros_like(r)
    for t in range(num_rows - 1, -1, -1):
        after, before = min(t + 1, num_rows - 1), max(t - 1, 0)
        d = discount[{"discount of the next row": after, "discount of the row before": before}.get(change, t)]
        weight = lam[{"lambda of the next row": after, "lambda of the row before": before}.get(change, t)]
        own = v[before if change == "value of the state left" else t]
        is_last = last[{"break one row late": before, "break one row early": after}.get(change, t)]
        if change == "lambda exchanged":
            weight = 1 - weight
        if change == "termination ignored":
            d = torch.full_like(d, GAMMA)
        if change == "truncation as termination":
            d = torch.where(is_last, 0.0, d)
        if change == "break ignored":
            is_last = torch.zeros_like(is_last)
        if change == "second-to-last from the final value" and t == num_rows - 2:
            own = v[t + 1]
        if t == num_rows - 1:
            kept = {"last row not bootstrapped": 0 * weight, "last row mixed": 1 - weight}.get(change, 1 + 0 * weight)
            out[t] = r[t] + d * kept * own
            continue
        mixed = r[t] + d * ((1 - weight) * own + weight * out[t + 1])
        full = r[t] + d * ((1 - weight) * own if change == "broken row mixed" else own)
        out[t] = torch.where(is_last, full, mixed)
    return out


LAMBDA_MUTANTS = {
    "second-to-last from the final value": "edge",
    "last row not bootstrapped": "edge",
    "last row mixed": "edge",
    "lambda exchanged": "edge",
    "value of the state left": "edge",
    "truncation as termination": "truncation",
    "break ignored": "truncation",
    "break one row late": "truncation",
    "break one row early": "truncation",
    "broken row mixed": "truncation",
    "termination ignored": "termination",
    "lambda of the next row": "lambda per row",
    "lambda of the row before": "lambda per row",
    "discount of the next row": "discount per row",
    "discount of the row before": "discount per row",
}


@pytest.mark.parametrize("name", STREAMS)
def test_the_unchanged_harness_passes(name: str) -> None:
    check_lambda(plain, name)


@pytest.mark.parametrize("mutant", LAMBDA_MUTANTS)
def test_lambda_mutant_dies(mutant: str) -> None:
    with pytest.raises(AssertionError):
        check_lambda(lambda *row: plain(*row, change=mutant), LAMBDA_MUTANTS[mutant])


# ---------------------------------------------------------------------------------------------- Watkins' exploring cut


def watkins_sum(
    r: np.ndarray, discount: np.ndarray, v: np.ndarray, greedy: np.ndarray, last: np.ndarray, row: int
) -> float:
    """Watkins from the definition: (1-λ) Σ λⁿ⁻¹ Q⁽ⁿ⁾, the longest return ending before the next exploring action.

    greedy[k] says whether the action of row k was greedy. From ``row``, its own action is given; the first exploring
    action after it (row + m) is not followed, so the longest return has m rewards.
    """
    longest = horizon(last, row)
    for m in range(1, longest):
        if not greedy[row + m]:
            longest = m
            break
    lam = 0.7
    terms = [(1 - lam) * lam ** (n - 1) * q_n(r, discount, v, row, n) for n in range(1, longest)]
    return math.fsum(terms) + lam ** (longest - 1) * q_n(r, discount, v, row, longest)


def check_watkins(rule: Callable[[float, Tensor], Tensor], exploring_rows: list[int], name: str = "edge") -> None:
    """λ-returns with the rule's λ equal Watkins' sum when the given rows explored."""
    r, discount, v, _, last = stream(name)
    greedy = torch.ones(r.shape, dtype=torch.bool)
    greedy[exploring_rows] = False
    arrays = [x.numpy() for x in (r, discount, v, greedy, last)]
    expected = [[watkins_sum(*(x[:, n] for x in arrays), row) for n in range(3)] for row in range(NUM_ROWS)]
    returns = lambda_returns(r, discount, v, rule(0.7, greedy), last)
    torch.testing.assert_close(returns, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-10)


@pytest.mark.parametrize("rows", [[], [0], [3], [6], [2, 3], [1, 4], list(range(NUM_ROWS))])
def test_watkins_cuts_at_the_exploring_action(rows: list[int]) -> None:
    check_watkins(watkins_lambda, rows)


@pytest.mark.parametrize("name", ["termination", "truncation"])
@pytest.mark.parametrize("rows", [[2], [3], [4], [1, 5]])
def test_watkins_cut_beside_a_break(name: str, rows: list[int]) -> None:
    check_watkins(watkins_lambda, rows, name)


def shifted(lambda_: float, greedy: Tensor, shift: int) -> Tensor:
    """λ where the flag ``shift`` rows later is true (rows without one: greedy)."""
    out = torch.full(greedy.shape, lambda_, dtype=torch.float64)
    for t in range(len(greedy)):
        if 0 <= t + shift < len(greedy):
            out[t] = greedy[t + shift] * torch.tensor(lambda_, dtype=torch.float64)
    return out


WATKINS_MUTANTS: dict[str, Callable[[float, Tensor], Tensor]] = {
    "no shift: one row late": lambda lam, greedy: shifted(lam, greedy, 0),
    "shift the wrong way": lambda lam, greedy: shifted(lam, greedy, -1),
    "shift by two: one row early": lambda lam, greedy: shifted(lam, greedy, 2),
    "inverted": lambda lam, greedy: shifted(lam, ~greedy, 1),
    "never cut (Peng)": lambda lam, greedy: torch.full(greedy.shape, lam, dtype=torch.float64),
    "cut on both sides": lambda lam, greedy: shifted(lam, greedy, 1) * shifted(1.0, greedy, 0),
}


def test_the_unchanged_watkins_harness_passes() -> None:
    check_watkins(lambda lam, greedy: shifted(lam, greedy, 1), [3])


@pytest.mark.parametrize("mutant", WATKINS_MUTANTS)
def test_watkins_mutant_dies(mutant: str) -> None:
    with pytest.raises(AssertionError):
        check_watkins(WATKINS_MUTANTS[mutant], [3])


def test_ties_are_greedy() -> None:
    q = torch.tensor([[2.0, 2.0, 1.0], [-torch.inf, 0.0, -1.0]])
    assert is_greedy(q, torch.tensor([1, 1])).tolist() == [True, True]
    assert is_greedy(q, torch.tensor([2, 2])).tolist() == [False, False]


# ------------------------------------------------------------------------------------------ mutants of n_step_returns


def plain_n_step(r: Tensor, discount: Tensor, v: Tensor, n: int, last: Tensor, change: str = "") -> Tensor:
    """n-step returns walked forwards, with one planted bug (or none)."""
    num_rows, num_streams = r.shape
    out = torch.zeros_like(r)
    count = {"one reward too many": n + 1, "one reward too few": n - 1}.get(change, n)
    for t in range(num_rows):
        for k in range(num_streams):
            total, product = 0.0, 1.0
            for i in range(t, min(t + count, num_rows)):
                total += product * float(r[i, k])
                product *= float(discount[i, k])
                if change == "truncation as termination" and last[i, k]:
                    product = 0.0
                if last[i, k] and change != "break ignored":
                    break
            reached = i
            if change == "bootstrap from the next row":
                reached = min(i + 1, num_rows - 1)
            if change == "one discount too many":
                product *= GAMMA
            if change == "edge without bootstrap" and t + count > num_rows:
                product = 0.0
            out[t, k] = total + product * float(v[reached, k])
    return out


N_STEP_MUTANTS = {
    "one reward too many": "edge",
    "one reward too few": "edge",
    "edge without bootstrap": "edge",
    "bootstrap from the next row": "edge",
    "one discount too many": "edge",
    "break ignored": "truncation",
    "truncation as termination": "truncation",
}


@pytest.mark.parametrize("name", STREAMS)
def test_the_unchanged_n_step_harness_passes(name: str) -> None:
    check_n_step(plain_n_step, name)


@pytest.mark.parametrize("mutant", N_STEP_MUTANTS)
def test_n_step_mutant_dies(mutant: str) -> None:
    with pytest.raises(AssertionError):
        check_n_step(lambda *row: plain_n_step(*row, change=mutant), N_STEP_MUTANTS[mutant])

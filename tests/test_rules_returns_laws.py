"""λ-returns and n-step returns: hand arithmetic, the book's misprint, laws that hold for every rollout, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from beartype import beartype
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Bool, Float, Int, TypeCheckError, jaxtyped
from torch import Tensor

from neuralq.rules import is_greedy, lambda_returns, n_step_returns, q_learning, watkins_lambda

# ------------------------------------------------------------------------------------------------------ golden numbers


def test_hand_arithmetic_and_the_misprint() -> None:
    """Three steps, reward 1 at the end, γ = .9, λ = .5, V(s0) = .6, V(s1) = .2, V(s2) = .4.

    Q1 = .9·.2 = .18, Q2 = .81·.4 = .324, Q3 = .81·1 = .81: .5·.18 + .25·.324 + .25·.81 = .3735.
    Recursion with the successor: G2 = 1; G1 = .9(.5·.4 + .5·1) = .63; G0 = .9(.5·.2 + .5·.63) = .3735.
    As printed, with the state left: G2 = 1; G1 = .9(.5·.2 + .5·1) = .54; G0 = .9(.5·.6 + .5·.54) = .513.
    """
    r, discount = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.9, 0.9, 0.0])
    last = torch.tensor([False, False, True])
    right = lambda_returns(r, discount, torch.tensor([0.2, 0.4, 0.0]), 0.5, last)
    printed = lambda_returns(r, discount, torch.tensor([0.6, 0.2, 0.4]), 0.5, last)
    torch.testing.assert_close(right, torch.tensor([0.3735, 0.63, 1.0]))
    torch.testing.assert_close(printed, torch.tensor([0.513, 0.54, 1.0]))


def test_misprint_on_an_endless_stream() -> None:
    """On 400 steps the truncated series (1-λ) Σ λⁿ⁻¹ Q⁽ⁿ⁾ is the recursion with s_{t+1}, and not the one with s_t."""
    rng = np.random.default_rng(3)
    r, v = rng.uniform(size=400), rng.uniform(size=401)  # v[k] = max Q(s_k)
    v[0] += 1.0  # the state that is left: no part of the sum
    series = 0.2 * math.fsum(
        0.8 ** (n - 1) * (sum(0.9**i * r[i] for i in range(n)) + 0.9**n * v[n]) for n in range(1, 400)
    )
    discount, last = torch.full((400,), 0.9, dtype=torch.float64), torch.zeros(400, dtype=torch.bool)
    rewards, values = torch.from_numpy(r), torch.from_numpy(v)
    assert lambda_returns(rewards, discount, values[1:], 0.8, last)[0].item() == pytest.approx(series, abs=1e-10)
    assert abs(lambda_returns(rewards, discount, values[:-1], 0.8, last)[0].item() - series) > 0.1


def test_each_end_by_hand() -> None:
    """γ = λ = .5, r = 1, v = 8: termination gives 1, truncation and the edge 1 + .5·8 = 5, before them a mixture."""
    ones, v = torch.ones(2), torch.full((2,), 8.0)
    half, none, end = torch.tensor([0.5, 0.5]), torch.tensor([False, False]), torch.tensor([False, True])
    # 1 + .5 (.5·8 + .5·G): G = 5 gives 4.25, G = 1 gives 3.25
    assert lambda_returns(ones, half, v, 0.5, none).tolist() == [4.25, 5.0]
    assert lambda_returns(ones, half, v, 0.5, end).tolist() == [4.25, 5.0]
    assert lambda_returns(ones, torch.tensor([0.5, 0.0]), v, 0.5, end).tolist() == [3.25, 1.0]
    assert lambda_returns(ones, half, v, 0.5, torch.tensor([True, False])).tolist() == [5.0, 5.0]


# ---------------------------------------------------------------------------------------------------------------- laws

rollouts = st.integers(0, 2**32 - 1)


def random_rollout(seed: int) -> tuple[Tensor, ...]:
    """Any rollout: 1 to 9 rows, 1 to 3 streams, breaks and terminations anywhere."""
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 10)), int(rng.integers(1, 4)))
    last = rng.random(shape) < 0.3
    discount = np.where(last & (rng.random(shape) < 0.5), 0.0, rng.uniform(0, 1, shape))
    arrays = (rng.normal(size=shape), discount, rng.normal(size=shape), rng.random(shape), last)
    return tuple(torch.from_numpy(x) for x in arrays)


@given(rollouts)
def test_lambda_zero_is_one_step(seed: int) -> None:
    r, discount, v, _, last = random_rollout(seed)
    one = q_learning(r, discount, v[..., None])
    torch.testing.assert_close(lambda_returns(r, discount, v, 0.0, last), one)
    torch.testing.assert_close(n_step_returns(r, discount, v, 1, last), one)


@given(rollouts)
def test_lambda_one_is_the_return(seed: int) -> None:
    r, discount, v, _, last = random_rollout(seed)
    full = lambda_returns(r, discount, v, 1.0, last)
    torch.testing.assert_close(full, n_step_returns(r, discount, v, len(r), last))
    torch.testing.assert_close(full, n_step_returns(r, discount, v, 10**6, last))
    if bool(last[-1].all()) and bool((discount[last] == 0).all()):  # everything terminates: no estimate is left
        torch.testing.assert_close(full, lambda_returns(r, discount, v + 100.0, 1.0, last))


@given(rollouts)
def test_exact_values_are_a_fixed_point(seed: int) -> None:
    """If v satisfies v_{t-1} = r_t + discount_t v_t along the stream, every λ and n returns it."""
    r, discount, v, lam, last = random_rollout(seed)
    truth = n_step_returns(r, discount, v, len(r), last)
    successor = torch.cat([truth[1:], v[-1:]])
    successor = torch.where(last, v, successor)
    torch.testing.assert_close(lambda_returns(r, discount, successor, lam, last), truth)
    torch.testing.assert_close(n_step_returns(r, discount, successor, 2, last), truth)


@given(rollouts)
def test_lambda_is_a_mixture_of_neighbours(seed: int) -> None:
    """Returns are monotone in v: a discounted average never answers more than it was given."""
    r, discount, v, lam, last = random_rollout(seed)
    rise = lambda_returns(r, discount, v + 1.0, lam, last) - lambda_returns(r, discount, v, lam, last)
    assert bool((rise >= -1e-12).all()) and bool((rise <= 1.0 + 1e-12).all())


# ----------------------------------------------------------------------------- illegal actions, derivatives, bad input


def test_a_terminal_state_without_legal_action_is_harmless() -> None:
    r, discount = torch.ones(3), torch.tensor([0.9, 0.0, 0.9])
    v, last = torch.tensor([1.0, -torch.inf, 1.0]), torch.tensor([False, True, False])
    expected = torch.tensor([1.0 + 0.9 * (0.5 * 1.0 + 0.5 * 1.0), 1.0, 1.9])
    torch.testing.assert_close(lambda_returns(r, discount, v, 0.5, last), expected)
    torch.testing.assert_close(n_step_returns(r, discount, v, 2, last), torch.tensor([1.9, 1.0, 1.9]))


def test_lambda_one_needs_no_value_on_the_way() -> None:
    v = torch.tensor([-torch.inf, 2.0])
    out = lambda_returns(torch.ones(2), torch.full((2,), 0.5), v, 1.0, torch.tensor([False, False]))
    assert out.tolist() == [2.0, 2.0]


@pytest.mark.parametrize("rule", ["lambda", "n-step", "whole"])
def test_derivatives_are_exact(rule: str) -> None:
    """Autograd through the rule agrees with finite differences, and the two code paths with each other."""
    r, discount, v, lam, last = random_rollout(11)

    def function(*inputs: Tensor) -> Tensor:
        if rule == "lambda":
            return lambda_returns(*inputs, last)
        return n_step_returns(*inputs[:3], 3 if rule == "n-step" else 99, last)

    inputs = tuple(x.clone().requires_grad_() for x in (r, discount, v, lam))
    used = inputs if rule == "lambda" else inputs[:3]
    assert torch.autograd.gradcheck(function, used)
    assert torch.equal(function(*used).detach(), function(*(x.detach() for x in used)))


def test_inputs_are_not_written() -> None:
    inputs = random_rollout(5)
    copies = tuple(x.clone() for x in inputs)
    lambda_returns(*inputs)
    n_step_returns(*inputs[:3], 2, inputs[4])
    n_step_returns(*inputs[:3], 99, inputs[4])
    assert all(torch.equal(x, y) for x, y in zip(inputs, copies, strict=True))


def test_a_single_greedy_flag_is_no_row_of_them() -> None:
    with pytest.raises(ValueError, match=r"greedy_tm1 must be bool \[T, \*n\] .*got torch.bool \[\]; pass is_greedy"):
        watkins_lambda(0.95, torch.tensor(True))


def test_watkins_lambda_keeps_float64_and_returns_keep_float32() -> None:
    lam = watkins_lambda(0.95, torch.ones(4, 2, dtype=torch.bool))
    assert lam.dtype == torch.float64 and lam[0, 0].item() == 0.95 and lam[-1].eq(0).all()
    x = torch.ones(4, 2)
    assert lambda_returns(x, x * 0.9, x, lam, torch.zeros(4, 2, dtype=torch.bool)).dtype == torch.float32


def test_no_leading_axes_and_many() -> None:
    r, discount, v, lam, last = random_rollout(8)
    deep = lambda_returns(*(x[:, None, :, None].expand(-1, 2, -1, 2) for x in (r, discount, v, lam, last)))
    flat = torch.stack(
        [lambda_returns(*(x[:, n] for x in (r, discount, v, lam, last))) for n in range(r.shape[1])], dim=1
    )
    assert torch.equal(deep[:, 1, :, 0], flat)


def test_wrong_input_is_refused() -> None:
    x, flags = torch.ones(3), torch.zeros(3, dtype=torch.bool)
    for call, message in [
        (lambda: lambda_returns(x, x, x, 1.5, flags), "lambda_t must lie in"),
        (lambda: lambda_returns(x, x, x[:, None], 0.5, flags), "v_t must have the shape of r_t"),
        (lambda: lambda_returns(x, x, x, torch.ones(1), flags), "lambda_t must have the shape"),
        (lambda: lambda_returns(x, x, x, 0.5, x), "last_t must be a bool tensor"),
        (lambda: lambda_returns(x[:0], x[:0], x[:0], 0.5, flags[:0]), "T of at least 1"),
        (lambda: n_step_returns(x, x, x, 0, flags), "n must be a whole number"),
        (lambda: watkins_lambda(-0.1, flags), "lambda_ must lie in"),
        (lambda: watkins_lambda(0.5, x), "greedy_tm1 must be bool"),
        (lambda: is_greedy(x[:, None], x), "int64"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


def test_shapes_as_documented() -> None:
    """[T, *n] in, [T, *n] out, and [*n, A] to [*n], checked by jaxtyping and beartype."""
    rows, rows_of_actions = Float[Tensor, " T *n"], Float[Tensor, " T *n A"]
    flags, actions = Bool[Tensor, " T *n"], Int[Tensor, " T *n"]

    def returns(r, q, a, last):  # type: ignore[no-untyped-def]
        lambda_t = watkins_lambda(0.5, is_greedy(q, a))
        return lambda_returns(r, r, q.amax(-1), lambda_t, last) + n_step_returns(r, r, q.amax(-1), 2, last)

    returns.__annotations__ = {"r": rows, "q": rows_of_actions, "a": actions, "last": flags, "return": rows}
    checked = jaxtyped(typechecker=beartype)(returns)
    for shape in ((4,), (4, 2), (1, 3, 2)):
        checked(torch.ones(shape), torch.ones(*shape, 3), torch.zeros(shape).long(), torch.zeros(shape).bool())
    with pytest.raises(TypeCheckError):  # the check is in force
        checked(torch.ones(4), torch.ones(4, 2, 3), torch.zeros(4).long(), torch.zeros(4).bool())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an accelerator")
def test_an_accelerator_gives_the_same_returns() -> None:
    rollout = random_rollout(3)
    there = tuple(x.cuda() for x in rollout)
    torch.testing.assert_close(lambda_returns(*there).cpu(), lambda_returns(*rollout), rtol=0, atol=1e-12)
    torch.testing.assert_close(
        n_step_returns(*there[:3], 2, there[4]).cpu(), n_step_returns(*rollout[:3], 2, rollout[4]), rtol=0, atol=1e-12
    )
    flags = watkins_lambda(0.5, there[4])
    assert flags.device == there[4].device and torch.equal(flags.cpu(), watkins_lambda(0.5, rollout[4]))

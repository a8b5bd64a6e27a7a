"""Losses and Bellman errors against hand arithmetic.

Mutants that these tests kill: weights ignored (also in one branch of the Huber loss only); weights inside the square;
no ½; Huber without its -½delta²; the sign of the error; a target that is detached in secret (residual) or
differentiated in secret (semi-gradient).
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuralq import rules


def test_squared_by_hand() -> None:
    error, weight = torch.tensor([3.0, -2.0]), torch.tensor([2.0, 0.5])
    assert rules.squared(error).tolist() == [4.5, 2.0]
    assert rules.squared(error, weight).tolist() == [9.0, 1.0]


def test_huber_by_hand() -> None:
    """delta = 2: ½·1² = .5, ½·2² = 2 at the seam, 2·(5 - 1) = 8; weights 1, 2, 3 multiply both pieces."""
    error, weight = torch.tensor([-1.0, 2.0, -5.0]), torch.tensor([1.0, 2.0, 3.0])
    assert rules.huber(error, 2.0).tolist() == [0.5, 2.0, 8.0]
    assert rules.huber(error, 2.0, weight).tolist() == [0.5, 4.0, 24.0]


@given(st.floats(-50, 50), st.floats(0.1, 10), st.floats(0, 5))
def test_the_derivative_is_the_clipped_weighted_error(e: float, delta: float, w: float) -> None:
    weight = torch.tensor([w], dtype=torch.float64)
    for loss, expected in ((rules.squared, w * e), (None, w * max(-delta, min(delta, e)))):
        error = torch.tensor([e], dtype=torch.float64, requires_grad=True)
        out = rules.squared(error, weight) if loss else rules.huber(error, delta, weight)
        out.sum().backward()
        assert error.grad is not None and error.grad.item() == pytest.approx(expected, abs=1e-12)


def test_huber_agrees_with_the_framework() -> None:
    error = torch.linspace(-4, 4, 33, dtype=torch.float64)
    theirs = torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=1.5)
    torch.testing.assert_close(rules.huber(error, 1.5), theirs)


def test_semi_and_residual_gradient_of_a_line() -> None:
    """Q = w·x with x = 2 then x' = 3, w = 1, r = 4, γ = ½: δ = 4 + 1.5 - 2 = 3.5.

    Semi-gradient of ½δ²: -3.5·2 = -7. Residual gradient: 3.5·(½·3 - 2) = -1.75.
    """
    w = torch.tensor(1.0, requires_grad=True)
    semi = rules.semi_gradient_error(w * 2, (4 + 0.5 * 3 * w).detach())
    rules.squared(semi).backward()
    assert semi.item() == 3.5 and w.grad is not None and w.grad.item() == -7.0
    w.grad = None
    rules.squared(rules.residual_gradient_error(w * 2, 4 + 0.5 * 3 * w)).backward()
    assert w.grad is not None and w.grad.item() == -1.75


def test_the_wrong_preparation_is_refused() -> None:
    w = torch.ones(2, requires_grad=True)
    with pytest.raises(ValueError, match="detach it in the learner"):
        rules.semi_gradient_error(w, 2 * w)
    with pytest.raises(ValueError, match="without detaching"):
        rules.residual_gradient_error(w, torch.ones(2))
    with torch.no_grad():  # for reporting, no gradient is asked for on either side
        assert rules.residual_gradient_error(w * 1, torch.ones(2)).tolist() == [0.0, 0.0]


def test_bad_input_is_refused() -> None:
    ones = torch.ones(2)
    for call, message in [
        (lambda: rules.squared(ones, torch.ones(2, 1)), "weight must have the shape of error"),
        (lambda: rules.huber(ones, 1.0, torch.ones(1)), "weight must have the shape of error"),
        (lambda: rules.huber(ones, 0.0), "delta must be a finite number above 0"),
        (lambda: rules.semi_gradient_error(ones, torch.ones(2, 1)), "target must have the shape"),
        (lambda: rules.residual_gradient_error(ones, torch.ones(2, 1)), "target must have the shape"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()

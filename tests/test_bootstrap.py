"""The compiled one-step targets are those of `rules.q_learning`, bit for bit.

Mutants that die here: the maximum over all but the last action; NaN passed over by the maximum; 0 · −∞ left as NaN; the
scale applied to the bootstrap; the discount left out where it is 0.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neuralq import rules
from neuralq.learners.replay.targets import q_learning_targets


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("num_actions", [1, 2, 5])
def test_equals_the_rule_with_illegal_actions_and_terminations(dtype: torch.dtype, num_actions: int) -> None:
    rng = np.random.default_rng(num_actions)
    q_t = torch.from_numpy(rng.normal(size=(200, num_actions))).to(dtype)
    q_t[torch.from_numpy(rng.random((200, num_actions)) < 0.3)] = -torch.inf
    r_t = torch.from_numpy(rng.normal(size=200).astype(np.float32))
    discount_t = torch.from_numpy(np.where(rng.random(200) < 0.4, 0.0, 0.97).astype(np.float32))
    expected = rules.q_learning(r_t.to(dtype) * 0.1, discount_t.to(dtype), q_t)
    got = q_learning_targets(r_t, discount_t, q_t, 0.1)
    assert got.dtype == dtype and torch.equal(got, expected)
    assert not got.isnan().any()


@pytest.mark.parametrize("place", [0, 1, 2])
def test_nan_reaches_the_target(place: int) -> None:
    q_t = torch.tensor([[1.0, 2.0, 3.0]])
    q_t[0, place] = torch.nan
    assert q_learning_targets(torch.zeros(1), torch.ones(1), q_t).isnan().all()


def test_hand_arithmetic_with_a_scale() -> None:
    q_t = torch.tensor([[1.0, 4.0], [9.0, 2.0], [-torch.inf, -torch.inf]])
    got = q_learning_targets(torch.tensor([2.0, 4.0, 6.0]), torch.tensor([0.5, 0.0, 0.0]), q_t, 0.5)
    assert got.tolist() == [3.0, 2.0, 3.0]  # 1 + .5 · 4, 2, 3 + 0 · (−∞) := 3


def test_shapes_that_differ_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        q_learning_targets(torch.zeros(2), torch.zeros(3), torch.zeros(3, 2))

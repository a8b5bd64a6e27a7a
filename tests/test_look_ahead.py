"""Backed-up scores as targets, and alpha-beta over any game, against autograd and plain minimax.

Mutants that die here: a target not cut, or cut at another number, a decided score that teaches, a fixed weight moved,
the error with the other sign; alpha and beta exchanged or not turned round, a search that ends where it is not quiet or
goes on where it is, a line that is not the one that the score comes from.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.tabular import BackupRule, alpha_beta, backup_update


def test_a_backed_up_score_corrects_by_the_gradient_and_the_first_weights_stay() -> None:
    rng = np.random.default_rng(0)
    for num_fixed, backed_up in itertools.product((0, 1, 3), (-49.0, -12.5, -3.0, 0.2, 11.0, 12.5, 49.9)):
        weights, terms = rng.normal(size=(2, 5))
        w = torch.tensor(weights, requires_grad=True)
        loss = (min(max(backed_up, -12.0), 12.0) - w @ torch.tensor(terms)) ** 2 / 2
        loss.backward()  # type: ignore[no-untyped-call]
        assert w.grad is not None
        expected = np.where(np.arange(5) < num_fixed, weights, weights - 0.03 * w.grad.numpy())
        error = backup_update(weights, BackupRule(num_fixed), terms, backed_up, 0.03)
        assert np.allclose(weights, expected, rtol=0, atol=1e-15) and abs(error) == pytest.approx(
            np.sqrt(2 * loss.item())
        )
    before = weights.copy()
    assert backup_update(weights, BackupRule(decided=20.0), terms, -20.5, 0.03) == 0.0 and (weights == before).all()
    assert backup_update(weights, BackupRule(decided=20.0), terms, -19.5, 0.03) != 0.0


def minimax(node: Any, depth: int) -> float:
    """A tree is a leaf's value with its children; an odd tenth of the value says that it is not quiet."""
    value, children = node
    if not children or (depth <= 0 and int(value * 10) % 2 == 0):
        return float(value)
    return max(-minimax(child, depth - 1) for child in children)


def test_alpha_beta_is_minimax_and_looks_at_less() -> None:
    rng = np.random.default_rng(0)

    def grown(height: int) -> Any:
        value = round(float(rng.normal()), 1)
        return value, [grown(height - 1) for _ in range(rng.integers(0, 5))] if height else []

    def is_quiet(node: Any) -> bool:
        return int(node[0] * 10) % 2 == 0

    def children(node: Any) -> Any:
        return node[1]

    looked = [0, 0]

    def evaluate(node: Any) -> float:
        looked[0] += 1
        return float(node[0])

    for _ in range(150):
        tree, depth = grown(6), int(rng.integers(0, 6))
        found = alpha_beta(tree, depth, children, evaluate, is_quiet)
        assert found.score == minimax(tree, depth)
        end = found.line[-1] if found.line else tree
        assert end[0] * (-1) ** len(found.line) == found.score
        window = alpha_beta(tree, depth, children, lambda node: float(node[0]), is_quiet, -0.3, 0.4).score
        assert np.clip(window, -0.3, 0.4) == np.clip(found.score, -0.3, 0.4)
        stack = [(tree, depth)]
        while stack:
            node, left = stack.pop()
            if not node[1] or (left <= 0 and is_quiet(node)):
                looked[1] += 1
            else:
                stack += [(child, left - 1) for child in node[1]]
    assert looked[0] < 0.6 * looked[1]
    with pytest.raises(ValueError, match="depth must be a whole number of at least 0"):
        alpha_beta(0, -1, lambda node: [], float)

"""The sum tree against NumPy's cumulative sums.

Planted mutant that dies here: `<=` for `<` in the descent.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuralq.learners.replay.sum_tree import SumTree

weights_lists = st.lists(st.integers(0, 50), min_size=1, max_size=40)


@settings(max_examples=60, deadline=None)
@given(weights_lists, st.data())
def test_find_is_the_inverse_of_the_cumulative_sum(weights: list[int], draw: st.DataObject) -> None:
    # Whole numbers add without rounding, so each boundary must be exact.
    tree = SumTree(len(weights))
    order = draw.draw(st.permutations(range(len(weights))))
    for i in order:
        tree.set(np.array([i]), np.array([float(weights[i])]))
    assert tree.total == sum(weights)
    if sum(weights) == 0:
        with pytest.raises(ValueError, match="every weight is 0"):
            tree.find(np.array([0.0]))
        return
    masses = np.arange(0, sum(weights), 0.5)
    expected = np.searchsorted(np.cumsum(weights), masses, side="right")
    np.testing.assert_array_equal(tree.find(masses), expected)


def test_a_leaf_set_a_million_times_leaves_no_rounding_behind() -> None:
    tree = SumTree(5)
    rng = np.random.default_rng(0)
    tree.set(rng.integers(0, 5, 1_000_000), 10.0 ** rng.uniform(-8, 8, 1_000_000))
    tree.set(np.arange(5), np.array([1.0, 2.0, 4.0, 8.0, 16.0]))
    assert tree.total == 31.0


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(1e-12, 1e12), min_size=1, max_size=33), st.integers(0, 2**32 - 1))
def test_no_leaf_of_weight_zero_is_found(weights: list[float], seed: int) -> None:
    values = np.array(weights)
    values[np.random.default_rng(seed).random(len(values)) < 0.5] = 0.0
    tree = SumTree(len(values))
    tree.set(np.arange(len(values)), values)
    if tree.total > 0:
        masses = np.concatenate([np.linspace(0, tree.total, 99, endpoint=False), [np.nextafter(tree.total, 0.0)]])
        assert (values[tree.find(np.minimum(masses, np.nextafter(tree.total, 0.0)))] > 0).all()


def test_state_gives_the_same_tree_node_for_node() -> None:
    tree, other = SumTree(6), SumTree(6)
    tree.set(np.arange(6), np.random.default_rng(1).random(6))
    other.load_state_dict(tree.state_dict())
    np.testing.assert_array_equal(tree.nodes, other.nodes)
    with pytest.raises(ValueError, match="6 leaves"):
        other.load_state_dict({"weights": np.zeros(7)})


@pytest.mark.parametrize(
    ("indices", "weights", "message"),
    [
        ([3], [1.0], r"lie in \[0, 3\)"),
        ([-1], [1.0], r"lie in \[0, 3\)"),
        ([0], [-1.0], "finite and not negative"),
        ([0], [np.nan], "finite and not negative"),
        ([0], [np.inf], "finite and not negative"),
        ([0, 1], [1.0], "equally long"),
    ],
)
def test_refuses_what_would_spoil_the_tree(indices: list[int], weights: list[float], message: str) -> None:
    tree = SumTree(3)
    with pytest.raises(ValueError, match=message):
        tree.set(np.array(indices), np.array(weights))
    assert tree.total == 0.0


def test_refuses_masses_outside_the_tree() -> None:
    tree = SumTree(2)
    tree.set(np.array([0]), np.array([1.0]))
    for mass in (1.0, -0.1):
        with pytest.raises(ValueError, match="masses must lie"):
            tree.find(np.array([mass]))

"""The compiled product of small matrices equals NumPy's in float64, wherever its operands lie, and writes nothing else.

Mutants that die here: a block begun where it would reach beyond C; the last row of a block written to the next one;
the step between rows taken for the step along the inner index; the bias of the first columns for all; the inner loop
one step short; an offset forgotten, of any of the four arrays; sums that depend on the other rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuralq.q.kernels.products import MAX_PANEL, MIN_COLUMNS, multiply, suits


def _placed(x: np.ndarray, at: int) -> np.ndarray:
    """``x`` flat behind ``at`` entries of something else, and followed by more of it."""
    return np.concatenate([np.full(at, 7e7), x.ravel(), np.full(5, 7e7)]).astype(x.dtype)


def _product(a: np.ndarray, b: np.ndarray, bias: np.ndarray, places: Any = (0, 0, 0, 0), turned: bool = False) -> Any:
    (rows, inner), columns = a.shape, b.shape[1]
    a_at, b_at, bias_at, c_at = places
    c = _placed(np.full((rows, columns), np.nan, a.dtype), c_at)
    row, along = (1, rows) if turned else (inner, 1)
    multiply(
        _placed(a.T if turned else a, a_at), a_at, row, along, rows, inner,
        _placed(b, b_at), b_at, columns, _placed(bias, bias_at), bias_at, c, c_at,
    )  # fmt: skip
    assert (c[:c_at] == 7e7).all() and (c[c_at + rows * columns :] == 7e7).all()
    return c[c_at : c_at + rows * columns].reshape(rows, columns)


@given(
    rows=st.integers(1, 20),
    inner=st.integers(1, 40),
    extra=st.integers(0, 3 * MIN_COLUMNS),
    places=st.tuples(*[st.integers(0, 9)] * 4),
    turned=st.booleans(),
    dtype=st.sampled_from([np.float32, np.float64]),
    seed=st.integers(0, 2**32),
)
def test_equals_numpy_in_float64(
    rows: int, inner: int, extra: int, places: Any, turned: bool, dtype: Any, seed: int
) -> None:
    rng, columns = np.random.default_rng(seed), MIN_COLUMNS + extra
    a, b, bias = (rng.standard_normal(shape).astype(dtype) for shape in ((rows, inner), (inner, columns), (columns,)))
    exact = a.astype(np.float64) @ b.astype(np.float64) + bias
    # |error| ≤ (inner + 1) · ε · (Σ|a||b| + |bias|) for a sum in any order (Higham 2002, eq. 3.5).
    bound = (inner + 1) * np.finfo(dtype).eps * (np.abs(a) @ np.abs(b) + np.abs(bias))
    assert (np.abs(_product(a, b, bias, places, turned) - exact) <= bound).all()


def test_whole_numbers_are_exact() -> None:
    """Small whole numbers have no rounding: every entry must be the very number."""
    a, b = np.arange(7 * 3).reshape(7, 3), np.arange(3 * 50).reshape(3, 50)
    bias = np.arange(50) * 1000
    for dtype in (np.float32, np.float64):
        assert (_product(a.astype(dtype), b.astype(dtype), bias.astype(dtype)) == a @ b + bias).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_row_does_not_depend_on_the_others(dtype: Any) -> None:
    """Acting alone and in a batch gives the same bits."""
    rng = np.random.default_rng(0)
    a, b, bias = (rng.standard_normal(n).astype(dtype) for n in ((13, 30), (30, 84), (84,)))
    together = _product(a, b, bias)
    for i in range(13):
        assert _product(a[i : i + 1], b, bias).tobytes() == together[i : i + 1].tobytes()
    columns = _product(a, np.ascontiguousarray(b[:, :64]), bias[:64])
    assert columns.tobytes() == np.ascontiguousarray(together[:, :64]).tobytes()


def test_nan_and_infinity_stay_where_they_belong() -> None:
    a, b, bias = np.ones((7, 2)), np.ones((2, 40)), np.zeros(40)
    a[3, 1], b[0, 39] = np.nan, np.inf
    c = _product(a, b, bias)
    assert np.isnan(c[3]).all() and np.isinf(np.delete(c[:, 39], 3)).all()
    assert (np.delete(c[:, :39], 3, axis=0) == 2).all()


def test_what_suits() -> None:
    assert suits(1, MIN_COLUMNS) and not suits(1, MIN_COLUMNS - 1) and not suits(0, MIN_COLUMNS)
    assert suits(MAX_PANEL // 64, 64) and not suits(MAX_PANEL // 64 + 1, 64)

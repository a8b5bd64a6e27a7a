"""Products of small matrices, compiled into the kernels that need them: C = A·B + bias, in one pass over registers.

BLAS is made for large matrices. At a batch of 64 and 64 units its call costs as much as its arithmetic, and what it
knows of a processor is what its build was told: on processors that it does not recognise it leaves half of their vector
width unused. Here a block of C, 6 rows by two vectors, is kept in registers while the inner index runs, with operands
taken where they lie; that is enough as long as the rows of B stay in the cache, which those of small networks do.

The vectors are LLVM's, as wide as the processor on which the code is compiled has them, so no machine code is chosen at
run time and none is written here. Blocks that would reach beyond C begin earlier and compute some of it twice. Each
entry is summed in the order of the inner index, so the result does not depend on the other rows of the batch.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from neuralq.jit import reassociating_kernel
from neuralq.types import Array

__all__ = ["MAX_PANEL", "MIN_COLUMNS", "multiply", "suits"]


_ROWS, _VECTORS = 6, 2
"""Size of a block: its 12 vectors of sums, two of B and one of A fit into the 16 registers of AVX2."""


def _vector_bytes() -> int:
    """Width of this processor's vectors; 32 where nothing is known, which LLVM splits if it must."""
    try:
        features = llvmlite.binding.get_host_cpu_features()
    except RuntimeError:
        return 32
    return 64 if features.get("avx512f", False) else 32


_VECTOR_BYTES = _vector_bytes()

MIN_COLUMNS = _VECTOR_BYTES // 2
"""Columns of B below which `multiply` must not be called: two vectors of float32 (float64 could do with half)."""

MAX_PANEL = 1 << 18
"""Entries of B up to which it stays in the cache, so that this is at least as quick as BLAS."""


@intrinsic
def _block(
    typingctx: Any, a: Any, a_at: Any, a_row: Any, a_inner: Any, last: Any, b: Any, b_at: Any, columns: Any,
    inner: Any, bias: Any, bias_at: Any, c: Any, c_at: Any,
) -> Any:  # fmt: skip
    """Rows 0 to min(5, ``last``) of two vectors of C; places as for `multiply`, with an inner length of at least 1."""
    whole = types.int64
    arguments = (a, whole, whole, whole, whole, b, whole, whole, whole, bias, whole, c, whole)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        arrays = {i: context.make_array(t)(context, builder, args[i]).data
                  for i, t in enumerate(signature.args) if isinstance(t, types.Array)}  # fmt: skip
        _Block(builder, c.dtype.bitwidth // 8, *(arrays.get(i, x) for i, x in enumerate(args))).write()
        return context.get_dummy_value()

    return types.void(*arguments), generate


class _Block:
    """Writes the loop of `_block` in LLVM's language: registers are what Python has no word for."""

    def __init__(
        self, builder: Any, size: int, a: Any, a_at: Any, a_row: Any, a_inner: Any, last: Any, b: Any, b_at: Any,
        columns: Any, inner: Any, bias: Any, bias_at: Any, c: Any, c_at: Any,
    ) -> None:  # fmt: skip
        self.builder, self.size = builder, size
        self.a, self.a_inner, self.b, self.b_at, self.b_row, self.inner = a, a_inner, b, b_at, columns, inner
        scalar = ir.FloatType() if size == 4 else ir.DoubleType()
        self.lanes = _VECTOR_BYTES // size
        self.vector = ir.VectorType(scalar, self.lanes)
        # Rows below the last are the last row once more: computed twice, written twice, with the same numbers.
        rows = [builder.select(builder.icmp_signed(">", _word(r), last), last, _word(r)) for r in range(_ROWS)]
        self.starts = [builder.add(a_at, builder.mul(row, a_row)) for row in rows]
        self.ends = [(c, builder.add(c_at, builder.mul(row, columns))) for row in rows]
        self.first = [builder.load(place, align=size) for place in self.places(bias, bias_at)]

    def places(self, array: Any, at: Any) -> list[Any]:
        """Where the two vectors from entry ``at`` on lie."""
        found = []
        for v in range(_VECTORS):
            entry = self.builder.gep(array, [self.builder.add(at, _word(v * self.lanes))])
            found.append(self.builder.bitcast(entry, self.vector.as_pointer()))
        return found

    def spread(self, value: Any) -> Any:
        """A vector full of one number."""
        undefined, zero = ir.Constant(self.vector, ir.Undefined), ir.Constant(ir.IntType(32), 0)
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), [0] * self.lanes)
        return self.builder.shuffle_vector(self.builder.insert_element(undefined, value, zero), undefined, everywhere)

    def step(self, k: Any, sums: list[Any]) -> list[Any]:
        """The sums with the products of inner index ``k``."""
        builder, updated = self.builder, []
        from_b = [builder.load(place, align=self.size)
                  for place in self.places(self.b, builder.add(self.b_at, builder.mul(k, self.b_row)))]  # fmt: skip
        along = builder.mul(k, self.a_inner)
        for row, start in enumerate(self.starts):
            one = self.spread(builder.load(builder.gep(self.a, [builder.add(start, along)])))
            for v, vector in enumerate(from_b):
                product = builder.fmul(one, vector, flags=["contract"])  # one instruction with the sum, where there is
                updated.append(builder.fadd(product, sums[row * _VECTORS + v], flags=["contract"]))
        return updated

    def write(self) -> None:
        """The loop over the inner index, and the stores after it."""
        builder, before = self.builder, self.builder.block
        loop, after = (builder.append_basic_block(name) for name in ("inner", "after"))
        builder.branch(loop)
        builder.position_at_end(loop)
        k = builder.phi(ir.IntType(64))
        sums = [builder.phi(self.vector) for _ in range(_ROWS * _VECTORS)]
        updated, following = self.step(k, sums), builder.add(k, _word(1))
        for one, start, new in zip((k, *sums), (_word(0), *self.first * _ROWS), (following, *updated), strict=True):
            one.add_incoming(start, before)
            one.add_incoming(new, loop)
        builder.cbranch(builder.icmp_signed("<", following, self.inner), loop, after)
        builder.position_at_end(after)
        for row, (c, at) in enumerate(self.ends):
            for v, place in enumerate(self.places(c, at)):
                builder.store(updated[row * _VECTORS + v], place, align=self.size)


def _word(n: int) -> Any:
    return ir.Constant(ir.IntType(64), n)


@reassociating_kernel
def suits(inner: int, columns: int) -> bool:
    """Whether `multiply` takes a B of this shape, and is the quicker way.

    Example:
        >>> suits(64, 64), suits(64, 2), suits(0, 64)
        (True, False, False)
    """
    return inner > 0 and columns >= MIN_COLUMNS and inner * columns <= MAX_PANEL


@reassociating_kernel
def multiply(
    a: Array, a_at: int, a_row: int, a_inner: int, rows: int, inner: int,
    b: Array, b_at: int, columns: int, bias: Array, bias_at: int, c: Array, c_at: int,
) -> None:  # fmt: skip
    """C ← A·B + bias with every operand a place in a flat array.

    Args:
        a: holds A ``[rows, inner]``: entry (i, k) is ``a[a_at + i·a_row + k·a_inner]``, so that a transpose is as good.
        a_at: where A begins.
        a_row: step from row to row.
        a_inner: step along the inner index.
        rows: of A and C, at least 1.
        inner: columns of A, rows of B, at least 1.
        b: holds B ``[inner, columns]`` row by row.
        b_at: where B begins.
        columns: of B and C, at least `MIN_COLUMNS`.
        bias: holds what is added to every row of C, ``[columns]``.
        bias_at: where that begins.
        c: takes C ``[rows, columns]`` row by row; no part of the other arrays.
        c_at: where C begins.

    Example:
        >>> import numpy as np
        >>> a, b, c = np.arange(2.0), np.arange(64.0), np.zeros(32)
        >>> multiply(a, 0, 2, 1, 1, 2, b, 0, 32, np.ones(32), 0, c, 0)
        >>> c[:3].tolist()  # 1 + 0·0 + 1·32, …
        [33.0, 34.0, 35.0]
    """
    width = _VECTORS * (_VECTOR_BYTES // c.itemsize)
    for j in range(0, columns, width):
        at = min(j, columns - width)
        for i in range(0, rows, _ROWS):
            top = max(0, min(i, rows - _ROWS))
            here, there = a_at + top * a_row, c_at + top * columns + at
            last, bias_here = rows - 1 - top, bias_at + at
            _block(  # type: ignore[call-arg]  # the typing context is numba's to give
                a, here, a_row, a_inner, last, b, b_at + at, columns, inner, bias, bias_here, c, there
            )

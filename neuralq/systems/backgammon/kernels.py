"""Values of backgammon boards as compiled loops over plain arrays, and the choice of a turn by them.

A board is int8 ``[2, 25]`` seen by the side to move (`neuralq_envs.backgammon.rules`), and the network always sees it
so: the side to move is player 0 of Tesauro's inputs. Exchanging the players therefore leaves every value as it is, to
the bit, and what one side learns the other knows. The K outputs are those of the side to move: with six, the chances
of a plain win, a gammon, a backgammon, and of the same lost; with four, as Tesauro, a backgammon counts as a gammon;
with one, of a win.

With the hidden units h = σ(Wᵀx) and the outputs y = σ(Vh + c), three things make a value cheap:

* only about 27 of the 198 inputs are not zero, and an afterstate differs from its siblings in about six: so Wᵀx is
  summed once for the first afterstate of a roll, and for the others only what changed is added;
* σ in float32 is a quotient of polynomials (the eleventh convergent of Lambert's continued fraction of tanh, wrong by
  less than 5e-7), which vectorises; in float64 it is the exponential of the mathematics library;
* no kernel within a game counts references to arrays (`neuralq.jit.lean_kernel`), which saves a sixth of the time.

Weights are float32 or float64: ``w`` ``[199, H]``, one row per input, the last for the constant 1, and 14 rows more if
the network is also shown the numbers of `neuralq_envs.backgammon.expert`; ``v`` ``[K, H]``; ``c`` ``[K]``. All scratch
is in one `Scratch` tuple, made once.

Source: Tesauro (1992), "Practical issues in temporal difference learning".
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel, lean_reassociating_kernel
from neuralq.types import Array
from neuralq_envs.backgammon.expert import NUM_EXPERT, expert_inputs
from neuralq_envs.backgammon.inputs import MAX_ACTIVE, NUM_INPUTS, tesauro_sparse
from neuralq_envs.backgammon.rules import BAR, MAX_AFTERSTATES, Board, result

__all__ = ["Scratch", "choose", "equity_of", "evaluate", "forward", "new_scratch", "settled"]


_OTHER = 98  # where the inputs of the side that is not to move begin


class Scratch(NamedTuple):
    """What the kernels write to between two lines; nothing in it outlives a call."""

    boards: Board  # [MAX_AFTERSTATES, 2, 25]
    indices: NDArray[np.int64]  # [46]
    inputs: Array  # [46]
    expert: Array  # [14]
    first: Array  # [H] Wᵀx of the first afterstate
    hidden: Array  # [H]
    y: Array  # [K]
    back: Array  # [K, H]


def new_scratch(num_hidden: int, num_outputs: int, dtype: Any) -> Scratch:
    """Arrays of the right sizes, not yet written.

    Example:
        >>> new_scratch(40, 4, np.float32).hidden.shape
        (40,)
    """
    return Scratch(
        np.empty((MAX_AFTERSTATES, 2, 25), np.int8),
        np.empty(MAX_ACTIVE + 1 + NUM_EXPERT, np.int64),
        np.empty(MAX_ACTIVE + 1 + NUM_EXPERT, dtype),
        np.empty(NUM_EXPERT, dtype),
        np.empty(num_hidden, dtype),
        np.empty(num_hidden, dtype),
        np.empty(num_outputs, dtype),
        np.empty((num_outputs, num_hidden), dtype),
    )


@lean_reassociating_kernel
def _sigmoids(z: Array) -> None:
    """σ(z) in place."""
    one = z.dtype.type(1.0)
    if z.itemsize == 8:
        for j in range(z.size):
            z[j] = one / (one + np.exp(-z[j]))
        return
    half, eight, nought = z.dtype.type(0.5), z.dtype.type(8.0), z.dtype.type(0.0)
    n0, n1, n2 = z.dtype.type(13749310575.0), z.dtype.type(1964187225.0), z.dtype.type(64324260.0)
    n3, n4, n5 = z.dtype.type(675675.0), z.dtype.type(2145.0), z.dtype.type(1.0)
    d0, d1, d2 = z.dtype.type(13749310575.0), z.dtype.type(6547290750.0), z.dtype.type(413513100.0)
    d3, d4, d5 = z.dtype.type(7567560.0), z.dtype.type(45045.0), z.dtype.type(66.0)
    for j in range(z.size):
        x = max(-eight, min(eight, half * z[j]))
        q = x * x
        above = x * (n0 + q * (n1 + q * (n2 + q * (n3 + q * (n4 + q * n5)))))
        below = d0 + q * (d1 + q * (d2 + q * (d3 + q * (d4 + q * d5))))
        z[j] = max(nought, min(one, half + half * (above / below)))


@lean_reassociating_kernel
def _outputs(v: Array, c: Array, hidden: Array, y: Array) -> None:
    for k in range(y.size):
        total = c[k]
        for j in range(hidden.size):
            total += v[k, j] * hidden[j]
        y[k] = total
    _sigmoids(y)


@lean_reassociating_kernel
def _sum_of_inputs(board: Board, w: Array, indices: NDArray[np.int64], inputs: Array, z: Array) -> int:
    """Wᵀx, from the inputs that are not zero; they and their numbers are written too."""
    count = tesauro_sparse(board, 0, indices, inputs)
    indices[count] = NUM_INPUTS
    inputs[count] = 1.0
    for j in range(z.size):
        z[j] = w[NUM_INPUTS, j]
    for i in range(count):
        row, x = indices[i], inputs[i]
        for j in range(z.size):
            z[j] += x * w[row, j]
    return count + 1


@lean_kernel
def _with_expert(board: Board, w: Array, count: int, s: Scratch, z: Array) -> int:
    """Adds what the expert inputs give to z, if the network has them; writes them behind the ``count`` others."""
    if len(w) == NUM_INPUTS + 1:
        return count
    expert_inputs(board, s.expert)
    for i in range(NUM_EXPERT):
        if s.expert[i] != 0:
            s.indices[count], s.inputs[count] = NUM_INPUTS + 1 + i, s.expert[i]
            _add_row(w, NUM_INPUTS + 1 + i, s.expert[i], z)
            count += 1
    return count


@lean_reassociating_kernel
def _add_row(w: Array, row: int, x: Any, z: Array) -> None:
    for j in range(z.size):
        z[j] += x * w[row, j]


@lean_reassociating_kernel
def _change(before: Board, boards: Board, i: int, w: Array, z: Array) -> int:
    """Adds to z what Wᵀx of ``boards[i]`` has beyond that of ``before``; says how many checkers row 1 has left."""
    one = z.dtype.type(1.0)
    left = 0
    for side in range(2):
        offset = _OTHER * side
        gone, left = 0, 0
        for point in range(BAR):
            old, new = before[side, point], boards[i, side, point]
            left += new
            if old == new:
                continue
            gone += old - new
            low, high, sign = (old, new, one) if old < new else (new, old, -one)
            for unit in range(min(low, 3), min(high, 3)):
                _add_row(w, offset + 4 * point + unit, sign, z)
            if high > 3:
                _add_row(w, offset + 4 * point + 3, z.dtype.type(0.5 * (max(new, 3) - max(old, 3))), z)
        old, new = before[side, BAR], boards[i, side, BAR]
        left += new
        gone += old - new
        if old != new:
            _add_row(w, offset + 96, z.dtype.type(0.5 * (new - old)), z)
        if gone != 0:
            _add_row(w, offset + 97, z.dtype.type(gone / 15), z)
    return left


@lean_kernel
def equity_of(y: Array) -> float:
    """Points that the side to move expects: Σₖ (k + 1)(yₖ − yₖ₊ₘ), m = K/2 kinds of a win, or 2y₀ − 1 where K = 1."""
    kinds, equity = y.size // 2, 0.0
    if kinds == 0:
        return 2.0 * float(y[0]) - 1.0
    for k in range(kinds):
        equity += (k + 1.0) * (float(y[k]) - float(y[k + kinds]))
    return equity


@lean_reassociating_kernel
def settled(points: int, y: Array) -> None:
    """The outputs of a game that is over, ``points`` being what the side to move has won."""
    for k in range(y.size):
        y[k] = 0.0
    kinds = y.size // 2
    if kinds == 0:
        y[0] = 1.0 if points > 0 else 0.0
    else:
        y[(0 if points > 0 else kinds) + min(abs(points), kinds) - 1] = 1.0


@lean_kernel
def choose(count: int, w: Array, v: Array, c: Array, s: Scratch) -> int:
    """Which of the first ``count`` afterstates in ``s.boards`` is worst for the side that is then to move."""
    best, lowest = 0, np.inf
    _sum_of_inputs(s.boards[0], w, s.indices, s.inputs, s.first)
    for i in range(count):
        for j in range(s.first.size):
            s.hidden[j] = s.first[j]
        left = _change(s.boards[0], s.boards, i, w, s.hidden)
        if left == 0:
            equity = float(result(s.boards[i]))
        else:
            _with_expert(s.boards[i], w, 0, s, s.hidden)
            _sigmoids(s.hidden)
            _outputs(v, c, s.hidden, s.y)
            equity = equity_of(s.y)
        if equity < lowest:
            best, lowest = i, equity
    return best


@lean_kernel
def forward(board: Board, w: Array, v: Array, c: Array, s: Scratch) -> int:
    """Writes the hidden units and the outputs, and the inputs that are not zero; returns how many these are."""
    count = _sum_of_inputs(board, w, s.indices, s.inputs, s.hidden)
    count = _with_expert(board, w, count, s, s.hidden)
    _sigmoids(s.hidden)
    _outputs(v, c, s.hidden, s.y)
    return count


@lean_kernel
def evaluate(boards: Board, w: Array, v: Array, c: Array, s: Scratch, y: Array) -> None:
    """Writes the outputs of each board: what the network says, or what has happened where the game is over.

    Args:
        boards: ``[n, 2, 25]``.
        w: ``[199, H]`` or ``[213, H]``.
        v: ``[K, H]``.
        c: ``[K]``.
        s: scratch.
        y: ``[n, K]``; written.
    """
    for i in range(len(boards)):
        points = result(boards[i])
        if points != 0:
            settled(points, y[i])
        else:
            forward(boards[i], w, v, c, s)
            for k in range(len(s.y)):
                y[i, k] = s.y[k]

"""TD(λ) self-play as compiled loops, in the backward and in the forward view.

Both play whole games with the values of `neuralq.systems.backgammon.kernels`, and two things make what they learn
cheap:

* backward, the trace of an input that has not been seen for so long that λ to that power is below 1e-12 is dropped;
* forward, errors are combined over the outputs first, so that there is nothing to keep for each output.

Sources: Tesauro (1992, 1995); Sutton (1988), eq. 4; Sutton & Barto (2018), section 16.1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import kernel, lean_kernel, lean_reassociating_kernel
from neuralq.systems.backgammon.kernels import Scratch, choose, forward, settled
from neuralq.types import Array
from neuralq_envs.backgammon.rules import START, Board, afterstates, copy_board, result, roll

__all__ = ["play_batch", "play_online"]


_NEGLIGIBLE = 1e-12
_FIRST_HISTORY = 512


@kernel
def _turn(board: Board, opening: bool, rng: np.random.Generator, w: Array, v: Array, c: Array, s: Scratch) -> None:
    """Rolls and plays the best turn, in place: the board is then seen by the other side."""
    die_1, die_2 = roll(rng, opening)
    count = afterstates(board, die_1, die_2, s.boards)
    copy_board(s.boards[choose(count, w, v, c, s) if count > 1 else 0], board)


@lean_kernel
def _tally(points: int, turns: int, tally: NDArray[np.int64]) -> None:
    tally[abs(points) - 1] += 1
    tally[3] += turns


@lean_reassociating_kernel
def _backward(v: Array, s: Scratch, sign: Any) -> None:
    """∂y[k]/∂z into s.back ``[K, H]`` for z = Wᵀx, times ``sign``; s.hidden and s.y are the values."""
    one = s.y.dtype.type(1.0)
    for k in range(s.y.size):
        slope = sign * s.y[k] * (one - s.y[k])
        for j in range(s.hidden.size):
            s.back[k, j] = slope * v[k, j] * s.hidden[j] * (one - s.hidden[j])


@lean_kernel
def _seen_by_first(y: Array, first_moves: bool, out: Array) -> None:
    """The outputs as the player who moved first sees them."""
    if y.size == 1:
        out[0] = y[0] if first_moves else y.dtype.type(1.0) - y[0]
    else:
        for k in range(y.size):
            out[k] = y[k] if first_moves else y[(k + y.size // 2) % y.size]


@lean_reassociating_kernel
def _learn(
    w: Array, v: Array, c: Array, zw: Array, zv: Array, zc: Array,
    step: Array, decay: Any, rows: NDArray[np.int64], ages: NDArray[np.int64], num_rows: int, oldest: int,
) -> int:  # fmt: skip
    """θ ← θ + Σₖ stepₖ zₖ, then z ← decay · z, in one pass; drops rows too old, returns how many are left."""
    num_outputs, num_hidden = step.size, w.shape[1]
    kept = 0
    for r in range(num_rows):
        i = rows[r]
        ages[i] += 1
        drop = ages[i] > oldest
        for k in range(num_outputs):
            a = step[k]
            if drop:
                for j in range(num_hidden):
                    w[i, j] += a * zw[i, k, j]
                    zw[i, k, j] = 0
                ages[i] = -1
            else:
                for j in range(num_hidden):
                    w[i, j] += a * zw[i, k, j]
                    zw[i, k, j] *= decay
        if not drop:
            rows[kept] = i
            kept += 1
    for k in range(num_outputs):
        a = step[k]
        for m in range(num_outputs):
            for j in range(num_hidden):
                v[m, j] += a * zv[k, m, j]
                zv[k, m, j] *= decay
            c[m] += a * zc[k, m]
            zc[k, m] *= decay
    return kept


@lean_reassociating_kernel
def _remember(
    s: Scratch, count: int, first_moves: bool, sign: Any, zw: Array, zv: Array, zc: Array,
    rows: NDArray[np.int64], ages: NDArray[np.int64], num_rows: int,
) -> int:  # fmt: skip
    """Adds ∇y to the trace, the outputs being those the first player sees; returns how many rows of zw are not zero."""
    one, num_outputs, num_hidden = s.y.dtype.type(1.0), s.y.size, s.hidden.size
    for m in range(num_outputs):
        k = m if first_moves else (m + num_outputs // 2) % num_outputs
        slope = sign * s.y[m] * (one - s.y[m])
        zc[k, m] += slope
        for j in range(num_hidden):
            zv[k, m, j] += slope * s.hidden[j]
    for n in range(count):
        i, x = s.indices[n], s.inputs[n]
        if ages[i] < 0:
            rows[num_rows] = i
            num_rows += 1
        ages[i] = 0
        for m in range(num_outputs):
            k = m if first_moves else (m + num_outputs // 2) % num_outputs
            for j in range(num_hidden):
                zw[i, k, j] += x * s.back[m, j]
    return num_rows


@lean_kernel
def _forget(zw: Array, zv: Array, zc: Array, ages: NDArray[np.int64]) -> None:
    for i in range(len(ages)):
        ages[i] = -1
        for k in range(zw.shape[1]):
            for j in range(zw.shape[2]):
                zw[i, k, j] = 0
    for k in range(len(zc)):
        for m in range(len(zc)):
            zc[k, m] = 0
            for j in range(zv.shape[2]):
                zv[k, m, j] = 0


@lean_kernel
def _oldest_trace(lambda_: float) -> int:
    """The last age at which a trace is not negligible."""
    if lambda_ >= 1.0:
        return 2**62
    return 0 if lambda_ <= 0.0 else int(np.log(_NEGLIGIBLE) / np.log(lambda_))


@kernel
def play_online(
    rates: NDArray[np.float64], lambdas: NDArray[np.float64], rng: np.random.Generator,
    w: Array, v: Array, c: Array, s: Scratch, tally: NDArray[np.int64],
) -> None:  # fmt: skip
    """Plays ``len(rates)`` games against itself, learning after every turn: Tesauro's TD(λ), backward view.

    With V the outputs as the first player sees them, after each turn δ = V(s_t) − V(s_tm1), or the outcome minus
    V(s_tm1); θ ← θ + α Σₖ δₖ zₖ; zₖ ← λ zₖ + ∇Vₖ(s_t) with the new θ. Nothing is discounted, and there are no rewards
    but the outcome.

    Args:
        rates: the step size α of each game, ``[n]``.
        lambdas: λ in [0, 1] of each game, ``[n]``.
        rng: draws the dice.
        w: ``[199, H]`` or ``[213, H]``; changed.
        v: ``[K, H]``; changed.
        c: ``[K]``; changed.
        s: scratch.
        tally: plain games, gammons, backgammons and turns, ``[4]``; added to.
    """
    num_outputs, num_hidden = v.shape
    dtype = w.dtype
    zw = np.zeros((len(w), num_outputs, num_hidden), dtype)
    zv = np.zeros((num_outputs, num_outputs, num_hidden), dtype)
    zc = np.zeros((num_outputs, num_outputs), dtype)
    rows, ages = np.empty(len(w), np.int64), np.full(len(w), -1)
    before, after, step = np.empty(num_outputs, dtype), np.empty(num_outputs, dtype), np.empty(num_outputs, dtype)
    board = np.empty((2, 25), np.int8)
    plus = dtype.type(1.0)
    for game in range(len(rates)):
        rate, decay = dtype.type(rates[game]), dtype.type(lambdas[game])
        oldest = _oldest_trace(lambdas[game])
        copy_board(START, board)
        _forget(zw, zv, zc, ages)
        turns, points = 0, 0
        num_rows: Any = np.int64(0)  # a literal 0 would have `_remember` compiled twice
        while points == 0:
            first_moves = turns % 2 == 0
            count = forward(board, w, v, c, s)
            sign = plus if first_moves or num_outputs > 1 else -plus
            _backward(v, s, sign)
            num_rows = _remember(s, count, first_moves, sign, zw, zv, zc, rows, ages, num_rows)
            _seen_by_first(s.y, first_moves, before)
            _turn(board, turns == 0, rng, w, v, c, s)
            turns += 1
            points = result(board)
            if points != 0:
                settled(points, s.y)
            else:
                forward(board, w, v, c, s)
            _seen_by_first(s.y, not first_moves, after)
            for k in range(num_outputs):
                step[k] = rate * (after[k] - before[k])
            num_rows = _learn(w, v, c, zw, zv, zc, step, decay, rows, ages, num_rows, oldest)
        _tally(points, turns, tally)


@kernel
def play_batch(
    num_games: int, lambda_: float, rng: np.random.Generator, w: Array, v: Array, c: Array,
    gw: Array, gv: Array, gc: Array, s: Scratch, tally: NDArray[np.int64],
) -> None:  # fmt: skip
    """Plays games against itself with fixed weights, and sums what TD(λ) would have them change: the forward view.

    With Vₜ the outputs as the first player sees them and G_T the outcome, Gₜ = λ Gₜ₊₁ + (1 − λ) Vₜ₊₁, and the sum is
    over all turns of Σₖ (Gₜ − Vₜ)ₖ ∇Vₜₖ: what `play_online` adds in a game, divided by α, if α is so small that the
    weights do not change meanwhile.

    Args:
        num_games: how many.
        lambda_: λ in [0, 1].
        rng: draws the dice.
        w: ``[199, H]`` or ``[213, H]``.
        v: ``[K, H]``.
        c: ``[K]``.
        gw: as ``w``; added to.
        gv: as ``v``; added to.
        gc: as ``c``; added to.
        s: scratch.
        tally: plain games, gammons, backgammons and turns, ``[4]``; added to.
    """
    num_outputs, num_hidden = v.shape
    history = np.empty((_FIRST_HISTORY, 2, 25), np.int8)
    returns, error = np.empty(num_outputs, w.dtype), np.empty(num_outputs, w.dtype)
    back = np.empty(num_hidden, w.dtype)
    board = np.empty((2, 25), np.int8)
    some, rest = w.dtype.type(lambda_), w.dtype.type(1.0 - lambda_)
    for _ in range(num_games):
        copy_board(START, board)
        turns, points = 0, 0
        while points == 0:
            if turns == len(history):
                longer = np.empty((2 * turns, 2, 25), np.int8)
                for t in range(turns):  # numba takes 3 s to compile `longer[:turns] = history`
                    copy_board(history[t], longer[t])
                history = longer
            copy_board(board, history[turns])
            _turn(board, turns == 0, rng, w, v, c, s)
            turns += 1
            points = result(board)
        _tally(points, turns, tally)
        settled(points, s.y)  # as the side to move in the last board sees it; from here on, each turn in its own view
        for k in range(num_outputs):
            returns[k] = s.y[k]
        for t in range(turns - 1, -1, -1):
            _turn_around(returns)
            count = forward(history[t], w, v, c, s)
            for k in range(num_outputs):
                error[k] = returns[k] - s.y[k]
            _add_gradient(v, s, count, error, back, gw, gv, gc)
            for k in range(num_outputs):
                returns[k] = some * returns[k] + rest * s.y[k]


@lean_kernel
def _turn_around(y: Array) -> None:
    """The outputs as the other side sees them, in place."""
    kinds = y.size // 2
    if kinds == 0:
        y[0] = y.dtype.type(1.0) - y[0]
    for k in range(kinds):
        y[k], y[k + kinds] = y[k + kinds], y[k]


@lean_reassociating_kernel
def _add_gradient(v: Array, s: Scratch, count: int, error: Array, back: Array, gw: Array, gv: Array, gc: Array) -> None:
    """Adds Σₖ errorₖ ∇yₖ."""
    one = s.y.dtype.type(1.0)
    for j in range(back.size):
        back[j] = 0
    for k in range(error.size):
        slope = error[k] * s.y[k] * (one - s.y[k])
        gc[k] += slope
        for j in range(back.size):
            gv[k, j] += slope * s.hidden[j]
            back[j] += slope * v[k, j]
    for j in range(back.size):
        back[j] *= s.hidden[j] * (one - s.hidden[j])
    for n in range(count):
        i, x = s.indices[n], s.inputs[n]
        for j in range(back.size):
            gw[i, j] += x * back[j]

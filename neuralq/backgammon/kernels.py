"""Values of backgammon boards, and TD(λ) self-play on them, as compiled loops over plain arrays.

A board is int8 ``[2, 25]`` seen by the side to move (`neuralq_envs.backgammon.rules`), and the network always sees it
so: the side to move is player 0 of Tesauro's inputs. Exchanging the players therefore leaves every value as it is, to
the bit, and what one side learns the other knows. The outputs are those of the side to move: with four, the chances of
a plain win, a gammon, a plain loss and a lost gammon (a backgammon counts as a gammon); with one, of a win.

With the hidden units h = σ(Wᵀx) and the outputs y = σ(Vh + c), four things make a game cheap:

* only about 27 of the 198 inputs are not zero, and an afterstate differs from its siblings in about six: so Wᵀx is
  summed once for the first afterstate of a roll, and for the others only what changed is added;
* σ in float32 is a quotient of polynomials (the eleventh convergent of Lambert's continued fraction of tanh, wrong by
  less than 5e-7), which vectorises; in float64 it is the exponential of the mathematics library;
* the trace of an input that has not been seen for so long that λ to that power is below 1e-12 is dropped;
* in the forward view errors are combined over the outputs first, so that there is nothing to keep per output.

Weights are float32 or float64: ``w`` ``[199, H]``, one row per input, the last for the constant 1, and 14 rows more if
the network is also shown the numbers of `neuralq_envs.backgammon.expert`; ``v`` ``[K, H]``; ``c`` ``[K]``. All scratch
is in one `Scratch` tuple, made once.

Sources: Tesauro (1992, 1995); Sutton (1988), eq. 4; Sutton & Barto (2018), section 16.1.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import kernel, reassociating_kernel
from neuralq_envs.backgammon.expert import NUM_EXPERT, expert_inputs
from neuralq_envs.backgammon.inputs import MAX_ACTIVE, NUM_INPUTS, tesauro_sparse
from neuralq_envs.backgammon.rules import BAR, MAX_AFTERSTATES, START, Board, afterstates, result

__all__ = ["Scratch", "choose", "equity_of", "evaluate", "new_scratch", "play_batch", "play_online"]

_Array = NDArray[Any]

_NEGLIGIBLE = 1e-12
_FIRST_HISTORY = 512
_OTHER = 98  # where the inputs of the side that is not to move begin


class Scratch(NamedTuple):
    """What the kernels write to between two lines; nothing in it outlives a call."""

    boards: Board  # [MAX_AFTERSTATES, 2, 25]
    indices: NDArray[np.int64]  # [46]
    inputs: _Array  # [46]
    expert: _Array  # [14]
    first: _Array  # [H] Wᵀx of the first afterstate
    hidden: _Array  # [H]
    y: _Array  # [K]
    back: _Array  # [K, H]


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


@reassociating_kernel
def _sigmoids(z: _Array) -> None:
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


@reassociating_kernel
def _outputs(v: _Array, c: _Array, hidden: _Array, y: _Array) -> None:
    for k in range(y.size):
        total = c[k]
        for j in range(hidden.size):
            total += v[k, j] * hidden[j]
        y[k] = total
    _sigmoids(y)


@reassociating_kernel
def _sum_of_inputs(board: Board, w: _Array, indices: NDArray[np.int64], inputs: _Array, z: _Array) -> int:
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


@kernel
def _with_expert(board: Board, w: _Array, count: int, s: Scratch, z: _Array) -> int:
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


@reassociating_kernel
def _add_row(w: _Array, row: int, x: Any, z: _Array) -> None:
    for j in range(z.size):
        z[j] += x * w[row, j]


@reassociating_kernel
def _change(before: Board, boards: Board, i: int, w: _Array, z: _Array) -> int:
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


@kernel
def equity_of(y: _Array) -> float:
    """Points that the side to move expects: y₀ + 2y₁ − y₂ − 2y₃, or 2y₀ − 1 with one output."""
    if y.size == 1:
        return 2.0 * float(y[0]) - 1.0
    return float(y[0]) + 2.0 * float(y[1]) - float(y[2]) - 2.0 * float(y[3])


@reassociating_kernel
def _settled(points: int, y: _Array) -> None:
    """The outputs of a game that is over, ``points`` being what the side to move has won."""
    for k in range(y.size):
        y[k] = 0.0
    if y.size == 1:
        y[0] = 1.0 if points > 0 else 0.0
    else:
        y[(0 if points > 0 else 2) + (1 if abs(points) > 1 else 0)] = 1.0


@kernel
def choose(count: int, w: _Array, v: _Array, c: _Array, s: Scratch) -> int:
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


@kernel
def evaluate(boards: Board, w: _Array, v: _Array, c: _Array, s: Scratch, y: _Array) -> None:
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
            _settled(points, y[i])
        else:
            _with_expert(boards[i], w, _sum_of_inputs(boards[i], w, s.indices, s.inputs, s.hidden), s, s.hidden)
            _sigmoids(s.hidden)
            _outputs(v, c, s.hidden, y[i])


@kernel
def _roll(rng: np.random.Generator, opening: bool) -> tuple[int, int]:
    """Two dice; the opening roll is no double."""
    while True:
        die_1, die_2 = 1 + int(6 * rng.random()), 1 + int(6 * rng.random())
        if die_1 != die_2 or not opening:
            return die_1, die_2


@kernel
def _copy(board: Board, to: Board) -> None:
    for side in range(2):
        for point in range(25):
            to[side, point] = board[side, point]


@kernel
def _turn(board: Board, opening: bool, rng: np.random.Generator, w: _Array, v: _Array, c: _Array, s: Scratch) -> None:
    """Rolls and plays the best turn, in place: the board is then seen by the other side."""
    die_1, die_2 = _roll(rng, opening)
    count = afterstates(board, die_1, die_2, s.boards)
    _copy(s.boards[choose(count, w, v, c, s) if count > 1 else 0], board)


@kernel
def _tally(points: int, turns: int, tally: NDArray[np.int64]) -> None:
    tally[abs(points) - 1] += 1
    tally[3] += turns


@reassociating_kernel
def _backward(v: _Array, s: Scratch, sign: Any) -> None:
    """∂y[k]/∂z into s.back ``[K, H]`` for z = Wᵀx, times ``sign``; s.hidden and s.y are the values."""
    one = s.y.dtype.type(1.0)
    for k in range(s.y.size):
        slope = sign * s.y[k] * (one - s.y[k])
        for j in range(s.hidden.size):
            s.back[k, j] = slope * v[k, j] * s.hidden[j] * (one - s.hidden[j])


@kernel
def _seen_by_first(y: _Array, first_moves: bool, out: _Array) -> None:
    """The outputs as the player who moved first sees them."""
    if y.size == 1:
        out[0] = y[0] if first_moves else y.dtype.type(1.0) - y[0]
    else:
        for k in range(4):
            out[k] = y[k] if first_moves else y[(k + 2) % 4]


@reassociating_kernel
def _learn(
    w: _Array, v: _Array, c: _Array, zw: _Array, zv: _Array, zc: _Array,
    step: _Array, decay: Any, rows: NDArray[np.int64], ages: NDArray[np.int64], num_rows: int, oldest: int,
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


@reassociating_kernel
def _remember(
    s: Scratch, count: int, first_moves: bool, sign: Any, zw: _Array, zv: _Array, zc: _Array,
    rows: NDArray[np.int64], ages: NDArray[np.int64], num_rows: int,
) -> int:  # fmt: skip
    """Adds ∇y to the trace, the outputs being those the first player sees; returns how many rows of zw are not zero."""
    one, num_outputs, num_hidden = s.y.dtype.type(1.0), s.y.size, s.hidden.size
    for m in range(num_outputs):
        k = m if first_moves else (m + 2) % 4 if num_outputs == 4 else m
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
            k = m if first_moves else (m + 2) % 4 if num_outputs == 4 else m
            for j in range(num_hidden):
                zw[i, k, j] += x * s.back[m, j]
    return num_rows


@kernel
def _oldest_trace(lambda_: float) -> int:
    """The last age at which a trace is not negligible."""
    if lambda_ >= 1.0:
        return 2**62
    return 0 if lambda_ <= 0.0 else int(np.log(_NEGLIGIBLE) / np.log(lambda_))


@kernel
def play_online(
    rates: NDArray[np.float64], lambdas: NDArray[np.float64], rng: np.random.Generator,
    w: _Array, v: _Array, c: _Array, s: Scratch, tally: NDArray[np.int64],
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
        _copy(START, board)
        zw[:], zv[:], zc[:] = 0, 0, 0
        ages[:] = -1
        num_rows, turns, points = 0, 0, 0
        first_moves = True
        while True:
            count = _sum_of_inputs(board, w, s.indices, s.inputs, s.hidden)
            count = _with_expert(board, w, count, s, s.hidden)
            _sigmoids(s.hidden)
            _outputs(v, c, s.hidden, s.y)
            sign = plus if first_moves or num_outputs > 1 else -plus
            _backward(v, s, sign)
            num_rows = _remember(s, count, first_moves, sign, zw, zv, zc, rows, ages, num_rows)
            _seen_by_first(s.y, first_moves, before)
            _turn(board, turns == 0, rng, w, v, c, s)
            turns += 1
            first_moves = not first_moves
            points = result(board)
            if points != 0:
                _settled(points, s.y)
            else:
                count = _sum_of_inputs(board, w, s.indices, s.inputs, s.hidden)
                _with_expert(board, w, count, s, s.hidden)
                _sigmoids(s.hidden)
                _outputs(v, c, s.hidden, s.y)
            _seen_by_first(s.y, first_moves, after)
            for k in range(num_outputs):
                step[k] = rate * (after[k] - before[k])
            num_rows = _learn(w, v, c, zw, zv, zc, step, decay, rows, ages, num_rows, oldest)
            if points != 0:
                break
        _tally(points, turns, tally)


@kernel
def play_batch(
    num_games: int, lambda_: float, rng: np.random.Generator, w: _Array, v: _Array, c: _Array,
    gw: _Array, gv: _Array, gc: _Array, s: Scratch, tally: NDArray[np.int64],
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
        _copy(START, board)
        turns, points = 0, 0
        while points == 0:
            if turns == len(history):
                longer = np.empty((2 * turns, 2, 25), np.int8)
                longer[:turns] = history
                history = longer
            _copy(board, history[turns])
            _turn(board, turns == 0, rng, w, v, c, s)
            turns += 1
            points = result(board)
        _tally(points, turns, tally)
        _settled(points, s.y)  # as the side to move in the last board sees it; from here on, each turn in its own view
        returns[:] = s.y
        for t in range(turns - 1, -1, -1):
            _turn_around(returns)
            count = _sum_of_inputs(history[t], w, s.indices, s.inputs, s.hidden)
            count = _with_expert(history[t], w, count, s, s.hidden)
            _sigmoids(s.hidden)
            _outputs(v, c, s.hidden, s.y)
            for k in range(num_outputs):
                error[k] = returns[k] - s.y[k]
            _add_gradient(v, s, count, error, back, gw, gv, gc)
            for k in range(num_outputs):
                returns[k] = some * returns[k] + rest * s.y[k]


@kernel
def _turn_around(y: _Array) -> None:
    """The outputs as the other side sees them, in place."""
    if y.size == 1:
        y[0] = y.dtype.type(1.0) - y[0]
    else:
        y[0], y[1], y[2], y[3] = y[2], y[3], y[0], y[1]


@reassociating_kernel
def _add_gradient(
    v: _Array, s: Scratch, count: int, error: _Array, back: _Array, gw: _Array, gv: _Array, gc: _Array
) -> None:
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

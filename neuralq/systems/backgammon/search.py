"""Two-ply search in Tesauro's sense: what a turn is worth once the other side has rolled and answered.

One ply is the network's word on the boards in which a turn can end. Two plies look one roll further: for a board s'
that a turn can leave,

    V₂(s') = Σ_r p(r) V(a_r),   a_r the board, of those in which a turn with roll r from s' can end, that the side
                                which plays it likes best at one ply: V(a_r) is the least for us,

over the 21 rolls r of the other side. In a_r it is our turn, so V(a_r) is what the network says of us; a game that is
over counts as what has been won. GNU Backgammon and others count one less: their one ply is this.

A ply costs some 21 · 15 values, so only turns that are good at one ply are looked at: at most `MAX_CANDIDATES`, and
none whose value at one ply is more than `WINDOW` points below the best (GNU Backgammon's normal filter).

Source: Tesauro (1995), "Temporal difference learning and TD-Gammon", on two-ply search; Russell & Norvig (2010),
section 5.5, expectiminimax.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import kernel
from neuralq.systems.backgammon.kernels import Scratch, choose, equity_of, evaluate
from neuralq.types import Array
from neuralq_envs.backgammon.rules import ROLL_PROBABILITIES, ROLLS, Board, afterstates, copy_board, result

__all__ = ["MAX_CANDIDATES", "WINDOW", "choose_two_ply", "look_ahead"]


MAX_CANDIDATES = 8
WINDOW = 0.16

_DICE = np.array(ROLLS)
_CHANCES = np.array(ROLL_PROBABILITIES)


@kernel
def look_ahead(board: Board, w: Array, v: Array, c: Array, s: Scratch, ahead: NDArray[np.float64]) -> float:
    """What the side that has just moved expects of the board it leaves, at two plies; the game is not over.

    Args:
        board: seen by the side that moves next, ``[2, 25]``; not one of ``s.boards``, which are overwritten.
        w: ``[199, H]``.
        v: ``[K, H]``.
        c: ``[K]``.
        s: scratch.
        ahead: mean outputs over the rolls, as the side that has just moved sees them, ``[K]``; written.
    """
    y = np.empty((1, c.size), w.dtype)
    ahead[:] = 0.0
    equity = 0.0
    for i in range(len(_CHANCES)):
        count = afterstates(board, _DICE[i, 0], _DICE[i, 1], s.boards)
        best = choose(count, w, v, c, s) if count > 1 else 0
        evaluate(s.boards[best : best + 1], w, v, c, s, y)
        for k in range(c.size):
            ahead[k] += _CHANCES[i] * y[0, k]
        points = result(s.boards[best])
        equity += _CHANCES[i] * (equity_of(y[0]) if points == 0 else float(points))
    return equity


@kernel
def choose_two_ply(count: int, w: Array, v: Array, c: Array, s: Scratch) -> int:
    """Which of the first ``count`` afterstates in ``s.boards`` is best for the side that leaves it, at two plies.

    ``s.boards`` is overwritten from its beginning, but not the board that was chosen: that is written to its place.
    """
    y = np.empty((count, c.size), w.dtype)
    evaluate(s.boards[:count], w, v, c, s, y)
    others = np.empty(count)
    found, num_found = np.empty(MAX_CANDIDATES + 1, np.int64), 0  # the least for the others, in rising order
    for i in range(count):
        points = result(s.boards[i])
        others[i] = equity_of(y[i]) if points == 0 else float(points)
        place = num_found
        while place > 0 and others[i] < others[found[place - 1]]:
            found[place] = found[place - 1]
            place -= 1
        found[place] = i
        num_found = min(num_found + 1, MAX_CANDIDATES)
    candidates, num_candidates = np.empty((MAX_CANDIDATES, 2, 25), np.int8), 0
    while num_candidates < num_found and others[found[num_candidates]] <= others[found[0]] + WINDOW:
        copy_board(s.boards[found[num_candidates]], candidates[num_candidates])
        num_candidates += 1
    best, highest = 0, -np.inf
    ahead = np.empty(c.size)
    for n in range(num_candidates if num_candidates > 1 else 0):
        if result(candidates[n]) != 0:
            equity = -others[found[n]]
        else:
            equity = look_ahead(candidates[n], w, v, c, s, ahead)
        if equity > highest:
            best, highest = n, equity
    copy_board(candidates[best], s.boards[found[best]])
    return int(found[best])

"""Random games of backgammon keep every invariant that a legal turn has, in a compiled loop over all afterstates."""

from __future__ import annotations

import numpy as np
import pytest

from neuralq.jit import kernel
from neuralq_envs.backgammon.inputs import MAX_ACTIVE, NUM_INPUTS, tesauro_dense, tesauro_sparse
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, START, afterstates, result


@kernel
def what_is_wrong_with_the_inputs(
    board: np.ndarray, x: np.ndarray, y: np.ndarray, dense: np.ndarray, indices: np.ndarray, values: np.ndarray
) -> int:
    tesauro_dense(board, 0, x)
    tesauro_dense(board, 1, y)
    for i in range(98):
        if x[i] != y[98 + i] or x[98 + i] != y[i]:
            return 11
    if x[196] != 1.0 or x[197] != 0.0 or y[196] != 0.0 or y[197] != 1.0:
        return 12
    num_active = tesauro_sparse(board, 1, indices, values)
    for i in range(NUM_INPUTS):
        dense[i] = 0.0
    for i in range(num_active):
        if values[i] == 0.0 or dense[indices[i]] != 0.0:
            return 13
        dense[indices[i]] = values[i]
    for i in range(NUM_INPUTS):
        if dense[i] != y[i]:
            return 14
    return 0


@kernel
def fuzz(num_positions: int, rng: np.random.Generator, out: np.ndarray, counts: np.ndarray) -> int:
    """Plays random games; 0, or what was wrong with an afterstate. ``counts``: dances, games, afterstates."""
    board = np.empty((2, 25), np.int8)
    for i in range(25):
        board[0, i], board[1, i] = START[0, i], START[1, i]
    x, y, dense = np.empty(NUM_INPUTS), np.empty(NUM_INPUTS), np.empty(NUM_INPUTS)
    indices, values = np.empty(MAX_ACTIVE, np.int64), np.empty(MAX_ACTIVE)
    own_off, other_off = 0, 0
    for _ in range(num_positions):
        die_1, die_2 = 1 + int(6 * rng.random()), 1 + int(6 * rng.random())
        total = die_1 + die_2 if die_1 != die_2 else 4 * die_1
        count = afterstates(board, die_1, die_2, out)
        if count < 1 or count > MAX_AFTERSTATES:
            return 1
        pips, own_on, other_on, bar = 0, 0, 0, board[1, 24]
        for i in range(25):
            pips += (i + 1) * board[0, i]
            own_on += board[0, i]
            other_on += board[1, i]
        if own_on + own_off != 15 or other_on + other_off != 15:
            return 2
        for k in range(count):
            after_pips, after_own, after_other, off_after = 0, 0, 0, 0
            for i in range(25):
                if out[k, 0, i] < 0 or out[k, 1, i] < 0:
                    return 3
                if i < 24 and out[k, 0, i] > 0 and out[k, 1, 23 - i] > 0:
                    return 4
                if i < 24 and out[k, 0, i] > board[1, i]:
                    return 5  # the other side moves backwards to its bar only
                if i < 24 and out[k, 0, i] < board[1, i] and (board[1, i] != 1 or out[k, 0, i] != 0):
                    return 6  # only blots are hit
                after_pips += (i + 1) * out[k, 1, i]
                after_own += out[k, 1, i]
                after_other += out[k, 0, i]
            off_after = own_on - after_own
            if after_other != other_on or off_after < 0 or off_after > 4 or out[k, 0, 24] < bar:
                return 7
            if pips - after_pips > total or after_pips > pips or (after_pips == pips and count > 1):
                return 8
            if off_after > 0:  # whoever bears off had no checker outside at that moment, and moved at most `total`
                for i in range(6, 25):
                    if out[k, 1, i] > 0:
                        return 9
            if out[k, 1, 24] > 0:  # who stays on the bar has moved nothing but checkers from it
                for i in range(18):
                    if out[k, 1, i] != board[0, i]:
                        return 10
        chosen = int(count * rng.random())
        counts[0] += board[0, 24] > 0 and out[0, 1, 24] == board[0, 24]
        counts[2] += count
        own_off, other_off = other_off, own_off + own_on
        for i in range(25):
            board[0, i], board[1, i] = out[chosen, 0, i], out[chosen, 1, i]
            other_off -= board[1, i]
        wrong = what_is_wrong_with_the_inputs(board, x, y, dense, indices, values)
        if wrong != 0:
            return wrong
        if result(board) != 0:
            for i in range(25):
                board[0, i], board[1, i] = START[0, i], START[1, i]
            own_off, other_off = 0, 0
            counts[1] += 1
    return 0


def run_fuzz(num_positions: int) -> None:
    out, counts = np.empty((MAX_AFTERSTATES, 2, 25), np.int8), np.zeros(3, np.int64)
    assert fuzz(num_positions, np.random.default_rng(4), out, counts) == 0
    dances, games, seen = counts.tolist()
    assert dances > num_positions // 50 and games > num_positions // 200 and seen > 10 * num_positions


def test_random_games_keep_every_invariant() -> None:
    run_fuzz(20_000)


@pytest.mark.slow
def test_a_million_positions_of_random_games_keep_every_invariant() -> None:
    run_fuzz(1_000_000)

"""The inputs a player would name, against the slow definition of each on boards from random games.

Mutants that die here: direct shots only up to five points; a step in between open with two checkers on it; combined
shots although two are on the bar; doubles of three steps left out; a roll counted once for each blot; the way back
counted from the wrong end; escapes blocked by blots; contact one point too early.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from neuralq_envs.backgammon.expert import NUM_EXPERT, expert_inputs, shots_at
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, START, Board, afterstates, result

ROLLS = [(first, second) for first in range(1, 7) for second in range(1, 7)]


def boards(seed: int, num_games: int) -> Iterator[Board]:
    rng, out = np.random.default_rng(seed), np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    for _ in range(num_games):
        board = START.copy()
        while result(board) == 0:
            yield board
            count = afterstates(board, *(int(die) for die in rng.integers(1, 7, 2)), out)
            board = out[rng.integers(count)].copy()


def walks(dice: tuple[int, ...], start: int, goal: int, is_open: list[bool]) -> bool:
    """Whether one checker gets from start to goal with some of these dice, in this order, by open points."""
    at = start
    for die in dice:
        at -= die
        if at == goal:
            return True
        if at < 0 or not is_open[at]:
            return False
    return False


def hits(board: Board, side: int, point: int, roll: tuple[int, int]) -> bool:
    """Whether some checker of the other side lands on ``point`` with this roll, moving alone, the bar first."""
    own, theirs, goal = board[side], board[1 - side], 23 - point
    is_open = [own[23 - i] < 2 for i in range(24)]
    first, second = roll
    orders = [(first,) * 4] if first == second else [(first, second), (second, first)]
    sources = [24] if theirs[24] > 0 else [i for i in range(24) if theirs[i] > 0]
    if theirs[24] > 1:
        orders = [(first,), (second,)]
    return any(walks(dice, source, goal, is_open) for source in sources for dice in orders)


def test_shots_are_those_of_a_walk_with_each_roll() -> None:
    seen = with_bar = 0
    for board in boards(0, 12):
        for side in (seen % 2,):
            for point in np.flatnonzero(board[side, :24] == 1):
                found = int(shots_at(board, side, int(point)))
                assert [bool(found >> i & 1) for i in range(36)] == [hits(board, side, int(point), r) for r in ROLLS]
                seen += found != 0
                with_bar += board[1 - side, 24] > 1
    assert seen > 1000 and with_bar > 20


@pytest.mark.parametrize(
    ("distance", "rolls"),  # the table of every book, with nothing in between
    [(1, 11), (2, 12), (3, 14), (4, 15), (5, 15), (6, 17), (7, 6), (8, 6), (9, 5), (10, 3), (11, 2), (12, 3), (16, 1),
     (18, 1), (20, 1), (24, 1)],
)  # fmt: skip
def test_the_table_of_shots(distance: int, rolls: int) -> None:
    board = np.zeros((2, 25), np.int8)
    source = 24
    board[1, source], board[0, 23 - (source - distance)] = 1, 1
    assert int(shots_at(board, 0, 23 - (source - distance))).bit_count() == rolls


def slowly(board: Board) -> list[float]:
    x: list[float] = []
    backs, pips = [], []
    for side in range(2):
        own, theirs = board[side].tolist(), board[1 - side].tolist()
        pips.append(sum((i + 1) * n for i, n in enumerate(own)))
        backs.append(max((i for i in range(25) if own[i]), default=0))
        blots = [i for i in range(24) if own[i] == 1]
        rolls = {i: {roll for roll in ROLLS if hits(board, side, i, roll)} for i in blots}
        made = "".join("x" if n > 1 else " " for n in own[:24])
        closed = [i < 0 or theirs[23 - i] > 1 for i in range(24)]
        escapes = 0
        for first, second in ROLLS:
            a, b, end = backs[side] - first, backs[side] - second, backs[side] - first - second
            escapes += (end < 0 or not closed[end]) and any(i < 0 or not closed[i] for i in (a, b))
        x += [
            pips[side] / 167,
            len(set().union(*rolls.values())) / 36,
            sum(len(r) * (24 - i) for i, r in rolls.items()) / (24 * 36),
            max(map(len, made.split()), default=0) / 6,
            escapes / 36,
            made[:6].count("x") / 6,
        ]
    return [*x, max(0, sum(backs) - 23) / 23, min(1.0, max(-1.0, (pips[1] - pips[0]) / 50))]


def test_every_input_is_as_described() -> None:
    x = np.empty(NUM_EXPERT)
    for number, board in enumerate(boards(1, 8)):
        if number % 5:
            continue
        expert_inputs(board, x)
        np.testing.assert_allclose(x, slowly(board), rtol=0, atol=1e-12, err_msg=str(board) + str(number))


def test_both_sides_are_treated_alike() -> None:
    x, y = np.empty(NUM_EXPERT), np.empty(NUM_EXPERT)
    for board in boards(2, 5):
        expert_inputs(board, x)
        expert_inputs(board[::-1].copy(), y)
        assert (x[:6] == y[6:12]).all() and (x[6:12] == y[:6]).all() and x[12] == y[12] and x[13] == -y[13]

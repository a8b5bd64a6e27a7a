"""The rules of backgammon as compiled loops over small integer arrays: legal turns, results, random games.

A board is int8 ``[2, 25]``: row 0 holds the checkers of the side to move, row 1 those of the other side. Each side
counts its points from its own: index 0 is its ace point, indices 0 to 5 its home, 23 the point it starts furthest
back, 24 the bar. Checkers that a row lacks to 15 are borne off. So point i of one side is point 23 − i of the other,
a move goes from i to i − die, and entering from the bar is the move from 24.

A turn ends in an *afterstate*: the board that the other side meets, hence with the rows exchanged. A turn must play
as many dice as possible, and the larger one if only one of two can be played; a double is played up to four times.
Different orders of the dice often end in the same board; each board is written once:

* a double's moves can be put in order of falling source without becoming illegal (where a checker may land does not
  change within a turn), and the board tells how often each source was used, so falling sources never repeat a board;
* of two different dice both orders are tried, and a board is dropped if it has been written (a 64-bit sum of
  changes is compared first, then the checkers).

No turn has more afterstates than there are ways to give four steps to 15 checkers, C(18, 4) = 3060; two different
dice have at most 15·14 + 2·15 = 240. So buffers of `MAX_AFTERSTATES` never overflow, and nothing has to check.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import kernel, lean_kernel

__all__ = [
    "BAR",
    "MAX_AFTERSTATES",
    "NUM_CHECKERS",
    "ROLLS",
    "ROLL_PROBABILITIES",
    "START",
    "Board",
    "afterstates",
    "copy_board",
    "is_legal",
    "play",
    "random_game",
    "result",
    "roll",
    "take_back",
]

Board = NDArray[np.int8]

BAR = 24
NUM_CHECKERS = 15
MAX_AFTERSTATES = 3060
_MOST_OF_TWO_DICE = 240

_ROW = [0, 0, 0, 0, 0, 5, 0, 3, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0]
START: Board = np.array([_ROW, _ROW], dtype=np.int8)
START.flags.writeable = False

ROLLS = tuple((large, small) for large in range(1, 7) for small in range(1, large + 1))  # 21, the order does not count
ROLL_PROBABILITIES = tuple((1 if large == small else 2) / 36 for large, small in ROLLS)

# One random number for each point a checker leaves or reaches (row 0) and for each blot that is hit (row 1).
_SIGNS = np.random.default_rng(198).integers(0, 2**63, size=(2, 25)).astype(np.uint64)


@lean_kernel
def is_legal(board: Board, source: int, die: int) -> bool:
    """Whether the side to move may move a checker from ``source`` by ``die``.

    The bar comes first; a point with two of the other side's checkers is closed; bearing off needs every checker at
    home, and a die larger than the point needs no checker behind it.

    Args:
        board: ``[2, 25]``.
        source: 0 to 24.
        die: 1 to 6.

    Example:
        >>> [source for source in range(25) if is_legal(START, source, 5)]  # the 24 point faces five checkers
        [7, 12]
    """
    if board[0, source] == 0 or (source != BAR and board[0, BAR] > 0):
        return False
    target = source - die
    if target >= 0:
        return bool(board[1, 23 - target] < 2)
    for point in range(6, 25):
        if board[0, point] > 0:
            return False
    if target < -1:
        for point in range(source + 1, 6):
            if board[0, point] > 0:
                return False
    return True


@lean_kernel
def play(board: Board, source: int, die: int) -> bool:
    """Moves one checker in place, without asking whether it may; says whether it hit.

    Example:
        >>> board = START.copy()
        >>> board[1, 23] = 1  # a blot on the other side's 24 point, which is our ace point
        >>> play(board, 5, 5), board[1, 24].item(), board[0, [0, 5]].tolist()
        (True, 1, [1, 4])
    """
    board[0, source] -= 1
    target = source - die
    if target < 0:
        return False
    board[0, target] += 1
    if board[1, 23 - target] != 1:
        return False
    board[1, 23 - target] = 0
    board[1, BAR] += 1
    return True


@lean_kernel
def take_back(board: Board, source: int, die: int, hit: bool) -> None:
    """Undoes `play`, in place.

    Example:
        >>> board = START.copy()
        >>> take_back(board, 5, 5, play(board, 5, 5))
        >>> (board == START).all().item()
        True
    """
    board[0, source] += 1
    target = source - die
    if target >= 0:
        board[0, target] -= 1
        if hit:
            board[1, 23 - target] = 1
            board[1, BAR] -= 1


@lean_kernel
def copy_board(board: Board, to: Board) -> None:
    """Writes ``board`` over ``to``, both ``[2, 25]``.

    Example:
        >>> board = np.zeros((2, 25), np.int8)
        >>> copy_board(START, board)
        >>> (board == START).all().item()
        True
    """
    for point in range(25):
        to[0, point] = board[0, point]
        to[1, point] = board[1, point]


@lean_kernel
def _write(board: Board, out: Board, i: int) -> None:
    """The board as the other side meets it."""
    for point in range(25):
        out[i, 0, point] = board[1, point]
        out[i, 1, point] = board[0, point]


@lean_kernel
def _is_written(board: Board, out: Board, i: int) -> bool:
    for point in range(25):
        if out[i, 0, point] != board[1, point] or out[i, 1, point] != board[0, point]:
            return False
    return True


@lean_kernel
def _sum_of_changes(source: int, die: int, hit: bool) -> int:
    key = -_SIGNS[0, source]
    target = source - die
    if target >= 0:
        key += _SIGNS[0, target]
        if hit:
            key += _SIGNS[1, target]
    return key  # type: ignore[no-any-return]


@lean_kernel
def _play_both(board: Board, first: int, second: int, count: int, keys: NDArray[np.uint64], out: Board) -> int:
    """Appends the boards after ``first`` then ``second`` to the ``count`` that are there."""
    for source_1 in range(BAR, -1, -1):
        if not is_legal(board, source_1, first):
            continue
        hit_1 = play(board, source_1, first)
        key_1 = _sum_of_changes(source_1, first, hit_1)
        for source_2 in range(BAR, -1, -1):
            if not is_legal(board, source_2, second):
                continue
            hit_2 = play(board, source_2, second)
            key = key_1 + _sum_of_changes(source_2, second, hit_2)
            is_new = True
            for i in range(count):
                if keys[i] == key and _is_written(board, out, i):
                    is_new = False
                    break
            if is_new:
                _write(board, out, count)
                keys[count] = key
                count += 1
            take_back(board, source_2, second, hit_2)
        take_back(board, source_1, first, hit_1)
    return count


@lean_kernel
def _play_one(board: Board, die: int, out: Board) -> int:
    count = 0
    for source in range(BAR, -1, -1):
        if is_legal(board, source, die):
            hit = play(board, source, die)
            _write(board, out, count)
            count += 1
            take_back(board, source, die, hit)
    return count


@kernel
def _play_double(board: Board, die: int, out: Board) -> int:
    """Depth first, with falling sources; a deeper turn than all before makes those void."""
    sources, hits = np.empty(4, np.int64), np.empty(4, np.bool_)
    count, depth, deepest, source = 0, 0, 0, BAR
    while True:
        while depth < 4 and source >= 0 and not is_legal(board, source, die):
            source -= 1
        if depth == 4 or source < 0:
            if depth == 0:
                return count
            depth -= 1
            source = sources[depth]
            take_back(board, source, die, hits[depth])
            source -= 1
            continue
        hits[depth] = play(board, source, die)
        sources[depth] = source  # and the next source may be the same
        depth += 1
        if depth > deepest:
            deepest, count = depth, 0
        if depth == deepest:
            _write(board, out, count)
            count += 1


@kernel
def afterstates(board: Board, die_1: int, die_2: int, out: Board) -> int:
    """Writes every board in which a turn can end, each once, and returns their number, which is at least 1.

    Where no die can be played, the one afterstate is the board with its rows exchanged.

    Args:
        board: ``[2, 25]``, contiguous; left as it is.
        die_1: 1 to 6.
        die_2: 1 to 6, in either order.
        out: ``[MAX_AFTERSTATES, 2, 25]``; written, row 0 being the side that moves next.

    Example:
        >>> out = np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
        >>> [afterstates(START, *dice, out) for dice in [(2, 1), (6, 5), (1, 1)]]
        [15, 7, 42]
    """
    work = np.empty((2, 25), np.int8)
    copy_board(board, work)
    if die_1 == die_2:
        count = _play_double(work, die_1, out)
    else:
        keys = np.empty(_MOST_OF_TWO_DICE, np.uint64)
        large, small = max(die_1, die_2), min(die_1, die_2)
        count = _play_both(work, large, small, 0, keys, out)
        count = _play_both(work, small, large, count, keys, out)
        if count == 0:
            count = _play_one(work, large, out)
        if count == 0:
            count = _play_one(work, small, out)
    if count == 0:
        _write(work, out, 0)
        count = 1
    return count


@lean_kernel
def result(board: Board) -> int:
    """What the side to move has won: 0 while the game goes on, else ±1, ±2 (gammon) or ±3 (backgammon).

    Negative in the afterstate of a turn that ends the game, for then the other side has won. A loser who has borne
    off nothing loses a gammon; with a checker on the bar or in the winner's home, a backgammon.

    Example:
        >>> result(START)
        0
        >>> board = START.copy()
        >>> board[1] = 0
        >>> result(board)  # two checkers are still on the winner's ace point
        -3
    """
    for winner in range(2):
        left = 0
        for point in range(25):
            left += board[winner, point]
        if left > 0:
            continue
        loser, points = 1 - winner, 2
        left = 0
        for point in range(25):
            left += board[loser, point]
            if point >= 18 and board[loser, point] > 0:
                points = 3
        if left < NUM_CHECKERS:
            points = 1
        return points if winner == 0 else -points
    return 0


@lean_kernel
def roll(rng: np.random.Generator, opening: bool) -> tuple[int, int]:
    """Two dice; the opening roll of a game is no double.

    Example:
        >>> rng = np.random.default_rng(2)
        >>> [roll(rng, opening=number == 0) for number in range(4)]
        [(5, 1), (4, 5), (2, 1), (2, 4)]
    """
    while True:
        die_1, die_2 = 1 + int(6 * rng.random()), 1 + int(6 * rng.random())
        if die_1 != die_2 or not opening:
            return die_1, die_2


@kernel
def random_game(board: Board, rng: np.random.Generator, out: Board) -> tuple[int, int, int]:
    """Plays to the end, both sides choosing among afterstates with equal chances; the first roll may be a double.

    Returns what the side that moves first wins (negative if it loses), the number of turns, and the number of
    afterstates from which both have chosen.

    Args:
        board: where it starts, ``[2, 25]``; left as it is.
        rng: draws the dice and the choices.
        out: ``[MAX_AFTERSTATES, 2, 25]``; overwritten.

    Example:
        >>> out = np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
        >>> points, turns, seen = random_game(START, np.random.default_rng(0), out)
        >>> abs(points) in (1, 2, 3), seen > turns > 20
        (True, True)
    """
    now, turns, seen = np.empty((2, 25), np.int8), 0, 0
    copy_board(board, now)
    while result(now) == 0:
        count = afterstates(now, 1 + int(6 * rng.random()), 1 + int(6 * rng.random()), out)
        copy_board(out[int(count * rng.random())], now)
        turns += 1
        seen += count
    return (result(now) if turns % 2 == 0 else -result(now)), turns, seen

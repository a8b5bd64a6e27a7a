"""Fourteen numbers that a player would name: the race, shots at blots, primes, escapes, the home board, contact.

They are computed from the board alone, and a network may be given them beside Tesauro's inputs. For each side, the one
to move first, at 6 · side + …:

* 0: its pips, divided by the 167 of the start;
* 1: the share of the 36 rolls with which the other side could hit one of its blots;
* 2: what that would cost: the sum over its blots of that share and of the way back, 24 − point, divided by 24;
* 3: its longest row of made points, divided by 6;
* 4: the share of rolls that its rearmost checker could play in full against the other side's points;
* 5: its made points at home, divided by 6;

and 12: how far the rearmost checkers have still to pass each other, in points divided by 23 and 0 in a race; 13: the
lead of the side to move in the race, in pips divided by 50, within ±1.

A shot counts a single die, the sum of two, and of doubles up to four steps; steps in between must not be blocked. With
a checker on the bar only that one can hit, and with two only by the die that brings it in. What the rest of a turn
would then allow is not asked.

Source: the quantities are common knowledge of the game; Tesauro (1995) reports that such inputs lifted TD-Gammon 1.0.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq_envs.backgammon.rules import BAR, Board

__all__ = ["NUM_EXPERT", "expert_inputs", "shots_at"]

NUM_EXPERT = 14
_PER_SIDE = 6


@lean_kernel
def _with_die(die: int) -> int:
    """The rolls, as bits 6 · (first − 1) + second − 1, that show ``die``."""
    return (63 << (6 * (die - 1))) | (1090785345 << (die - 1))


@lean_kernel
def shots_at(board: Board, side: int, point: int) -> int:
    """The rolls, as bits 6 · (first − 1) + second − 1, with which the other side reaches a point of ``side``.

    Args:
        board: ``[2, 25]``.
        side: 0 or 1, whose point it is.
        point: 0 to 23, counted by ``side``.

    Example:
        >>> import numpy as np
        >>> board = np.zeros((2, 25), np.int8)
        >>> board[0, 10], board[1, 16] = 1, 1  # three points apart
        >>> int(shots_at(board, 0, 10)).bit_count()  # eleven with a 3, 2-1 twice, and 1-1
        14
    """
    other = 1 - side
    target = 23 - point
    on_bar = board[other, BAR]
    rolls = 0
    for source in range(target + 1, 25):
        if board[other, source] == 0 or (on_bar > 0 and source != BAR):
            continue
        distance = source - target
        if distance <= 6:
            rolls |= _with_die(distance)
        if on_bar > 1:
            continue
        for first in range(max(1, distance - 6), min(6, distance - 1) + 1):
            if board[side, 23 - (source - first)] < 2:  # the step in between is open
                second = distance - first
                rolls |= (1 << (6 * (first - 1) + second - 1)) | (1 << (6 * (second - 1) + first - 1))
        for die in range(1, 7):
            if distance % die == 0 and 3 * die <= distance <= 4 * die:
                is_open = True
                for step in range(1, distance // die):
                    if board[side, 23 - (source - step * die)] >= 2:
                        is_open = False
                        break
                if is_open:
                    rolls |= 1 << (7 * (die - 1))
    return rolls


@lean_kernel
def _count(rolls: int) -> int:
    count = 0
    while rolls != 0:
        rolls &= rolls - 1
        count += 1
    return count


@lean_kernel
def _escapes(board: Board, side: int, source: int) -> int:
    """With how many of the 36 rolls a checker on ``source`` can play both dice (all four steps are not asked)."""
    count = 0
    for first in range(1, 7):
        for second in range(1, 7):
            target = source - first - second
            if target >= 0 and board[1 - side, 23 - target] >= 2:
                continue
            a, b = source - first, source - second
            if a < 0 or b < 0 or board[1 - side, 23 - a] < 2 or board[1 - side, 23 - b] < 2:
                count += 1
    return count


@lean_kernel
def expert_inputs(board: Board, x: NDArray[Any]) -> None:
    """Writes the fourteen numbers.

    Args:
        board: seen by the side to move, ``[2, 25]``.
        x: any floats, ``[14]``; written.

    Example:
        >>> import numpy as np
        >>> from neuralq_envs.backgammon.rules import START
        >>> x = np.empty(14)
        >>> expert_inputs(START, x)
        >>> x[:6].round(3).tolist(), x[12:].tolist()  # even, no blot, one point at home, as far apart as can be
        ([1.0, 0.0, 0.0, 0.167, 0.667, 0.167], [1.0, 0.0])
    """
    pips_of_first, back_of_first = 0, 0
    for side in range(2):
        pips, back, row, longest, home, rolls = 0, 0, 0, 0, 0, 0
        loss = 0.0
        for point in range(24):
            n = board[side, point]
            if n == 0:
                row = 0
                continue
            back = point
            pips += n * (point + 1)
            if n == 1:
                row = 0
                found = shots_at(board, side, point)
                rolls |= found
                loss += _count(found) * (24 - point)
            else:
                row += 1
                longest = max(longest, row)
                if point < 6:
                    home += 1
        if board[side, BAR] > 0:
            back = BAR
            pips += 25 * board[side, BAR]
        at = _PER_SIDE * side
        x[at] = pips / 167
        x[at + 1] = _count(rolls) / 36
        x[at + 2] = loss / (24 * 36)
        x[at + 3] = longest / 6
        x[at + 4] = _escapes(board, side, back) / 36
        x[at + 5] = home / 6
        if side == 0:
            pips_of_first, back_of_first = pips, back
        else:
            x[12] = max(0, back_of_first + back - 23) / 23
            x[13] = max(-1.0, min(1.0, (pips - pips_of_first) / 50))

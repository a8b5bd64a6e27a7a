"""The rules of English draughts (American checkers) on the full board as compiled loops over bits: moves and perft.

A board is three numbers of 35 bits: the pieces of the side to move, those of the other side, and which of both are
kings. It is always seen by who is to move, who moves upwards; so the board that a move leaves is turned round, and
neither rules nor learners know colours. Four squares of a row are four bits, and one bit is left out after every two
rows (8, 17 and 26); then a step goes up by 4 or 5 bits and down by 4 or 5, from every row, and one that leaves the
board at its side ends on a bit that is no square (Samuel 1959 laid his boards out like this).

Captures are forced, any of them may be chosen, and one that can go on must go on; a man that reaches the last row is
crowned and its move ends there; who cannot move has lost. A move of several jumps is a path: two paths that leave the
same board are two moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import kernel, lean_kernel

__all__ = [
    "LAST_ROW",
    "MAX_MOVES",
    "NUM_BITS",
    "SQUARES",
    "START",
    "bit_count",
    "jumpers",
    "moves",
    "num_steps",
    "perft",
    "shifted",
    "turned",
]

NUM_BITS = 35
SQUARES = sum(1 << bit for bit in range(NUM_BITS) if bit not in (8, 17, 26))
LAST_ROW = 0b1111 << 31
MAX_MOVES = 192
"""No board has more moves: twelve kings make at most 48 steps, or jump along at most 16 paths each."""

_TURNED_NINE = np.array([int(f"{nine:09b}"[::-1], 2) for nine in range(512)], np.int64)  # two rows and a gap


@lean_kernel
def turned(pieces: int) -> int:
    """The bits as the other side sees them: bit b becomes bit 34 − b.

    Example:
        >>> turned(0b1) == 1 << 34, turned(turned(12345)) == 12345
        (True, True)
    """
    low, second, third, high = pieces & 511, pieces >> 9 & 511, pieces >> 18 & 511, pieces >> 27 & 511
    down = (_TURNED_NINE[low] << 26) | (_TURNED_NINE[second] << 17) | (_TURNED_NINE[third] << 8)
    return down | (_TURNED_NINE[high] >> 1)  # type: ignore[no-any-return]


START = (0b1111_0_1111_1111, int(turned(0b1111_0_1111_1111)), 0)
"""Own pieces, the other side's and kings, as a game begins."""


@lean_kernel
def shifted(pieces: int, direction: int) -> int:
    """All pieces one step on: 0 and 1 are upwards, 2 and 3 downwards; what would leave the board is lost.

    Example:
        >>> [shifted(1 << 12, direction).bit_length() - 1 for direction in range(4)]  # beside the rim
        [16, -1, -1, 7]
    """
    if direction < 2:
        return (pieces << 4 + direction) & SQUARES
    return (pieces >> 2 + direction) & SQUARES


@lean_kernel
def bit_count(pieces: int) -> int:
    """How many.

    Example:
        >>> bit_count(SQUARES)
        32
    """
    count = pieces - (pieces >> 1 & 0x5_5555_5555)
    count = (count & 0x3_3333_3333) + (count >> 2 & 0x3_3333_3333)
    count = count + (count >> 4) & 0xF_0F0F_0F0F
    count += count >> 8
    count += count >> 16
    return (count + (count >> 32)) & 63


@lean_kernel
def jumpers(own: int, other: int, kings: int) -> int:
    """The pieces of the side to move that can capture.

    Example:
        >>> jumpers(*START), jumpers(1 << 4, 1 << 9, 0) == 1 << 4, jumpers(1 << 14, 1 << 9, 0)
        (0, True, 0)
    """
    empty = SQUARES & ~(own | other)
    found = 0
    for direction in range(4):
        movers = own if direction < 2 else own & kings
        landing = shifted(shifted(movers, direction) & other, direction) & empty
        found |= shifted(shifted(landing, direction ^ 2), direction ^ 2)
    return found


@lean_kernel
def _write(
    own: int, other: int, kings: int, source: int, target: int, taken: int, path: int, out: NDArray[np.int64], i: int
) -> None:
    """The board after a move, as the other side meets it, and how the move went."""
    is_king = (kings & source) != 0 or (target & LAST_ROW) != 0
    after = (kings & ~source & ~taken) | (target if is_king else 0)
    out[i, 0] = turned(other & ~taken)
    out[i, 1] = turned((own & ~source) | target)
    out[i, 2] = turned(after)
    out[i, 3] = source
    out[i, 4] = path


@lean_kernel
def _write_jumps(own: int, other: int, kings: int, source: int, out: NDArray[np.int64], count: int) -> int:
    """Every path of captures of one piece, depth first; the path itself is the stack.

    A man moves upwards until its move ends, so one that is crowned goes no further.
    """
    empty = (SQUARES & ~(own | other)) | source
    num_directions = 4 if kings & source else 2
    at, taken, path, depth, direction, went_on = source, 0, 1, 0, 0, 0
    while True:
        while direction < num_directions:
            jumped = shifted(at, direction) & other & ~taken
            target = shifted(jumped, direction) & empty
            if target:
                break
            direction += 1
        if direction < num_directions:
            went_on |= 1 << depth
            depth += 1
            went_on &= ~(1 << depth)
            at, taken, path, direction = target, taken | jumped, path << 2 | direction, 0
            continue
        if depth == 0:
            return count
        if not went_on >> depth & 1:
            _write(own, other, kings, source, at, taken, path, out, count)
            count += 1
        last = path & 3
        jumped = shifted(at, last ^ 2)
        at, taken, path = shifted(jumped, last ^ 2), taken & ~jumped, path >> 2
        depth -= 1
        direction = last + 1


@lean_kernel
def moves(own: int, other: int, kings: int, out: NDArray[np.int64]) -> int:
    """Writes every legal move and returns their number; with none, the side to move has lost.

    Args:
        own: pieces of the side to move.
        other: pieces of the other side.
        kings: which of both are kings.
        out: ``[MAX_MOVES, 5]``; written: own, other and kings as the other side meets them, the square that was left,
            and the path: a one, then two bits for the direction of each step or jump.

    Example:
        >>> moves(*START, np.empty((MAX_MOVES, 5), np.int64))
        7
    """
    count = 0
    can_jump = jumpers(own, other, kings)
    if can_jump:
        while can_jump:
            source = can_jump & -can_jump
            can_jump ^= source
            count = _write_jumps(own, other, kings, source, out, count)
        return count
    empty = SQUARES & ~(own | other)
    for direction in range(4):
        targets = shifted(own if direction < 2 else own & kings, direction) & empty
        while targets:
            target = targets & -targets
            targets ^= target
            _write(own, other, kings, shifted(target, direction ^ 2), target, 0, 4 | direction, out, count)
            count += 1
    return count


@lean_kernel
def num_steps(own: int, other: int, kings: int) -> int:
    """How many moves capture nothing; they are legal if no other one captures.

    Example:
        >>> num_steps(*START)
        7
    """
    empty = SQUARES & ~(own | other)
    count = 0
    for direction in range(4):
        count += bit_count(shifted(own if direction < 2 else own & kings, direction) & empty)
    return count


@kernel
def perft(own: int, other: int, kings: int, depth: int) -> int:
    """The number of ways to play ``depth`` moves.

    Example:
        >>> [perft(*START, depth) for depth in range(4)]
        [1, 7, 49, 302]
    """
    if depth == 0:
        return 1
    out = np.empty((depth, MAX_MOVES, 5), np.int64)
    left = np.zeros(depth, np.int64)
    ply, total = 0, 0
    left[0] = moves(own, other, kings, out[0])
    while ply >= 0:
        if left[ply] == 0 or ply == depth - 1:
            total += left[ply] if ply == depth - 1 else 0
            ply -= 1
            continue
        left[ply] -= 1
        board = out[ply, left[ply]]
        own, other, kings = board[0], board[1], board[2]
        if ply == depth - 2 and not jumpers(own, other, kings):
            total += num_steps(own, other, kings)
            continue
        ply += 1
        left[ply] = moves(own, other, kings, out[ply])
    return total

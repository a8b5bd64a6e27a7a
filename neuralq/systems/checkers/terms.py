"""Fourteen terms of a board, each that of the side to move less that of the other side: what the weights weigh.

Advantage in pieces comes first, with a weight that stays 1, so that the others have a unit. The terms are of the kind
that Samuel (1959) lists; which of his they are, and how he scaled them, he does not print.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq_envs.checkers.rules import SQUARES, bit_count, num_steps, shifted, turned

__all__ = ["MATERIAL_ONLY", "NUM_TERMS", "TERMS", "evaluate", "write_terms"]

TERMS = {
    "pieces": "a man counts 1, a king 1.5",
    "advance": "men on the rows 5 and 6 less those on 3 and 4",
    "back row": "men on the first row",
    "row 7": "men one step from being crowned",
    "centre": "pieces on the eight squares of the middle",
    "edge": "pieces at the left or right rim",
    "rows": "a fifth of the sum of all men's rows, counted from 0",
    "king centre": "kings on the eight squares of the middle",
    "kings": "kings",
    "isolated": "men without a piece of their own beside them",
    "mobility": "a quarter of the steps that are free",
    "exposed": "pieces that could be captured if the other side were to move",
    "bridge": "men on the first and the third square of the first row",
    "exchange": "the advantage in pieces, times the share of the 24 that are gone",
}
"""What is counted, by name; rows from 1, one's own first."""
NUM_TERMS = len(TERMS)

MATERIAL_ONLY = np.eye(NUM_TERMS)[0]
MATERIAL_ONLY.flags.writeable = False


def _row(row: int) -> int:
    return 0b1111 << 9 * (row // 2) + 4 * (row % 2)


_ROWS_3_4, _ROWS_5_6, _ROW_7, _ROW_1 = _row(2) | _row(3), _row(4) | _row(5), _row(6), _row(0)
# Of rows 1, 3, 5, 7 the last of the four squares is at the rim, of the others the first.
_RIM = sum(1 << 9 * pair + bit for pair in range(4) for bit in (3, 4))
_CENTRE = sum(0b0110 << 9 * pair + 4 * odd for pair, odd in ((1, 0), (2, 0), (1, 1), (2, 1)))
_BRIDGE = 0b101


@lean_kernel
def _add(own: int, other: int, kings: int, sign: float, terms: NDArray[np.float64]) -> None:
    """Adds one side's counts, which sees the board as given."""
    men, crowned = own & ~kings, own & kings
    empty = SQUARES & ~(own | other)
    exposed = beside = 0
    for direction in range(4):
        threats = other if direction >= 2 else other & kings  # they come from ahead, or are kings
        exposed |= shifted(threats, direction) & own & shifted(empty, direction ^ 2)
        beside |= shifted(own, direction)
    rows = 0
    for row in range(1, 7):
        rows += row * bit_count(men & (0b1111 << 9 * (row // 2) + 4 * (row % 2)))
    terms[0] += sign * (bit_count(men) + 1.5 * bit_count(crowned))
    terms[1] += sign * (bit_count(men & _ROWS_5_6) - bit_count(men & _ROWS_3_4))
    terms[2] += sign * bit_count(men & _ROW_1)
    terms[3] += sign * bit_count(men & _ROW_7)
    terms[4] += sign * bit_count(own & _CENTRE)
    terms[5] += sign * bit_count(own & _RIM)
    terms[6] += sign * 0.2 * rows
    terms[7] += sign * bit_count(crowned & _CENTRE)
    terms[8] += sign * bit_count(crowned)
    terms[9] += sign * bit_count(men & ~beside)
    terms[10] += sign * 0.25 * num_steps(own, other, kings)
    terms[11] += sign * bit_count(exposed)
    terms[12] += sign * (1.0 if men & _BRIDGE == _BRIDGE else 0.0)


@lean_kernel
def write_terms(own: int, other: int, kings: int, terms: NDArray[np.float64]) -> None:
    """Writes all fourteen terms of a board.

    Args:
        own: pieces of the side to move.
        other: pieces of the other side.
        kings: which of both are kings.
        terms: ``[14]``; written.

    Example:
        >>> from neuralq_envs.checkers import Position
        >>> position, terms = Position.from_fen("B:W20,30:B1,3,K18"), np.empty(NUM_TERMS)
        >>> write_terms(position.own, position.other, position.kings, terms)
        >>> dict(zip(TERMS, terms.round(3).tolist()))["pieces"]
        1.5
    """
    for i in range(NUM_TERMS):
        terms[i] = 0.0
    _add(own, other, kings, 1.0, terms)
    _add(turned(other), turned(own), turned(kings), -1.0, terms)
    terms[13] = terms[0] * (24 - bit_count(own | other)) / 24.0


@lean_kernel
def evaluate(own: int, other: int, kings: int, weights: NDArray[np.float64], terms: NDArray[np.float64]) -> float:
    """The weighted sum of the terms, for the side to move.

    Args:
        own: pieces of the side to move.
        other: pieces of the other side.
        kings: which of both are kings.
        weights: ``[14]``.
        terms: ``[14]``; overwritten.

    Example:
        >>> from neuralq_envs.checkers.rules import START
        >>> evaluate(*START, MATERIAL_ONLY, np.empty(NUM_TERMS))
        0.0
    """
    write_terms(own, other, kings, terms)
    value = 0.0
    for i in range(NUM_TERMS):
        value += weights[i] * terms[i]
    return value

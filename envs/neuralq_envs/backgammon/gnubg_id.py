"""GNU Backgammon's position IDs: a board as 14 characters, read and written.

The key is a string of 80 bits. For the side that is *not* to move, then for the side to move, it holds for each of
that side's own points 1 to 24 and its bar as many ones as it has checkers there and then a zero; zeros fill the rest.
Two times 25 zeros and at most two times 15 ones just fit. Bit i is bit i mod 8 of byte i div 8, the least significant
first. The ID is the base64 of the ten bytes (RFC 4648) without the two "=" at its end; so its last character carries
two bits only, and 14 characters that leave the other four set name no position.

The order of the sides is that of the program, whose own text calls the first one "player on roll": after the opening
3-1, 8/5 6/5, its ID is sGfwATDgc/ABMA, and the first half is that of the side that has just moved.
An ID says neither which of the two players is to move nor the dice nor the cube: those are in the match ID.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence

__all__ = ["read_id", "write_id"]

_BYTES = 10


def write_id(own: Sequence[int], other: Sequence[int]) -> str:
    """The position ID of a board.

    Args:
        own: checkers of the side to move on its points 1 to 24 and its bar, 25 numbers.
        other: those of the other side, counted from its own side.

    Example:
        >>> start = [0, 0, 0, 0, 0, 5, 0, 3, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0]
        >>> write_id(start, start)
        '4HPwATDgc/ABMA'
    """
    key, bit = 0, 0
    for count in [*other, *own]:
        key |= ((1 << count) - 1) << bit
        bit += count + 1
    return base64.b64encode(key.to_bytes(_BYTES, "little")).decode().rstrip("=")


def read_id(text: str) -> tuple[list[int], list[int]]:
    """The checkers of the side to move and of the other side, each as `write_id` takes them.

    Raises:
        ValueError: text that is no position ID. Whether the board can be one of a game is not asked here.

    Example:
        >>> own, other = read_id("sGfwATDgc/ABMA")
        >>> other[:8]  # it has played 8/5 6/5
        [0, 0, 0, 0, 2, 4, 0, 2]
    """
    try:
        key = int.from_bytes(base64.b64decode(f"{text}==", validate=True), "little") if len(text) == 14 else None
    except (binascii.Error, ValueError):
        key = None
    counts = [0]
    for bit in range(8 * _BYTES):
        if key is not None and key >> bit & 1:
            counts[-1] += 1
        else:
            counts.append(0)
    own, other = counts[25:50], counts[:25]
    # Writing it again refuses what base64 lets pass: bits after the last point, and more than 80 of them.
    if key is None or len(own) < 25 or write_id(own, other) != text:
        raise ValueError(
            "a position ID must be 14 characters of A-Z a-z 0-9 + /, such as 4HPwATDgc/ABMA, that hold 50 counts "
            f"in 80 bits, got {text!r}; of an ID with a colon give the part before it"
        )
    return own, other

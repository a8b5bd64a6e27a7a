"""Rote learning: a memory of positions with the scores that searches have given them (Samuel 1959).

A position is remembered as the side to move sees it, so both colours share it, with the depth of the search that gave
the score. A search that meets it may take the score for its own if it was going to look no deeper there; at the end
of its look-ahead this makes it see further than it looks.

A score that is a win says how many plies away it is (`search.WIN`): that is Samuel's sense of direction. It
is kept as counted from the remembered position.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.jit import lean_kernel

__all__ = ["Memory", "find", "new_memory", "remember"]


class Memory(NamedTuple):
    """Positions by hashing, each in the first free place from its own on.

    Args:
        boards: own, other, kings, ``[N, 3]``; zeros where nothing is.
        scores: for the side to move, ``[N]``.
        depths: of the searches that gave them, ``[N]``.
        size: how many are remembered, ``[1]``.
    """

    boards: NDArray[np.int64]
    scores: NDArray[np.float64]
    depths: NDArray[np.int64]
    size: NDArray[np.int64]


def new_memory(num_places: int) -> Memory:
    """A memory of nothing.

    Args:
        num_places: rounded up to a power of two, of which seven eighths are filled at most; 0 for none.

    Raises:
        ValueError: below 0.

    Example:
        >>> new_memory(1000).scores.shape, int(new_memory(1000).size[0])
        ((1024,), 0)
    """
    check_whole("num_places", num_places, minimum=0)
    size = 1 << (num_places - 1).bit_length() if num_places > 1 else num_places
    return Memory(np.zeros((size, 3), np.int64), np.zeros(size), np.zeros(size, np.int64), np.zeros(1, np.int64))


@lean_kernel
def _place(memory: Memory, own: int, other: int, kings: int) -> int:
    """Where the position is, or the free place where it belongs."""
    last = len(memory.scores) - 1
    mixed = (own * 3) ^ (other * 5) ^ (kings * 7)  # 38 bits, in Python as in the machine
    mixed = (mixed ^ mixed >> 15) * 0xF35
    mixed = (mixed ^ mixed >> 17) & last
    while memory.boards[mixed, 0] != 0 and (
        memory.boards[mixed, 0] != own or memory.boards[mixed, 1] != other or memory.boards[mixed, 2] != kings
    ):
        mixed = (mixed + 1) & last
    return mixed


@lean_kernel
def find(memory: Memory, own: int, other: int, kings: int, depth: int) -> int:
    """The place of a position that was searched at least so deep, or −1.

    Example:
        >>> memory = new_memory(8)
        >>> remember(memory, 1, 1 << 9, 0, 3, 0.5)
        >>> find(memory, 1, 1 << 9, 0, 4), memory.scores[find(memory, 1, 1 << 9, 0, 3)].item()
        (-1, 0.5)
    """
    if len(memory.scores) == 0:
        return -1
    place = _place(memory, own, other, kings)
    return place if memory.boards[place, 0] != 0 and memory.depths[place] >= depth else -1


@lean_kernel
def remember(memory: Memory, own: int, other: int, kings: int, depth: int, score: float) -> None:
    """Keeps a score; a shallower one is overwritten, and so is one of the same depth, for it was made with less.

    A memory that is full takes no more positions.

    Args:
        memory: changed in place.
        own: pieces of the side to move, at least one.
        other: pieces of the other side.
        kings: which of both are kings.
        depth: of the search.
        score: what it found, for the side to move.
    """
    if len(memory.scores) == 0:
        return
    place = _place(memory, own, other, kings)
    if memory.boards[place, 0] == 0:
        if memory.size[0] >= len(memory.scores) * 7 // 8:
            return
        memory.boards[place, 0], memory.boards[place, 1], memory.boards[place, 2] = own, other, kings
        memory.size[0] += 1
    elif memory.depths[place] > depth:
        return
    memory.scores[place], memory.depths[place] = score, depth

"""Tesauro's 198 inputs of a board, dense and as the at most 31 that are not zero.

The two players are numbered 0 and 1, and each has 98 inputs, 98 · player + …:

* 4 · i + 0, 1, 2, 3 for its own point i, counted from its ace point: n ≥ 1, n ≥ 2, n ≥ 3 as 0 or 1, and (n − 3) / 2
  where n > 3, n being the number of its checkers there;
* 96: its checkers on the bar, halved; 97: its checkers borne off, divided by 15;

and 196 + player is 1 for the player to move. Since each player counts its points from its own side, exchanging the
players exchanges the two blocks and the last two inputs, exactly.

Each input that is not zero, but for the last two, needs a checker of its own: so 15 for each player and one are the
most there can be, and a first layer that adds only these columns does a sixth of the work.

Source: Tesauro (1992), "Practical issues in temporal difference learning"; Sutton & Barto (2018), section 16.1.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq_envs.backgammon.rules import BAR, NUM_CHECKERS, Board

__all__ = ["MAX_ACTIVE", "NUM_INPUTS", "tesauro_dense", "tesauro_sparse"]

NUM_INPUTS = 198
MAX_ACTIVE = 31
_BLOCK = 98


@lean_kernel
def tesauro_sparse(board: Board, player: int, indices: NDArray[Any], values: NDArray[Any]) -> int:
    """Writes the numbers and the values of the inputs that are not zero, and returns how many they are.

    Args:
        board: seen by the side to move, ``[2, 25]``.
        player: 0 or 1: who is to move.
        indices: any integers, ``[31]``; written, rising within each player's block.
        values: any floats, ``[31]``; written.

    Example:
        >>> import numpy as np
        >>> from neuralq_envs.backgammon.rules import START
        >>> indices, values = np.empty(31, np.int64), np.empty(31)
        >>> count = tesauro_sparse(START, 0, indices, values)
        >>> indices[:5].tolist(), values[:5].tolist(), count  # five checkers on the 6 point, then the 8 point
        ([20, 21, 22, 23, 28], [1.0, 1.0, 1.0, 1.0, 1.0], 27)
    """
    count = 0
    for row in range(2):
        offset = _BLOCK * (player if row == 0 else 1 - player)
        left = 0
        for point in range(BAR):
            n = board[row, point]
            left += n
            for unit in range(min(n, 3)):
                indices[count] = offset + 4 * point + unit
                values[count] = 1.0
                count += 1
            if n > 3:
                indices[count] = offset + 4 * point + 3
                values[count] = (n - 3) / 2
                count += 1
        n = board[row, BAR]
        left += n
        if n > 0:
            indices[count] = offset + 96
            values[count] = n / 2
            count += 1
        if left < NUM_CHECKERS:
            indices[count] = offset + 97
            values[count] = (NUM_CHECKERS - left) / 15
            count += 1
    indices[count] = 2 * _BLOCK + player
    values[count] = 1.0
    return count + 1


@lean_kernel
def tesauro_dense(board: Board, player: int, x: NDArray[Any]) -> None:
    """Writes all inputs.

    Args:
        board: seen by the side to move, ``[2, 25]``.
        player: 0 or 1: who is to move.
        x: any floats, ``[198]``; written.

    Example:
        >>> import numpy as np
        >>> from neuralq_envs.backgammon.rules import START
        >>> x = np.empty(198)
        >>> tesauro_dense(START, 1, x)
        >>> x[20:24].tolist(), x[98 + 28 : 98 + 32].tolist(), x[196:].tolist()
        ([1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 0.0], [0.0, 1.0])
    """
    for i in range(NUM_INPUTS):
        x[i] = 0.0
    for row in range(2):
        offset = _BLOCK * (player if row == 0 else 1 - player)
        left = 0
        for point in range(BAR):
            n = board[row, point]
            left += n
            for unit in range(min(n, 3)):
                x[offset + 4 * point + unit] = 1.0
            if n > 3:
                x[offset + 4 * point + 3] = (n - 3) / 2
        left += board[row, BAR]
        x[offset + 96] = board[row, BAR] / 2
        x[offset + 97] = (NUM_CHECKERS - left) / 15
    x[2 * _BLOCK + player] = 1.0

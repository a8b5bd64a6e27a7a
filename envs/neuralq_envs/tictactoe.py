"""Tic-tac-toe against a fixed opponent (Mitchell 1997, exercise 13.3): the opponent is part of the world.

One state per position that play can reach: 5,478 of them, numbered in the order in which a search from the empty board
finds them, the same in all variants. The learner's states are the positions in which it is to move; an action is the
cell to mark, row by row. Its row holds the opponent's answers with their probabilities. So the game is a finite MDP,
solved by exact methods, and the value of the best answer to any of these opponents is known:

* ``"random"``: any free cell. Playing X one can win .99479 and never lose; playing O win .93228 and lose .0074 (the
  difference is the best there is; who counts wins only can get .93862);
* ``"forced"``: a winning cell if there is one, else a cell that stops the learner's win, else any (exercise 13.3);
* ``"optimal"``: any cell that keeps the minimax value: the best answer is a draw.

The numbers were computed by exhaustive enumeration, and the tests repeat it.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq.mdp import FiniteMDP
from neuralq_envs.canvas import BLUE, CELL, GREY, INK, PAPER, blank, disk, frame, stroke, write
from neuralq_envs.rendering import factories

__all__ = ["GAMMA", "OPPONENTS", "BoardScene", "make", "make_vector", "mdp", "minimax_values", "positions"]

GAMMA = 1.0
OPPONENTS = ("random", "forced", "optimal")
_CELLS = range(9)
_FULL = 0b111_111_111
_LINES = (0b111, 0b111_000, 0b111_000_000, 0b001_001_001, 0b010_010_010, 0b100_100_100, 0b100_010_001, 0b001_010_100)

Board = tuple[int, int]  # the cells of X and of O, one bit each


def positions() -> NDArray[np.int8]:
    """Every position that play can reach, ``[5478, 9]``: 1 where X is, −1 where O is, 0 where nothing is.

    Example:
        >>> positions().shape, positions()[0].tolist()
        ((5478, 9), [0, 0, 0, 0, 0, 0, 0, 0, 0])
    """
    boards = np.array(_boards())
    marks = boards[:, :, None] >> np.arange(9) & 1
    return (marks[:, 0] - marks[:, 1]).astype(np.int8)


def minimax_values() -> NDArray[np.int8]:
    """Who wins each position when both play perfectly, ``[5478]``: 1 for X, −1 for O, 0 for nobody.

    Example:
        >>> int(minimax_values()[0])  # tic-tac-toe is a draw
        0
    """
    mover_wins = np.array([_minimax(*_seen_by_mover(board)) for board in _boards()])
    x_moves = np.array([_x_to_move(board) for board in _boards()])
    return np.where(x_moves, mover_wins, -mover_wins).astype(np.int8)


@functools.lru_cache(maxsize=16)
def mdp(
    opponent: str = "forced",
    player: str = "X",
    win_reward: float = 1.0,
    draw_reward: float = 0.0,
    loss_reward: float = -1.0,
) -> FiniteMDP:
    """The exact model of the game as the learner meets it.

    With rewards (1, 0, 0) the value of a policy is its probability to win, with (0, 0, 1) to lose.

    Args:
        opponent: ``"random"``, ``"forced"`` or ``"optimal"``.
        player: ``"X"``, who begins, or ``"O"``.
        win_reward: of the move that wins.
        draw_reward: of the move after which nobody can win any more: the board is full.
        loss_reward: of the move after which the opponent wins.

    Raises:
        ValueError: another opponent or player, or rewards that are not finite.

    Example:
        >>> mdp().num_states, mdp().num_actions
        (5478, 9)
        >>> env = make(opponent="random", player="O")
        >>> int(env.reset(seed=0)[1]["action_mask"].sum())  # X has moved
        8
    """
    check_choice("opponent", opponent, OPPONENTS)
    check_choice("player", player, ("X", "O"))
    rewards = (win_reward, draw_reward, loss_reward)
    if not all(map(math.isfinite, rewards)):
        raise ValueError(f"rewards must be finite, got {rewards}")
    boards = _boards()
    number = {board: s for s, board in enumerate(boards)}

    def actions(s: int) -> list[int]:
        board = boards[s]
        return _free(board) if _x_to_move(board) == (player == "X") and not _is_over(board) else []

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        after = _marked(boards[s], a)
        if _is_over(after):
            return [(1.0, number[after], win_reward if _has_won(after) else draw_reward, True)]
        answers = [_marked(after, cell) for cell in _answers(after, opponent)]
        chance = 1 / len(answers)
        ends = [(loss_reward if _has_won(b) else draw_reward) if _is_over(b) else None for b in answers]
        return [(chance, number[b], pays or 0.0, pays is not None) for b, pays in zip(answers, ends, strict=True)]

    start = np.zeros(len(boards))
    openings = [(0, 0)] if player == "X" else [_marked((0, 0), cell) for cell in _answers((0, 0), opponent)]
    start[[number[board] for board in openings]] = 1 / len(openings)
    names = [_compact(board) for board in boards]
    return FiniteMDP.from_functions(len(boards), 9, actions, transitions, start=start, state_names=names)


class BoardScene:
    """The board of each state, as text and as a picture.

    Example:
        >>> print(BoardScene().text(0))
        . . .
        . . .
        . . .
        <BLANKLINE>
    """

    def text(self, state: int | None) -> str:
        """Three lines of ``X``, ``O`` and ``.``."""
        signs = _compact(_boards()[state or 0])
        return "".join(" ".join(signs[i : i + 3]) + "\n" for i in (0, 3, 6))

    def pixels(self, state: int | None) -> NDArray[np.uint8]:
        """Uint8 ``[144, 144, 3]``: crosses dark, rings blue, the number of each free cell in grey."""
        picture = blank(3 * CELL, 3 * CELL)
        for i in (1, 2):
            picture[i * CELL - 1 : i * CELL + 1] = INK
            picture[:, i * CELL - 1 : i * CELL + 1] = INK
        low, high, middle = 0.25 * CELL, 0.75 * CELL, CELL / 2 - 0.5
        for cell, sign in enumerate(_compact(_boards()[state or 0])):
            row, column = cell // 3 * CELL, cell % 3 * CELL
            square = picture[row : row + CELL, column : column + CELL]  # a view
            if sign == "X":
                for points in ([[low, low], [high, high]], [[low, high], [high, low]]):
                    stroke(square, np.array(points), INK, width=5)
            elif sign == "O":
                disk(square, (middle, middle), 0.32 * CELL, BLUE)
                disk(square, (middle, middle), 0.32 * CELL - 5, PAPER)
            else:
                write(square, str(cell), (middle, middle), GREY)
        frame(picture)
        return picture


make, make_vector = factories(mdp, lambda **_: BoardScene())


@functools.cache
def _boards() -> tuple[Board, ...]:
    found: dict[Board, None] = {(0, 0): None}  # a dict keeps the order
    frontier = [(0, 0)]
    for board in frontier:  # grows while it is read
        for cell in [] if _is_over(board) else _free(board):
            after = _marked(board, cell)
            if after not in found:
                found[after] = None
                frontier.append(after)
    return tuple(found)


def _x_to_move(board: Board) -> bool:
    return board[0].bit_count() == board[1].bit_count()


def _marked(board: Board, cell: int) -> Board:
    """The board after whose turn it is has marked ``cell``."""
    x, o = board
    return (x | 1 << cell, o) if _x_to_move(board) else (x, o | 1 << cell)


def _free(board: Board) -> list[int]:
    return [cell for cell in _CELLS if not (board[0] | board[1]) >> cell & 1]


def _wins(cells: int) -> bool:
    return any(cells & line == line for line in _LINES)


def _has_won(board: Board) -> bool:
    """Whether the last move won."""
    return _wins(board[1] if _x_to_move(board) else board[0])


def _is_over(board: Board) -> bool:
    return board[0] | board[1] == _FULL or _has_won(board)


def _seen_by_mover(board: Board) -> Board:
    """(own cells, the other's cells) of who is to move."""
    return board if _x_to_move(board) else (board[1], board[0])


def _answers(board: Board, opponent: str) -> list[int]:
    """The cells between which the opponent, who is to move, chooses at random."""
    own, other = _seen_by_mover(board)
    free = _free(board)
    if opponent == "forced":
        winning = [cell for cell in free if _wins(own | 1 << cell)]
        saving = [cell for cell in free if _wins(other | 1 << cell)]
        return winning or saving or free
    if opponent == "optimal":
        values = [-_minimax(other, own | 1 << cell) for cell in free]
        return [cell for cell, value in zip(free, values, strict=True) if value == max(values)]
    return free


@functools.cache
def _minimax(own: int, other: int) -> int:
    """1, 0 or −1: what who is to move can be sure of."""
    if _wins(other):
        return -1
    free = [cell for cell in _CELLS if not (own | other) >> cell & 1]
    return max((-_minimax(other, own | 1 << cell) for cell in free), default=0)


def _compact(board: Board) -> str:
    return "".join("X" if board[0] >> cell & 1 else "O" if board[1] >> cell & 1 else "." for cell in _CELLS)

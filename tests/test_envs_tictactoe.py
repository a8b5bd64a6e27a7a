"""Tic-tac-toe against a recursion over strings that shares nothing with the model, and against published shares.

Mutants that die here: a line of cells missing; the opponent blocking before it wins, or blocking at random cells; a
draw paid as a loss; a game that goes on after a win; O's first position without X's opening; an "optimal" opponent that
keeps only wins.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest

from neuralq.mdp import FiniteMDP
from neuralq_envs import tictactoe

LINES = [(0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6)]
Shares = tuple[float, float, float]  # win, draw and loss of the learner


def winner(board: str) -> str | None:
    """X or O if there is a line, "" for a full board, None for a game that goes on."""
    for i, j, k in LINES:
        if board[i] == board[j] == board[k] != ".":
            return board[i]
    return None if "." in board else ""


def mover(board: str) -> str:
    return "XO"[board.count("X") - board.count("O")]


def play(board: str, cell: int) -> str:
    return board[:cell] + mover(board) + board[cell + 1 :]


def free(board: str) -> list[int]:
    return [i for i in range(9) if board[i] == "."]


@functools.cache
def worth(board: str) -> int:
    """1 if X wins with perfect play of both, −1 if O does."""
    if (won := winner(board)) is not None:
        return {"X": 1, "O": -1, "": 0}[won]
    best = max if mover(board) == "X" else min
    return best(worth(play(board, cell)) for cell in free(board))


def answers(board: str, opponent: str) -> list[int]:
    me, cells = mover(board), free(board)
    if opponent == "optimal":
        return [cell for cell in cells if worth(play(board, cell)) == worth(board)]
    if opponent == "forced":
        for sign in (me, "XO"[me == "X"]):
            found = [cell for cell in cells if winner(board[:cell] + sign + board[cell + 1 :]) == sign]
            if found:
                return found
    return cells


def game(opponent: str, player: str, choose: Callable[[list[Shares]], Shares]) -> Callable[[str], Shares]:
    """Shares of win, draw and loss from a position, if the learner picks among its moves' shares by ``choose``."""

    @functools.cache
    def shares(board: str) -> Shares:
        if (won := winner(board)) is not None:
            return (float(won == player), float(won == ""), float(won not in ("", player)))
        if mover(board) == player:
            return choose([shares(play(board, cell)) for cell in free(board)])
        return average([shares(play(board, cell)) for cell in answers(board, opponent)])

    return shares


def average(shares: list[Shares]) -> Shares:
    win, draw, loss = np.mean(shares, axis=0).tolist()
    return win, draw, loss


def best(shares: list[Shares]) -> Shares:
    """The first with the largest difference of win and loss; rounded, for ties must not be broken by the last bit."""
    return max(shares, key=lambda share: round(share[0] - share[2], 12))


@functools.cache
def boards() -> list[str]:
    return ["".join(".XO"[mark] for mark in position) for position in tictactoe.positions()]


def solved(model: FiniteMDP) -> np.ndarray:
    """V* by value iteration: no game takes more than five moves of the learner."""
    v, lively = np.zeros(model.num_states), np.flatnonzero(~model.is_terminal)
    for _ in range(6):
        v[lively] = np.maximum.reduceat(model.reward + model.transition @ v, model.row_starts[lively])
    return v


def test_play_reaches_5478_positions() -> None:
    found, frontier = {"." * 9}, ["." * 9]
    while frontier:
        board = frontier.pop()
        if winner(board) is None:
            new = {play(board, cell) for cell in free(board)} - found
            found |= new
            frontier += new
    assert len(found) == 5478 == len(tictactoe.positions())
    assert set(boards()) == found
    assert boards()[0] == "." * 9


def test_the_minimax_values_are_those_of_the_recursion() -> None:
    assert tictactoe.minimax_values().tolist() == [worth(board) for board in boards()]
    assert tictactoe.minimax_values()[0] == 0  # a draw


@pytest.mark.parametrize("player", ["X", "O"])
@pytest.mark.parametrize("opponent", tictactoe.OPPONENTS)
def test_the_model_has_the_values_of_the_recursion_everywhere(opponent: str, player: str) -> None:
    model = tictactoe.mdp(opponent, player)
    expected = game(opponent, player, best)
    v = solved(model)
    for s, board in enumerate(boards()):
        moves = free(board) if winner(board) is None and mover(board) == player else []
        assert np.flatnonzero(model.legal[s]).tolist() == moves if s % 50 == 0 else True
        assert model.is_terminal[s] == (not moves)
        if moves:
            win, _, loss = expected(board)
            assert v[s] == pytest.approx(win - loss, abs=1e-12)
    begin = expected("." * 9)
    assert v @ model.start_distribution == pytest.approx(begin[0] - begin[2], abs=1e-12)


# Win, draw and loss of the learner; computed by exhaustive enumeration. Of the best answer to a random opponent as O
# only win − loss = .92487 is unique: the shares are those of the lowest of the best cells.
@pytest.mark.parametrize(
    ("opponent", "player", "choose", "published"),
    [
        ("random", "X", best, (0.99479, 0.00521, 0.0)),
        ("random", "O", best, (0.93228, 0.06032, 0.00741)),
        pytest.param("random", "X", average, (0.58492, 0.12698, 0.28810), marks=pytest.mark.slow),
        pytest.param("random", "O", average, (0.28810, 0.12698, 0.58492), marks=pytest.mark.slow),
        pytest.param("optimal", "X", best, (0.0, 1.0, 0.0), marks=pytest.mark.slow),
        ("optimal", "O", best, (0.0, 1.0, 0.0)),
        ("optimal", "O", average, (0.0, 0.03219, 0.96781)),
        ("optimal", "X", average, (0.0, 0.22252, 0.77748)),
    ],
)
def test_the_shares_of_win_draw_and_loss_are_the_published_ones(
    opponent: str, player: str, choose: Callable[[list[Shares]], Shares], published: Shares
) -> None:
    model = tictactoe.mdp(opponent, player)
    lively = np.flatnonzero(~model.is_terminal)
    if choose is best:
        q = model.reward + model.transition @ solved(model)
        top = np.repeat(np.maximum.reduceat(q, model.row_starts[lively]), np.diff(model.row_starts)[lively])
        policy = np.unique(model.s_tm1[q >= top - 1e-12], return_index=True)[1]
        weight = np.zeros(model.num_rows)
        weight[np.flatnonzero(q >= top - 1e-12)[policy]] = 1.0
    else:
        weight = np.ones(model.num_rows)
    share = np.add.reduceat(weight, model.row_starts[lively])
    for i, expected in enumerate(published):
        v, reward = np.zeros(model.num_states), np.eye(3)[i]
        of_share = tictactoe.mdp(opponent, player, *reward)  # pays 1 for this result only
        for _ in range(6):
            q = weight * (of_share.reward + of_share.transition @ v)
            v[lively] = np.add.reduceat(q, model.row_starts[lively]) / share
        assert v @ model.start_distribution == pytest.approx(expected, abs=5.1e-6)
        assert game(opponent, player, choose)("." * 9)[i] == pytest.approx(expected, abs=5.1e-6)


def number(board: str) -> int:
    return boards().index(board)


def answered(opponent: str, board: str, cell: int) -> dict[str, float]:
    """The positions that may follow the learner's move, with their probabilities; the learner is X."""
    model = tictactoe.mdp(opponent, "X")
    assert model.outcomes is not None
    row = int(model.row_index[number(board), cell])
    first, last = model.outcomes.indptr[row : row + 2]
    found = zip(model.outcomes.s_t[first:last], model.outcomes.probability[first:last], strict=True)
    return {boards()[s_t]: float(p) for s_t, p in found}


def test_the_opponent_takes_forced_moves_and_wins_rather_than_blocks() -> None:
    # O can win at 5; X threatens 2. O wins.
    assert answered("forced", "X..OO...X", 1) == {"XX.OOO..X": 1.0}
    # X threatens 2 only: O blocks there.
    assert answered("forced", "X...O....", 1) == {"XXO.O....": 1.0}
    # X threatens 4 and 7, O nothing: O blocks either.
    assert answered("forced", "XO.O....X", 6) == {"XO.OO.X.X": 0.5, "XO.O..XOX": 0.5}
    assert answered("forced", ".........", 4) == {
        board: 0.125 for board in (play("....X....", cell) for cell in (0, 1, 2, 3, 5, 6, 7, 8))
    }
    assert answered("random", "X...O....", 1) == {
        board: pytest.approx(1 / 6) for board in (play("XX..O....", cell) for cell in (2, 3, 5, 6, 7, 8))
    }


def test_a_game_is_played_to_its_end_and_paid_for() -> None:
    env = gymnasium.make("neuralq/TicTacToe-v0", render_mode="ansi", opponent="forced").unwrapped
    s, extra = env.reset(seed=0, options={"state": number("XX.OO....")})
    assert extra["action_mask"].tolist() == [0, 0, 1, 0, 0, 1, 1, 1, 1]
    assert env.step(2)[1:3] == (1.0, True) and env.render() == "X X X\nO O .\n. . .\n"
    env.reset(options={"state": s})
    s_t, reward, terminated, _, _ = env.step(8)
    assert (reward, terminated, boards()[s_t]) == (-1.0, True, "XX.OOO..X")
    env.reset(options={"state": number("XOXXOO.XO")})
    s_t, reward, terminated, _, extra = env.step(6)
    assert (reward, terminated) == (1.0, True) and extra["action_mask"].sum() == 0
    full = gymnasium.make("neuralq/TicTacToe-v0", draw_reward=0.5).unwrapped
    full.reset(options={"state": number("XOXXOOO.X")})
    assert full.step(7)[1:3] == (0.5, True)


def test_playing_o_x_has_opened() -> None:
    env = gymnasium.make("neuralq/TicTacToe-v0", opponent="random", player="O").unwrapped
    seen = {boards()[env.reset(seed=seed)[0]] for seed in range(80)}
    assert seen == {play("." * 9, cell) for cell in range(9)}
    optimal = tictactoe.mdp("optimal", "O").start_distribution
    assert np.flatnonzero(optimal).size == 9  # every opening keeps the draw


def test_bad_games_are_refused() -> None:
    for wrong, message in (
        ({"opponent": "sleepy"}, "opponent must be one of"),
        ({"player": "x"}, "player must be one of"),
        ({"loss_reward": float("-inf")}, "rewards must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            tictactoe.make(**wrong)  # type: ignore[arg-type]
    assert tictactoe.BoardScene().pixels(None).shape == (144, 144, 3)

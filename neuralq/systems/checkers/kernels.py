"""Games of checkers in one compiled loop: learned from backed-up scores, remembered by rote, or only played."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.systems.checkers.memory import Memory, remember
from neuralq.systems.checkers.search import WIN, Desk, search
from neuralq.systems.checkers.terms import NUM_TERMS, write_terms
from neuralq.tabular.kernels.backups import BackupRule, backup_update
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.checkers.rules import START, bit_count, moves

__all__ = ["Game", "Program", "learn", "new_game", "play", "play_out", "play_pairs", "play_positions", "set_up"]


class Program(NamedTuple):
    """Who plays.

    Args:
        weights: of the terms, ``[14]``.
        depth: plies of look-ahead; 0 moves at random.
        ply_penalty: what a win loses for each ply that it is away.
        epsilon: chance that a move is drawn at random.
        remembers: whether every position that it searches is put into its memory.
        memory: of positions; an empty one for none.
        desk: what it works on; its counts go on as long as it lasts.
    """

    weights: NDArray[np.float64]
    depth: int
    ply_penalty: float
    epsilon: float
    remembers: bool
    memory: Memory
    desk: Desk


class Game(NamedTuple):
    """A game as it stands.

    Args:
        board: own, other, kings of the side to move, ``[3]``.
        counts: plies played, and plies since the last capture or move of a man, ``[2]``.
    """

    board: NDArray[np.int64]
    counts: NDArray[np.int64]


def new_game() -> Game:
    """From the beginning.

    Example:
        >>> new_game().counts.tolist()
        [0, 0]
    """
    return Game(np.array(START, np.int64), np.zeros(2, np.int64))


@lean_kernel
def set_up(game: Game, own: int, other: int, kings: int) -> None:
    """Starts from this board.

    Example:
        >>> game = new_game()
        >>> set_up(game, 1, 1 << 9, 0)
        >>> game.board.tolist()
        [1, 512, 0]
    """
    game.board[0], game.board[1], game.board[2] = own, other, kings
    game.counts[0] = game.counts[1] = 0


@lean_kernel
def play(game: Game, own: int, other: int, kings: int, source: int) -> None:
    """Goes on to the board that a move leaves, as the other side meets it; ``source`` is where the piece stood."""
    is_quiet = game.board[2] & source and bit_count(own) == bit_count(game.board[1])
    game.counts[0] += 1
    game.counts[1] = game.counts[1] + 1 if is_quiet else 0
    game.board[0], game.board[1], game.board[2] = own, other, kings


@lean_kernel
def _look(game: Game, program: Program, rng: NDArray[np.uint64]) -> float:
    """The score of the position, −100 if there is no move, 0 if the program does not look; `Desk.moves` are written."""
    own, other, kings, desk = game.board[0], game.board[1], game.board[2], program.desk
    if program.depth == 0:
        desk.at[0, 0] = moves(own, other, kings, desk.moves[0])
        return 0.0 if desk.at[0, 0] > 0 else -WIN
    score = search(own, other, kings, program.depth, program.weights, program.ply_penalty, program.memory, desk, rng)
    if program.remembers and desk.at[0, 0] > 0:
        remember(program.memory, own, other, kings, program.depth, score)
    return score


@lean_kernel
def _move(game: Game, program: Program, score: float, rng: NDArray[np.uint64]) -> None:
    """Plays the best of the moves that have just been looked at, or one at random."""
    chosen, desk = 0, program.desk
    if program.depth == 0 or (program.epsilon > 0.0 and uniform(rng) < program.epsilon):
        chosen = int(desk.at[0, 0] * uniform(rng))
    else:
        while desk.scores[chosen] != score:
            chosen += 1
    found = desk.moves[0, chosen]
    play(game, found[0], found[1], found[2], found[3])


@lean_kernel
def _open(game: Game, num_plies: int, desk: Desk, rng: NDArray[np.uint64]) -> None:
    """A new game, after so many moves at random."""
    set_up(game, START[0], START[1], START[2])
    for _ in range(num_plies):
        count = moves(game.board[0], game.board[1], game.board[2], desk.moves[0])
        if count > 0:
            found = desk.moves[0, int(count * uniform(rng))]
            play(game, found[0], found[1], found[2], found[3])


@lean_kernel
def play_out(game: Game, first: Program, second: Program, most_quiet_plies: int, rng: NDArray[np.uint64]) -> int:
    """Plays a game to its end: 1 if ``first``, who is to move, wins, −1 if it loses, 0 for a draw.

    Args:
        game: changed in place.
        first: who is to move.
        second: the other side.
        most_quiet_plies: plies without a capture or a move of a man after which it is a draw.
        rng: draws among equal moves, and moves at random.
    """
    start = game.counts[0]
    while game.counts[1] < most_quiet_plies:
        if (game.counts[0] - start) % 2 == 0:
            score = _look(game, first, rng)
            if first.desk.at[0, 0] == 0:
                return -1
            _move(game, first, score, rng)
        else:
            score = _look(game, second, rng)
            if second.desk.at[0, 0] == 0:
                return 1
            _move(game, second, score, rng)
    return 0


@lean_kernel
def play_pairs(
    game: Game,
    first: Program,
    second: Program,
    opening_plies: int,
    most_quiet_plies: int,
    openings: NDArray[np.uint64],
    rng: NDArray[np.uint64],
    results: NDArray[np.int64],
) -> None:
    """Openings at random, each played twice, so that either program has either side of it.

    Args:
        game: overwritten.
        first: whose results are counted.
        second: its opponent.
        opening_plies: moves at random before a game.
        most_quiet_plies: after which a game is a draw.
        openings: draws them.
        rng: draws among equal moves.
        results: ``[N, 2]``; written: 1, 0 or −1 for ``first``, when it moves first after the opening and when second.
    """
    for i in range(len(results)):
        _open(game, opening_plies, first.desk, openings)
        own, other, kings = game.board[0], game.board[1], game.board[2]
        results[i, 0] = play_out(game, first, second, most_quiet_plies, rng)
        set_up(game, own, other, kings)
        results[i, 1] = -play_out(game, second, first, most_quiet_plies, rng)


@lean_kernel
def play_positions(
    game: Game,
    positions: NDArray[np.int64],
    first: Program,
    second: Program,
    most_quiet_plies: int,
    rng: NDArray[np.uint64],
    results: NDArray[np.int64],
    plies: NDArray[np.int64],
) -> None:
    """Plays positions to their end, ``first`` to move in all of them.

    Args:
        game: overwritten.
        positions: own, other and kings, ``[N, 3]``.
        first: whose results are counted.
        second: its opponent.
        most_quiet_plies: after which a game is a draw.
        rng: draws among equal moves, and moves at random.
        results: ``[N]``; written: 1, 0 or −1 for ``first``.
        plies: ``[N]``; written: how long each took.
    """
    for i in range(len(positions)):
        set_up(game, positions[i, 0], positions[i, 1], positions[i, 2])
        results[i] = play_out(game, first, second, most_quiet_plies, rng)
        plies[i] = game.counts[0]


@lean_kernel
def learn(
    game: Game,
    program: Program,
    rule: BackupRule,
    first_step_size: float,
    last_step_size: float,
    opening_plies: int,
    most_quiet_plies: int,
    rng: NDArray[np.uint64],
    history: NDArray[np.float64],
    earlier: NDArray[np.float64],
) -> None:
    """Games with itself: at each turn the side's position before is told what the search says now.

    Args:
        game: overwritten.
        program: who plays both sides; its weights are changed in place.
        rule: how a backed-up score corrects the weights.
        first_step_size: α of the first game; it falls geometrically.
        last_step_size: α of the last one.
        opening_plies: moves at random before each game.
        most_quiet_plies: after which a game is a draw.
        rng: draws openings, moves at random, and among equal ones.
        history: weights after each game, ``[N, 14]``; written.
        earlier: room for the terms of either side's last position, ``[2, 14]``.
    """
    num_games = len(history)
    for i in range(num_games):
        step_size = first_step_size * (last_step_size / first_step_size) ** (i / max(num_games - 1, 1))
        _open(game, opening_plies, program.desk, rng)
        start = game.counts[0]
        while game.counts[1] < most_quiet_plies:
            side = (game.counts[0] - start) % 2
            score = _look(game, program, rng)
            if game.counts[0] - start >= 2:
                backup_update(program.weights, rule, earlier[side], score, step_size)
            if program.desk.at[0, 0] == 0:
                break
            write_terms(game.board[0], game.board[1], game.board[2], earlier[side])
            _move(game, program, score, rng)
        for k in range(NUM_TERMS):
            history[i, k] = program.weights[k]

"""TD(λ) for backgammon once more, slow and readable, in NumPy; and the compiled kernels, called in one line.

The slow version computes all 198 inputs, chooses among `Position.afterstates`, derives gradients by the chain rule as
one reads it, keeps the whole trace, and takes each return from its definition.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neuralq.systems.backgammon import ValueNetwork, learning_kernels
from neuralq.systems.backgammon.kernels import choose
from neuralq.systems.backgammon.network import equities
from neuralq.systems.backgammon.torch_engine import Games, TorchValues, play_in_lockstep
from neuralq_envs.backgammon import Position
from neuralq_envs.backgammon.inputs import NUM_INPUTS, tesauro_dense
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES, START, afterstates, result

Array = np.ndarray


def sigmoid(z: Array) -> Array:
    return 1.0 / (1.0 + np.exp(-z.astype(np.float64)))


def inputs_of(boards: Array) -> Array:
    x = np.ones((len(boards), NUM_INPUTS + 1))  # the last is the constant
    for row, board in zip(x, boards, strict=True):
        tesauro_dense(board, 0, row[:NUM_INPUTS])
    return x


def slow_outputs(net: ValueNetwork, boards: Array) -> tuple[Array, Array]:
    h = sigmoid(inputs_of(boards) @ net.w.astype(np.float64))
    return sigmoid(h @ net.v.T.astype(np.float64) + net.c), h


def slow_gradients(net: ValueNetwork, board: Array) -> tuple[Array, Array]:
    """The outputs ``[K]`` and their gradients ``[K, d]``, in the order of ``net.flat``."""
    x = inputs_of(board[None])[0]
    y, h = (values[0] for values in slow_outputs(net, board[None]))
    grads = []
    for k in range(net.num_outputs):
        slope = y[k] * (1 - y[k])
        gw = slope * np.outer(x, net.v[k] * h * (1 - h))
        gv, gc = np.zeros_like(net.v), np.zeros_like(net.c)
        gv[k], gc[k] = slope * h, slope
        grads.append(np.concatenate([gw.ravel(), gv.ravel(), gc]))
    return y, np.stack(grads)


def seen_by_first(y: Array, first_moves: bool, by: int | None = None) -> Array:
    if first_moves:
        return y
    by = len(y) // 2 if by is None else by
    return 1.0 - y if len(y) == 1 else y[[(k + by) % len(y) for k in range(len(y))]]


def gradients_seen_by_first(grads: Array, first_moves: bool, by: int | None = None) -> Array:
    return -grads if len(grads) == 1 and not first_moves else seen_by_first(grads, first_moves, by)


def slow_outcome(points: int, num_outputs: int) -> Array:
    if num_outputs == 1:
        return np.array([float(points > 0)])
    if num_outputs == 4:
        return np.eye(4)[{1: 0, 2: 1, 3: 1, -1: 2, -2: 3, -3: 3}[points]]  # a backgammon counts as a gammon
    return np.eye(6)[{1: 0, 2: 1, 3: 2, -1: 3, -2: 4, -3: 5}[points]]


def slow_choice(net: ValueNetwork, position: Position, dice: tuple[int, int]) -> Position:
    afters = position.afterstates(dice)
    expected = equities(slow_outputs(net, np.stack([after.board for after in afters]))[0])
    for i, after in enumerate(afters):
        if after.winner is not None:
            expected[i] = -after.points
    return afters[int(np.argmin(expected))]


def slow_roll(rng: np.random.Generator, opening: bool) -> tuple[int, int]:
    while True:
        dice = 1 + int(6 * rng.random()), 1 + int(6 * rng.random())
        if not (opening and dice[0] == dice[1]):
            return dice


def slow_game(net: ValueNetwork, rng: np.random.Generator) -> Iterator[tuple[Position, Position]]:
    """Each turn's position before and after; the weights may change meanwhile. Player 0 begins."""
    position = Position.initial()
    while position.winner is None:
        after = slow_choice(net, position, slow_roll(rng, position == Position.initial()))
        yield position, after
        position = after


def points_of_first(position: Position) -> int:
    return position.points if position.winner == 0 else -position.points


def slow_online(
    net: ValueNetwork,
    rates: Array,
    lambda_: float,
    rng: np.random.Generator,
    *,
    by: int | None = None,
    keep: bool = False,
) -> None:
    """Backward view. ``by`` and ``keep`` are mistakes: another change of view, traces kept between games."""
    z = np.zeros((net.num_outputs, net.flat.size))
    for rate in rates:
        z = z if keep else np.zeros_like(z)
        for position, after in slow_game(net, rng):
            y, grads = slow_gradients(net, position.board)
            z = lambda_ * z + gradients_seen_by_first(grads, position.turn == 0, by)
            if after.winner is None:
                target = seen_by_first(slow_outputs(net, after.board[None])[0][0], after.turn == 0, by)
            else:
                target = slow_outcome(points_of_first(after), net.num_outputs)
            net.flat += rate * ((target - seen_by_first(y, position.turn == 0, by)) @ z)


def slow_batch(net: ValueNetwork, num_games: int, lambda_: float, rng: np.random.Generator) -> Array:
    """Forward view, each return from its definition: a weighted mean of all values to come and of the outcome."""
    total = np.zeros(net.flat.size)
    for _ in range(num_games):
        game = list(slow_game(net, rng))
        pairs = [slow_gradients(net, position.board) for position, _ in game]
        v = [seen_by_first(y, t % 2 == 0) for t, (y, _) in enumerate(pairs)]
        v.append(slow_outcome(points_of_first(game[-1][1]), net.num_outputs))
        last = len(game)
        for t, (_, grads) in enumerate(pairs):
            g = lambda_ ** (last - t - 1) * v[last]
            for n in range(1, last - t):
                g = g + (1 - lambda_) * lambda_ ** (n - 1) * v[t + n]
            total += (g - v[t]) @ gradients_seen_by_first(grads, t % 2 == 0)
    return total


# The kernels, called in one line.


def drawn(num_outputs: int, num_hidden: int = 5, seed: int = 1, dtype: type = np.float64) -> ValueNetwork:
    return ValueNetwork.drawn(num_hidden, num_outputs, np.random.default_rng(seed), scale=0.3, dtype=dtype)


def online(net: ValueNetwork, rates: Array, lambda_: float, rng: np.random.Generator) -> Array:
    tally = np.zeros(4, np.int64)
    lambdas = np.full(len(rates), lambda_)
    learning_kernels.play_online(rates, lambdas, rng, net.w, net.v, net.c, net.scratch, tally)
    return tally


def batch(net: ValueNetwork, num_games: int, lambda_: float, rng: np.random.Generator) -> tuple[Array, Array]:
    sums, tally = ValueNetwork(net.num_hidden, net.num_outputs, net.dtype), np.zeros(4, np.int64)
    learning_kernels.play_batch(
        num_games, lambda_, rng, net.w, net.v, net.c, sums.w, sums.v, sums.c, net.scratch, tally
    )  # fmt: skip
    return sums.flat, tally


def boards_of_random_games(num_boards: int, rng: np.random.Generator) -> Array:
    """All afterstates met on the way through random games, finished ones too."""
    found, board, room = [], START.copy(), np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    total = 0
    while total < num_boards:
        count = afterstates(board, int(rng.integers(1, 7)), int(rng.integers(1, 7)), room)
        found.append(room[:count].copy())
        total += count
        board = room[rng.integers(count)].copy()
        if result(board) != 0:
            board = START.copy()
    return np.concatenate(found)[:num_boards]


def worst(a: Array, b: Array) -> float:
    return float(np.abs(a - b).max())


def best_afterstate(net: ValueNetwork, board: Array, die_1: int, die_2: int) -> Array:
    """The board that the compiled choice leaves to the other side."""
    count = afterstates(board, die_1, die_2, net.scratch.boards)
    return net.scratch.boards[choose(count, net.w, net.v, net.c, net.scratch)].copy()


def play_in_turn(values: TorchValues, num_games: int, rng: np.random.Generator) -> Games:
    """One game after another from one generator: the games that the kernel `play_batch` plays."""
    games = [play_in_lockstep(values, [rng]) for _ in range(num_games)]
    num_turns = np.concatenate([game.num_turns for game in games])
    boards = np.zeros((num_turns.max(), num_games, 2, 25), np.int8)
    for i, game in enumerate(games):
        boards[: len(game.boards), i] = game.boards[:, 0]
    return Games(boards, num_turns, np.concatenate([game.points for game in games]))

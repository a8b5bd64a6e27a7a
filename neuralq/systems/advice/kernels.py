"""Game after game of Pengo, learned by one-step Q-learning with a softmax policy, in one compiled loop."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.learners import SmdpNetwork, smdp_network_update, smdp_network_values
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.pengo_kernels import Game, deal, look, play

__all__ = ["MOST_STEPS", "Room", "learn_games", "play_games"]

MOST_STEPS = 60
"""Of a game."""


class Room(NamedTuple):
    """What a game needs beside itself.

    Args:
        x_tm1: what was seen before an action, ``[44]``.
        x_t: and after it, ``[44]``.
        dealt: numbers for a board, ``[48]``.
        drawn: numbers for the enemies, ``[4]``.
    """

    x_tm1: NDArray[np.float64]
    x_t: NDArray[np.float64]
    dealt: NDArray[np.float64]
    drawn: NDArray[np.float64]


@lean_kernel
def learn_games(
    network: SmdpNetwork,
    game: Game,
    room: Room,
    step_size: float,
    gamma: float,
    temperatures: NDArray[np.float64],
    rng: NDArray[np.uint64],
) -> int:
    """A game for each of the temperatures; returns the number of steps.

    Args:
        network: changed in place.
        game: written over.
        room: written over.
        step_size: α.
        gamma: γ.
        temperatures: of the softmax in each game.
        rng: a stream; advanced.
    """
    rate, total = -math.log(gamma), 0
    for temperature in temperatures:
        _begin(game, room.dealt, rng)
        look(game, room.x_tm1)
        smdp_network_values(network, room.x_tm1)
        action, over, steps = _drawn(network.q, temperature, rng), False, 0
        while not over and steps < MOST_STEPS:
            _fill(room.drawn, rng)
            reward, over = play(game, action, room.drawn)
            steps += 1
            v_t, following = 0.0, 0
            if not over:
                look(game, room.x_t)
                smdp_network_values(network, room.x_t)
                v_t = network.q[_best(network.q)]
                following = _drawn(network.q, temperature, rng)
            smdp_network_update(network, room.x_tm1, action, reward, 1.0, rate, v_t, step_size, np.inf)
            action = following
            for i in range(len(room.x_t)):
                room.x_tm1[i] = room.x_t[i]
        total += steps
    return total


@lean_kernel
def play_games(
    network: SmdpNetwork, game: Game, room: Room, returns: NDArray[np.float64], seen: NDArray[np.float64],
    rng: NDArray[np.uint64],
) -> int:  # fmt: skip
    """Greedy games, one for each return, which is written; and what was seen in them, as far as there is room.

    Returns:
        The number of states seen.
    """
    count = 0
    for i in range(len(returns)):
        _begin(game, room.dealt, rng)
        returns[i] = 0.0
        for _ in range(MOST_STEPS):
            look(game, room.x_t)
            smdp_network_values(network, room.x_t)
            if count < len(seen):
                for j in range(len(room.x_t)):
                    seen[count, j] = room.x_t[j]
            count += 1
            _fill(room.drawn, rng)
            reward, over = play(game, _best(network.q), room.drawn)
            returns[i] += reward
            if over:
                break
    return min(count, len(seen))


@lean_kernel
def _begin(game: Game, dealt: NDArray[np.float64], rng: NDArray[np.uint64]) -> None:
    _fill(dealt, rng)
    deal(game, dealt)


@lean_kernel
def _fill(numbers: NDArray[np.float64], rng: NDArray[np.uint64]) -> None:
    for i in range(len(numbers)):
        numbers[i] = uniform(rng)


@lean_kernel
def _best(q: NDArray[np.float64]) -> int:
    """The first of the best."""
    best = 0
    for a in range(1, len(q)):
        if q[a] > q[best]:
            best = a
    return best


@lean_kernel
def _drawn(q: NDArray[np.float64], temperature: float, rng: NDArray[np.uint64]) -> Any:
    """An action with probability proportional to e^(q/T)."""
    most, total = q[_best(q)], 0.0
    for a in range(len(q)):
        total += math.exp((q[a] - most) / temperature)
    left = uniform(rng) * total
    for a in range(len(q)):
        left -= math.exp((q[a] - most) / temperature)
        if left < 0.0:
            return a
    return len(q) - 1

"""One play in Lin's world, compiled: by a network that learns or not, by a teacher, or at random."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.learners.lessons import Lessons, begin_lesson, note_step
from neuralq.learners.turned import TurnedNetwork, turned_action, turned_actor_critic_update, turned_q_update
from neuralq.systems.lin.models import EnemyModel, count_moves, plan
from neuralq.systems.lin.teacher import Plan, advised
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.lin_world.kernels import (
    ATE,
    CLEARED,
    COLUMN,
    ENERGY,
    NUM_MOVES,
    ROW,
    WENT,
    World,
    move,
    reward_of,
    sense,
    settle,
)

__all__ = [
    "ACTOR_CRITIC",
    "FIXED",
    "FRAME",
    "PLANNING",
    "Q_LEARNING",
    "RANDOM",
    "TEACHER",
    "Player",
    "Rates",
    "Room",
    "play",
]

Q_LEARNING, PLANNING, ACTOR_CRITIC, FIXED, TEACHER, RANDOM = range(6)
"""Who plays; the first three learn while they do, `FIXED` is a network that does not."""
FRAME = 5
"""Numbers of a frame of a film before the enemies' places: the agent's row, column and energy, what came of the last
step, the food that was left."""


class Rates(NamedTuple):
    """Constants of the learners.

    Args:
        step_size: α of values.
        merit_step_size: α of merits.
        critic_step_size: α of the critic.
        gamma: γ.
        least_chance: actions of a smaller probability are not learned about in replays and plans.
    """

    step_size: float = 0.3
    merit_step_size: float = 0.2
    critic_step_size: float = 0.1
    gamma: float = 0.9
    least_chance: float = 0.01


class Player(NamedTuple):
    """Who acts.

    Args:
        kind: `Q_LEARNING`, `PLANNING`, `ACTOR_CRITIC`, `FIXED`, `TEACHER` or `RANDOM`.
        network: of values or merits.
        critic: of the actor-critic.
        rates: constants of the learners.
    """

    kind: int
    network: TurnedNetwork
    critic: TurnedNetwork
    rates: Rates


class Room(NamedTuple):
    """What a play needs room for.

    Args:
        food: numbers that say where food is, ``[15]``.
        moves: numbers of the enemies' moves, ``[8]``.
        x_tm1: what was seen, ``[145]``.
        x_t: what is seen, ``[145]``.
        plan: the teacher's.
        model: of who plans.
    """

    food: NDArray[np.float64]
    moves: NDArray[np.float64]
    x_tm1: NDArray[np.int8]
    x_t: NDArray[np.int8]
    plan: Plan
    model: EnemyModel


@lean_kernel
def play(
    world: World,
    player: Player,
    temperature: float,
    lessons: Lessons,
    room: Room,
    boards: NDArray[np.uint64],
    rng: NDArray[np.uint64],
    film: NDArray[np.int64],
    bits: NDArray[np.int8],
) -> int:
    """Plays once from the start to the end, and says how much food was eaten.

    Args:
        world: changed.
        player: who acts; its network is changed where it learns.
        temperature: of a network's policy; 0 for the best action.
        lessons: where the play is kept, unless a `FIXED` network or a `RANDOM` player acts.
        room: written.
        boards: the stream that says where food is; advanced.
        rng: the stream of all other draws; advanced.
        film: the first states of the play, ``[F, 5 + 2 E]``; written.
        bits: what was seen in them, ``[F, 145]``; written.
    """
    for i in range(len(room.food)):
        room.food[i] = uniform(boards)
    settle(world, room.food)
    sense(world, room.x_t)
    keeps = player.kind not in (FIXED, RANDOM)
    if keeps:
        begin_lesson(lessons, room.x_t)
    eaten, steps, found = 0, 0, WENT
    while found <= ATE:
        if steps < len(film):
            _shoot(world, found, film[steps])
            _copy(room.x_t, bits[steps])
        _copy(room.x_t, room.x_tm1)
        action = _chosen(world, player, temperature, room, rng)
        rate = player.rates.step_size
        if player.kind == PLANNING:
            least, gamma = player.rates.least_chance, player.rates.gamma
            plan(room.model, world, player.network, room.x_tm1, action, temperature, least, rate, gamma, rng)
            for i in range(len(world.enemies)):
                room.model.before[i, 0], room.model.before[i, 1] = world.enemies[i, 0], world.enemies[i, 1]
        for i in range(len(room.moves)):
            room.moves[i] = uniform(rng)
        found = move(world, action, room.moves)
        if player.kind == PLANNING:
            count_moves(room.model, world)
        sense(world, room.x_t)
        eaten += found in (ATE, CLEARED)
        steps += 1
        reward, discount = reward_of(found), player.rates.gamma if found <= ATE else 0.0
        if keeps:
            note_step(lessons, action, reward, discount, room.x_t)
        if player.kind in (Q_LEARNING, PLANNING):
            turned_q_update(player.network, room.x_tm1, action, reward, discount, room.x_t, rate)
        elif player.kind == ACTOR_CRITIC:
            turned_actor_critic_update(
                player.network, player.critic, room.x_tm1, action, reward, discount, room.x_t,
                player.rates.merit_step_size, player.rates.critic_step_size,
            )  # fmt: skip
    if steps < len(film):
        _shoot(world, found, film[steps])
        _copy(room.x_t, bits[steps])
    return eaten


@lean_kernel
def _chosen(world: World, player: Player, temperature: float, room: Room, rng: NDArray[np.uint64]) -> int:
    if player.kind == TEACHER:
        return advised(world, room.plan)
    if player.kind == RANDOM:
        return int(NUM_MOVES * uniform(rng))
    return int(turned_action(player.network, room.x_tm1, temperature, rng))


@lean_kernel
def _copy(source: NDArray[np.int8], to: NDArray[np.int8]) -> None:
    for i in range(len(source)):
        to[i] = source[i]


@lean_kernel
def _shoot(world: World, found: int, shot: NDArray[np.int64]) -> None:
    shot[0], shot[1], shot[2] = world.agent[ROW], world.agent[COLUMN], world.agent[ENERGY]
    shot[3], shot[4] = found, world.agent[5]
    for i in range(len(world.enemies)):
        shot[FRAME + 2 * i], shot[FRAME + 2 * i + 1] = world.enemies[i, 0], world.enemies[i, 1]

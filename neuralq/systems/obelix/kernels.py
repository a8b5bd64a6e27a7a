"""The robot's life in one compiled loop: one learner for all it does, or three behaviours in an order of precedence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.bits import BitMemory, bit_update, bit_values
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.obelix_kernels import BUMP, FORWARD, FRONT_NEAR, NUM_MOVES, STUCK, Room, move, sense, settle

__all__ = ["BEHAVIOURS", "FIND", "HAND", "MONOLITH", "PUSH", "RANDOM", "UNWEDGE", "Rates", "live"]

MONOLITH, BEHAVIOURS, HAND, RANDOM = range(4)
"""Who is in control."""
FIND, PUSH, UNWEDGE = range(3)
"""Behaviours; the later takes precedence where both apply."""
_MEMORY_STEPS = 3  # moves after a push, or after being refused, for which a behaviour goes on


class Rates(NamedTuple):
    """Constants of the learner (Mahadevan & Connell 1992).

    Args:
        step_size: α.
        gamma: γ.
        epsilon: how often a move is drawn.
    """

    step_size: float = 0.5
    gamma: float = 0.9
    epsilon: float = 0.1


@lean_kernel
def live(
    control: int,
    memories: tuple[BitMemory, BitMemory, BitMemory],
    rates: Rates,
    room: Room,
    rng: NDArray[np.uint64],
    trial_steps: int,
    drawn: NDArray[np.float64],
    values: NDArray[np.float64],
    pushed: NDArray[np.bool_],
    first_filmed: int,
    film: NDArray[np.float64],
) -> None:
    """As many steps as ``pushed`` has room for; every trial begins in another room.

    Args:
        control: `MONOLITH`, `BEHAVIOURS`, `HAND` or `RANDOM`.
        memories: of `FIND`, `PUSH` and `UNWEDGE`; the monolith's is the first. Changed in place.
        rates: of the learner.
        room: written.
        rng: a stream; advanced.
        trial_steps: steps of a trial.
        drawn: room for 11 numbers.
        values: room for 5 numbers.
        pushed: whether a box was pushed, by step; written.
        first_filmed: step from which it is filmed.
        film: robot (3), boxes (8), behaviour and bits of each step filmed, ``[F, 13]``; written.
    """
    since_stuck, since_push = _MEMORY_STEPS, _MEMORY_STEPS
    bits, turning = 0, 0
    for step in range(len(pushed)):
        if step % trial_steps == 0:
            _enter(room, rng, drawn)
            bits, turning = sense(room), 0
            since_stuck, since_push = _MEMORY_STEPS, _MEMORY_STEPS
        active = _active(bits, since_stuck, since_push) if control in (BEHAVIOURS, HAND) else FIND
        if control == HAND:
            action, turning = _by_hand(active, bits, turning, rng)
        else:
            action = _choose(memories[active], bits, control == RANDOM, rates.epsilon, values, rng)
        if first_filmed <= step < first_filmed + len(film):
            _shoot(room, active, bits, film[step - first_filmed])
        was, touched = bits, bits & BUMP != 0 or since_push < _MEMORY_STEPS
        moved = move(room, action)
        bits = sense(room)
        pushed[step] = moved
        since_stuck = 0 if bits & STUCK else since_stuck + 1
        since_push = 0 if moved else since_push + 1
        if control in (MONOLITH, BEHAVIOURS):
            for b in range(active + 1):
                if b == FIND or b == active or touched:
                    reward = _reward(control, b, action, moved, bits)
                    target = reward + rates.gamma * bit_values(memories[b], bits, values)
                    bit_update(memories[b], was, action, target, rates.step_size)


@lean_kernel
def _enter(room: Room, rng: NDArray[np.uint64], drawn: NDArray[np.float64]) -> None:
    """Another room, drawn until nothing overlaps."""
    placed = False
    while not placed:
        for i in range(len(drawn)):
            drawn[i] = uniform(rng)
        placed = settle(room, drawn)


@lean_kernel
def _active(bits: int, since_stuck: int, since_push: int) -> int:
    """The behaviour with precedence among those that apply."""
    if bits & STUCK or since_stuck < _MEMORY_STEPS:
        return UNWEDGE
    if bits & BUMP or since_push < _MEMORY_STEPS:
        return PUSH
    return FIND


@lean_kernel
def _choose(
    memory: BitMemory, bits: int, random: bool, epsilon: float, values: NDArray[np.float64], rng: NDArray[np.uint64]
) -> int:
    """The best move, the first of those that tie; with ε, or always, any."""
    if random or uniform(rng) < epsilon:
        return int(NUM_MOVES * uniform(rng))
    best = bit_values(memory, bits, values)
    for a in range(NUM_MOVES):
        if values[a] == best:
            return a
    return 0


@lean_kernel
def _reward(control: int, active: int, action: int, pushed: bool, bits: int) -> float:
    stuck = bits & STUCK != 0
    if control == MONOLITH:
        return 1.0 if pushed else -3.0 if stuck else 0.0
    if active == UNWEDGE:
        return -3.0 if stuck else 1.0
    if active == PUSH:
        return 1.0 if pushed else -3.0
    if action != FORWARD:
        return -1.0
    return 3.0 if bits & FRONT_NEAR and not stuck else -1.0


@lean_kernel
def _by_hand(active: int, bits: int, turning: int, rng: NDArray[np.uint64]) -> tuple[int, int]:
    """What somebody would write down: turn away when stuck, go on when touching, else towards what is near.

    Returns:
        The move, and which way it is turning away (0 for not at all).
    """
    if active == UNWEDGE:
        if turning == 0:
            turning = 3 if uniform(rng) < 0.5 else 4
        return (turning if bits & STUCK or uniform(rng) < 0.5 else FORWARD), turning
    if active == PUSH:
        return FORWARD, 0
    if bits & FRONT_NEAR:
        left, right = bits & (1 << 4 | 1 << 6), bits & (1 << 8 | 1 << 10)
        return (1 if left and not right else 2 if right and not left else FORWARD), 0
    return (FORWARD if uniform(rng) < 0.8 else 1 + int(2 * uniform(rng))), 0


@lean_kernel
def _shoot(room: Room, active: int, bits: int, shot: NDArray[np.float64]) -> None:
    for i in range(3):
        shot[i] = room.robot[i]
    for i in range(len(room.boxes)):
        shot[3 + 2 * i], shot[4 + 2 * i] = room.boxes[i, 0], room.boxes[i, 1]
    shot[11], shot[12] = active, bits

"""Experience replay by whole lessons, as its inventor had it: the latest lessons are lived through again, backwards.

A lesson is an episode. `Lessons` keeps the latest L of them; `recent_lesson` draws one, the later the likelier; and
`replay_q` and `replay_actor_critic` teach a `TurnedNetwork` from its last step to its first, so that a reward reaches
the steps before it in one pass. Steps whose action the present policy would hardly take any more are passed over: what
was good at a time when everything else was different says little.

Lessons need not be one's own. Those that a teacher gave are kept and replayed in the same way, without passing
anything over.

Source: Lin 1992.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.jit import lean_kernel
from neuralq.learners.turned import TurnedNetwork, turned_actor_critic_update, turned_policy, turned_q_update
from neuralq.tabular.kernels.random_numbers import uniform

__all__ = [
    "Lessons",
    "begin_lesson",
    "new_lessons",
    "note_step",
    "recent_lesson",
    "replay_actor_critic",
    "replay_q",
]


class Lessons(NamedTuple):
    """The latest L lessons of at most T steps, in a ring.

    Args:
        x: what was seen before each step and after the last, ``[L, T + 1, I]``; whole numbers within ±127.
        actions: ``[L, T]``.
        rewards: ``[L, T]``.
        discounts: γ, or 0 where the world terminated, ``[L, T]``.
        lengths: steps of each, ``[L]``.
        begun: how many lessons were begun in all, ``[1]``.
    """

    x: NDArray[np.int8]
    actions: NDArray[np.int64]
    rewards: NDArray[np.float64]
    discounts: NDArray[np.float64]
    lengths: NDArray[np.int64]
    begun: NDArray[np.int64]


def new_lessons(num_lessons: int, most_steps: int, num_inputs: int) -> Lessons:
    """Room for so many lessons.

    Args:
        num_lessons: L.
        most_steps: T.
        num_inputs: I.

    Raises:
        ValueError: a size below 1.

    Example:
        >>> new_lessons(100, 250, 145).x.shape
        (100, 251, 145)
    """
    for name, size in (("num_lessons", num_lessons), ("most_steps", most_steps), ("num_inputs", num_inputs)):
        check_whole(name, size)
    shape = (num_lessons, most_steps)
    return Lessons(
        np.zeros((num_lessons, most_steps + 1, num_inputs), np.int8), np.zeros(shape, np.int64), np.zeros(shape),
        np.zeros(shape), np.zeros(num_lessons, np.int64), np.zeros(1, np.int64),
    )  # fmt: skip


@lean_kernel
def begin_lesson(lessons: Lessons, x: NDArray[Any]) -> None:
    """Begins a lesson in the place of the oldest, with what is seen at first, ``[I]``.

    Example:
        >>> lessons = new_lessons(2, 3, 1)
        >>> for first in range(3):
        ...     begin_lesson(lessons, np.array([first]))
        >>> lessons.x[:, 0, 0].tolist(), lessons.begun.tolist()
        ([2, 1], [3])
    """
    slot = lessons.begun[0] % len(lessons.lengths)
    lessons.begun[0] += 1
    lessons.lengths[slot] = 0
    for i in range(len(x)):
        lessons.x[slot, 0, i] = x[i]


@lean_kernel
def note_step(lessons: Lessons, a_tm1: int, r_t: float, discount_t: float, x_t: NDArray[Any]) -> bool:
    """Adds a step to the lesson that was begun last, and says whether there was room for it.

    Example:
        >>> lessons = new_lessons(2, 1, 1)
        >>> begin_lesson(lessons, np.zeros(1))
        >>> note_step(lessons, 0, 1.0, 0.9, np.ones(1)), note_step(lessons, 0, 1.0, 0.9, np.ones(1))
        (True, False)
    """
    slot = (lessons.begun[0] - 1) % len(lessons.lengths)
    step = lessons.lengths[slot]
    if step == lessons.actions.shape[1]:
        return False
    lessons.actions[slot, step], lessons.rewards[slot, step] = a_tm1, r_t
    lessons.discounts[slot, step] = discount_t
    for i in range(len(x_t)):
        lessons.x[slot, step + 1, i] = x_t[i]
    lessons.lengths[slot] = step + 1
    return True


@lean_kernel
def recent_lesson(lessons: Lessons, recency: float, rng: NDArray[np.uint64]) -> Any:
    """The place of a lesson, drawn: of n the k-th latest (from 0) with a probability proportional to e^(−recency k/n).

    Args:
        lessons: at least one.
        recency: how much the latest are preferred; 0 for not at all.
        rng: a stream of `neuralq.tabular.new_stream`; advanced.

    Example:
        >>> from neuralq.tabular import new_stream
        >>> lessons, stream = new_lessons(2, 1, 1), new_stream(0)
        >>> for _ in range(3):
        ...     begin_lesson(lessons, np.zeros(1))
        >>> np.bincount([recent_lesson(lessons, 3.0, stream) for _ in range(1000)]).tolist()  # 0 is the latest
        [810, 190]
    """
    n = min(lessons.begun[0], len(lessons.lengths))
    fade = math.exp(-recency / n)
    total, weight = 0.0, 1.0
    for _ in range(n):
        total += weight
        weight *= fade
    left, weight, k = uniform(rng) * total, 1.0, 0
    while k < n - 1 and left >= weight:
        left -= weight
        weight *= fade
        k += 1
    return (lessons.begun[0] - 1 - k) % len(lessons.lengths)


@lean_kernel
def replay_q(
    network: TurnedNetwork, lessons: Lessons, slot: int, step_size: float, temperature: float, least_chance: float
) -> Any:
    """Q-learning from the last step of a lesson to its first; returns from how many steps was learned.

    Args:
        network: changed in place.
        lessons: where it is.
        slot: its place there.
        step_size: α.
        temperature: of the policy.
        least_chance: steps whose action has a smaller probability than this by now are passed over; 0 for none.

    Example:
        >>> from neuralq.learners import new_turned_network
        >>> lessons, network = new_lessons(1, 9, 1), new_turned_network([[0], [0]], 2, np.random.default_rng(0))
        >>> begin_lesson(lessons, np.ones(1))
        >>> note_step(lessons, 1, 1.0, 0.0, np.ones(1))
        True
        >>> replay_q(network, lessons, 0, 0.1, 0.1, 0.6), replay_q(network, lessons, 0, 0.1, 0.1, 0.0)
        (0, 1)
    """
    learned = 0
    for t in range(lessons.lengths[slot] - 1, -1, -1):
        x, a = lessons.x[slot, t], lessons.actions[slot, t]
        if least_chance <= 0.0 or turned_policy(network, x, a, temperature) >= least_chance:
            discount = lessons.discounts[slot, t]
            turned_q_update(network, x, a, lessons.rewards[slot, t], discount, lessons.x[slot, t + 1], step_size)
            learned += 1
    return learned


@lean_kernel
def replay_actor_critic(
    merits: TurnedNetwork,
    critic: TurnedNetwork,
    lessons: Lessons,
    slot: int,
    merit_step_size: float,
    critic_step_size: float,
    temperature: float,
    least_chance: float,
) -> Any:
    """As `replay_q`, for critic and merits; passing over matters more, for a critic is of the policy that acted.

    Args:
        merits: changed in place.
        critic: changed in place.
        lessons: where the lesson is.
        slot: its place there.
        merit_step_size: α of the merits.
        critic_step_size: α of the critic.
        temperature: of the policy.
        least_chance: steps whose action has a smaller probability than this by now are passed over; 0 for none.

    Example:
        >>> from neuralq.learners import new_turned_network
        >>> lessons, rng = new_lessons(1, 9, 1), np.random.default_rng(0)
        >>> merits, critic = (new_turned_network([[0]] * a, 3, rng, shared=False) for a in (2, 1))
        >>> begin_lesson(lessons, np.ones(1))
        >>> note_step(lessons, 1, 1.0, 0.0, np.ones(1))
        True
        >>> replay_actor_critic(merits, critic, lessons, 0, 0.1, 0.1, 0.1, 0.0)
        1
    """
    learned = 0
    for t in range(lessons.lengths[slot] - 1, -1, -1):
        x, a = lessons.x[slot, t], lessons.actions[slot, t]
        if least_chance <= 0.0 or turned_policy(merits, x, a, temperature) >= least_chance:
            turned_actor_critic_update(
                merits, critic, x, a, lessons.rewards[slot, t], lessons.discounts[slot, t], lessons.x[slot, t + 1],
                merit_step_size, critic_step_size,
            )  # fmt: skip
            learned += 1
    return learned

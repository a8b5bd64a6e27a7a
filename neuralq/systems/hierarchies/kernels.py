"""Trial after trial in the room of landmarks, learned by the library's CQ-L, in one compiled loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.compositional import (
    CompositionalQ,
    CompositionalRates,
    compositional_action,
    compositional_module,
    compositional_update,
    compositional_value,
)
from neuralq.tabular.kernels.random_numbers import uniform

__all__ = ["Path", "RoomArrays", "compositional_trials"]


class RoomArrays(NamedTuple):
    """What a trial needs to know of the room: fields of `neuralq_envs.landmarks.Room`, and what is paid."""

    free: NDArray[np.int64]
    led: NDArray[np.int64]
    first: NDArray[np.int64]
    goals: NDArray[np.int64]
    step_reward: float
    goal_reward: float


class Path(NamedTuple):
    """Room for one stage, each ``[most steps]``."""

    states: NDArray[np.int64]
    actions: NDArray[np.int64]
    rewards: NDArray[np.float64]


@lean_kernel
def compositional_trials(
    learned: CompositionalQ,
    rates: CompositionalRates,
    room: RoomArrays,
    tasks: NDArray[np.int64],
    path: Path,
    num_trials: int,
    rng: NDArray[np.uint64],
) -> int:
    """So many trials, each of a task that is drawn and of at most as many steps as ``path`` has room for.

    Args:
        learned: changed in place.
        rates: constants of the learner.
        room: where it is.
        tasks: that are drawn from.
        path: written.
        num_trials: how many.
        rng: a stream; advanced.

    Returns:
        How many trials came to the end of their task.
    """
    ended = 0
    for _ in range(num_trials):
        task = tasks[int(uniform(rng) * len(tasks))]
        stage, last = room.first[task], room.first[task + 1] - 1
        s = room.goals[stage]
        while s == room.goals[stage]:
            s = room.free[int(uniform(rng) * len(room.free))]
        steps, reached = 0, True
        while reached and stage <= last:
            module, taken, reached = compositional_module(learned, stage, rng), 0, False
            while not reached and steps < len(path.states):
                a = compositional_action(learned, rates, module, s, rng)
                path.states[taken], path.actions[taken], path.rewards[taken] = s, a, room.step_reward
                s = room.led[s, a]
                reached = s == room.goals[stage]
                taken += 1
                steps += 1
            following, is_end = 0.0, reached and stage == last
            if is_end:
                path.rewards[taken - 1] += room.goal_reward
                ended += 1
            elif reached:
                following = compositional_value(learned, stage + 1, s)
            compositional_update(
                learned,
                rates,
                stage,
                module,
                path.states,
                path.actions,
                path.rewards,
                taken,
                following,
                reached,
                is_end,
            )
            stage += 1
    return ended

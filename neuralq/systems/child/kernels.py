"""Trial after trial in a maze, by Q-learning on the outputs of a transition hierarchy, in one compiled loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq.tabular.kernels.transition_hierarchy import (
    HierarchyRates,
    TransitionHierarchy,
    hierarchy_begin,
    hierarchy_learn,
    hierarchy_observe,
)

__all__ = ["MazeArrays", "Rewards", "Scratch", "learn_maze", "walk_greedily"]


class MazeArrays(NamedTuple):
    """What a trial needs to know of a maze; the start is cell 0, the goal cell 1.

    Args:
        led: where each move leads, ``[S, 4]``.
        percepts: what each cell looks like, ``[S]``.
        shortest: steps of the shortest way.
    """

    led: NDArray[np.int64]
    percepts: NDArray[np.int64]
    shortest: int


class Rewards(NamedTuple):
    """What is paid, and what is later is worth.

    Args:
        gamma: γ.
        step: for a step that does not reach the goal.
        goal: for the one that does.
    """

    gamma: float
    step: float
    goal: float


class Scratch(NamedTuple):
    """Room to work in: the inputs, ``[n]``, and what is wrong with the outputs, ``[4]``."""

    inputs: NDArray[np.float64]
    errors: NDArray[np.float64]


@lean_kernel
def _see(net: TransitionHierarchy, scratch: Scratch, percept: int, a_tm1: int) -> None:
    """The percept together with the move before, −1 for none: one input of all is 1."""
    at = percept * (net.num_outputs + 1) + a_tm1 + 1
    scratch.inputs[at] = 1.0
    hierarchy_observe(net, scratch.inputs)
    scratch.inputs[at] = 0.0


@lean_kernel
def _best(net: TransitionHierarchy, rng: NDArray[np.uint64]) -> int:
    """The action with the largest output, one of them at random where there are several."""
    best, equal = 0, 1
    for a in range(1, net.num_outputs):
        if net.value[a] > net.value[best]:
            best, equal = a, 1
        elif net.value[a] == net.value[best]:
            equal += 1
            if uniform(rng) * equal < 1.0:
                best = a
    return best


@lean_kernel
def walk_greedily(net: TransitionHierarchy, maze: MazeArrays, scratch: Scratch, rng: NDArray[np.uint64]) -> bool:
    """Whether the best move of each moment makes up a shortest way; nothing is learned.

    Args:
        net: which only forgets what it saw last.
        maze: where.
        scratch: room to work in.
        rng: a stream; advanced where moves are equally good.
    """
    hierarchy_begin(net)
    s, a, steps = 0, -1, 0
    while s != 1 and steps < maze.shortest:
        _see(net, scratch, maze.percepts[s], a)
        a = _best(net, rng)
        s = maze.led[s, a]
        steps += 1
    return s == 1


@lean_kernel
def learn_maze(
    net: TransitionHierarchy,
    rates: HierarchyRates,
    rewards: Rewards,
    epsilon: float,
    maze: MazeArrays,
    scratch: Scratch,
    test_every: int,
    most_steps: int,
    rng: NDArray[np.uint64],
) -> int:
    """Trials until a walk without exploring is a shortest way, and how many steps that took; or until all were taken.

    Args:
        net: changed in place.
        rates: its constants.
        rewards: what is paid.
        epsilon: of exploring.
        maze: where.
        scratch: room to work in.
        test_every: trials between such walks, which do not count as steps.
        most_steps: after which it is given up.
        rng: a stream; advanced.

    Returns:
        The steps; ``most_steps + 1`` where it was given up.
    """
    steps, trials = 0, 0
    while steps < most_steps:
        hierarchy_begin(net)
        s = 0
        _see(net, scratch, maze.percepts[s], -1)
        while s != 1 and steps < most_steps:
            a = _best(net, rng)
            if uniform(rng) < epsilon:
                a = int(uniform(rng) * net.num_outputs)
            q = net.value[a]
            s = maze.led[s, a]
            steps += 1
            if s == 1:
                scratch.errors[a] = rewards.goal - q
                hierarchy_learn(net, rates, scratch.errors, 0)
            else:
                _see(net, scratch, maze.percepts[s], a)
                scratch.errors[a] = rewards.step + rewards.gamma * net.value[_best(net, rng)] - q
                hierarchy_learn(net, rates, scratch.errors, 1)
            scratch.errors[a] = 0.0
        trials += s == 1
        if s == 1 and trials % test_every == 0 and walk_greedily(net, maze, scratch, rng):
            return steps
    return most_steps + 1

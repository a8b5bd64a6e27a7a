"""An hour of elevators in which every car learns from its own decisions, in one compiled loop."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.learners import SmdpNetwork, smdp_network_update, smdp_network_values
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.elevators.building import BETA, SETTLED, Building
from neuralq_envs.elevators.inputs import num_inputs, write_inputs
from neuralq_envs.elevators.kernels import advance, decide, open_account, rewind

__all__ = ["Memory", "learn_hour", "new_memory"]


class Memory(NamedTuple):
    """The latest decision of each car.

    Args:
        x: room for what a car sees, ``[I]``.
        x_tm1: what each car saw when it decided, ``[C, I]``.
        a_tm1: what it decided, ``[C]``.
        second: when, −1 where it has not decided yet, ``[C]``.
    """

    x: NDArray[np.float64]
    x_tm1: NDArray[np.float64]
    a_tm1: NDArray[np.int64]
    second: NDArray[np.float64]


def new_memory(num_cars: int, num_floors: int) -> Memory:
    """Room for the decisions of so many cars.

    Example:
        >>> new_memory(4, 10).x_tm1.shape
        (4, 47)
    """
    size = num_inputs(num_floors)
    return Memory(np.zeros(size), np.zeros((num_cars, size)), np.zeros(num_cars, np.int64), np.zeros(num_cars))


@lean_kernel
def learn_hour(
    building: Building,
    network: SmdpNetwork,
    memory: Memory,
    step_size: float,
    max_error: float,
    temperature: float,
    rng: NDArray[np.uint64],
) -> Any:
    """Plays an hour from its beginning and learns at every decision; returns the sum of |TD error|.

    A car that decides has learned what its latest decision has cost up to now, all who waited anywhere counted, and
    what it expects from here on. Where the hour ends, nothing more is expected.

    Args:
        building: rewound, and played to the end.
        network: changed in place; its values are negative costs.
        memory: written over.
        step_size: α.
        max_error: to which errors are cut.
        temperature: T > 0: an action's probability is proportional to e^(Q/T).
        rng: a stream; a number a decision.
    """
    x, x_tm1, a_tm1, second = memory
    beta, q = building.clock[BETA], network.q
    rewind(building)
    for car in range(len(second)):
        second[car] = -1.0
    total = 0.0
    while True:
        car = advance(building, np.inf)
        if car < 0:
            break
        now = building.clock[SETTLED]
        write_inputs(building, car, x)
        smdp_network_values(network, x)
        advantage, v = q[1] - q[0], max(q[0], q[1])
        if second[car] >= 0.0:
            error = smdp_network_update(
                network, x_tm1[car], a_tm1[car], -building.cost[car], now - second[car], beta, v, step_size, max_error
            )
            total += abs(error)
        stop = uniform(rng) < 1.0 / (1.0 + math.exp(-advantage / temperature))
        for i in range(len(x)):
            x_tm1[car, i] = x[i]
        a_tm1[car], second[car] = (1 if stop else 0), now
        open_account(building, car)
        decide(building, car, stop)
    for car in range(len(second)):
        if second[car] >= 0.0:
            error = smdp_network_update(
                network, x_tm1[car], a_tm1[car], -building.cost[car], 0.0, beta, 0.0, step_size, max_error
            )
            total += abs(error)
    return total

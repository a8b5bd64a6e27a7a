"""Problem after problem in the woods, learned by the library's ZCS, in one compiled loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq.tabular.kernels.zcs import Zcs, ZcsRates, zcs_action, zcs_update

__all__ = ["forage"]


@lean_kernel
def forage(
    zcs: Zcs,
    rates: ZcsRates,
    seen: NDArray[np.int64],
    led: NDArray[np.int64],
    is_food: NDArray[np.bool_],
    free: NDArray[np.int64],
    reward: float,
    most_steps: int,
    rng: NDArray[np.uint64],
    steps: NDArray[np.int64],
) -> None:
    """As many problems as ``steps`` has places; each begins in a free cell and ends with food.

    Args:
        zcs: what is learned; changed in place.
        rates: its constants.
        seen: what is seen from each cell, ``[S]``.
        led: where each move leads, ``[S, 8]``.
        is_food: ``[S]``.
        free: the cells that a problem may begin in.
        reward: of food.
        most_steps: after which a problem is broken off.
        rng: a stream; advanced.
        steps: of each problem; written.
    """
    for problem in range(len(steps)):
        cell = free[int(uniform(rng) * len(free))]
        taken = 0
        while taken < most_steps and not is_food[cell]:
            a = zcs_action(zcs, rates, seen[cell], rng)
            cell = led[cell, a]
            taken += 1
            found = is_food[cell]
            zcs_update(zcs, rates, reward if found else 0.0, found or taken == most_steps, rng)
        steps[problem] = taken

"""One episode of repairs from S0 to a schedule without conflicts, compiled, for everything that can choose repairs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.learners.afterstates import ValueNetwork, choose_afterstate
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.job_shop.kernels import Plan, Repairs, ShopArrays, apply_repair, lay_out, look_ahead, measure

__all__ = ["ANNEALED", "GREEDY", "LEARNED", "RANDOM", "repair_all"]

LEARNED, GREEDY, RANDOM, ANNEALED = 0, 1, 2, 3


@lean_kernel
def _choose(
    chooser: int, network: ValueNetwork, repairs: Repairs, count: int, epsilon: float, rng: NDArray[np.uint64]
) -> Any:
    if chooser == LEARNED:
        return choose_afterstate(network, repairs.rewards, repairs.discounts, repairs.features, count, epsilon, rng)
    chosen = 0
    if chooser == GREEDY:
        for r in range(1, count):
            if repairs.trui[r] < repairs.trui[chosen]:
                chosen = r
    else:
        chosen = int(uniform(rng) * count)
    return chosen


@lean_kernel
def repair_all(
    shop: ShopArrays,
    plan: Plan,
    repairs: Repairs,
    chooser: int,
    network: ValueNetwork,
    epsilon: float,
    temperatures: NDArray[np.float64],
    step_cost: float,
    rng: NDArray[np.uint64],
    features: NDArray[np.float64],
    rewards: NDArray[np.float64],
    chosen: NDArray[np.int64],
) -> Any:
    """Repairs S0 until no conflict is left; returns how many repairs it took, and whether none is left.

    Args:
        shop: the problem.
        plan: room for the schedule; afterwards the last one.
        repairs: room for the repairs of one conflict.
        chooser: `LEARNED` (ε-greedy in what the network expects), `GREEDY` (least TRUI), `RANDOM`, or `ANNEALED` (a
            random repair, kept if there is no more excess after it, else with a chance of exp(−growth / temperature)).
        network: of what comes later.
        epsilon: ε.
        temperatures: of annealing, first, factor per proposal, and least, ``[3]``.
        step_cost: of a repair.
        rng: a stream; advanced.
        features: of S0 and of the schedule after each repair, ``[T + 1, 14]``; written. After T repairs it is given up.
        rewards: of each repair, ``[T]``; written.
        chosen: task, kind (0 another pool, 1 another start), type and pool or start of each repair, ``[T, 4]``;
        written.
    """
    lay_out(shop, plan)
    _, excess = measure(shop, plan, features[0])
    steps, heat = 0, temperatures[0]
    while excess > 0.0 and steps < len(rewards):
        count = look_ahead(shop, plan, step_cost, repairs)
        if count == 0:
            return steps, False
        r = _choose(chooser, network, repairs, count, epsilon, rng)
        if chooser == ANNEALED:
            growth = repairs.excess[r] - excess
            heat = max(heat * temperatures[1], temperatures[2])
            if growth > 0.0 and uniform(rng) >= np.exp(-growth / heat):
                continue
        apply_repair(shop, plan, repairs, r)
        excess = repairs.excess[r]
        rewards[steps] = repairs.rewards[r]
        chosen[steps, 0], chosen[steps, 1] = repairs.task[r], repairs.kind[r]
        chosen[steps, 2], chosen[steps, 3] = repairs.resource[r], repairs.to[r]
        steps += 1
        for i in range(features.shape[1]):
            features[steps, i] = repairs.features[r, i]
    return steps, excess == 0.0

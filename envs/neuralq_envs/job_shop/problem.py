"""Job-shop problems: tasks that wait for each other and share pools of resources, checked when they are built."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_whole
from neuralq_envs.job_shop.kernels import NUM_FEATURES, Plan, Repairs, ShopArrays, lay_out, measure

__all__ = ["JobShop", "new_plan", "new_repairs", "random_job_shop"]

_HORIZON = 1  # times the sum of all durations, which is what the tasks take one after the other
_MOST_PREDECESSORS, _AMONG = 2, 5
_LONGEST, _SHORTEST, _MOST_UNITS, _CHANCE = 8, 2, 3, 0.7


@dataclass(frozen=True, eq=False)
class JobShop:
    """A problem and its first schedule S0: every task as early as the tasks before it allow, whatever it asks for.

    Args:
        durations: whole numbers of at least 1, ``[n]``.
        requests: units that a task asks for of each type of resource, all from one pool, ``[n, K]``.
        before: for each task those that must have ended, as sequences of their numbers.
        capacities: units of each pool of each type, ``[K, P]``; 0 where a type has fewer pools.
        pools: from which pool S0 takes what each task asks for, ``[n, K]``; what stands where nothing is asked for does
            not matter. The largest pool, the first of several, where it is left out.

    Raises:
        ValueError: a cycle among the tasks, a task that asks for more than any pool has, or a pool of S0 that is too
            small for its task; arrays that do not go together.

    Example:
        Two tasks of two units each, at once, from a pool of three.

        >>> shop = JobShop([2, 3], [[2], [2]], [(), ()], [[3]])
        >>> shop.first_length, shop.first_trui, round(shop.rdf(5), 3)
        (3, 3.6666666666666665, 1.364)
    """

    durations: ArrayLike
    requests: ArrayLike
    before: tuple[tuple[int, ...], ...]
    capacities: ArrayLike
    pools: ArrayLike | None = None

    def __post_init__(self) -> None:
        """Builds the arrays, so that what is wrong is said here."""
        object.__setattr__(self, "before", tuple(tuple(int(j) for j in one) for one in self.before))
        _ = self.arrays

    @property
    def num_tasks(self) -> int:
        """How many tasks there are."""
        return len(self.arrays.durations)

    @property
    def first_length(self) -> int:
        """The length of S0."""
        return int(self.arrays.facts[0])

    @property
    def first_trui(self) -> float:
        """Total resource utilisation index of S0."""
        return float(self.arrays.facts[1])

    @property
    def bound(self) -> int:
        """No schedule without conflicts is shorter: neither than S0, nor than all the work of a type takes."""
        return int(self.arrays.facts[2])

    @property
    def num_conflicts(self) -> int:
        """Moments at which a pool is over-full in S0, counted for each pool."""
        plan = new_plan(self.arrays)
        lay_out(self.arrays, plan)
        return int((plan.usage > self.arrays.capacities[:, :, None]).sum())

    def rdf(self, length: int) -> float:
        """Resource dilation factor of a schedule of that length that has no conflicts."""
        return float(self.arrays.capacities.shape[0] * length / self.first_trui)

    @cached_property
    def arrays(self) -> ShopArrays:
        """What the compiled functions take."""
        durations = _whole("durations", self.durations, 1, 1)
        requests = _whole("requests", self.requests, 2, 0)
        capacities = _whole("capacities", self.capacities, 2, 0)
        n = len(durations)
        if requests.shape != (n, len(capacities)) or len(self.before) != n:
            raise ValueError(
                f"{n} tasks and {len(capacities)} types of resource need requests of shape {(n, len(capacities))} and "
                f"{n} entries of before, got {requests.shape} and {len(self.before)}"
            )
        _check_fits(requests, capacities)
        order = _order(self.before)
        start = np.zeros(n, np.int64)
        for i in order:
            start[i] = max((start[j] + durations[j] for j in self.before[i]), default=0)
        before = np.full((n, max(1, *(len(one) for one in self.before))), -1, np.int64)
        for i, one in enumerate(self.before):
            before[i, : len(one)] = one
        facts = np.zeros(3 + len(capacities))
        facts[:2], facts[3:] = 1.0, durations @ requests
        length = int((start + durations).max())
        facts[2] = max(length, *np.ceil(facts[3:] / capacities.sum(axis=1)).tolist())
        pool = _first_pools(requests, capacities, self.pools)
        shop = ShopArrays(
            durations,
            requests,
            capacities,
            before,
            order,
            _reach(order, self.before),
            start,
            pool,
            facts,
            _tails(order, self.before, durations),
        )
        plan = new_plan(shop)
        lay_out(shop, plan)
        facts[0] = length
        facts[1] = measure(shop, plan, np.zeros(NUM_FEATURES))[0]
        return shop


def new_plan(shop: ShopArrays) -> Plan:
    """Room for a schedule of this problem, not yet written (`neuralq_envs.job_shop.kernels.lay_out` sets it to S0).

    Example:
        >>> new_plan(JobShop([2, 3], [[2], [2]], [(), ()], [[3]]).arrays).usage.shape
        (1, 1, 5)
    """
    n, num_types = shop.requests.shape
    horizon = _HORIZON * int(shop.durations.sum())
    usage = np.zeros((num_types, shop.capacities.shape[1], horizon), np.int64)
    zeros = (np.zeros(n, np.int64) for _ in range(3))
    start, changed, old = zeros
    return Plan(start, np.full((n, num_types), -1, np.int64), usage, np.zeros(1, np.int64), changed, old)


def new_repairs(most: int) -> Repairs:
    """Room for so many repairs.

    Example:
        >>> new_repairs(8).features.shape
        (8, 14)
    """
    task, kind, resource, to = (np.zeros(most, np.int64) for _ in range(4))
    rewards, discounts, trui, excess = (np.zeros(most) for _ in range(4))
    return Repairs(task, kind, resource, to, np.zeros((most, NUM_FEATURES)), rewards, discounts, trui, excess)


def random_job_shop(
    rng: np.random.Generator,
    num_missions: int = 3,
    num_tasks: int = 17,
    capacities: ArrayLike = ((4, 4), (4, 4)),
) -> JobShop:
    """Missions of tasks that share pools, by default two types of resource with two pools of four units, S0's drawn.

    Durations are uniform in 2..8; a task asks for a type with a chance of .7, for 1 to 3 units; every task of a mission
    but its first waits for one or two of the five before it. Drawn again where S0 has no conflict.

    Args:
        rng: draws.
        num_missions: how many; at least 1.
        num_tasks: of each; at least 2.
        capacities: units of each pool of each type, ``[K, P]``, at least 3 each.

    Raises:
        ValueError: fewer, or smaller pools.

    Source: in the manner of Zhang & Dietterich (1995), whose missions of a space shuttle have 34 to 164 tasks.

    Example:
        >>> random_job_shop(np.random.default_rng(0)).num_tasks
        51
    """
    check_whole("num_missions", num_missions)
    check_whole("num_tasks", num_tasks, 2)
    pools = _whole("capacities", capacities, 2, _MOST_UNITS)
    while True:
        n = num_missions * num_tasks
        durations = rng.integers(_SHORTEST, _LONGEST + 1, n)
        requests = (rng.random((n, len(pools))) < _CHANCE) * rng.integers(1, _MOST_UNITS + 1, (n, len(pools)))
        before: list[tuple[int, ...]] = []
        for i in range(n):
            near = min(i % num_tasks, _AMONG)
            count = min(near, int(rng.integers(1, _MOST_PREDECESSORS + 1)))
            before.append(tuple(sorted((i - 1 - rng.choice(near, count, replace=False)).tolist())) if near else ())
        drawn = rng.integers(0, pools.shape[1], requests.shape)
        shop = JobShop(durations, requests, tuple(before), pools, drawn)
        if shop.num_conflicts:
            return shop


def _whole(name: str, values: ArrayLike, num_axes: int, least: int) -> NDArray[np.int64]:
    given = np.asarray(values)
    if given.ndim != num_axes or not given.size or not (np.equal(np.mod(given, 1), 0) & (given >= least)).all():
        axes = "a row" if num_axes == 1 else "a table"
        raise ValueError(f"{name} must be {axes} of whole numbers of at least {least}, got {values!r}")
    return np.array(given, np.int64)


def _check_fits(requests: NDArray[np.int64], capacities: NDArray[np.int64]) -> None:
    largest = capacities.max(axis=1)
    for i, k in np.argwhere(requests > largest).tolist():
        raise ValueError(
            f"task {i} asks for {requests[i, k]} units of type {k}, and the largest pool of that type has "
            f"{largest[k]}: "
            "it fits no pool; ask for less, or split the task"
        )


def _order(before: tuple[tuple[int, ...], ...]) -> NDArray[np.int64]:
    """The tasks, each after those before it, those of one component together."""
    n = len(before)
    wrong = [(i, j) for i, one in enumerate(before) for j in one if not 0 <= j < n]
    if wrong:
        raise ValueError(f"task {wrong[0][0]} waits for task {wrong[0][1]}, and tasks are numbered 0 to {n - 1}")
    order: list[int] = []
    state = [0] * n  # 1: being visited, 2: in order
    for root in range(n):
        path = [] if state[root] else [(root, iter(before[root]))]
        state[root] = state[root] or 1
        while path:
            i, rest = path[-1]
            j = next(rest, None)
            if j is None:
                state[i] = 2
                order.append(i)
                path.pop()
            elif state[j] == 1:
                tasks = [task for task, _ in path]
                cycle = [*tasks[tasks.index(j) :], j]
                raise ValueError(
                    f"tasks wait for each other in a circle: {' waits for '.join(map(str, cycle))}; leave one out"
                )
            elif state[j] == 0:
                state[j] = 1
                path.append((j, iter(before[j])))
    return np.array(order, np.int64)


def _tails(
    order: NDArray[np.int64], before: tuple[tuple[int, ...], ...], durations: NDArray[np.int64]
) -> NDArray[np.int64]:
    """For each task, the longest way from its start to the end of what waits for it."""
    tail = durations.copy()
    for i in order[::-1].tolist():
        for j in before[i]:
            tail[j] = max(tail[j], durations[j] + tail[i])
    return tail


def _reach(order: NDArray[np.int64], before: tuple[tuple[int, ...], ...]) -> NDArray[np.int64]:
    place = np.argsort(order)
    reach = np.arange(len(order))
    for r in range(len(order) - 1, -1, -1):
        for j in before[order[r]]:
            reach[place[j]] = max(reach[place[j]], reach[r])
    return reach


def _first_pools(
    requests: NDArray[np.int64], capacities: NDArray[np.int64], pools: ArrayLike | None
) -> NDArray[np.int64]:
    chosen = np.broadcast_to(capacities.argmax(axis=1), requests.shape) if pools is None else np.asarray(pools)
    if chosen.shape != requests.shape:
        raise ValueError(f"pools must have the shape of requests, {requests.shape}, got {chosen.shape}")
    pool = np.where(requests > 0, chosen, -1).astype(np.int64)
    for i, k in np.argwhere(requests > 0).tolist():
        p = pool[i, k]
        if not 0 <= p < capacities.shape[1] or capacities[k, p] < requests[i, k]:
            fitting = np.flatnonzero(capacities[k] >= requests[i, k]).tolist()
            raise ValueError(
                f"task {i} asks for {requests[i, k]} units of type {k} and S0 takes them from pool {p}, where they "
                f"never "
                f"fit; take one of {fitting}"
            )
    return pool

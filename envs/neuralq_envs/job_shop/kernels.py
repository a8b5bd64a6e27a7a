"""Schedules and what repairs make of them, compiled.

Time is whole. A schedule says when each of n tasks starts and, for each of K types of resource that the task asks for,
from which of P pools it takes all of it. With u(k, p, t) what is taken of a pool, c(k, p) its capacity and L the
schedule's length,

* TRUI = Σ_k Σ_{t<L} (Σ_p max(u, c)) / Σ_p c: what stands there or would have to, for as long as the schedule lasts;
* RDF = K L / TRUI(S0): how much longer a schedule without conflicts is than the first one, S0, with all that it lacks.

Where a pool is over-full for the first time, every task that takes from it then may be repaired in up to P + 2 ways:
taken from another pool with room for all of its interval, moved to the next start where all that it asks for is free,
moved to where the first of the others ends, or moved to the last earlier start that is free and after the tasks that
it waits for. What waits for a moved task is pushed as far as needed and no further.

Source: Zhang & Dietterich 1995; the second of the three moves is ours. Without it schedules become a third longer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel

__all__ = [
    "NUM_FEATURES",
    "Plan",
    "Repairs",
    "ShopArrays",
    "apply_repair",
    "first_conflict",
    "lay_out",
    "look_ahead",
    "measure",
    "take_back",
]

NUM_FEATURES = 14
REASSIGN, MOVE = 0, 1
# About the mean of each feature, and six times its standard deviation, while problems of 51 tasks were repaired: a
# network learns badly from numbers of unlike sizes, and from sharper ones it learns what does not hold for 164 tasks.
_MIDDLE = np.array([0.94, 1.04, 0.33, 0.58, 0.12, 0.13, 0.65, 0.24, 0.83, 0.59, 0.97, 0.8, 0.85, 0.5])
_SPREAD = np.array([0.66, 0.42, 1.14, 1.44, 0.48, 0.42, 0.30, 0.18, 0.24, 0.54, 0.54, 0.66, 0.66, 1.5])

Whole = NDArray[np.int64]


class ShopArrays(NamedTuple):
    """A problem as arrays, and its first schedule.

    Args:
        durations: ``[n]``.
        requests: units of each type that a task asks for, ``[n, K]``.
        capacities: of each pool of each type, ``[K, P]``.
        before: tasks that must have ended before, filled up with −1, ``[n, B]``.
        order: the tasks, each after those before it, ``[n]``.
        reach: by place in ``order``, the last place of any task that waits for this one, ``[n]``.
        start: S0, each task as early as those before it allow, ``[n]``.
        pool: S0, −1 where nothing is asked for, ``[n, K]``.
        facts: length of S0, TRUI of S0, a bound below the length of every schedule without conflicts, and the work
            (units times duration) of each type, ``[3 + K]``.
        tail: the longest way from the start of a task to the end of what waits for it, ``[n]``.
    """

    durations: Whole
    requests: Whole
    capacities: Whole
    before: Whole
    order: Whole
    reach: Whole
    start: Whole
    pool: Whole
    facts: NDArray[np.float64]
    tail: Whole


class Plan(NamedTuple):
    """A schedule that is being repaired, and how to take the last repair back.

    Args:
        start: ``[n]``.
        pool: ``[n, K]``.
        usage: what is taken, up to a horizon, ``[K, P, H]``.
        length: of the schedule, ``[1]``.
        changed: tasks that the last repair moved, ``[n]``.
        old: and where they started, ``[n]``.
    """

    start: Whole
    pool: Whole
    usage: Whole
    length: Whole
    changed: Whole
    old: Whole


class Repairs(NamedTuple):
    """What may be done, and what would come of it; as long as there is room for.

    Args:
        task: that is changed, ``[M]``.
        kind: 0 for another pool, 1 for another start, ``[M]``.
        resource: type of resource that is over-full, ``[M]``.
        to: the pool or the start, ``[M]``.
        features: of the schedule that it leads to (`measure`), ``[M, 14]``.
        rewards: ``[M]``.
        discounts: 0 where that has no conflict, else 1, ``[M]``.
        trui: of that, ``[M]``.
        excess: units above capacity, summed over time, of that, ``[M]``.
    """

    task: Whole
    kind: Whole
    resource: Whole
    to: Whole
    features: NDArray[np.float64]
    rewards: NDArray[np.float64]
    discounts: NDArray[np.float64]
    trui: NDArray[np.float64]
    excess: NDArray[np.float64]


@lean_kernel
def lay_out(shop: ShopArrays, plan: Plan) -> None:
    """Sets the plan to S0."""
    usage = plan.usage
    for k in range(usage.shape[0]):
        for p in range(usage.shape[1]):
            for t in range(usage.shape[2]):
                usage[k, p, t] = 0
    plan.length[0] = 0
    for i in range(len(shop.durations)):
        plan.start[i] = shop.start[i]
        for k in range(shop.requests.shape[1]):
            plan.pool[i, k] = shop.pool[i, k]
        _take(shop, plan, i, 1)
        plan.length[0] = max(plan.length[0], plan.start[i] + shop.durations[i])


@lean_kernel
def _take(shop: ShopArrays, plan: Plan, i: int, sign: int) -> None:
    """Takes what a task asks for over its interval, or gives it back."""
    for k in range(shop.requests.shape[1]):
        units = sign * shop.requests[i, k]
        if units != 0:
            row = plan.usage[k, plan.pool[i, k]]
            for t in range(plan.start[i], plan.start[i] + shop.durations[i]):
                row[t] += units


@lean_kernel
def first_conflict(shop: ShopArrays, plan: Plan) -> Any:
    """The first time at which a pool is over-full, its type and which it is, the lowest of several; −1s if none is."""
    for t in range(plan.length[0]):
        for k in range(plan.usage.shape[0]):
            for p in range(plan.usage.shape[1]):
                if plan.usage[k, p, t] > shop.capacities[k, p]:
                    return t, k, p
    return -1, -1, -1


@lean_kernel
def _blocked(shop: ShopArrays, plan: Plan, i: int, start: int) -> Any:
    """The last time in a task's interval at which something it asks for is not free, −1 if all is; without itself."""
    last = -1
    for k in range(shop.requests.shape[1]):
        units = shop.requests[i, k]
        if units > 0:
            row = plan.usage[k, plan.pool[i, k]]
            room = shop.capacities[k, plan.pool[i, k]] - units
            for t in range(start + shop.durations[i] - 1, max(start, last + 1) - 1, -1):
                if row[t] > room:
                    last = t
                    break
    return last


@lean_kernel
def _has_room(shop: ShopArrays, plan: Plan, i: int, k: int, pool: int) -> Any:
    room = shop.capacities[k, pool] - shop.requests[i, k]
    if room < 0:
        return False
    for t in range(plan.start[i], plan.start[i] + shop.durations[i]):
        if plan.usage[k, pool, t] > room:
            return False
    return True


@lean_kernel
def _earliest(shop: ShopArrays, plan: Plan, i: int) -> Any:
    """When the last of the tasks before this one ends."""
    ready = 0
    for b in range(shop.before.shape[1]):
        j = shop.before[i, b]
        if j >= 0:
            ready = max(ready, plan.start[j] + shop.durations[j])
    return ready


@lean_kernel
def _add(repairs: Repairs, count: int, task: int, kind: int, resource: int, to: int) -> Any:
    if count < len(repairs.task):
        repairs.task[count], repairs.kind[count] = task, kind
        repairs.resource[count], repairs.to[count] = resource, to
        return count + 1
    return count


@lean_kernel
def _list(shop: ShopArrays, plan: Plan, repairs: Repairs) -> Any:
    """Writes down every repair of the first conflict, no move twice; returns how many there are."""
    when, k, p = first_conflict(shop, plan)
    count = 0
    if when < 0:
        return count
    for i in range(len(shop.durations)):
        here, end = plan.start[i], plan.start[i] + shop.durations[i]
        if plan.pool[i, k] != p or not here <= when < end:
            continue
        for q in range(plan.usage.shape[1]):
            if q != p and _has_room(shop, plan, i, k, q):
                count = _add(repairs, count, i, REASSIGN, k, q)
        _take(shop, plan, i, -1)
        later = here + 1
        blocked = _blocked(shop, plan, i, later)
        while blocked >= 0:
            later = blocked + 1
            blocked = _blocked(shop, plan, i, later)
        earlier, ready = here - 1, _earliest(shop, plan, i)
        while earlier >= ready and _blocked(shop, plan, i, earlier) >= 0:
            earlier -= 1
        _take(shop, plan, i, 1)
        count = _add(repairs, count, i, MOVE, k, later)
        after = -1
        for j in range(len(shop.durations)):
            other = plan.start[j] + shop.durations[j]
            if j != i and plan.pool[j, k] == p and plan.start[j] <= when < other and (after < 0 or other < after):
                after = other
        if after >= 0 and after != later:
            count = _add(repairs, count, i, MOVE, k, after)
        if earlier >= ready:
            count = _add(repairs, count, i, MOVE, k, earlier)
    return count


@lean_kernel
def _move(shop: ShopArrays, plan: Plan, count: int, i: int, start: int) -> Any:
    _take(shop, plan, i, -1)
    plan.changed[count], plan.old[count] = i, plan.start[i]
    plan.start[i] = start
    _take(shop, plan, i, 1)
    return count + 1


@lean_kernel
def _ends(shop: ShopArrays, plan: Plan) -> Any:
    length = 0
    for i in range(len(shop.durations)):
        length = max(length, plan.start[i] + shop.durations[i])
    return length


@lean_kernel
def apply_repair(shop: ShopArrays, plan: Plan, repairs: Repairs, which: int) -> Any:
    """Carries a repair out; returns how many tasks it moved, or −1 if the horizon ends before the schedule would.

    In the latter case the plan is as it was.
    """
    i, horizon = repairs.task[which], plan.usage.shape[2]
    if repairs.kind[which] == REASSIGN:
        _take(shop, plan, i, -1)
        k = repairs.resource[which]
        plan.old[0], plan.pool[i, k] = plan.pool[i, k], repairs.to[which]
        _take(shop, plan, i, 1)
        return 0
    count = 0
    if repairs.to[which] + shop.durations[i] > horizon:
        return -1
    count = _move(shop, plan, count, i, repairs.to[which])
    place = 0
    while shop.order[place] != i:
        place += 1
    for r in range(place + 1, shop.reach[place] + 1):
        j = shop.order[r]
        ready = _earliest(shop, plan, j)
        if ready > plan.start[j]:
            if ready + shop.durations[j] > horizon:
                _put_back(shop, plan, count)
                return -1
            count = _move(shop, plan, count, j, ready)
    plan.length[0] = _ends(shop, plan)
    return count


@lean_kernel
def _put_back(shop: ShopArrays, plan: Plan, count: int) -> None:
    for r in range(count - 1, -1, -1):
        i = plan.changed[r]
        _take(shop, plan, i, -1)
        plan.start[i] = plan.old[r]
        _take(shop, plan, i, 1)


@lean_kernel
def take_back(shop: ShopArrays, plan: Plan, repairs: Repairs, which: int, count: int) -> None:
    """Makes the last `apply_repair`, which returned ``count``, as if it had not been."""
    if repairs.kind[which] == REASSIGN:
        i, k = repairs.task[which], repairs.resource[which]
        _take(shop, plan, i, -1)
        plan.pool[i, k] = plan.old[0]
        _take(shop, plan, i, 1)
        return
    _put_back(shop, plan, count)
    plan.length[0] = _ends(shop, plan)


@lean_kernel
def measure(shop: ShopArrays, plan: Plan, x: NDArray[np.float64]) -> Any:
    """Fourteen numbers that tell how good a schedule is and may become, into ``x``; returns TRUI and units in excess.

    0. the length and 1. TRUI, both as a share of what S0 has of TRUI; 2. the share of time with a conflict; 3. when the
    first one is, as a share of the length, 1 if there is none; 4. units in excess as a share of what there is while S0
    lasts; 5. intervals in which a pool is over-full, by S0's length; 6. and 7. mean and standard deviation of how full
    the pools are, over time and types; 8. the bound below the length, as 0; 9. how full they are before the first
    conflict; 10. when all would be over if what is not taken before that filled all pools from then on, as 0; 11. when
    the last of what waits for a task would be over, as 0, a mean over the tasks that are not over at the first
    conflict; 12. the same as a mean of eighth powers, which tells how many are late; 13. the share of those tasks. Each
    is centred and scaled.
    """
    length, num_types, num_pools = plan.length[0], plan.usage.shape[0], plan.usage.shape[1]
    begin, windows, in_conflict = length, 0, 0
    trui, excess, filled, squares, early, rest = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for t in range(length):
        over, now = 0, 0.0
        for k in range(num_types):
            capacity, taken, above = 0, 0, 0
            for p in range(num_pools):
                c, u = shop.capacities[k, p], plan.usage[k, p, t]
                capacity += c
                taken += min(u, c)
                if u > c:
                    above += u - c
                    if t == 0 or plan.usage[k, p, t - 1] <= c:
                        windows += 1
            share = taken / capacity
            now += share
            squares += share * share
            trui += 1.0 + above / capacity
            over += above
        excess += over
        if over > 0:
            in_conflict += 1
            if t < begin:
                begin, early = t, filled
        filled += now
    if begin == length:
        early = filled
    for k in range(num_types):
        capacity, taken = 0, 0
        for p in range(num_pools):
            capacity += shop.capacities[k, p]
            for t in range(begin):
                taken += plan.usage[k, p, t]
        rest = max(rest, (shop.facts[3 + k] - taken) / capacity)
    unit, mean = num_types / shop.facts[1], filled / (num_types * length)
    x[0], x[1] = unit * length, trui / shop.facts[1]
    x[2], x[3] = in_conflict / length, begin / length
    x[4], x[5] = excess / (shop.facts[0] * shop.capacities.sum()), windows / shop.facts[0]
    x[6], x[7] = mean, np.sqrt(max(squares / (num_types * length) - mean * mean, 0.0))
    x[8] = unit * shop.facts[2]
    x[9] = early / (num_types * begin) if begin > 0 else 0.0
    x[10] = unit * max(begin + rest, shop.facts[2]) if begin < length else x[0]
    left, ends, powers = 0, 0.0, 0.0
    for i in range(len(shop.durations)):
        if begin == length or plan.start[i] + shop.durations[i] > begin:
            end = (plan.start[i] + shop.tail[i]) / length
            left += 1
            ends += end
            powers += end**8
    x[11] = x[0] * ends / left
    x[12] = x[0] * (powers / left) ** 0.125
    x[13] = left / len(shop.durations)
    for i in range(NUM_FEATURES):
        x[i] = (x[i] - _MIDDLE[i]) / _SPREAD[i]
    return trui, excess


@lean_kernel
def look_ahead(shop: ShopArrays, plan: Plan, step_cost: float, repairs: Repairs) -> Any:
    """Tries every repair of the first conflict, writes down what comes of it, and leaves the plan as it was.

    Returns how many there are: at most M, none where there is no conflict or the horizon leaves room for none. The
    reward is −``step_cost``, and −RDF on top where no conflict is left.
    """
    listed = _list(shop, plan, repairs)
    count = 0
    for r in range(listed):
        moved = apply_repair(shop, plan, repairs, r)
        if moved < 0:
            continue
        trui, excess = measure(shop, plan, repairs.features[count])
        take_back(shop, plan, repairs, r, moved)
        repairs.task[count], repairs.kind[count] = repairs.task[r], repairs.kind[r]
        repairs.resource[count], repairs.to[count] = repairs.resource[r], repairs.to[r]
        repairs.trui[count], repairs.excess[count] = trui, excess
        solved = excess == 0.0
        repairs.discounts[count] = 0.0 if solved else 1.0
        repairs.rewards[count] = -step_cost - (trui / shop.facts[1] if solved else 0.0)
        count += 1
    return count

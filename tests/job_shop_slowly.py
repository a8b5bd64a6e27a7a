"""Schedules and repairs in plain Python, written from their definitions; nothing is shared with the compiled ones."""

from __future__ import annotations

import math
from typing import NamedTuple

from neuralq_envs.job_shop import JobShop


class Slow(NamedTuple):
    """A schedule: starts, and pools by (task, type)."""

    starts: tuple[int, ...]
    pools: tuple[tuple[int, ...], ...]


class SlowShop:
    """A problem as lists."""

    def __init__(self, shop: JobShop) -> None:
        arrays = shop.arrays
        self.durations: list[int] = arrays.durations.tolist()
        self.requests: list[list[int]] = arrays.requests.tolist()
        self.capacities: list[list[int]] = arrays.capacities.tolist()
        self.before = shop.before
        self.tasks, self.types = range(len(self.durations)), range(len(self.capacities))
        self.pools = range(len(self.capacities[0]))
        starts = [0] * len(self.durations)
        for _ in self.tasks:
            starts = [max([0, *(starts[j] + self.durations[j] for j in self.before[i])]) for i in self.tasks]
        self.first = Slow(tuple(starts), tuple(map(tuple, arrays.pool.tolist())))
        self.first_length, self.first_trui = self.length(self.first), self.trui(self.first)
        self.work = [sum(self.durations[i] * self.requests[i][k] for i in self.tasks) for k in self.types]
        works = [math.ceil(self.work[k] / sum(self.capacities[k])) for k in self.types]
        self.bound = max(self.first_length, *works)
        self.horizon = sum(self.durations)

    def length(self, s: Slow) -> int:
        return max(s.starts[i] + self.durations[i] for i in self.tasks)

    def runs(self, s: Slow, i: int, t: int) -> bool:
        return s.starts[i] <= t < s.starts[i] + self.durations[i]

    def usage(self, s: Slow, k: int, p: int, t: int, without: int = -1) -> int:
        return sum(
            self.requests[i][k] for i in self.tasks if i != without and s.pools[i][k] == p and self.runs(s, i, t)
        )

    def table(self, s: Slow) -> list[list[list[int]]]:
        return [[[self.usage(s, k, p, t) for t in range(self.length(s))] for p in self.pools] for k in self.types]

    def trui(self, s: Slow) -> float:
        return sum(
            max(u, self.capacities[k][p]) / sum(self.capacities[k])
            for k, pools in enumerate(self.table(s))
            for p, row in enumerate(pools)
            for u in row
        )

    def rdf(self, s: Slow) -> float:
        return len(self.types) * self.length(s) / self.first_trui

    def conflict(self, s: Slow) -> tuple[int, int, int] | None:
        found = [
            (t, k, p)
            for k, pools in enumerate(self.table(s))
            for p, row in enumerate(pools)
            for t, u in enumerate(row)
            if u > self.capacities[k][p]
        ]
        return min(found, default=None)

    def fits(self, s: Slow, i: int, start: int, pools: tuple[int, ...]) -> bool:
        return all(
            self.usage(s, k, pools[k], t, without=i) + self.requests[i][k] <= self.capacities[k][pools[k]]
            for k in self.types
            if self.requests[i][k]
            for t in range(start, start + self.durations[i])
        )

    def ready(self, starts: list[int], i: int) -> int:
        return max([0, *(starts[j] + self.durations[j] for j in self.before[i])])

    def moved(self, s: Slow, i: int, start: int) -> Slow:
        """The task starts then, and what waits for it no earlier than it must."""
        starts = list(s.starts)
        starts[i] = start
        for _ in self.tasks:
            starts = [start if j == i else max(starts[j], self.ready(starts, j)) for j in self.tasks]
        return Slow(tuple(starts), s.pools)

    def repairs(self, s: Slow) -> list[tuple[tuple[int, int, int | None, int | None], Slow]]:
        """(task, type, pool or None, start or None) and what it leads to."""
        conflict = self.conflict(s)
        found: list[tuple[tuple[int, int, int | None, int | None], Slow]] = []
        if conflict is None:
            return found
        t, k, p = conflict
        there = [i for i in self.tasks if s.pools[i][k] == p and self.runs(s, i, t)]
        for i in there:
            for q in self.pools:
                pools = tuple(q if kk == k else one for kk, one in enumerate(s.pools[i]))
                room = all(
                    self.usage(s, k, q, tt) + self.requests[i][k] <= self.capacities[k][q]
                    for tt in range(s.starts[i], s.starts[i] + self.durations[i])
                )
                if q != p and room:
                    all_pools = tuple(pools if j == i else one for j, one in enumerate(s.pools))
                    found.append(((i, k, q, None), Slow(s.starts, all_pools)))
            later = next(a for a in range(s.starts[i] + 1, 10**6) if self.fits(s, i, a, s.pools[i]))
            ends = [s.starts[j] + self.durations[j] for j in there if j != i]
            ready = self.ready(list(s.starts), i)
            earlier = [a for a in range(ready, s.starts[i]) if self.fits(s, i, a, s.pools[i])]
            starts = [later, *(end for end in [min(ends, default=later)] if end != later), *earlier[-1:]]
            found += [((i, k, None, start), self.moved(s, i, start)) for start in starts]
        return [(what, led) for what, led in found if self.length(led) <= self.horizon]

    def tail(self, i: int) -> int:
        return self.durations[i] + max([0, *(self.tail(j) for j in self.tasks if i in self.before[j])])

    def features(self, s: Slow) -> list[float]:
        """What `measure` gives, before it is centred and scaled."""
        table, length, conflict = self.table(s), self.length(s), self.conflict(s)
        num_types, unit = len(self.types), len(self.types) / self.first_trui
        cells = [(k, t) for k in self.types for t in range(length)]
        above = {
            (k, p, t): max(table[k][p][t] - self.capacities[k][p], 0)
            for k in self.types for p in self.pools for t in range(-1, length) if t >= 0
        }  # fmt: skip
        filled = {
            (k, t): sum(min(table[k][p][t], self.capacities[k][p]) for p in self.pools) / sum(self.capacities[k])
            for k, t in cells
        }
        begin = length if conflict is None else conflict[0]
        mean = sum(filled.values()) / len(cells)
        windows = sum(1 for (k, p, t), a in above.items() if a and not above.get((k, p, t - 1), 0))
        rests = [
            (self.work[k] - sum(table[k][p][t] for p in self.pools for t in range(begin))) / sum(self.capacities[k])
            for k in self.types
        ]
        left = [i for i in self.tasks if conflict is None or s.starts[i] + self.durations[i] > begin]
        ends = [(s.starts[i] + self.tail(i)) / length for i in left]
        return [
            unit * length,
            self.trui(s) / self.first_trui,
            len({t for (_, _, t), a in above.items() if a}) / length,
            begin / length,
            sum(above.values()) / (self.first_length * sum(map(sum, self.capacities))),
            windows / self.first_length,
            mean,
            math.sqrt(sum((one - mean) ** 2 for one in filled.values()) / len(cells)),
            unit * self.bound,
            sum(one for (_, t), one in filled.items() if t < begin) / (num_types * begin) if begin else 0.0,
            unit * (length if conflict is None else max(begin + max(rests), self.bound)),
            unit * length * sum(ends) / len(left),
            unit * length * (sum(end**8 for end in ends) / len(left)) ** (1 / 8),
            len(left) / len(self.tasks),
        ]

    def least_cost(self, step_cost: float) -> float:
        """The least RDF + cost of repairs over every schedule that repairs reach."""
        best, depth, level, seen = math.inf, 0, [self.first], {self.first}
        lowest = len(self.types) * self.bound / self.first_trui
        while level and depth * step_cost + lowest < best:
            best = min([best, *(self.rdf(s) + depth * step_cost for s in level if self.conflict(s) is None)])
            following = []
            for s in level:
                for _, led in self.repairs(s):
                    if led not in seen:
                        seen.add(led)
                        following.append(led)
            level, depth = following, depth + 1
        return best

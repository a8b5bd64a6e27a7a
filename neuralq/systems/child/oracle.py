"""What must be exact: a context of k moments grows a chain of k units, and the shortest ways of the mazes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from neuralq.checks import check_whole
from neuralq.exact import solve
from neuralq.runs.report.claims import Row, claim, number
from neuralq.tabular import (
    HierarchyRates,
    hierarchy_begin,
    hierarchy_learn,
    hierarchy_observe,
    new_transition_hierarchy,
)
from neuralq_envs.ring_mazes import NUM_MAZES, corridors, model, shortest_way

__all__ = ["Chain", "learn_context", "moments_needed", "oracle"]

_LONGEST = 6


class Chain(NamedTuple):
    """What was grown to tell two sequences apart.

    Args:
        num_units: beside the outputs.
        depths: moments that the units of each output look back, in order.
        error: the largest of an output at the end of a sequence, of the last 100.
    """

    num_units: int
    depths: tuple[tuple[int, ...], ...]
    error: float


def learn_context(num_moments: int, grows: bool = True, num_sequences: int = 3000) -> Chain:
    """Predicts C after A x … x, and D after B x … x: A and B were seen k moments ago.

    Args:
        num_moments: k, how often x is seen.
        grows: whether units may be made.
        num_sequences: drawn, each of the two with the same chance.

    Raises:
        ValueError: no moment.

    Example:
        >>> learn_context(2)[:2]
        (4, ((1, 2), (1, 2)))
    """
    check_whole("num_moments", num_moments)
    rates = HierarchyRates(step_size=0.2, threshold=0.1 if grows else np.inf)
    net, inputs, rng = new_transition_hierarchy(3, 2, max_units=100), np.eye(3), np.random.default_rng(0)
    errors = np.zeros((num_sequences, 2))
    for i in range(num_sequences):
        first = int(rng.integers(2))
        hierarchy_begin(net)
        hierarchy_observe(net, inputs[first])
        for left in range(num_moments, 0, -1):
            hierarchy_observe(net, inputs[2])
            errors[i] = (left == 1) * inputs[first, :2] - net.value[:2]
            hierarchy_learn(net, rates, errors[i], 0)
    num_units = int(net.counts[0]) - 2
    roots = np.arange(num_units + 2)
    for unit in range(2, num_units + 2):
        roots[unit] = roots[net.modifies[unit, 0]]
    depths = tuple(tuple(net.delay[: num_units + 2][roots == i].tolist()[1:]) for i in range(2))
    return Chain(num_units, depths, float(np.abs(errors[-100:]).max()))


def moments_needed(maze: int) -> int:
    """How far one has to look back, beside what is seen and what was done last, to walk the shortest way.

    Example:
        >>> [moments_needed(maze) for maze in (1, 2, 3)]
        [0, 0, 2]
    """
    one, way = corridors(maze), shortest_way(maze)
    s, past = 0, []
    for i, a in enumerate(way):
        past.append((int(one.percepts[s]), way[i - 1] if i else -1))
        s = int(one.led[s, a])
    k = 0
    while len({tuple(past[max(i - k, 0) : i + 1]) for i in range(len(way))}) < len(
        {(tuple(past[max(i - k, 0) : i + 1]), a) for i, a in enumerate(way)}
    ):
        k += 1
    return k


def oracle() -> tuple[Row, ...]:
    """As rows."""
    lengths = range(1, _LONGEST + 1)
    chains = [learn_context(k) for k in lengths]
    told = [tuple(range(1, k + 1)) for k in lengths]
    blind = [learn_context(k, grows=False).error for k in lengths]
    shortest = [round(1.0 - solve(model(maze).mdp, 1.0).v[0]) for maze in range(1, NUM_MAZES + 1)]
    ways = [len(shortest_way(maze)) for maze in range(1, NUM_MAZES + 1)]
    needed = [moments_needed(maze) for maze in range(1, NUM_MAZES + 1)]
    return (
        claim(
            f"a context of k = 1 … {_LONGEST} moments: units that each of two outputs grows",
            "k, one behind the other",
            ", ".join(str(one.num_units // 2) for one in chains),
            all(one.depths == (depths, depths) for one, depths in zip(chains, told, strict=True)),
            "C after A x…x, D after B x…x",
        ),
        number("the same: the largest error then", 0.0, max(one.error for one in chains), tol=1e-12),
        claim("the same without growth", "at least .8", round(min(blind), 3), min(blind) >= 0.8),
        claim(
            "shortest ways of the nine mazes, by the exact solver",
            ", ".join(map(str, ways)),
            ", ".join(map(str, shortest)),
            ways == shortest,
        ),
        claim(
            "moments before the present one that the shortest way needs",
            "none in the first two mazes, then some",
            ", ".join(map(str, needed)),
            not any(needed[:2]) and all(needed[2:]),
            "beside what is seen and what was done last",
        ),
    )

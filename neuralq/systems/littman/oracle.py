"""What is exactly known of the maze: 404 steps for who sees the cell, 416 for who sees the percept and decides once."""

from __future__ import annotations

from functools import cache

import numpy as np

from neuralq.exact import MemorylessSolution, best_memoryless, evaluate_memoryless, solve, solve_histories
from neuralq.mdp import AliasedMDP, FiniteMDP
from neuralq.runs.report.claims import Row, number
from neuralq.systems.littman.trainings import LOST
from neuralq_envs.aliased import littman, walked

__all__ = ["best_policy", "oracle"]


@cache
def best_policy() -> MemorylessSolution:
    """The best policy of percepts that leaves nothing to chance, with its proof.

    Example:
        >>> best_policy().proved
        True
    """
    return best_memoryless(littman(), 1.0)


def oracle() -> tuple[Row, ...]:
    """As rows."""
    maze, best = littman(), best_policy()
    num_starts = int(np.count_nonzero(maze.mdp.start_distribution))
    return (
        number("steps from the 46 starts, who sees the cell", 404.0, -float(solve(maze.mdp, 1.0).v.sum())),
        number(
            "the best policy of percepts",
            416.0,
            -num_starts * best.value if best.proved else np.nan,
            note=f"proved by branch and bound, {best.num_bounds} bounds",
        ),
        number("the same policy, followed step by step", 416.0, float(walked(maze, best.policy, LOST).sum()), tol=0.0),
        *_counter_example(),
    )


def _counter_example(gamma: float = 0.9) -> tuple[Row, ...]:
    """Two states that look alike: a move to the other one pays 1, a refused one costs 1."""
    seen = FiniteMDP.from_arrays([[[0, 1], [0, 1]], [[1, 0], [1, 0]]], [[1.0, -1.0], [-1.0, 1.0]])
    swap = AliasedMDP(seen, np.zeros(2, dtype=np.int64))
    far = gamma / (1 - gamma)
    what = "two states that look alike"
    return (
        number(f"{what}: the best that decides once", -far, best_memoryless(swap, gamma).value),
        number(f"{what}: a coin", 0.0, float(evaluate_memoryless(swap, [[0.5, 0.5]], gamma).mean())),
        number(f"{what}: who remembers", far, solve_histories(swap, gamma).value),
    )

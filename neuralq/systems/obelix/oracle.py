"""What must be exact: a Hamming radius of 0 is a table, and a table is Q-learning written in plain Python."""

from __future__ import annotations

import numpy as np

from neuralq.runs.report.claims import Row, number
from neuralq.systems.obelix.kernels import BEHAVIOURS, Rates, live
from neuralq.systems.obelix.lives import TRIAL_STEPS, WEIGHTS, new_memory
from neuralq.tabular.kernels.bits import BitMemory, bit_hamming
from neuralq.tabular.kernels.random_numbers import Seed, new_stream
from neuralq_envs.obelix_kernels import NUM_MOVES, new_room

__all__ = ["oracle", "radius_difference"]


def oracle() -> tuple[Row, ...]:
    """As rows."""
    return (
        number(
            "Hamming distance with radius 0: difference from a table",
            0.0,
            radius_difference(),
            tol=0.0,
            note="three behaviours, 2,000 steps, bit for bit",
        ),
    )


def radius_difference(seed: Seed = 0, num_steps: int = 2000) -> float:
    """The largest difference between what a table and a radius of 0 have learned, or 1 where they pushed otherwise.

    Example:
        >>> radius_difference(num_steps=300)
        0.0
    """
    lives = []
    for kind in ("table", "radius 0"):
        one, two, three = (
            new_memory(kind) if kind == "table" else bit_hamming(WEIGHTS, NUM_MOVES, 0.0) for _ in range(3)
        )
        memories, pushed = (one, two, three), np.zeros(num_steps, np.bool_)
        live(
            BEHAVIOURS, memories, Rates(), new_room(), new_stream(seed), TRIAL_STEPS, np.zeros(11), np.zeros(NUM_MOVES),
            pushed, 0, np.zeros((0, 13)),
        )  # fmt: skip
        lives.append((memories, pushed))
    (tables, before), (shared, after) = lives
    worst = max(_difference(table, memory) for table, memory in zip(tables, shared, strict=True))
    return max(worst, float((before != after).any()))


def _difference(table: BitMemory, memory: BitMemory) -> float:
    """Over all states; those that were never seen are 0 in the table."""
    spread = np.zeros_like(table.q)
    spread[memory.states[: memory.used[0]]] = memory.q[: memory.used[0]]
    return float(np.abs(spread - table.q).max())

"""One life of the robot from nothing: how often it pushed, and what it remembers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.systems.obelix.kernels import BEHAVIOURS, HAND, MONOLITH, RANDOM, Rates, live
from neuralq.tabular.kernels.bits import BitMemory, bit_clusters, bit_hamming, bit_table
from neuralq.tabular.kernels.random_numbers import Seed, new_stream
from neuralq_envs.obelix_kernels import NUM_BITS, NUM_MOVES, new_room

__all__ = ["CONTROLS", "GENERALISERS", "TRIAL_STEPS", "Life", "new_memory", "spend"]

CONTROLS = {"monolith": MONOLITH, "behaviours": BEHAVIOURS, "by hand": HAND, "random": RANDOM}
GENERALISERS = ("table", "Hamming", "clusters")
TRIAL_STEPS = 100
"""Steps between two rooms."""
WEIGHTS = np.array([2.0, 1.0] * 8 + [5.0, 5.0])
"""Of NEAR and FAR of each sonar, BUMP and STUCK."""
RADIUS = 1.0


@dataclass(frozen=True, eq=False)
class Life:
    """What came of one life.

    Args:
        pushed: whether a box was pushed, by step.
        film: its last steps: robot (3), boxes (8), behaviour and bits, ``[F, 13]``.
    """

    pushed: NDArray[np.bool_]
    film: NDArray[np.float64]

    @property
    def share(self) -> float:
        """Of the steps of the last quarter, how many pushed a box."""
        return float(self.pushed[-(len(self.pushed) // 4) :].mean())


def new_memory(generaliser: str) -> BitMemory:
    """An empty memory of the robot's bits.

    Raises:
        ValueError: another generaliser.

    Example:
        >>> new_memory("clusters").num_bits
        18
    """
    check_choice("generaliser", generaliser, GENERALISERS)
    if generaliser == "table":
        return bit_table(NUM_BITS, NUM_MOVES)
    return bit_hamming(WEIGHTS, NUM_MOVES, RADIUS) if generaliser == "Hamming" else bit_clusters(NUM_BITS, NUM_MOVES)


def spend(
    seed: Seed, control: str, generaliser: str = "table", *, num_steps: int = 8000, filmed_steps: int = TRIAL_STEPS
) -> Life:
    """A life of so many steps, in another room every hundred.

    Args:
        seed: of the stream that draws rooms and moves.
        control: one of `CONTROLS`.
        generaliser: one of `GENERALISERS`; whoever does not learn needs none.
        num_steps: of the life.
        filmed_steps: how many of the last are filmed.

    Raises:
        ValueError: a name that is not known, or a count below what is needed.

    Example:
        >>> life = spend(0, "random", num_steps=400)
        >>> life.pushed.shape, life.film.shape
        ((400,), (100, 13))
    """
    check_choice("control", control, CONTROLS)
    check_whole("num_steps", num_steps, 4)
    check_whole("filmed_steps", filmed_steps, 0)
    memories = (new_memory(generaliser), new_memory(generaliser), new_memory(generaliser))
    pushed, film = np.zeros(num_steps, np.bool_), np.zeros((min(filmed_steps, num_steps), 13))
    live(
        CONTROLS[control], memories, Rates(), new_room(), new_stream(seed), TRIAL_STEPS, np.zeros(11),
        np.zeros(NUM_MOVES), pushed, num_steps - len(film), film,
    )  # fmt: skip
    return Life(pushed, film)

"""The chain of Boyan 1999: thirteen states, down by one or two with equal chances, −3 a move, −2 for the last one.

The values are V(s) = −2s (γ = 1), and linear in four features, which interpolate between the states 12, 8, 4 and 0: the
weights −24, −16, −8, 0 give all of them exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.mdp import FiniteMDP
from neuralq_envs.graphs import GraphScene
from neuralq_envs.rendering import factories

__all__ = ["GAMMA", "NUM_STATES", "features", "make", "make_vector", "mdp"]

GAMMA = 1.0
NUM_STATES = 13
_START = NUM_STATES - 1


def mdp() -> FiniteMDP:
    """The exact model: every episode starts in state 12 and ends in state 0.

    Example:
        >>> mdp().reward.tolist()[:3]
        [-2.0, -3.0, -3.0]
    """

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        if s == 1:
            return [(1.0, 0, -2.0, True)]
        return [(0.5, s - jump, -3.0, s == jump) for jump in (1, 2)]

    return FiniteMDP.from_functions(
        NUM_STATES,
        1,
        lambda s: [0] if s else [],
        transitions,
        start=[float(s == _START) for s in range(NUM_STATES)],
        action_names=("move",),
    )


def features() -> NDArray[np.float64]:
    """X ``[13, 4]``: state 12 is (1, 0, 0, 0), 11 is (3/4, 1/4, 0, 0), ..., 8 is (0, 1, 0, 0), ..., 0 is (0, 0, 0, 1).

    Example:
        >>> features()[[12, 11, 0]].tolist()
        [[1.0, 0.0, 0.0, 0.0], [0.75, 0.25, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    """
    knots = np.array([12.0, 8.0, 4.0, 0.0])
    weights: NDArray[np.float64] = np.maximum(0.0, 1 - np.abs(np.arange(NUM_STATES)[:, None] - knots) / 4)
    return weights


def _scene() -> GraphScene:
    return GraphScene(
        labels=tuple(map(str, range(NUM_STATES))),
        places=tuple((0, _START - s) for s in range(NUM_STATES)),
        edges=tuple((s, s - jump) for s in range(1, NUM_STATES) for jump in (1, 2) if s >= jump),
        ends=(0,),
    )


make, make_vector = factories(mdp, _scene)

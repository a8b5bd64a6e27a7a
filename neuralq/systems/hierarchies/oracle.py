"""What must be exact: a composite task is an elemental one and a constant, and how long the shortest ways are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.exact import solve
from neuralq.runs.report.claims import Row, number
from neuralq.systems.hierarchies.studies import ROOM, SHORTEST
from neuralq_envs.landmarks import NUM_CELLS, TASKS, mdp

__all__ = ["constants", "largest_spread", "oracle"]

_OPTIMA = {"A": 5.661, "B": 5.119, "C": 5.593, "AC": 10.661, "BC": 11.119, "ABC": 20.661}


def constants(step_reward: float = -0.05) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """K of each stage of the six tasks, and by how much Q of the stage less Q of its elemental task varies, ``[10]``.

    Args:
        step_reward: of a step.

    Example:
        >>> constants()[0].round(9).tolist()
        [0.0, 0.0, 0.0, -0.25, 0.0, -0.3, 0.0, -0.75, -0.3, 0.0]
    """
    whole = solve(mdp(step_reward=step_reward), 1.0).q.reshape(len(ROOM.goals), NUM_CELLS, 4)
    alone = np.stack([solve(mdp([task], step_reward=step_reward), 1.0).q for task in TASKS[:3]])
    apart = [whole[i] - alone[landmark] for i, landmark in enumerate(ROOM.landmarks)]
    return np.array([np.nanmean(one) for one in apart]), np.array([np.nanmax(one) - np.nanmin(one) for one in apart])


def largest_spread() -> float:
    """By how much a composite Q less the elemental one varies over states and actions, at most.

    Example:
        >>> largest_spread() < 1e-9
        True
    """
    return float(constants()[1].max())


def oracle() -> tuple[Row, ...]:
    """As rows."""
    values, spreads = constants()
    told = ", ".join(f"{value:.2f}" for value in values if abs(value) > 1e-9)
    return (
        number(
            "Q of a stage less Q of its elemental task: how much it varies",
            0.0,
            float(spreads.max()),
            note=f"ten stages, all cells and moves; the constants that are not 0: {told}",
        ),
        *(
            number(f"shortest ways of task {task}, mean over the starts", steps, float(mean), tol=5e-4)
            for (task, steps), mean in zip(_OPTIMA.items(), SHORTEST, strict=True)
        ),
    )

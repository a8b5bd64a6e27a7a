"""Random walks on which TD converges: the controls of every experiment.

The five states of Sutton 1988 (reward 1 at the right end) and the nineteen of Sutton & Barto 2018, example 7.1 (−1 and
1) are learned on-policy with a table. The off-policy walk has the rewards −1 and 1 on five states; the target goes
right with probability .6, the behaviour tosses a coin. It is learned with three kinds of features: tabular; inverted,
where a state is told by the one feature that is missing; and dependent, three features for five states, which cannot
represent the values. With q = ⅔ the chance of left against right, V(i) = 2 (1 − qⁱ)/(1 − q⁶) − 1 for i = 1..5.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_fraction
from neuralq.mdp import FiniteMDP
from neuralq_envs import random_walk
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["LEFT", "RIGHT", "walk5", "walk19", "walk_off_policy", "walk_values"]

LEFT, RIGHT = 0, 1
WalkFeatures = Literal["tabular", "inverted", "dependent"]
"""How the off-policy walk shows its states."""


def walk5() -> Problem:
    """The five-state walk of Sutton 1988, on-policy in a table; all estimates start at ½.

    Example:
        >>> (walk5().state_distribution * 9).round(12).tolist()
        [0.0, 1.0, 2.0, 3.0, 2.0, 1.0, 0.0]
    """
    return Problem.from_mdp(
        random_walk.mdp(5),
        _between_ends(np.eye(5)),
        gamma=random_walk.GAMMA,
        initial_weights=np.full(5, 0.5),
        step_size=0.1,
        name="walk5",
        title="Five-state walk",
        source="Sutton 1988; Sutton & Barto 2018, example 6.2",
        known="On-policy and tabular: TD(λ) converges to 1/6, 2/6, ..., 5/6.",
    )


def walk19() -> Problem:
    """The nineteen-state walk, on-policy in a table.

    Example:
        >>> walk19().features.shape
        (21, 19)
    """
    return Problem.from_mdp(
        random_walk.mdp(19, left_reward=-1.0),
        _between_ends(np.eye(19)),
        gamma=random_walk.GAMMA,
        initial_weights=np.zeros(19),
        step_size=0.4,
        name="walk19",
        title="Nineteen-state walk",
        source="Sutton & Barto 2018, example 7.1",
        known="On-policy and tabular: TD(λ) converges to −.9, −.8, ..., .9.",
    )


def walk_off_policy(features: WalkFeatures = "dependent", right: float = 0.6) -> Problem:
    """The five-state walk with rewards −1 and 1 whose target goes right with probability ``right``; μ is a coin.

    Raises:
        ValueError: unknown features, or ``right`` outside [0, 1].

    Example:
        >>> walk_off_policy("inverted").features[1].tolist()
        [0.0, 0.5, 0.5, 0.5, 0.5]
    """
    check_choice("features", features, ("tabular", "inverted", "dependent"))
    check_fraction("right", right)
    tables = {"tabular": np.eye(5), "inverted": (np.ones((5, 5)) - np.eye(5)) / 2, "dependent": _dependent()}

    def transitions(s: int, a: int) -> Sequence[tuple[float, int, float, bool]]:
        s_t = s + (1 if a == RIGHT else -1)
        return [(1.0, s_t, {0: -1.0, 6: 1.0}.get(s_t, 0.0), s_t in (0, 6))]

    model = FiniteMDP.from_functions(
        7,
        2,
        lambda s: [LEFT, RIGHT] if 0 < s < 6 else [],
        transitions,
        start=np.eye(7)[3],
        state_names=["left end", *"ABCDE", "right end"],
        action_names=("left", "right"),
    )
    table = _between_ends(tables[features])
    inside = _between_ends(np.ones((5, 1)))
    return Problem.from_mdp(
        model,
        table,
        gamma=1.0,
        target_policy=inside * [1 - right, right],
        behaviour_policy=inside * [0.5, 0.5],
        initial_weights=np.zeros(table.shape[1]),
        step_size=0.05,
        name=f"walk-{features}",
        title=f"Off-policy walk, {features} features",
        source="Ghiassian et al. 2020; features of Sutton et al. 2009",
        known="Off-policy, and TD(0) converges: the behaviour does not stray far from the target."
        + (" Three features cannot represent the five values." if features == "dependent" else ""),
    )


def walk_values(right: float = 0.6) -> NDArray[np.float64]:
    """Values of the five states when walking right with probability ``right``: 2 (1 − qⁱ)/(1 − q⁶) − 1, ``[5]``.

    q = (1 − right)/right: the chance to leave by the right end is the gambler's ruin.

    Raises:
        ValueError: ``right`` outside [0, 1].

    Example:
        >>> walk_values(0.5).round(6).tolist()
        [-0.666667, -0.333333, 0.0, 0.333333, 0.666667]
    """
    check_fraction("right", right)
    place = np.arange(1.0, 6.0)
    if right == 0.5:
        return place / 3.0 - 1.0
    if right < 0.5:  # seen from the other end, so that q stays below 1
        return -walk_values(1.0 - right)[::-1]
    q = (1.0 - right) / right
    return np.asarray(2.0 * (1.0 - q**place) / (1.0 - q**6) - 1.0, dtype=np.float64)


def _between_ends(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows of the states of the walk, with a row of 0 for each end."""
    return np.pad(rows, ((1, 1), (0, 0)))


def _dependent() -> NDArray[np.float64]:
    """Three features of five states, each row of length 1."""
    rows = np.array([[1.0, 0, 0], [1, 1, 0], [1, 1, 1], [0, 1, 1], [0, 0, 1]])
    unit: NDArray[np.float64] = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return unit

"""What residual methods find, and what no data can tell (Sutton & Barto 2018, examples 11.2 to 11.4).

A-split: A leads to B or C evenly, B then pays 1, C pays 0. A table holds the values (½, 1, 0), but the squared TD error
is least at (½, ¾, ¼), which is where the residual gradient goes when one sample of the successor serves twice.

A-presplit: A is two states that look alike, one before B and one before C. Everything is deterministic now, so the
Bellman error is the TD error, and even the true residual gradient goes to (½, ¾, ¼); TD finds (½, 1, 0).

The last pair of processes shows the same stream of features, actions and rewards to a learner, so nothing it can do
tells them apart. On the left A and B are all there is and w = 0 has no Bellman error. On the right B is two states,
one of which is always followed by A and pays 1, the other never and pays −1: at w = 0 the squared Bellman error is 2/3,
and it is least at

    w = (−γ, γ/2) / (1 + γ + γ²),     which tends to (−1/3, 1/6) as γ → 1.

The book prints (−1/2, 0) as the limit of these minimisers. That point lies on the line w_B − w_A = 1/2 of the points
that minimise the error at γ = 1 itself, as does (−1/3, 1/6), but for no γ below 1 is the minimiser near it.
"""

from __future__ import annotations

import numpy as np

from neuralq.checks import check_discount
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["a_presplit", "a_split", "bellman_error_left", "bellman_error_right", "right_minimiser"]


def a_split() -> Problem:
    """A leads to B or C evenly, B pays 1 and C nothing; a table, γ = 1.

    Example:
        >>> a_split().state_distribution.round(12).tolist()
        [0.5, 0.25, 0.25]
    """
    transition = [[0.0, 0.5, 0.5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    model = FiniteMDP.from_arrays(
        [transition],
        [[0.0], [1.0], [0.0]],
        substochastic=True,
        start=[1.0, 0.0, 0.0],
        state_names=("A", "B", "C"),
    )
    return Problem.from_mdp(
        model,
        np.eye(3),
        gamma=1.0,
        initial_weights=np.zeros(3),
        step_size=0.1,
        name="a-split",
        title="A-split",
        source="Sutton & Barto 2018, example 11.2",
        known="The values are (1/2, 1, 0), which TD and the double-sampled residual gradient find. The mean squared TD "
        "error is least at (1/2, 3/4, 1/4), where the naive residual gradient goes.",
    )


def a_presplit() -> Problem:
    """Two states that look like A lead to B and to C; B pays 1 and C nothing; γ = 1.

    Example:
        >>> a_presplit().features[:2].tolist()
        [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    transition = np.zeros((4, 4))
    transition[0, 2] = transition[1, 3] = 1.0
    model = FiniteMDP.from_arrays(
        [transition],
        [[0.0], [0.0], [1.0], [0.0]],
        substochastic=True,
        start=[0.5, 0.5, 0.0, 0.0],
        state_names=("A1", "A2", "B", "C"),
    )
    return Problem.from_mdp(
        model,
        np.eye(3)[[0, 0, 1, 2]],
        gamma=1.0,
        initial_weights=np.zeros(3),
        step_size=0.1,
        name="a-presplit",
        title="A-presplit",
        source="Sutton & Barto 2018, example 11.3",
        known="TD finds (1/2, 1, 0), the best values that the features allow. The Bellman error is least at "
        "(1/2, 3/4, 1/4), where every residual gradient goes.",
    )


def bellman_error_left(gamma: float = 0.9) -> Problem:
    """Two states: A leads to B, B evenly to A with reward 1 or to itself with reward −1.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> bellman_error_left().state_distribution.round(6).tolist()
        [0.333333, 0.666667]
    """
    moves = {0: [(1.0, 1, 0.0, False)], 1: [(0.5, 0, 1.0, False), (0.5, 1, -1.0, False)]}
    model = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: moves[s], state_names=("A", "B"))
    return Problem.from_mdp(
        model,
        np.eye(2),
        gamma=gamma,
        step_size=0.1,
        name="bellman-error-left",
        title="Bellman error, left",
        source="Sutton & Barto 2018, example 11.4",
        known="w = 0 is exact and has no Bellman error, but the data are those of the process on the right, where it "
        "has: the Bellman error cannot be learned from data.",
    )


def bellman_error_right(gamma: float = 0.9) -> Problem:
    """Three states, two of which look like B: one pays 1 and leads to A, the other pays −1 and stays among the B.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> bellman_error_right().features.tolist()
        [[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]
    """
    check_discount("gamma", gamma)
    moves = {
        0: [(0.5, 1, 0.0, False), (0.5, 2, 0.0, False)],
        1: [(1.0, 0, 1.0, False)],
        2: [(0.5, 1, -1.0, False), (0.5, 2, -1.0, False)],
    }
    model = FiniteMDP.from_functions(3, 1, lambda s: [0], lambda s, a: moves[s], state_names=("A", "B", "B'"))
    best = ", ".join(f"{weight:.4f}" for weight in right_minimiser(gamma))
    return Problem.from_mdp(
        model,
        np.eye(2)[[0, 1, 1]],
        gamma=gamma,
        step_size=0.1,
        name="bellman-error-right",
        title="Bellman error, right",
        source="Sutton & Barto 2018, example 11.4",
        known=f"TD finds w = 0, of squared Bellman error 2/3. The minimiser is ({best}) and tends to (−1/3, 1/6) as "
        "γ → 1; the book prints (−1/2, 0).",
    )


def right_minimiser(gamma: float) -> tuple[float, float]:
    """The Bellman error of the process on the right is least at w = (−γ, γ/2) / (1 + γ + γ²).

    Both derivatives of ½[(γw₂ − w₁)² + (1 + γw₁ − w₂)² + (−1 + γw₂ − w₂)²] vanish there. At γ = 1 the minimisers are
    the line w₂ − w₁ = 1/2, of which this is the limit.

    Raises:
        ValueError: γ outside [0, 1].

    Example:
        >>> [round(weight, 6) for weight in right_minimiser(0.5)]
        [-0.285714, 0.142857]
    """
    check_discount("gamma", gamma)
    scale = gamma / (1.0 + gamma + gamma**2)
    return -scale, scale / 2

"""Bertsekas' chain (Bertsekas 1995): TD(0) and TD(1) converge to weights of opposite sign, on-policy.

State i = n, ..., 1 leads to i − 1, state 0 ends. The one feature is x(i) = i. The costs are 1 in state n, −(n − 1) in
state 1 and else 0, so the cost to go is −(n − 1) everywhere but in n, where it is −(n − 2). Nothing diverges, but

    w_TD(0) = 2 / (n (n + 1)) > 0,        w_TD(1) = Σ i J(i) / Σ i² < 0:

with x(i) − x(i−1) = 1 the TD(0) matrix is Σ i / n = (n + 1)/2, and b = (n − (n − 1))/n = 1/n.
"""

from __future__ import annotations

import numpy as np

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["bertsekas", "fixed_point"]


def bertsekas(num_states: int = 50) -> Problem:
    """A chain on which the TD(0) fixed point has the wrong sign; rewards are the costs, γ = 1.

    Raises:
        ValueError: fewer than two states.

    Example:
        >>> problem = bertsekas(4)
        >>> problem.mdp.reward.tolist(), problem.features.reshape(-1).tolist()
        ([-3.0, 0.0, 0.0, 1.0], [0.0, 1.0, 2.0, 3.0, 4.0])
    """
    check_whole("num_states", num_states, minimum=2)
    n = int(num_states)
    reward = np.zeros((n + 1, 1))
    reward[0], reward[1], reward[n] = np.nan, -(n - 1.0), 1.0  # NaN: state 0 has no action
    start = np.zeros(n + 1)
    start[n] = 1.0
    model = FiniteMDP.from_arrays([np.eye(n + 1, k=-1)], reward, start=start)
    return Problem.from_mdp(
        model,
        np.arange(n + 1.0)[:, None],
        gamma=1.0,
        initial_weights=[0.0],
        step_size=1 / n**2,
        name="bertsekas",
        title="Bertsekas' chain",
        source="Bertsekas 1995",
        known=f"Every TD(λ) converges, TD(0) to 2/(n(n + 1)) = {fixed_point(n):.4g}, a weight of the wrong sign: the "
        "least-squares weight is negative.",
    )


def fixed_point(num_states: int) -> float:
    """TD(0) converges to 2/(n(n + 1)).

    Raises:
        ValueError: fewer than two states.

    Example:
        >>> fixed_point(50) == 2 / 2550
        True
    """
    check_whole("num_states", num_states, minimum=2)
    return 2.0 / (num_states * (num_states + 1))

"""Semi-Markov decisions: actions that last, and a discount that depends on how long.

Where the next decision comes τ later, and rewards that arrive at a rate ρ(t) in between are discounted by e^(−βt), the
Bellman equation is

    Q(s_tm1, a_tm1) = E[r_t + e^(−βτ) max_a Q(s_t, a)],   r_t = ∫ e^(−βt) ρ(t) dt from 0 to τ.

So nothing changes but the discount, which is no longer one γ: with `smdp_discount` as their ``discount_t``, the targets
and returns of `neuralq.rules` are those of semi-Markov problems. The same step for a table in compiled code is
`neuralq.tabular.smdp_q_update`, for a network `neuralq.learners.smdp_network_update`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.checks import check_positive
from neuralq.rules.shapes import check_same_shape

__all__ = ["smdp_discount"]


def smdp_discount(duration_t: Tensor, terminated_t: Tensor, rate: float) -> Tensor:
    """What follows a decision counts e^(−βτ) after a duration τ, and nothing where the world terminated.

    Args:
        duration_t: τ between the decision and the next one, in any unit, ``[*n]``, at least 0.
        terminated_t: whether the world terminated, bool ``[*n]``.
        rate: β > 0, per unit of time; γ per unit of time is e^(−β).

    Returns:
        ``discount_t``, ``[*n]``.

    Raises:
        ValueError: if the shapes differ, a duration is negative or the rate is not positive.

    Source: Bradtke & Duff 1995, eq. 2.

    Example:
        SMDP Q-learning: a reward of 1 a second for 2 s and then values of 3 and 5, with β = .5. The reward is
        (1 − e⁻¹)/.5 = 1.2642, and the best value counts e⁻¹.

        >>> from neuralq.rules import q_learning
        >>> discount_t = smdp_discount(torch.tensor([2.0, 2.0]), torch.tensor([False, True]), rate=0.5)
        >>> q_learning(torch.tensor([1.2642, 1.2642]), discount_t, torch.tensor([[3.0, 5.0], [3.0, 5.0]]))
        tensor([3.1036, 1.2642])
    """
    check_same_shape("terminated_t", terminated_t, "duration_t", duration_t)
    check_positive("rate", rate)
    if (duration_t < 0).any():
        raise ValueError(
            f"duration_t must be at least 0, got {duration_t.min().item():g}; durations are differences of times"
        )
    return torch.exp(-rate * duration_t).masked_fill(terminated_t, 0.0)

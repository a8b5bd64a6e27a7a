"""Collision (Ghiassian & Sutton 2021): eight states on the way to an obstacle, seen through six random bits.

Episodes start evenly in the first four states, where ``forward`` is all there is. In the last four the car may also
``turn away``, which ends the episode without reward; ``forward`` in the last state collides and pays 1. The target
drives on, the behaviour turns away every other time, γ = .9, so V(i) = .9^(8−i), i = 1..8. An episode visits the states
1/4, 1/2, 3/4, 1, 1, 1/2, 1/4, 1/8 times: d = (2, 4, 6, 8, 8, 4, 2, 1)/35, and lasts 35/8 steps. Each state shows three
of six bits, so the values cannot be represented; off-policy TD was stable on every set of bits that we tried.
"""

from __future__ import annotations

import numpy as np

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["FORWARD", "TURN", "collision"]

FORWARD, TURN = 0, 1
_NUM_STATES, _NUM_BITS, _NUM_ON = 8, 6, 3


def collision(seed: int = 0) -> Problem:
    """Eight states, each with three of six bits chosen at random by ``seed``.

    Raises:
        ValueError: a negative seed.

    Example:
        >>> (collision().state_distribution * 35).round(12).tolist()
        [2.0, 4.0, 6.0, 8.0, 8.0, 4.0, 2.0, 1.0]
    """
    check_whole("seed", seed, minimum=0)
    transition = np.zeros((2, _NUM_STATES, _NUM_STATES))
    transition[FORWARD] = np.eye(_NUM_STATES, k=1)
    reward = np.zeros((_NUM_STATES, 2))
    reward[:4, TURN] = np.nan  # not legal there
    reward[-1, FORWARD] = 1.0
    model = FiniteMDP.from_arrays(
        transition,
        reward,
        substochastic=True,
        start=[0.25] * 4 + [0.0] * 4,
        action_names=("forward", "turn away"),
    )
    rng = np.random.default_rng(seed)
    bits = np.zeros((_NUM_STATES, _NUM_BITS))
    for row in bits:
        row[rng.choice(_NUM_BITS, _NUM_ON, replace=False)] = 1.0
    return Problem.from_mdp(
        model,
        bits,
        gamma=0.9,
        target_policy=np.tile([1.0, 0.0], (_NUM_STATES, 1)),
        behaviour_policy=model.legal / model.legal.sum(axis=1, keepdims=True),
        initial_weights=np.zeros(_NUM_BITS),
        step_size=0.05,
        name="collision",
        title="Collision",
        source="Ghiassian & Sutton 2021",
        known="Off-policy, but TD(0) is stable; the weights are not unique where the bits are dependent.",
    )

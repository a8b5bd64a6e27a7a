"""What a counterexample consists of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_discount, check_positive
from neuralq.mdp import FiniteMDP

__all__ = ["Counterexample"]


@dataclass(frozen=True, eq=False)
class Counterexample:
    """A model, features, two policies and an update distribution: all that decides whether linear TD converges.

    Args:
        name: how it is called.
        mdp: the model.
        features: X, one row per state, ``[S, d]``.
        target_policy: π, whose values are learned, ``[S, A]``.
        behaviour_policy: μ, which chooses the actions, ``[S, A]``.
        state_distribution: how often each state is updated, ``[S]``.
        initial_weights: where learning starts, ``[d]``.
        gamma: γ.
        step_size: α of the published experiment.
        source: author and year.

    Raises:
        ValueError: shapes that do not fit the model, or a behaviour policy that never takes an action the target takes.
    """

    name: str
    mdp: FiniteMDP
    features: NDArray[np.float64]
    target_policy: NDArray[np.float64]
    behaviour_policy: NDArray[np.float64]
    state_distribution: NDArray[np.float64]
    initial_weights: NDArray[np.float64]
    gamma: float
    step_size: float
    source: str

    def __post_init__(self) -> None:
        check_discount("gamma", self.gamma)
        check_positive("step_size", self.step_size)
        pairs = (self.mdp.num_states, self.mdp.num_actions)
        if np.ndim(self.features) != 2:
            raise ValueError(f"features must be [S, d], got shape {np.shape(self.features)}")
        expected = {
            "features": (pairs[0], self.features.shape[1]),
            "target_policy": pairs,
            "behaviour_policy": pairs,
            "state_distribution": pairs[:1],
            "initial_weights": self.features.shape[1:],
        }
        for field, shape in expected.items():
            if np.shape(getattr(self, field)) != shape:
                raise ValueError(f"{field} must have shape {shape}, got {np.shape(getattr(self, field))}")
        uncovered = np.argwhere((self.behaviour_policy == 0) & (self.target_policy > 0))
        if uncovered.size:
            s, a = uncovered[0]
            raise ValueError(f"the behaviour policy never takes action {a} in state {s}, which the target policy takes")

    @property
    def importance_ratio(self) -> NDArray[np.float64]:
        """ρ = π / μ, ``[S, A]``; 0 where the target policy never goes."""
        covered = self.behaviour_policy > 0
        return np.where(covered, self.target_policy / np.where(covered, self.behaviour_policy, 1.0), 0.0)

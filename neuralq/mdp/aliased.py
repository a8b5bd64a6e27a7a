"""A finite model that is seen through an observation function: states that look alike share one observation.

What can be known of the state is what was observed and done so far, so a policy is a function of histories. A
*memoryless* policy looks at the present observation only. (Whitehead & Ballard 1991 call it perceptual aliasing; it is
a partially observable process whose observations are certain.) Rewards are not part of what is observed; that an
episode has ended is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neuralq.mdp.model import FiniteMDP

__all__ = ["AliasedMDP"]


@dataclass(frozen=True, eq=False)
class AliasedMDP:
    """A finite MDP of S states and what each of them looks like, one of O observations.

    Args:
        mdp: the model.
        observation: of every state, whole numbers from 0, ``[S]``. States that look alike and have actions have the
            same ones; what terminal states look like is free.
        observation_names: optional, O strings.

    Raises:
        ValueError: an observation of another shape or kind, another number of names, or states that look alike and have
            other legal actions.

    Example:
        >>> corridor = FiniteMDP.from_arrays([[[0, 1, 0], [0, 0, 1], [0, 0, 0]]], [[-1.0], [-1.0], [np.nan]])
        >>> AliasedMDP(corridor, [0, 0, 1]).num_observations
        2
    """

    mdp: FiniteMDP
    observation: NDArray[np.int64]
    observation_names: Sequence[str] | None = None

    def __post_init__(self) -> None:
        seen = np.array(self.observation)
        if seen.shape != (self.mdp.num_states,) or seen.dtype.kind not in "iu" or seen.min() < 0:
            raise ValueError(
                f"observation must be {self.mdp.num_states} whole numbers from 0, one for each state, got "
                f"{self.observation!r:.80}"
            )
        seen = seen.astype(np.int64)
        seen.flags.writeable = False
        object.__setattr__(self, "observation", seen)
        unlike = (self.mdp.legal != self.legal[seen]).any(axis=1)
        bad = np.flatnonzero(unlike & ~self.mdp.is_terminal)
        if bad.size:
            raise ValueError(f"{self.mdp.state_name(bad[0])} looks like a state with other legal actions")
        names = self.observation_names
        if names is not None and len(names) != self.num_observations:
            raise ValueError(f"observation_names must hold {self.num_observations} names, got {len(names)}")
        object.__setattr__(self, "observation_names", None if names is None else tuple(names))

    @property
    def num_observations(self) -> int:
        """O, one more than the largest observation."""
        return int(self.observation.max()) + 1

    @cached_property
    def legal(self) -> NDArray[np.bool_]:
        """Which actions each observation has, ``[O, A]``; none where only terminal states look so."""
        legal = np.zeros((self.num_observations, self.mdp.num_actions), dtype=bool)
        acting = np.flatnonzero(~self.mdp.is_terminal)
        legal[self.observation[acting]] = self.mdp.legal[acting]
        return legal

    def observation_name(self, o: int) -> str:
        """How messages call observation ``o``."""
        return (
            f"observation {o}" if self.observation_names is None else f"observation {o} ({self.observation_names[o]})"
        )

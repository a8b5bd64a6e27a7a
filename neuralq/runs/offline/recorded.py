"""Recorded experience: steps in the order in which they were taken, episode after episode.

A file holds arrays with one entry per step (NumPy's .npz, read without pickle), laid out as D4RL's are:

    observations [N, *obs]   actions [N]   rewards [N]   terminations [N] (or terminals)   truncations [N] (or timeouts)

and, where they are known, next_observations [N, *obs] and probabilities [N] (of the action, under whoever acted).
Without next_observations the successor of a step is the next step's observation; where an episode was cut, or the file
ends, nobody knows it, and that step is left out: what comes after it cannot be estimated.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from neuralq.types import Array, Floats

__all__ = ["LAYOUT", "Recorded", "recorded_from"]

LAYOUT = (
    "a data set holds observations [N, *obs], actions [N], rewards [N], terminations [N] and truncations [N] (D4RL's "
    "terminals and timeouts will do)"
)


@dataclass(frozen=True)
class Recorded:
    """N steps as the environment gave them.

    Args:
        observations: before the actions ``[N, *obs]``.
        actions: as the environment counts them ``[N]``, whole numbers.
        rewards: ``[N]``, finite.
        terminations: where the world ended ``[N]``, bool.
        truncations: where an episode was cut ``[N]``, bool.
        next_observations: successors ``[N, *obs]``; None where the next step's observation is one.
        probabilities: of each action under whoever acted ``[N]``, in (0, 1]; None where nobody knows.

    Raises:
        ValueError: for arrays that do not go together.

    Example:
        >>> data = Recorded(np.arange(3.0), np.zeros(3, int), np.ones(3), np.array([0, 0, 1]) > 0, np.zeros(3, bool))
        >>> data.num_episodes, data.known.tolist()
        (1, [True, True, True])
    """

    observations: Array
    actions: Array
    rewards: Floats
    terminations: Array
    truncations: Array
    next_observations: Array | None = None
    probabilities: Array | None = None

    def __post_init__(self) -> None:
        """Refuse what is no step for step record."""
        count = len(self.actions)
        for name, value in self.arrays().items():
            wanted = self.observations.shape[1:] if name.endswith("observations") else ()
            if value.shape != (count, *wanted):
                raise ValueError(f"{name} must have shape {(count, *wanted)}, got {value.shape}; {LAYOUT}")
        if count == 0:
            raise ValueError("the data set holds no step")
        if self.actions.dtype.kind not in "iu":
            raise ValueError(f"actions must be whole numbers, got {self.actions.dtype}: neuralq knows discrete actions")
        for name in ("rewards", "probabilities"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite, step {np.flatnonzero(~np.isfinite(value))[0]} is not")
        if self.probabilities is not None and not ((self.probabilities > 0) & (self.probabilities <= 1)).all():
            raise ValueError("probabilities must lie above 0 and up to 1: each is that of the action that was taken")

    def arrays(self) -> dict[str, Array]:
        """Those that there are, by name."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: value for name, value in fields.items() if value is not None}

    @property
    def ends(self) -> Array:
        """Where an episode ends ``[N]``; the record does at its last step."""
        ends: Array = self.terminations | self.truncations
        return np.append(ends[:-1], True)

    @property
    def num_episodes(self) -> int:
        """How many."""
        return int(self.ends.sum())

    @property
    def episodes(self) -> Array:
        """Which episode each step is of ``[N]``, counted from 0."""
        return np.append(0, np.cumsum(self.ends)[:-1])

    @property
    def known(self) -> Array:
        """Where what came after the step is known, or the world ended ``[N]``."""
        return (
            np.ones(len(self.actions), bool) if self.next_observations is not None else self.terminations | ~self.ends
        )

    @property
    def successors(self) -> Array:
        """What each step led to ``[N, *obs]``; its own observation where nobody knows, and where none matters."""
        if self.next_observations is not None:
            return self.next_observations
        at = np.arange(len(self.actions))
        successors: Array = self.observations[np.where(self.ends, at, np.minimum(at + 1, len(at) - 1))]
        return successors

    @property
    def longest_episode(self) -> int:
        """Steps of the longest."""
        return int(np.bincount(self.episodes).max())

    def sha256(self) -> str:
        """Of all arrays: two records of one hash are the same."""
        digest = hashlib.sha256()
        for name, value in self.arrays().items():
            digest.update(f"{name} {value.dtype.str} {value.shape}".encode())
            digest.update(np.ascontiguousarray(value).tobytes())
        return digest.hexdigest()


def recorded_from(arrays: Mapping[str, Array]) -> Recorded:
    """The record in arrays of these names; others are left alone.

    Raises:
        ValueError: if one is missing or of another kind.

    Example:
        >>> arrays = {"observations": np.eye(2), "actions": np.zeros(2, int), "rewards": np.ones(2)}
        >>> recorded_from({**arrays, "terminations": np.array([0, 1])}).truncations.tolist()
        [False, False]
    """
    missing = [name for name in ("observations", "actions", "rewards", "terminations") if name not in arrays]
    if missing:
        raise ValueError(f"{' and '.join(missing)} missing, got {', '.join(sorted(arrays)) or 'nothing'}; {LAYOUT}")
    values = {name: arrays[name] for name in (f.name for f in dataclasses.fields(Recorded)) if name in arrays}
    values.setdefault("truncations", np.zeros(len(values["actions"]), bool))
    for name in ("terminations", "truncations"):
        if not np.isin(values[name], (0, 1)).all():
            raise ValueError(f"{name} must be true or false, got others; {LAYOUT}")
        values[name] = values[name].astype(bool)
    for name in ("rewards", "probabilities"):
        if name in values and values[name].dtype.kind not in "biuf":
            raise ValueError(f"{name} must be numbers, got {values[name].dtype}")
        if name in values:
            values[name] = values[name].astype(np.float64)
    return Recorded(**values)

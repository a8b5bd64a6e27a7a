"""A recorded data set where a stream of experience would be: nothing is stepped, and all of it is there at once.

One step of the budget is what one step of an environment would have been to the learner: every ``train_period`` of them
there are ``updates_per_period`` updates. n-step targets and λ-returns run over whole episodes, as they were recorded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.runs.folder.env_probe import Resumability
from neuralq.runs.offline.recorded import Recorded
from neuralq.runs.stream import Interaction, Step
from neuralq.runs.stream.encoding import Encoder, ObservationError
from neuralq.runs.stream.experience import ReplayExperience, Sample
from neuralq.types import Array, Transition

__all__ = ["OFFLINE", "OfflineExperience", "Playback", "rows_of", "whole_buffer"]

OFFLINE = Resumability(True, "resumes bit-exact: no environment is stepped, and the data set is there")


class Playback:
    """Counts the steps that nobody takes; a stream of experience in all else.

    Args:
        inner: an interaction with the environment that the data are of, which says what is observed; it is not stepped.
        data: what was recorded.
        name: of the data set.
    """

    simulated = True
    normalisation = None

    def __init__(self, inner: Interaction, data: Recorded, name: str) -> None:
        self.envs, self.encoder, self.spec = inner.envs, inner.encoder, inner.spec
        self.num_envs, self.num_actions, self.discount = 1, inner.num_actions, inner.discount
        self.num_steps = 0
        self._longest = data.longest_episode
        known, lost = int(data.known.sum()), int((~data.known).sum())
        left_out = f", {lost:,} of them left out, whose successors nobody knows" if lost else ""
        self.told = (
            f"learning from {name}: {known + lost:,} steps in {data.num_episodes:,} episodes{left_out}; no environment "
            "is stepped but for evaluation: a step of the budget is what updates would follow"
        )
        empty = np.zeros((0, *self.spec.shape), self.spec.dtype)
        none = np.zeros(0, np.int64)
        self._nothing = Step((empty, none, *[np.zeros(0)] * 3, empty, none > 0), none, ())

    def step(self, policy: Any) -> Step:
        """One step less of the budget; nothing happens."""
        self.num_steps += 1
        return self._nothing

    def running_episodes(self) -> list[tuple[float, int]]:
        """For the bound on evaluations, as long a one as any."""
        return [(0.0, self._longest)]

    def restart(self, seed: int | None) -> None:
        """There is nothing to begin anew."""

    def state_dict(self) -> dict[str, Any]:
        """How far it has come."""
        return {
            "num_steps": self.num_steps,
            "normalisation": None,
            "scalings": self.encoder.scalings,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.load_normalisation(state)
        self.num_steps = int(state["num_steps"])

    def load_normalisation(self, state: Mapping[str, Any]) -> None:
        """Refuse what was learned from observations that were scaled otherwise."""
        self.encoder.require_scalings(state.get("scalings"))


def rows_of(data: Recorded, encoder: Encoder, first_action: int, num_actions: int, gamma: float) -> tuple[Array, ...]:
    """The fields of a `Transition`, in its order, of the steps whose successors are known, ``[M, …]``.

    Raises:
        ValueError: if the data are not of the environment that ``encoder`` is of.

    Example:
        >>> import gymnasium as gym
        >>> from neuralq.runs.stream.encoding import encoder_for
        >>> data = Recorded(np.array([2, 0]), np.array([1, 0]), np.ones(2), np.array([False, False]), np.zeros(2, bool))
        >>> [row.tolist() for row in rows_of(data, encoder_for(gym.spaces.Discrete(3)), 0, 2, 0.9)]
        [[2], [1], [1.0], [1.0], [0.9], [0], [True]]
    """
    actions, known = data.actions.astype(np.int64) - first_action, data.known
    if not ((actions >= 0) & (actions < num_actions)).all():
        theirs = f"{first_action} to {first_action + num_actions - 1}"
        raise ValueError(
            f"the data set's actions lie in {data.actions.min()} to {data.actions.max()}, the environment's in {theirs}"
        )
    try:
        s_tm1, s_t = encoder.encode(data.observations), encoder.encode(data.successors)
    except ObservationError as error:
        raise ValueError(f"the data set's observations are not the environment's: {error}") from error
    mu = np.ones(len(actions)) if data.probabilities is None else data.probabilities
    discounts = np.where(data.terminations, 0.0, gamma)
    last = data.ends | ~np.append(known[1:], True)  # nothing reaches over what is left out
    rows = (s_tm1, actions, mu.astype(np.float32), data.rewards, discounts, s_t, last)
    return tuple(row[known] for row in rows)


def whole_buffer(rows: tuple[Array, ...], settings: Any) -> ReplayBuffer:
    """A replay buffer that holds all of them.

    Raises:
        ValueError: if there are fewer than the settings need.
    """
    count = len(rows[1])
    if count < max(1, settings.block_length):
        raise ValueError(f"the data set holds {count} steps, and a block has {settings.block_length}; record more")
    steps = Transition(*(torch.from_numpy(np.ascontiguousarray(row))[:, None] for row in rows))
    for capacity in (count, 2 * count):  # short episodes of large observations take more room
        buffer = ReplayBuffer(
            capacity, rows[0].shape[1:], rows[0].dtype, num_steps=settings.num_steps,
            prioritised=settings.priorities,
        )  # fmt: skip
        buffer.add(steps)
        if len(buffer) == count:
            break
    return buffer


class OfflineExperience:
    """Draws from a replay buffer to which nothing is added.

    Args:
        drawing: from which buffer, and when.
        data: what is in it.
        name: of the data set.
    """

    def __init__(self, drawing: ReplayExperience, data: Recorded, name: str) -> None:
        self._drawing, self._name, self._sha256 = drawing, name, data.sha256()

    def add(self, step: Step) -> None:
        """Nothing comes in, but the next samples come nearer."""
        self._drawing.wait(1)

    def draw(self) -> Iterator[Sample]:
        """The samples that are due."""
        return self._drawing.draw()

    def return_errors(self, sample: Sample, errors: Tensor) -> None:
        """New priorities where sampling is prioritised."""
        self._drawing.return_errors(sample, errors)

    @property
    def between_samples(self) -> bool:
        """Always."""
        return True

    def state_dict(self) -> dict[str, Any]:
        """The counters; of the buffer, whose steps lie in the data set, what priorities there are."""
        state = {**self._drawing.state_dict(), "data": self._sha256}
        return state if self._drawing.buffer.prioritised else {**state, "buffer": None}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit.

        Raises:
            ValueError: if the data set holds other data now.
        """
        if state["data"] != self._sha256:
            raise ValueError(
                f"the data set {self._name} is not the one that the run learned from (sha256 {self._sha256[:12]}…, it "
                f"was {state['data'][:12]}…); put it back, or train anew"
            )
        if state["buffer"] is None:
            state = {**state, "buffer": self._drawing.buffer.state_dict()}
        self._drawing.load_state_dict(state)

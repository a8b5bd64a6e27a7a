"""Experience on its way from a stream to a learner: what is collected, and when there is something to learn from.

Every step goes in, and after each it is asked what is due. `RolloutExperience` hands out a rollout ``[T, N]`` each time
one is full, or every step as it comes; `ReplayExperience` draws from a replay buffer at its period.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.runs.stream import ObservationSpec, Step
from neuralq.types import Array, Transition

__all__ = ["ExperienceSource", "ReplayExperience", "RolloutExperience", "Sample"]


@dataclass(frozen=True, slots=True)
class Sample:
    """Something to learn from; valid until the next one.

    Args:
        transition: experience in the shape that the learner takes.
        weight: one per row, 0 where a row is no experience; None for all ones.
        indices: where the rows are stored, if their priorities are wanted back.
        reward_scale: by what its rewards were multiplied before the learner does, where a hook is to know.
    """

    transition: Transition
    weight: Tensor | None = None
    indices: Array | None = None
    reward_scale: float = 1.0


class ExperienceSource(Protocol):
    """What training asks of a source of experience."""

    def add(self, step: Step) -> None:
        """Take in one step of the stream."""
        ...

    def draw(self) -> Iterator[Sample]:
        """The samples that are due now, none most of the time."""
        ...

    def return_errors(self, sample: Sample, errors: Tensor) -> None:
        """Take back the TD errors of a sample, for its priorities."""
        ...

    @property
    def between_samples(self) -> bool:
        """Whether nothing is half collected: the time for checkpoints and evaluations."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that a continued run needs."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        ...


class RolloutExperience:
    """Collects T steps of N environments, hands them out once, ``[T, N]``, and starts again.

    Rewards and discounts are float64, so that tables and linear functions learn from the numbers that were meant. The
    memory is that of the next rollout, too.

    Args:
        num_steps: T; None hands out every step as it comes, ``[N]``.
        num_envs: N.
        spec: of the observations.
    """

    def __init__(self, num_steps: int | None, num_envs: int, spec: ObservationSpec) -> None:
        self._num_steps = num_steps or 1
        self._at = 0
        lead = (self._num_steps, num_envs)
        self._fields: tuple[Array, ...] = (
            np.zeros((*lead, *spec.shape), spec.dtype),
            np.zeros(lead, np.int64),
            np.ones(lead, np.float32),
            np.zeros(lead, np.float64),
            np.zeros(lead, np.float64),
            np.zeros((*lead, *spec.shape), spec.dtype),
            np.ones(lead, bool),
        )
        self._held = np.zeros(lead, np.float32)  # 1 where there is experience
        transition, weight = Transition(*map(torch.from_numpy, self._fields)), torch.from_numpy(self._held)
        if num_steps is None:
            transition, weight = transition.map(lambda x: x[0]), weight[0]
        self._all_held, self._some_held = Sample(transition), Sample(transition, weight)  # made once: views

    def add(self, step: Step) -> None:
        """Write the next row."""
        row, self._at = self._at, self._at + 1
        if len(step.env_indices) == self._held.shape[1]:
            for field, value in zip(self._fields, step.rows, strict=True):
                field[row] = value
            self._held[row] = 1
            return
        # An environment that did not move: nothing may reach across it, and nobody may learn from it.
        self._fields[4][row] = 0
        self._fields[6][row] = True
        self._held[row] = 0
        for field, value in zip(self._fields, step.rows, strict=True):
            field[row, step.env_indices] = value
        self._held[row, step.env_indices] = 1

    def draw(self) -> Iterator[Sample]:
        """What was collected, once it is all there; environments that did not move have weight 0."""
        if self._at == self._num_steps:
            self._at = 0  # before handing out: whoever takes one sample need not ask for another
            yield self._all_held if self._held.all() else self._some_held

    def return_errors(self, sample: Sample, errors: Tensor) -> None:
        """What is learned from once has no priorities."""

    @property
    def between_samples(self) -> bool:
        """Whether no rollout is half collected."""
        return self._at == 0

    def state_dict(self) -> dict[str, Any]:
        """Nothing: rollouts are kept only while they are collected, and runs stop between them."""
        if self._at:
            raise ValueError(
                f"a rollout is half collected ({self._at} of {self._num_steps} rows); save between rollouts"
            )
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Nothing to restore."""


@dataclass
class ReplayExperience:
    """Stores every step and draws batches, or blocks, at its period.

    Args:
        buffer: where steps are stored.
        rng: draws the samples.
        batch_size: rows per sample; with blocks, ``batch_size // block_length`` blocks.
        block_length: 1 for independent samples ``[B]``, more for blocks ``[burn_in + block_length, B]``.
        learning_starts: steps stored before the first sample.
        train_period: environment steps between samples.
        updates_per_period: samples at each of those times.
        burn_in: rows of a block before those that are learned from.
        importance: of the steps stored so far, β of the importance weights of prioritised samples; None for that of
            the buffer.
    """

    buffer: ReplayBuffer
    rng: np.random.Generator
    batch_size: int
    block_length: int
    learning_starts: int
    train_period: int
    updates_per_period: int
    burn_in: int = 0
    importance: Callable[[int], float | None] | None = None

    def __post_init__(self) -> None:
        """Nothing is stored yet."""
        self._num_added = 0
        self._due = self.learning_starts

    def add(self, step: Step) -> None:
        """Store one step of each environment that moved."""
        if len(step.env_indices) == 1:
            s_tm1, a_tm1, mu_tm1, r_t, discount_t, s_t, last_t = (row[0] for row in step.rows)
            self.buffer.add_step(int(step.env_indices[0]), s_tm1, a_tm1, mu_tm1, r_t, discount_t, s_t, last_t)
        else:
            self.buffer.add(step.transition, step.env_indices)
        self._num_added += len(step.env_indices)

    def wait(self, num_steps: int) -> None:
        """So many steps that nobody stores: what is due comes nearer all the same."""
        self._num_added += num_steps

    def draw(self) -> Iterator[Sample]:
        """The samples that are due."""
        while self._num_added >= self._due:
            self._due += self.train_period
            for _ in range(self.updates_per_period):
                if self.block_length > 1:
                    blocks = self.batch_size // self.block_length
                    length = self.burn_in + self.block_length
                    yield Sample(self.buffer.sample_blocks(blocks, length, self.rng))
                    continue
                beta = None if self.importance is None else self.importance(self._num_added)
                batch = self.buffer.sample(self.batch_size, self.rng, beta=beta)
                if self.buffer.prioritised is None:
                    yield Sample(batch.transition)
                else:
                    yield Sample(batch.transition, batch.weights, batch.indices)

    def return_errors(self, sample: Sample, errors: Tensor) -> None:
        """New priorities |δ| where sampling is prioritised."""
        if sample.indices is not None:
            self.buffer.update_priorities(sample.indices, errors)

    @property
    def between_samples(self) -> bool:
        """Always: every step is stored at once."""
        return True

    def state_dict(self) -> dict[str, Any]:
        """The buffer and the counters."""
        return {"buffer": self.buffer.state_dict(), "num_added": self._num_added, "due": self._due}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self.buffer.load_state_dict(state["buffer"])
        self._num_added = int(state["num_added"])
        self._due = int(state["due"])

"""One training of the pole by Q(λ) from nothing: how often it fell before it did not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_discount, check_fraction, check_positive, check_whole
from neuralq.systems.peng_williams.kernels import balance
from neuralq.tabular.engine import table_from
from neuralq.tabular.kernels.acting import REPLAY, new_log, new_walk
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.model import empty_arrays
from neuralq.tabular.policies import step_code
from neuralq.tabular.traces import trace_learner
from neuralq_envs.pole_kernels import NUM_BOXES

__all__ = ["Settings", "Training", "film_trials", "train"]

_NONE = np.zeros(0, np.int64)
_NO_FILM = np.zeros((0, 0, 4))


@dataclass(frozen=True)
class Settings:
    """How Q(λ) learns here; it acts greedily, and draws among the best where they tie.

    Args:
        lambda_: λ in [0, 1]; 0 is one-step Q-learning.
        step_size: α.
        gamma: γ.
        start_spread: each number of a first state is uniform between − and + this.
        long_trial_steps: steps that count as balanced.
        most_failures: after which it is given up.

    Raises:
        ValueError: a value out of range.
    """

    lambda_: float
    step_size: float = 0.1
    gamma: float = 0.99
    start_spread: float = 0.05
    long_trial_steps: int = 10_000
    most_failures: int = 4000

    def __post_init__(self) -> None:
        check_fraction("lambda_", self.lambda_)
        check_positive("step_size", self.step_size)
        check_discount("gamma", self.gamma)
        check_fraction("start_spread", self.start_spread)
        check_whole("long_trial_steps", self.long_trial_steps)
        check_whole("most_failures", self.most_failures)


@dataclass(frozen=True, eq=False)
class Training:
    """What came of one training.

    Args:
        seed: of its stream.
        settings: how it learned.
        lengths: steps of each trial, ``[trials]``; the last one is the long one, if it came to that.
        balanced: whether it did.
        q: what was learned, ``[162, 2]``.
    """

    seed: Seed
    settings: Settings
    lengths: NDArray[np.int64]
    balanced: bool
    q: NDArray[np.float64]

    @property
    def failures(self) -> int:
        """Before the long trial, or in all."""
        return len(self.lengths) - self.balanced


def train(seed: Seed, settings: Settings) -> Training:
    """Trials until one lasts ``settings.long_trial_steps``, or so many have failed.

    Example:
        >>> train(0, Settings(lambda_=0.9, most_failures=5)).failures
        5
    """
    failures, lengths, q = _run(seed, settings, settings.most_failures, _NONE, _NO_FILM)
    balanced = failures < settings.most_failures
    return Training(seed, settings, lengths[: failures + balanced], balanced, q)


def film_trials(training: Training, trials: list[int], most_steps: int) -> list[NDArray[np.float64]]:
    """The states of some trials of a training, which is repeated for it; ``[F, 4]`` each.

    Example:
        >>> training = train(0, Settings(lambda_=0.9, most_failures=3))
        >>> [len(states) for states in film_trials(training, [0, 2], 1000)] == training.lengths[[0, 2]].tolist()
        True
    """
    film = np.zeros((len(trials), most_steps, 4))
    _, lengths, _ = _run(training.seed, training.settings, max(trials) + 1, np.array(trials, np.int64), film)
    return [states[: min(lengths[trial], most_steps)] for trial, states in zip(trials, film, strict=True)]


def _run(
    seed: Seed, settings: Settings, most_failures: int, filmed: NDArray[np.int64], film: NDArray[np.float64]
) -> tuple[int, NDArray[np.int64], NDArray[np.float64]]:
    """Failures, lengths of the trials, and the table."""
    table = table_from(np.zeros((NUM_BOXES, 2)))
    learner = trace_learner(table, "greedy", step_code(settings.step_size, 1), "peng", settings.lambda_, "accumulating")
    step_size, traces, rule, replacing, lambda_ = learner.arguments
    lengths = np.zeros(most_failures, np.int64)
    failures = balance(
        empty_arrays(), learner.policy, table, new_walk(seed), new_log(1, REPLAY), step_size, traces, rule, replacing,
        lambda_, settings.gamma, settings.start_spread, settings.long_trial_steps, lengths, filmed, film,
    )  # fmt: skip
    return failures, lengths, table.q

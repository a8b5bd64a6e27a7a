"""One training of the pole by ASE/ACE from nothing: how often it fell before it did not, and what was learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.systems.ase_ace.kernels import balance
from neuralq.tabular.kernels.ase_ace import AseAce, AseAceRates, new_ase_ace
from neuralq.tabular.kernels.random_numbers import Seed, new_stream
from neuralq_envs.pole_kernels import NUM_BOXES

__all__ = ["GAMMA", "MOST_FAILURES", "Training", "film_trials", "train"]

GAMMA = 0.95
MOST_FAILURES = 1000
"""After which a training is given up."""
_NONE = np.zeros(0, np.int64)
_NO_FILM = np.zeros((0, 0, 4))


@dataclass(frozen=True, eq=False)
class Training:
    """What came of one training.

    Args:
        seed: of its stream.
        long_trial_steps: steps that counted as balanced.
        lengths: steps of each trial, ``[trials]``; the last one is the long one, if it came to that.
        balanced: whether it did.
        elements: what was learned.
    """

    seed: Seed
    long_trial_steps: int
    lengths: NDArray[np.int64]
    balanced: bool
    elements: AseAce

    @property
    def failures(self) -> int:
        """Before the long trial, or in all."""
        return len(self.lengths) - self.balanced


def train(
    seed: Seed,
    rates: AseAceRates = AseAceRates(),  # noqa: B008 - frozen
    *,
    long_trial_steps: int = 100_000,
    most_failures: int = MOST_FAILURES,
    friction: tuple[float, float] = (0.0, 0.0),
) -> Training:
    """Trials until one lasts ``long_trial_steps``, or so many have failed.

    Args:
        seed: of the stream.
        rates: constants of the learner.
        long_trial_steps: steps that count as balanced.
        most_failures: after which it is given up.
        friction: of the cart on its track and of the pole in its hinge.

    Raises:
        ValueError: a count below 1.

    Example:
        >>> train(0, most_failures=5).failures
        5
    """
    check_whole("long_trial_steps", long_trial_steps)
    check_whole("most_failures", most_failures)
    elements, lengths = new_ase_ace(NUM_BOXES), np.zeros(most_failures, np.int64)
    failures = balance(
        elements, rates, GAMMA, *friction, new_stream(seed), long_trial_steps, lengths, _NONE, _NO_FILM
    )  # fmt: skip
    balanced = failures < most_failures
    return Training(seed, long_trial_steps, lengths[: failures + balanced], balanced, elements)


def film_trials(
    training: Training, rates: AseAceRates, trials: list[int], most_steps: int
) -> list[NDArray[np.float64]]:
    """The states of some trials of a training without friction, which is repeated for it; ``[F, 4]`` each.

    Example:
        >>> training = train(0, most_failures=3)
        >>> filmed = film_trials(training, AseAceRates(), [0, 2], 1000)
        >>> [len(states) for states in filmed] == training.lengths[[0, 2]].tolist()
        True
    """
    film = np.zeros((len(trials), most_steps, 4))
    again = np.zeros(max(trials) + 1, np.int64)
    long_trial = training.long_trial_steps
    filmed = np.array(trials, np.int64)
    balance(new_ase_ace(NUM_BOXES), rates, GAMMA, 0.0, 0.0, new_stream(training.seed), long_trial, again, filmed, film)
    return [states[: min(again[trial], most_steps)] for trial, states in zip(trials, film, strict=True)]

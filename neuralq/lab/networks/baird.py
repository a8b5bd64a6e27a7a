"""Baird's star learned by five representations with one update: predicted first, then measured.

The target policy's true values are all 0, and every representation can say so. The table converges: an update moves its
own state alone. The linear features share weights, so correcting one state raises the state it bootstraps from; for γ
above (n + 9) / (2n + 5) the error grows for ever. What a network does depends on where its weights are, so its
prediction is local: made at the initial weights, for their neighbourhood.
"""

from __future__ import annotations

from dataclasses import replace

from neuralq.checks import check_whole
from neuralq.lab.networks.representations import (
    CAP,
    REPRESENTATIONS,
    RepresentationPrediction,
    RepresentationResult,
    predict_representations,
    run_representations,
)
from neuralq_envs.counterexamples import Problem, star

__all__ = ["CAP", "REPRESENTATIONS", "BairdPrediction", "BairdResult", "predict_baird", "run_baird"]

BairdPrediction = RepresentationPrediction
BairdResult = RepresentationResult


def run_baird(
    num_steps: int = 5000,
    gamma: float = 0.99,
    step_size: float = 0.01,
    num_upper: int = 6,
    seed: int = 0,
) -> list[BairdResult]:
    """The star learned by a table, by its linear features and by three network layouts, in this order.

    Args:
        num_steps: synchronous expected sweeps, at least 4.
        gamma: γ in [0, 1).
        step_size: α > 0.
        num_upper: upper states of the star.
        seed: of the networks' initial weights (each has one hidden layer of 16 rectified units).

    Raises:
        ValueError: an argument out of range.

    Source: Baird 1995; Sutton & Barto 2018, equation 11.9.

    Example:
        >>> table, linear, *networks = run_baird(num_steps=100)
        >>> table.verdict, linear.verdict, round(linear.predicted_growth, 7)
        ('converges', 'diverges', 1.0023925)
    """
    return run_representations(_problem(gamma, step_size, num_upper, seed), num_steps, seed=seed)


def predict_baird(
    gamma: float = 0.99, step_size: float = 0.01, num_upper: int = 6, seed: int = 0
) -> list[BairdPrediction]:
    """What `run_baird` will show, known before anything is trained. Arguments as there.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> predict_baird(gamma=0.85)[1].verdict  # below 15/17 the linear features converge as well
        'converges'
    """
    return predict_representations(_problem(gamma, step_size, num_upper, seed), seed=seed)


def _problem(gamma: float, step_size: float, num_upper: int, seed: int) -> Problem:
    check_whole("seed", seed, minimum=0)
    if gamma == 1:
        raise ValueError("gamma must be below 1, got 1: the star never ends, so its values would not be defined")
    return replace(star(num_upper), gamma=gamma, step_size=step_size)

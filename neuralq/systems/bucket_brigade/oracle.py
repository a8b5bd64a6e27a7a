"""What must be exact: the chain in closed form and as TD(0), and how far food is in Woods1."""

from __future__ import annotations

import numpy as np

from neuralq.exact import solve
from neuralq.runs.report.claims import Row, claim, number
from neuralq.systems.bucket_brigade.chain import bids, expected_bids, passes_to_half
from neuralq.systems.bucket_brigade.lives import FREE, LED
from neuralq.tabular import Experience, predict
from neuralq_envs.woods import REWARD, mdp

__all__ = ["closed_form_difference", "oracle", "random_steps", "shortest_steps", "td_difference"]

_LENGTHS = (5, 10, 20)


def oracle() -> tuple[Row, ...]:
    """As rows."""
    halves = {n: passes_to_half(n) for n in _LENGTHS}
    return (
        number(
            "bids of 5, 10 and 20 rules: difference from R P(Binomial(k, b) ≥ n − i)",
            0.0,
            max(closed_form_difference(n, 400) for n in _LENGTHS),
            note="400 passes, b = .1, R = 100",
        ),
        number(
            "the same: difference from TD(0) with α = b and γ = 1",
            0.0,
            max(td_difference(n, 400) for n in _LENGTHS),
        ),
        claim(
            "passes until the first of 5, 10, 20 rules bids half of R",
            "47, 97, 197",
            ", ".join(map(str, halves.values())),
            list(halves.values()) == [47, 97, 197],
            "(n − 1/3) / b or so: a long chain is slow",
        ),
        number("Woods1: steps to food at best, mean over the cells", 1.6875, shortest_steps()),
        number("Woods1: steps of random moves, mean over the cells", 29.06, random_steps(), tol=0.005),
    )


def closed_form_difference(num_rules: int, num_passes: int, share: float = 0.1, reward: float = 100.0) -> float:
    """The largest difference of a bid, over all passes, from its closed form.

    Example:
        >>> closed_form_difference(3, 50) < 1e-9
        True
    """
    told = expected_bids(num_rules, num_passes, share, reward)
    return float(np.abs(bids(num_rules, num_passes, share, reward) - told).max())


def td_difference(num_rules: int, num_passes: int, share: float = 0.1, reward: float = 100.0) -> float:
    """The largest difference of a bid after all passes from the value that the library's TD(0) gives to its rule.

    Example:
        >>> td_difference(3, 50) < 1e-9
        True
    """
    rules, last = np.arange(num_rules), np.arange(num_rules) == num_rules - 1
    one = (rules, 0 * rules, reward * last, 1.0 - last, np.minimum(rules + 1, num_rules - 1), last)
    experience = Experience(*(np.tile(column, num_passes) for column in one))
    values = predict(np.zeros(num_rules), experience, lambda_=0.0, step_size=share).v
    return float(np.abs(values - bids(num_rules, num_passes, share, reward)[-1]).max())


def shortest_steps() -> float:
    """From the model's optimum with γ = ½, which is R 2^(1 − steps).

    Example:
        >>> shortest_steps()
        1.6875
    """
    return float((1.0 - np.log2(solve(mdp(), 0.5).v[FREE] / REWARD)).mean())


def random_steps() -> float:
    """Of moves at random, by solving for the expectation.

    Example:
        >>> round(random_steps(), 2)
        29.06
    """
    stays = (LED[FREE][:, :, None] == FREE).mean(axis=1)
    return float(np.linalg.solve(np.eye(len(FREE)) - stays, np.ones(len(FREE))).mean())

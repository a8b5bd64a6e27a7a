"""Transitions for many independent seeds at once: independent draws, or chains that follow the behaviour policy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neuralq.lab.linear.process import Process
from neuralq.types import Floats, Indices

__all__ = ["SampledTransition", "Sampling", "sample_along", "stream"]

Sampling = Literal["expected", "iid", "markov"]


@dataclass(frozen=True, eq=False, slots=True)
class SampledTransition:
    """One transition for each of N seeds.

    Args:
        row: where it starts, ``[N]``.
        next_row: where it leads, -1 at an end, ``[N]``.
        x: features of the row, ``[N, d]``.
        x_next: features of the next row, 0 at an end, ``[N, d]``.
        x_second: features of a second, independent successor under the *target* policy, 0 at an end, ``[N, d]``.
        discount_second: γ, or 0 where that second successor is an end, ``[N]``.
        reward: ``[N]``.
        rho: importance ratio of the transition, ``[N]``.
        discount: γ, or 0 at an end, ``[N]``.
        begins: whether an episode begins here, so that traces start anew, ``[N]``.
    """

    row: Indices
    next_row: Indices
    x: Floats
    x_next: Floats
    x_second: Floats
    discount_second: Floats
    reward: Floats
    rho: Floats
    discount: Floats
    begins: NDArray[np.bool_]


def sample_along(
    process: Process, transition: Indices, second: Indices, begins: NDArray[np.bool_]
) -> SampledTransition:
    """Given transitions of the behaviour as samples, with second successors along given transitions of the target.

    Args:
        process: the problem.
        transition: indices into ``process.transitions``, ``[N]``.
        second: indices into ``process.target_transitions``, of the same rows, ``[N]``.
        begins: ``[N]``.
    """
    transitions, target = process.transitions, process.target_transitions
    row, next_row = transitions.row[transition], transitions.next_row[transition]
    return SampledTransition(
        row,
        next_row,
        process.X[row],
        process.seen(next_row),
        process.seen(target.next_row[second]),
        target.discount[second],
        transitions.reward[transition],
        transitions.rho[transition],
        transitions.discount[transition],
        begins,
    )


def stream(
    process: Process, sampling: Literal["iid", "markov"], num_seeds: int, rng: np.random.Generator
) -> Iterator[SampledTransition]:
    """Transitions without end for ``num_seeds`` independent seeds.

    * ``"iid"``: every row is drawn from D anew, so nothing connects one transition to the next.
    * ``"markov"``: chains begin at a row drawn from D and follow the behaviour policy; after an end they go on from the
      start distribution.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> samples = stream(linear_process(star()), "markov", 3, np.random.default_rng(0))
        >>> one, two = next(samples), next(samples)
        >>> bool((one.next_row == two.row).all()), one.begins.tolist(), two.begins.tolist()
        (True, [True, True, True], [False, False, False])
    """
    visits, start = np.cumsum(process.D), np.cumsum(process.start)
    row = _draw(visits, rng.random(num_seeds))
    begins = np.ones(num_seeds, dtype=bool)
    while True:
        transition = process.transitions.drawn_from(row, rng.random(num_seeds))
        second = process.target_transitions.drawn_from(row, rng.random(num_seeds))
        sample = sample_along(process, transition, second, begins)
        yield sample
        if sampling == "iid":
            row = _draw(visits, rng.random(num_seeds))
            continue
        ended = sample.next_row < 0
        if ended.any():
            row = np.where(ended, _draw(start, rng.random(num_seeds)), sample.next_row)
        else:
            row = sample.next_row
        begins = ended


def _draw(cumulative: Floats, u: Floats) -> Indices:
    """Indices with the chances whose running sum is given; never one of chance 0."""
    return np.asarray(np.searchsorted(cumulative, u * cumulative[-1], side="right"), dtype=np.int64)

"""The eligibility trace that sampled updates share: z = ρ (γλ z + x), anew where an episode begins."""

from __future__ import annotations

import numpy as np

from neuralq.checks import check_fraction
from neuralq.lab.linear.sampling import Sample
from neuralq.types import Floats

__all__ = ["Trace"]


class Trace:
    """An eligibility trace for N seeds: z = after · (γλ · before · z + x), starting anew where an episode begins.

    Args:
        shape: ``(N, d)``.
        lambda_: λ.

    Raises:
        ValueError: λ outside [0, 1].

    Example:
        >>> Trace((2, 3), 0.9).z.shape
        (2, 3)
    """

    def __init__(self, shape: tuple[int, ...], lambda_: float) -> None:
        check_fraction("lambda_", lambda_)
        self.z = np.zeros(shape)
        self._lambda = lambda_
        self._decay = np.zeros(shape[0])  # discount into the present row, times λ

    def follow(self, sample: Sample, after: Floats | float = 1.0, before: Floats | float = 1.0) -> Floats:
        """Take in the present row and return z, ``[N, d]``.

        Args:
            sample: the transitions.
            after: multiplies all of the new trace, ``[N]``.
            before: multiplies what is left of the old one, ``[N]``.
        """
        num_seeds = len(self.z)
        decay = np.where(sample.begins, 0.0, self._decay) * before
        after = np.broadcast_to(after, num_seeds)
        self.z = after[:, None] * (decay[:, None] * self.z + sample.x)
        self._decay = sample.discount * self._lambda
        return self.z

"""What sampled updates share: the TD error, and the eligibility trace z = ρ (γλ z + x), anew in each episode."""

from __future__ import annotations

import numpy as np

from neuralq.lab.linear.sampling import SampledTransition
from neuralq.types import Floats

__all__ = ["Trace", "dot", "errors"]


class Trace:
    """An eligibility trace for N seeds: z = after · (γλ · fade · before · z + x), anew where an episode begins.

    Args:
        shape: ``(N, d)``.
        lambda_: λ.

    Example:
        >>> Trace((2, 3), 0.9).z.shape
        (2, 3)
    """

    def __init__(self, shape: tuple[int, ...], lambda_: float = 1.0) -> None:
        self.z = np.zeros(shape)
        self._lambda = lambda_
        self._decay = np.zeros(shape[0])  # discount into the present row, times λ and what that row fades by

    def advance(
        self,
        sample: SampledTransition,
        after: Floats | None = None,
        before: Floats | None = None,
        fade: Floats | None = None,
        x: Floats | None = None,
    ) -> Floats:
        """Take in the present row and return z, ``[N, d]``.

        Args:
            sample: the transitions.
            after: multiplies all of the new trace, ``[N]``; this and the next two by default not at all.
            before: multiplies what is left of the old one, ``[N]``.
            fade: multiplies what will be left of the new one, ``[N]``.
            x: what is taken in, ``[N, d]``; default: the features of the row.
        """
        decay = np.where(sample.begins, 0.0, self._decay)
        if before is not None:
            decay *= before
        z = decay[:, None] * self.z
        z += sample.x if x is None else x
        if after is not None:
            z *= after[:, None]
        self._decay = sample.discount * self._lambda
        if fade is not None:
            self._decay *= fade
        self.z = z
        return z


def errors(w: Floats, sample: SampledTransition) -> Floats:
    """δ = r + γ w·x' − w·x of every seed, ``[N, d] -> [N]``."""
    change = sample.discount[:, None] * sample.x_next - sample.x
    total: Floats = sample.reward + np.einsum("nd,nd->n", w, change)
    return total


def dot(a: Floats, b: Floats) -> Floats:
    """The inner product of each seed as a column, ``[N, d] × [N, d] -> [N, 1]``."""
    product: Floats = np.einsum("nd,nd->n", a, b)[:, None]
    return product

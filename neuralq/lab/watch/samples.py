"""What a hook reads of the sample that was last learned from: its rows of experience, and what bounds a return."""

from __future__ import annotations

import torch

from neuralq.runs.stream.experience import Sample
from neuralq.types import Transition

__all__ = ["held_rows", "largest_return"]


def held_rows(sample: Sample) -> Transition:
    """The rows that are experience, with one leading axis."""
    axes = sample.transition.a_tm1.dim()
    flat = sample.transition.map(lambda x: x.reshape(-1, *x.shape[axes:]))
    if sample.weight is None or sample.indices is not None:
        return flat
    return flat.map(lambda x: x[sample.weight.reshape(-1).to(x.device) > 0])


def largest_return(sample: Sample, gamma: float, so_far: float = 0.0) -> float:
    """r_max / (1 − γ) in the environment's units, of the rewards of a sample and of those before it.

    Args:
        sample: what was learned from.
        gamma: γ; without discounting nothing is bounded, and ``so_far`` comes back.
        so_far: the same of the samples before.

    Example:
        >>> one = torch.ones(1)
        >>> round(largest_return(Sample(Transition(one, one, one, 2 * one, 0.9 * one, one, one)), 0.9), 4)
        20.0
    """
    most = so_far * (1 - gamma)
    if gamma == 1 or not float(sample.transition.r_t.abs().max()) / sample.reward_scale > most:  # mostly, and cheap
        return so_far
    rows = held_rows(sample)
    # A row of n steps is discounted by γⁿ: |Σ γᵏ r| / (1 − γⁿ) ≤ r_max / (1 − γ).
    share = torch.where(rows.discount_t > 0, 1 - rows.discount_t.double(), 1 - gamma)
    sizes = rows.r_t.double().abs() / sample.reward_scale / share.clamp(min=1 - gamma)
    return max(so_far, float(sizes.max()) if len(sizes) else 0.0)

"""Step sizes that fall over a run: what a constant one leaves of the noise of the last targets goes away with it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

__all__ = ["LinearFall", "falls_over"]


class LinearFall:
    """The factor 1 − n/N of a step size after n of N environment steps, and 0 from there on.

    Args:
        total_steps: N.
        like: on whose device steps are counted, so that nobody waits for it.

    Example:
        >>> fall = LinearFall(4, torch.zeros(1))
        >>> fall.advance(torch.tensor([1.0, 0.0])), fall.advance(torch.ones(1)), fall.advance(torch.ones(4))
        (tensor(1.), tensor(0.7500), tensor(0.5000))
        >>> fall.advance(torch.ones(1))
        tensor(0.)
    """

    def __init__(self, total_steps: int, like: Tensor) -> None:
        self.total_steps = total_steps
        self.num_steps = torch.zeros((), dtype=torch.int64, device=like.device)

    def advance(self, weight: Tensor) -> Tensor:
        """The factor of this step, ``[]``; rows of weight 0 are no steps."""
        factor = (1.0 - self.num_steps / self.total_steps).clamp_min(0.0)
        self.num_steps += (weight != 0).sum()
        return factor

    def state_dict(self) -> dict[str, Tensor]:
        """How many steps there were."""
        return {"num_steps": self.num_steps}


def falls_over(settings: Any, total_steps: int | None) -> int | None:
    """The steps over which a step size with ``anneal`` falls, None where it stays.

    Raises:
        ValueError: it falls, and there is no number of steps.

    Example:
        >>> from neuralq.learners import OnlineSettings
        >>> falls_over(OnlineSettings(), 100), falls_over(OnlineSettings(anneal=True), 100)
        (None, 100)
    """
    if settings.anneal and total_steps is None:
        raise ValueError("a step size falls over a number of steps; give total_steps, or leave anneal out")
    return total_steps if settings.anneal else None

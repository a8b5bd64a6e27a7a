"""Averages of the iterates: learn with one parameter vector, play with the average of where it has been.

Stochastic gradient steps circle around what they look for; the average of the iterates lies nearer to it than the last
of them (Ruppert 1988; Polyak & Juditsky 1992). Where the goal itself moves, as a policy's values do while the policy
improves, old iterates have to be forgotten, so the average is weighted towards the present, with a window to choose.
Nothing that is learned depends on the average: only greedy evaluations and the agents that are saved do.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from neuralq.learners.learner import Learner

__all__ = ["HasEvaluationParameters", "IterateAverage", "evaluating_with", "evaluation_parameters"]


class IterateAverage:
    """Average of the iterates θ₁ … θₙ of a vector with weights falling by β = 1 − 1/window per step into the past.

    θ̄ₙ = Σₖ βⁿ⁻ᵏ θₖ / Σₖ βⁿ⁻ᵏ, kept as θ̄ ← θ̄ + (1 − β)/(1 − βⁿ)·(θₙ − θ̄): the weights add up to 1 from the first step
    on, so the starting point has none. Source: Polyak & Juditsky (1992) for averaging; the normalisation is that of
    Adam's moments (Kingma & Ba, 2015, §3).

    Args:
        values: the vector to average; it is read, never written.
        window: steps over which a weight falls by about e, at least 1; at 1 the average is the last iterate.

    Raises:
        ValueError: if the window is below 1.

    Example:
        >>> theta = torch.tensor([0.0])
        >>> average = IterateAverage(theta, window=2.0)
        >>> for x in (1.0, 4.0):
        ...     _ = theta.fill_(x)
        ...     average.update()
        >>> average.values.item()  # (½·1 + 1·4)/(½ + 1)
        3.0
    """

    def __init__(self, values: Tensor, window: float) -> None:
        if not 1.0 <= window < math.inf:
            raise ValueError(f"window must be a finite number of at least 1, got {window!r}; 1 keeps the last iterate")
        self.values = values.detach().clone()
        self.window = window
        self.num_steps = 0
        self._iterate = values

    def update(self) -> None:
        """Take in the vector as it is now."""
        self.num_steps += 1
        beta = 1.0 - 1.0 / self.window
        self.values.lerp_(self._iterate, (1.0 - beta) / (1.0 - beta**self.num_steps))

    def state_dict(self) -> dict[str, Any]:
        """The average and how many iterates it has seen."""
        return {"values": self.values, "num_steps": self.num_steps}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self.values.copy_(torch.as_tensor(state["values"]))
        self.num_steps = int(state["num_steps"])


@runtime_checkable
class HasEvaluationParameters(Protocol):
    """A learner that plays greedily with other parameters than those it learns."""

    def evaluation_parameters(self) -> Tensor:
        """The flat vector to play with."""
        ...


def evaluation_parameters(learner: Learner) -> Tensor:
    """The flat vector that greedy play uses: the learner's average if it keeps one, else what it learns.

    Example:
        >>> import numpy as np
        >>> from neuralq.learners import RolloutLearner, RolloutSettings
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> learner = RolloutLearner(TorchEngine(TableQ(2, 1), Loss()), RolloutSettings(), np.random.default_rng(0))
        >>> evaluation_parameters(learner) is learner.engine.flat.values
        True
    """
    return (
        learner.evaluation_parameters() if isinstance(learner, HasEvaluationParameters) else learner.engine.flat.values
    )


@contextlib.contextmanager
def evaluating_with(learner: Learner) -> Iterator[None]:
    """Within the block the learner's engine computes with the parameters it plays with; afterwards as before.

    Example:
        >>> import numpy as np
        >>> from neuralq.learners import RolloutLearner, RolloutSettings
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> engine = TorchEngine(TableQ(2, 1), Loss())
        >>> learner = RolloutLearner(engine, RolloutSettings(average_updates=2.0), np.random.default_rng(0))
        >>> _ = engine.flat.values.fill_(7.0)
        >>> with evaluating_with(learner):
        ...     engine.all(torch.tensor(0)).item()
        0.0
        >>> engine.all(torch.tensor(0)).item()
        7.0
    """
    values, chosen = learner.engine.flat.values, evaluation_parameters(learner)
    if chosen is values:
        yield
        return
    learned = values.clone()
    values.copy_(chosen)
    try:
        yield
    finally:
        values.copy_(learned)

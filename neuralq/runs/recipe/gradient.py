"""What the settings of a gradient-TD run choose: the second function, where it starts, and the target policy."""

from __future__ import annotations

from functools import partial
from typing import Any, cast

import torch
from torch import nn

from neuralq.learners import GradientQLearner, GradientSettings, HeadCorrection, TangentCorrection
from neuralq.q import ActionInputQ, ActionOutputQ, DuelingQ, MaskedQ, SeparateQ
from neuralq.q.engine import Engine
from neuralq.rules import epsilon_greedy
from neuralq.types import QFunction

__all__ = ["gradient_learner", "started_at_zero"]


def started_at_zero(q: QFunction) -> QFunction:
    """``q`` itself with all its values 0: a table or linear function at 0, a network with its last layer at 0.

    The layers below keep the weights they were drawn with, so that a network has something to learn from.

    Example:
        >>> from neuralq.q import MLP
        >>> started_at_zero(ActionOutputQ((4,), 2, MLP((8,)), rng=0)).all(torch.ones(4)).tolist()
        [0.0, 0.0]
    """
    inner: Any = q.inner if isinstance(q, MaskedQ) else q
    if isinstance(inner, DuelingQ):
        last: list[nn.Module] = [inner.value.layers[-1], inner.advantage.layers[-1]]
    elif isinstance(inner, ActionInputQ | SeparateQ | ActionOutputQ):
        last = [cast(Any, inner.trunk).layers[-1]]
    else:
        last = [inner]
    for module in last:
        for p in module.parameters():
            p.data = torch.zeros_like(p)
    return q


def gradient_learner(
    engine: Engine, settings: GradientSettings, head: QFunction, reward_scale: float = 1.0
) -> GradientQLearner:
    """QRC(λ) with ``head`` for its second function; GQ(λ) finds its own in the tangent space of the values.

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> gradient_learner(TorchEngine(TableQ(2, 2), Loss()), GradientSettings(), TableQ(2, 2)).num_updates
        0
    """
    if settings.method == "qrc":
        return GradientQLearner(engine, HeadCorrection(head), settings.rule, 1, reward_scale)
    policy = partial(epsilon_greedy, epsilon=settings.target_epsilon or 0.0)
    return GradientQLearner(engine, TangentCorrection(engine), settings.rule, 1, reward_scale, policy)

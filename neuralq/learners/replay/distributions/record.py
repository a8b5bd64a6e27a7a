"""A description of returns as a replay learner knows it: what it makes of a representation, a target and a loss."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from neuralq.learners.kind import Representation
from neuralq.rules import Followed
from neuralq.rules.records import discovered
from neuralq.types import QFunction

__all__ = ["MEAN", "Distribution", "Moved", "distributions"]


@dataclass(frozen=True, slots=True)
class Moved:
    """What a pair's return should be like: values and how likely each is.

    Args:
        values: ``[B, J]``, or ``[J]`` where all rows share them.
        probabilities: ``[B, J]``; None where all are equally likely.
    """

    values: Tensor
    probabilities: Tensor | None = None

    def mean(self) -> Tensor:
        """Means ``[B]``."""
        if self.probabilities is None:
            return self.values.mean(-1)
        return (self.probabilities * self.values).sum(-1)


def _one_network(settings: Any, representation: Representation) -> None:
    """Refuse layouts with one output per action."""
    if representation.layout in ("action-input", "separate"):
        raise ValueError(
            f"distribution={settings.distribution!r} needs several outputs per action, and {representation.layout} "
            "networks have one output each; use layout='action-output', 'linear' or 'table'"
        )


@dataclass(frozen=True, eq=False)
class Distribution:
    """What is learned of returns, and what it goes with.

    Args:
        name: one word for configurations and options.
        title: what it is, in a few words.
        source: author and year.
        losses: the losses it can have, its own first.
        q_class: class of the Q-function whose values are the distribution's means; None where only means are learned,
            and then the next three are not needed.
        move: ``move(q, r_t, discount_t, outputs_t, followed) -> Moved``: the successor's distribution, from the numbers
            of every action ``[B, A, K]``, moved by a step.
        loss: ``loss(outputs_tm1 [B, K], moved, levels)``: what is descended, ``[B]``.
        levels: ``levels(num_rows, num_atoms, rng)``: levels drawn for an update, ``[B, K]``; None where they are fixed.
        num_atoms: numbers for each action where none are asked for; None where there is no choice.
        least_atoms: the fewest.
        bounded: whether returns must lie in a range that is given.
        represent: the Q-function that the outputs describe: ``represent(q, settings, reward_scale, rng)``.
        outputs: ``outputs(settings, layout)``: how many outputs a representation has for every action.
        check: as in `neuralq.learners.LearnerKind`.
        place: where it stands in lists; those of one number by name.
    """

    name: str
    title: str
    source: str
    losses: tuple[str, ...]
    q_class: type[Any] | None = None
    move: Callable[[Any, Tensor, Tensor, Tensor, Followed], Moved] | None = None
    loss: Callable[[Tensor, Moved, Tensor | None], Tensor] | None = None
    levels: Callable[[int, int, np.random.Generator], Tensor] | None = None
    num_atoms: int | None = None
    least_atoms: int = 1
    bounded: bool = False
    represent: Callable[[QFunction, Any, float, np.random.Generator], QFunction] = lambda q, *_: q
    outputs: Callable[[Any, str], int] = lambda settings, layout: settings.num_atoms or 1
    check: Callable[[Any, Representation], None] = _one_network
    place: int = 100


MEAN = Distribution(
    name="none",
    title="the mean of the return",
    source="Mnih et al. 2015",
    losses=("huber", "squared"),
    check=lambda settings, representation: None,
    place=1,
)


@functools.cache
def distributions() -> Mapping[str, Distribution]:
    """Every description of returns by name.

    Example:
        >>> distributions()["quantile"].num_atoms
        32
    """
    return discovered("neuralq.learners.replay.distributions", Distribution)

"""A target rule as a replay learner knows it: what it asks of the values, and what it makes of them.

A one-step rule says two things: what is done in the successor (one action, or a policy that mixes them) and what is
added to the reward. Both are said once, in a function from what was `Seen` to what is `Followed`, and serve single
values and whole distributions alike. A rule that takes blocks of successive rows says what their returns are, of means
only.

A rule is a function and a `TargetRule` in one of the modules of this package; `target_rules` finds it, and with it the
options, the help and the refusals.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from torch import Tensor

from neuralq.rules.records import discovered
from neuralq.rules.targets import expected_value, one_step
from neuralq.types import Transition

__all__ = ["Followed", "Option", "Seen", "TargetRule", "target_rules"]


@dataclass(frozen=True)
class Seen:
    """A batch as a target rule sees it; values are computed when they are first asked for.

    Args:
        transition: rows ``[*n]``; time-major ``[T, *n]`` for rules that take blocks.
        values: ``values(s, target)``: action values ``[*n, A]`` without gradient, −∞ for illegal actions, of the frozen
            copy if ``target``.
        reward_scale: factor of the rewards.
        lambda_: λ of the λ-returns.
        options: the rule's own numbers.

    Example:
        >>> import torch
        >>> row = torch.tensor
        >>> step = Transition(row([0]), row([0]), row([1.0]), row([3.0]), row([0.9]), row([1]), row([False]))
        >>> seen = Seen(step, lambda s, target: torch.ones(1, 2, dtype=torch.float64), reward_scale=0.5)
        >>> seen.r_t.tolist(), seen.q_t.tolist()
        ([1.5], [[1.0, 1.0]])
    """

    transition: Transition
    values: Callable[[Tensor, bool], Tensor]
    reward_scale: float = 1.0
    lambda_: float = 0.0
    options: Mapping[str, float] = field(default_factory=dict)

    @functools.cached_property
    def q_t(self) -> Tensor:
        """Values of the successors by the frozen copy, ``[*n, A]``."""
        return self.values(self.transition.s_t, True)

    @functools.cached_property
    def online_t(self) -> Tensor:
        """Values of the successors by the parameters that are learned, ``[*n, A]``."""
        return self.values(self.transition.s_t, False)

    @functools.cached_property
    def q_tm1(self) -> Tensor:
        """Values of the states that were left, by the frozen copy, ``[*n, A]``."""
        return self.values(self.transition.s_tm1, True)

    @functools.cached_property
    def r_t(self) -> Tensor:
        """Scaled rewards, ``[*n]``, in the precision of the values."""
        return self.transition.r_t.to(self.q_t.dtype) * self.reward_scale

    @functools.cached_property
    def discount_t(self) -> Tensor:
        """γ, or 0 at termination, ``[*n]``, in the precision of the values."""
        return self.transition.discount_t.to(self.q_t.dtype)


@dataclass(frozen=True)
class Followed:
    """What a one-step rule does in the successor and adds to the reward; either ``a`` or ``pi``.

    Args:
        a: the action that is followed, ``[*n]`` int64.
        pi: the probabilities with which actions are followed, ``[*n, A]``; all 0 where none is legal.
        bonus: what is added to the reward, ``[*n]``; None for nothing.
        entropy: what is added to the successor's value, ``[*n]``; None for nothing.
        averaged: whether the numbers that describe the actions' returns are averaged by ``pi``, in place of their
            distributions mixed. The mean is the same; the return of a policy that draws its action is the mixture.
    """

    a: Tensor | None = None
    pi: Tensor | None = None
    bonus: Tensor | None = None
    entropy: Tensor | None = None
    averaged: bool = False


@dataclass(frozen=True)
class Option:
    """A number that a rule takes, by the name that it has among the settings.

    Args:
        default: what it is where it is left out; a text names the setting whose value it takes.
        check: ``check(name, value)`` raises a `ValueError` for values out of range.
        label: what it is, in a few words, for help.
        lack: what a rule that does not take it lacks: "has no softmax policy".
    """

    default: float | str
    check: Callable[[str, float], None]
    label: str
    lack: str = "has no use for it"


@dataclass(frozen=True, eq=False)
class TargetRule:
    """A rule with its options and with what it does not go with.

    Args:
        name: one word for configurations and options.
        title: what it is, in a few words.
        source: author and year.
        follows: for one-step rules, what is done in the successor: ``follows(seen) -> Followed``.
        mean: ``mean(seen)``: targets ``[*n]`` for single values; None for those of ``follows``.
        options: its numbers by name.
        blocks: whether it takes blocks of successive rows ``[T, *n]`` in place of single samples.
        correction: empty for targets from a frozen copy of the values; else what is done in place of freezing.
        refuses: why not, and the way out, by what it does not go with: "distribution" (any of them), "bounded" (those
            on a grid) and "num_steps" (above 1). ``{distribution!r}`` and ``{num_steps}`` stand for what was given.
            A rule that follows nothing refuses distributions by itself.
        place: where it stands in lists; those of one number by name.
        behaviour: whether it needs the probabilities with which actions were taken.

    Example:
        >>> from neuralq.rules.one_step import DOUBLE
        >>> DOUBLE.source, DOUBLE.blocks
        ('van Hasselt, Guez & Silver 2016', False)
    """

    name: str
    title: str
    source: str
    follows: Callable[[Seen], Followed] | None = None
    mean: Callable[[Seen], Tensor] | None = None
    options: Mapping[str, Option] = field(default_factory=dict)
    blocks: bool = False
    correction: str = ""
    refuses: Mapping[str, str] = field(default_factory=dict)
    place: int = 100
    behaviour: bool = False

    def __post_init__(self) -> None:
        """A rule says what it follows, or what its means are and, by that, that it refuses whole distributions."""
        if self.follows is None and self.mean is None and not self.correction:
            raise ValueError(f"the target rule {self.name!r} says neither what it follows nor what its mean is")
        if self.follows is None:
            why = (
                f"target_rule={self.name!r} mixes means and distribution={{distribution!r}} needs whole distributions; "
                "use q_learning or double, with num_steps above 1 for longer returns"
            )
            object.__setattr__(self, "refuses", {"distribution": why, **self.refuses})

    def target(self, seen: Seen) -> Tensor:
        """Targets for single values, with the shape of the rewards."""
        if self.mean is not None:
            return self.mean(seen)
        if self.follows is None:
            raise ValueError(f"target_rule={self.name!r} {self.correction}; its learner knows how")
        followed = self.follows(seen)
        if followed.a is not None:
            v_t = seen.q_t.gather(-1, followed.a[..., None])[..., 0]
        else:
            assert followed.pi is not None
            v_t = expected_value(seen.q_t, followed.pi)
        v_t = v_t if followed.entropy is None else v_t + followed.entropy
        return one_step(seen.r_t if followed.bonus is None else seen.r_t + followed.bonus, seen.discount_t, v_t)


@functools.cache
def target_rules() -> Mapping[str, TargetRule]:
    """Every target rule of the library by name.

    Example:
        >>> target_rules()["retrace"].blocks
        True
    """
    return discovered("neuralq.rules", TargetRule)

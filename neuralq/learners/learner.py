"""What training asks of a learner, and what an update returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from neuralq.q.engine import Engine
from neuralq.types import Metrics, Transition

__all__ = ["HasEngineName", "HasValues", "Learner", "Update"]


@dataclass(frozen=True, slots=True)
class Update:
    """What one update saw; metrics are computed only when asked for.

    Args:
        errors: target − Q(s, a) of the samples last used, ``[B]``.
        targets: their targets, ``[B]``.
    """

    errors: Tensor
    targets: Tensor

    def metrics(self) -> Metrics:
        """``loss`` ½·mean(e²), ``abs_td_error`` mean |e|, ``max_q`` the largest target, ``max_abs_q`` max |Q(s, a)|."""
        errors = self.errors.double()
        return {
            "loss": float(0.5 * (errors * errors).mean()),
            "abs_td_error": float(errors.abs().mean()),
            "max_q": float(self.targets.max()),
            "max_abs_q": float((self.targets.double() - errors).abs().max()),
        }


class Learner(Protocol):
    """What training asks of a learner."""

    engine: Engine

    @property
    def num_updates(self) -> int:
        """How many updates there have been."""
        ...

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """Learn from experience; ``weight`` has one entry per row, 0 for rows that are no experience, on any device."""
        ...

    def begin_streams(self) -> None:
        """Every stream of experience starts anew: forget what connects one step to the next."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that a continued run needs; the flat parameters are under "parameters", or so in "descent"."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        ...


@runtime_checkable
class HasValues(Protocol):
    """A learner that acts by values of its own, the quick way to those of its engine."""

    def values(self, s: Tensor) -> Tensor:
        """Action values ``[N, *obs] -> [N, A]``."""
        ...


@runtime_checkable
class HasEngineName(Protocol):
    """A learner for which "compiled" or "torch", as the engine's kind says, would not be the whole truth."""

    @property
    def engine_name(self) -> str:
        """What computes: "compiled" kernels altogether, "torch", or "compiled and torch", each a part."""
        ...

"""What training asks of a learner, what an update returns, and the descent step that batch learners share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

from neuralq.checks import check_positive
from neuralq.learners.optim import FlatOptimiser, Optimiser, clip_norm_
from neuralq.q.compiled import on_arrays
from neuralq.q.engine import Engine
from neuralq.types import Array, Metrics, Transition

__all__ = ["Descent", "HasEngineName", "HasValues", "Learner", "Update"]


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
        """``loss`` ½·mean(e²), ``abs_td_error`` mean |e| and ``max_q``, the largest target."""
        errors = self.errors.double()
        return {
            "loss": float(0.5 * (errors * errors).mean()),
            "abs_td_error": float(errors.abs().mean()),
            "max_q": float(self.targets.max()),
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


_Numbers = TypeVar("_Numbers", Tensor, Array)


class Descent:
    """Clipped steps of an optimiser along the engine's gradient, with the learning rate annealed linearly if asked.

    ``on_arrays`` is the engine where it computes from arrays to arrays: at an update per environment step, making
    tensors of them would cost as much as the arithmetic.

    Args:
        engine: whose flat vector is changed.
        optimiser: which optimiser.
        learning_rate: at the first step.
        max_grad_norm: bound on the gradient's Euclidean norm; None for no bound.
    """

    def __init__(self, engine: Engine, optimiser: Optimiser, learning_rate: float, max_grad_norm: float | None) -> None:
        check_positive("learning_rate", learning_rate)
        if max_grad_norm is not None:
            check_positive("max_grad_norm", max_grad_norm)
        self.engine = engine
        self.learning_rate = learning_rate
        self.max_grad_norm = max_grad_norm
        self._state = FlatOptimiser(optimiser, engine.flat.values)
        self.on_arrays = on_arrays(engine)

    def fit(self, s: _Numbers, a: _Numbers, target: _Numbers, weight: _Numbers | None, scale: float = 1.0) -> _Numbers:
        """One step on the weighted loss; returns the errors before it, ``[B]``; arrays where there is `on_arrays`."""
        if isinstance(target, Tensor):
            errors = self.engine.loss_gradient(s, a, target, weight)
        else:
            assert self.on_arrays is not None
            errors = self.on_arrays.loss_gradient_arrays(s, a, target, weight)
        self.step(scale)
        return errors

    def step(self, scale: float = 1.0) -> None:
        """One step along the gradient that lies in the engine's flat vector, wherever it came from."""
        flat = self.engine.flat
        grad = flat.grad if flat.grad_array is None else flat.grad_array
        if self.max_grad_norm is not None:
            clip_norm_(grad, self.max_grad_norm)
        self._state.step(grad, self.learning_rate * scale)

    def state_dict(self) -> dict[str, Any]:
        """Parameters, their target copy and the optimiser."""
        return {
            "parameters": self.engine.flat.values,
            "target": self.engine.target_values(),
            "optimiser": self._state.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.engine.flat.load(torch.as_tensor(state["parameters"]))
        self._state.load_state_dict(state["optimiser"])
        if state["target"] is not None:
            self.engine.sync_target()
            target = self.engine.target_values()
            assert target is not None
            target.copy_(state["target"])

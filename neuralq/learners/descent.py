"""Steps of an optimiser towards targets that are held fixed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor

from neuralq.checks import check_positive
from neuralq.learners.optim import FlatOptimiser, Optimiser, clip_norm_
from neuralq.q.compiled import on_arrays
from neuralq.q.engine import Engine
from neuralq.types import Array

__all__ = ["Descent", "count_update"]

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

    def fit(
        self, s: _Numbers, a: _Numbers, target: _Numbers, weight: _Numbers | None, scale: float = 1.0,
        last: Tensor | None = None,
    ) -> _Numbers:  # fmt: skip
        """One step on the weighted loss; returns the errors before it, ``[B]``; arrays where there is `on_arrays`.

        With ``last``, where streams break, rows are the sequences ``[T, B]`` of a representation with a memory.
        """
        if isinstance(target, Tensor):
            errors = self.engine.loss_gradient(s, a, target, weight, last)
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


def count_update(self: Any, target_period: int | None, target_rate: float | None = None) -> None:
    """One more update; at every ``target_period``-th the parameters are copied into the target network, if any.

    With a ``target_rate`` τ it moves at every update instead, by τ of the way (Lillicrap et al. 2016).
    """
    self.num_updates += 1
    if target_rate is not None:
        self.engine.sync_target(target_rate)
    elif target_period is not None and self.num_updates % target_period == 0:
        self.engine.sync_target()

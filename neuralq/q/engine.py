"""Engines: who computes values and gradients for a learner, and on which code path.

`TorchEngine` runs any `QFunction` through autograd on any device. `neuralq.q.compiled.MlpEngine` does the same for the
three layouts with an MLP body on a CPU, through compiled kernels on the same flat parameters; `make_engine` there takes
it where it applies. Learners see no difference but speed: both are held to each other by tests.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Protocol, cast

import torch
from torch import Tensor, nn

from neuralq import rules
from neuralq.checks import check_choice, check_positive
from neuralq.q.flat import FlatParameters
from neuralq.q.masked import MaskedQ
from neuralq.q.recurrent import recurrent_part
from neuralq.types import QFunction

__all__ = ["Engine", "Loss", "TorchEngine", "check_actions", "check_samples", "check_single", "follow", "no_target"]


@dataclass(frozen=True)
class Loss:
    """Squared or Huber loss of the error target − Q(s, a), weighted per sample and averaged.

    Args:
        kind: "squared" (½e²) or "huber" (½e² up to ``delta``, then linear).
        delta: where Huber's loss turns linear; unused by "squared".
    """

    kind: str = "squared"
    delta: float = 1.0

    def __post_init__(self) -> None:
        """Refuse unknown kinds and a threshold that is not positive."""
        check_choice("loss", self.kind, ("squared", "huber"))
        check_positive("delta", self.delta)


class Engine(Protocol):
    """What a learner needs of a representation: values, and gradients into one flat vector."""

    q: QFunction
    flat: FlatParameters

    def all(self, s: Tensor, target: bool = False) -> Tensor:
        """Action values ``[*n, A]`` without gradient; ``target`` asks the target copy."""
        ...

    def loss_gradient(
        self, s: Tensor, a: Tensor, target: Tensor, weight: Tensor | None = None, last: Tensor | None = None
    ) -> Tensor:
        """Errors target − Q(s, a) ``[*n]``; leaves the mean loss's gradient in ``flat.grad``.

        With ``last``, where a stream breaks after a row, rows are sequences ``[T, B]`` and the gradient goes back
        through what the representation remembers along them; for others it changes nothing.

        Raises:
            ValueError: if ``target`` or ``weight`` is not of the actions' shape, or an action does not exist, or is
                illegal by its state's mask in a row whose weight is not 0 (looked at on CPUs only).
        """
        ...

    def value_gradient(self, s: Tensor, a: Tensor) -> Tensor:
        """Q(s, a) ``[]`` of one state and action; leaves its gradient in ``flat.grad``."""
        ...

    def sum_gradient(self, s: Tensor, c: Tensor) -> None:
        """Leaves the gradient of Σ c·Q(s, ·), for coefficients ``[B, A]`` of states ``[B, *obs]``, in ``flat.grad``.

        Coefficients of illegal actions must be 0.
        """
        ...

    def sync_target(self, rate: float = 1.0) -> None:
        """Move the target copy (made at the first call) by this share of the way to the parameters: 1 copies them."""
        ...

    def target_values(self) -> Tensor | None:
        """The target copy's flat vector, or None where there is none."""
        ...


class TorchEngine:
    """Autograd on any module and device.

    Args:
        q: the representation; its parameters become views of one flat vector.
        loss: squared or Huber.
    """

    def __init__(self, q: QFunction, loss: Loss) -> None:
        self.q = q
        self.loss = loss
        self.flat = FlatParameters(cast(nn.Module, q))
        self.recurrent = recurrent_part(q)
        self._target: QFunction | None = None
        self._target_flat: FlatParameters | None = None

    @torch.no_grad()
    def all(self, s: Tensor, target: bool = False) -> Tensor:
        """Action values without gradient, of the target copy if asked for."""
        # Acting comes with observations from the CPU, wherever the parameters live.
        return self.network(target).all(s.to(self.flat.values.device))

    def loss_gradient(
        self, s: Tensor, a: Tensor, target: Tensor, weight: Tensor | None = None, last: Tensor | None = None
    ) -> Tensor:
        """Errors and, in ``flat.grad``, the gradient of the mean weighted loss."""
        check_samples(a, target, weight)
        check_actions(a, self.q.num_actions)
        self.flat.grad.zero_()
        if last is not None and self.recurrent is not None:
            s, _ = self.recurrent.recalled(s, last)
        error = target.to(self.flat.values.dtype) - self._legal_at(s, a, weight)
        each = (
            rules.squared(error, weight) if self.loss.kind == "squared" else rules.huber(error, self.loss.delta, weight)
        )
        each.mean().backward()  # type: ignore[no-untyped-call]
        return error.detach()

    def _legal_at(self, s: Tensor, a: Tensor, weight: Tensor | None = None) -> Tensor:
        """Q(s, a) of legal actions; where a row's weight is 0 any number will do, but −∞ times 0 would be NaN."""
        if not isinstance(self.q, MaskedQ):
            return self.q.at(s, a)
        self.q.check_legal(s, a, weight)
        q = self.q.at(s, a)
        return q if weight is None else q.masked_fill(torch.isneginf(q) & (weight == 0), 0.0)

    def value_gradient(self, s: Tensor, a: Tensor) -> Tensor:
        """Value of one pair and, in ``flat.grad``, its gradient."""
        check_single(a)
        check_actions(a, self.q.num_actions)
        self.flat.grad.zero_()
        q = self._legal_at(s, a)
        q.backward()  # type: ignore[no-untyped-call]
        return q.detach()

    def sum_gradient(self, s: Tensor, c: Tensor) -> None:
        """Leaves the gradient of Σ c·Q(s, ·), for coefficients ``[B, A]`` of states ``[B, *obs]``, in ``flat.grad``."""
        self.flat.grad.zero_()
        torch.where(c == 0, 0.0, self.q.all(s) * c).sum().backward()  # type: ignore[no-untyped-call]

    def network(self, target: bool = False) -> QFunction:
        """The module itself, or its target copy, for learners that need more of it than action values."""
        if target and self._target is None:
            raise no_target()
        return cast(QFunction, self._target) if target else self.q

    def sync_target(self, rate: float = 1.0) -> None:
        """Move the target copy by this share of the way to the parameters; the first is a copy."""
        if self._target_flat is None:
            target = copy.deepcopy(cast(nn.Module, self.q))
            self._target, self._target_flat = cast(QFunction, target), FlatParameters(target)
        follow(self._target_flat.values, self.flat.values, rate)

    def target_values(self) -> Tensor | None:
        """The target copy's flat vector, or None."""
        return None if self._target_flat is None else self._target_flat.values


def follow(target: Tensor, values: Tensor, rate: float) -> None:
    """Target ← target + rate · (values − target), a copy where the rate is 1."""
    if rate == 1.0:
        target.copy_(values)
    else:
        target.lerp_(values, rate)


def no_target() -> ValueError:
    """The error of asking for a target copy that was never made."""
    return ValueError("there is no target copy yet; call sync_target() first")


def check_samples(a: Tensor, target: Tensor, weight: Tensor | None) -> None:
    """One target and weight per action: nothing is broadcast."""
    if target.shape != a.shape or (weight is not None and weight.shape != a.shape):
        shapes = f"{tuple(a.shape)}, {tuple(target.shape)} and {None if weight is None else tuple(weight.shape)}"
        raise ValueError(f"actions, targets and weights must pair up; got shapes {shapes}")


def check_single(a: Tensor) -> None:
    """One action, ``[]``, whose value has a gradient."""
    if a.dim() > 0:
        raise ValueError(f"a value's gradient is of one action, [], got {tuple(a.shape)}")


def check_actions(a: Tensor, num_actions: int) -> None:
    """Tables take index −1 for the last; on other devices looking would mean waiting, and gather refuses there."""
    if a.device.type == "cpu" and a.numel() and not 0 <= int(a.min()) <= int(a.max()) < num_actions:
        raise ValueError(f"actions must lie in 0..{num_actions - 1}, got {int(a.min())}..{int(a.max())}")

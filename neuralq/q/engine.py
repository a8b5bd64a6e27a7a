"""Engines: who computes values and gradients for a learner, and on which code path.

`TorchEngine` runs any `QFunction` through autograd on any device. `MlpEngine` runs the three layouts with an MLP body
on a CPU through compiled kernels on the same flat parameters; it is chosen automatically where it applies. Learners see
no difference but speed: both are held to each other by tests.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuralq import rules
from neuralq.checks import check_choice, check_positive
from neuralq.q.bodies import ACTIVATIONS, Trunk
from neuralq.q.flat import FlatParameters
from neuralq.q.kernels import batch as kernels
from neuralq.q.layouts import ActionInputQ, ActionOutputQ, SeparateQ
from neuralq.q.masked import MaskedQ
from neuralq.types import Array, QFunction

__all__ = ["Engine", "Loss", "MlpEngine", "TorchEngine", "array_values", "make_engine", "on_arrays", "runs_compiled"]


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

    def loss_gradient(self, s: Tensor, a: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
        """Errors target − Q(s, a) ``[*n]``; leaves the mean loss's gradient in ``flat.grad``.

        Raises:
            ValueError: if ``target`` or ``weight`` is not of the actions' shape, or an action does not exist, or is
                illegal by its state's mask in a row whose weight is not 0 (looked at on CPUs only).
        """
        ...

    def value_gradient(self, s: Tensor, a: Tensor) -> Tensor:
        """Q(s, a) ``[]`` of one state and action; leaves its gradient in ``flat.grad``."""
        ...

    def sync_target(self) -> None:
        """Copy the parameters into the target copy (made at the first call)."""
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
        self._target: QFunction | None = None
        self._target_flat: FlatParameters | None = None

    @torch.no_grad()
    def all(self, s: Tensor, target: bool = False) -> Tensor:
        """Action values without gradient, of the target copy if asked for."""
        # Acting comes with observations from the CPU, wherever the parameters live.
        return self.network(target).all(s.to(self.flat.values.device))

    def loss_gradient(self, s: Tensor, a: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
        """Errors and, in ``flat.grad``, the gradient of the mean weighted loss."""
        _check_samples(a, target, weight)
        _check_actions(a, self.q.num_actions)
        self.flat.grad.zero_()
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
        _check_single(a)
        _check_actions(a, self.q.num_actions)
        self.flat.grad.zero_()
        q = self._legal_at(s, a)
        q.backward()  # type: ignore[no-untyped-call]
        return q.detach()

    def network(self, target: bool = False) -> QFunction:
        """The module itself, or its target copy, for learners that need more of it than action values."""
        if target and self._target is None:
            raise _no_target()
        return cast(QFunction, self._target) if target else self.q

    def sync_target(self) -> None:
        """Copy the parameters into the target copy."""
        if self._target_flat is None:
            target = copy.deepcopy(cast(nn.Module, self.q))
            self._target, self._target_flat = cast(QFunction, target), FlatParameters(target)
        self._target_flat.values.copy_(self.flat.values)

    def target_values(self) -> Tensor | None:
        """The target copy's flat vector, or None."""
        return None if self._target_flat is None else self._target_flat.values


def _no_target() -> ValueError:
    return ValueError("there is no target copy yet; call sync_target() first")


def _check_samples(a: Tensor, target: Tensor, weight: Tensor | None) -> None:
    """One target and weight per action: nothing is broadcast."""
    if target.shape != a.shape or (weight is not None and weight.shape != a.shape):
        shapes = f"{tuple(a.shape)}, {tuple(target.shape)} and {None if weight is None else tuple(weight.shape)}"
        raise ValueError(f"actions, targets and weights must pair up; got shapes {shapes}")


def _check_single(a: Tensor) -> None:
    if a.dim() > 0:
        raise ValueError(f"a value's gradient is of one action, [], got {tuple(a.shape)}")


def _check_actions(a: Tensor, num_actions: int) -> None:
    """Tables take index −1 for the last; on other devices looking would mean waiting, and gather refuses there."""
    if a.device.type == "cpu" and a.numel() and not 0 <= int(a.min()) <= int(a.max()) < num_actions:
        raise ValueError(f"actions must lie in 0..{num_actions - 1}, got {int(a.min())}..{int(a.max())}")


def runs_compiled(q: Any) -> bool:
    """Whether `MlpEngine` knows this module: one of the three layouts, an MLP body, on a CPU, float32 or float64."""
    inner: Any = q.inner if type(q) is MaskedQ else q
    if type(inner) not in (ActionOutputQ, SeparateQ, ActionInputQ) or type(inner.trunk) is not Trunk:
        return False
    # A stem has parameters, and so may a feature map of the user's: only autograd knows their gradient.
    if any(True for _ in inner.input.parameters()):
        return False
    first: Tensor = next(inner.parameters())
    return first.device.type == "cpu" and first.dtype in (torch.float32, torch.float64)


class MlpEngine:
    """Compiled passes over the flat parameters of the three layouts with an MLP body.

    Args:
        q: one of the three layouts (or one under `MaskedQ`) for which `runs_compiled` is true.
        loss: squared or Huber.
    """

    def __init__(self, q: QFunction, loss: Loss) -> None:
        if not runs_compiled(q):
            raise ValueError(f"no compiled kernels for {type(q).__name__} as it is; use the torch engine")
        self.q = q
        self.flat = FlatParameters(cast(nn.Module, q))
        self._mask = q if isinstance(q, MaskedQ) else None
        net = cast(Any, q.inner if isinstance(q, MaskedQ) else q)
        self._net = net
        self._num_actions: int = net.num_actions
        self._layout = {ActionOutputQ: kernels.ACTION_OUTPUT, SeparateQ: kernels.SEPARATE}.get(
            type(net), kernels.ACTION_INPUT
        )
        self._activation = list(ACTIVATIONS).index(net.trunk.activation)
        self._loss = kernels.HUBER if loss.kind == "huber" else kernels.SQUARED
        self._delta = loss.delta
        self.plain_input = self._mask is None and net.input.features is None
        self._dtype: torch.dtype = self.flat.values.dtype
        self._plan, self._starts = _plan_of(net, self.flat)
        self._width: int = net.input.num_features
        self._values = self.flat.values.numpy()
        self._grad = self.flat.grad.numpy()
        self._target: Tensor | None = None
        self._target_values: Any = None
        self._kind = self._values.dtype
        widest, largest = int(self._plan[:, :2].max()), int((self._plan[:, 0] * self._plan[:, 1]).max())
        self._spare = torch.zeros(2 * max(widest, largest), dtype=self._dtype).numpy()
        self._capacity = 0
        self._reserve(1)

    def _reserve(self, rows: int) -> None:
        """Workspaces for that many samples; torch's allocator aligns them, which keeps BLAS reproducible."""
        if rows <= self._capacity:
            return
        self._capacity = rows
        wide = rows * (self._num_actions if self._layout == kernels.ACTION_INPUT else 1)
        total = int(self._starts[-1] + self._plan[-1, 1])

        def space(size: int) -> Any:
            return torch.zeros(size, dtype=self._dtype).numpy()

        self._acts, self._hats, self._deltas = space(wide * total), space(wide * total), space(wide * total)
        self._inverse = space(wide * len(self._plan))
        self._pairs = space(wide * (self._width + self._num_actions))
        self._ones = torch.ones(rows, dtype=self._dtype).numpy()

    def _rows(self, s: Tensor) -> tuple[Any, tuple[int, ...]]:
        if self.plain_input:
            shape = self._net.input.input_shape
            cut = s.dim() - len(shape)
            leading = tuple(s.shape[:cut])
            if s.shape[cut:] != shape:
                raise ValueError(f"this network takes observations of shape {shape}, got {tuple(s.shape)}")
            if s.dtype != self._dtype:
                s = s.to(self._dtype)
            rows = s.numpy().reshape(-1, self._width)
        else:
            obs = s if self._mask is None else self._mask.observation(s)
            x, size = self._net.input.rows(obs)
            leading, rows = tuple(size), x.reshape(-1, self._width).numpy()
        self._reserve(rows.shape[0])
        return np.ascontiguousarray(rows), leading

    def _array_rows(self, s: Array) -> Array:
        """Observations ``[B, *obs]`` as rows; refuses what `_rows` would, the usual kind first."""
        if s.ndim != 2 or s.dtype != self._kind or s.shape[1] != self._width or not s.flags.carray:
            return cast(Array, self._rows(torch.from_numpy(s if s.flags.writeable else s.copy()))[0])
        if len(s) > self._capacity:
            self._reserve(len(s))
        return s

    def all(self, s: Tensor, target: bool = False) -> Tensor:
        """Action values without gradient, of the target copy if asked for."""
        x, leading = self._rows(s)
        q = torch.from_numpy(self._all(x, target)).view(*leading, self._num_actions)
        return q if self._mask is None else q.masked_fill_(self._mask.illegal(s), -torch.inf)

    def all_arrays(self, s: Array, target: bool = False) -> Array:
        """As `all`, from observations ``[B, *obs]`` to values ``[B, A]``; for networks with a plain input."""
        return self._all(self._array_rows(s), target)

    def _all(self, x: Array, target: bool) -> Array:
        values = self._target_values if target else self._values
        if values is None:
            raise _no_target()
        out = np.empty((len(x), self._num_actions), self._kind)
        kernels.all_values(
            values, self._plan, self._starts, self._layout, self._num_actions, self._activation, x,
            self._acts, self._hats, self._inverse, self._pairs, out,
        )  # fmt: skip
        return out

    def _loss_gradient(self, x: Array, actions: Array, target: Any, weight: Any, loss: int) -> Any:
        if actions.size != len(x):
            raise ValueError(f"got {len(x)} states and {actions.size} actions; they must pair up")
        q = np.empty(len(x), self._kind)
        wrong = kernels.loss_gradient(
            self._values, self._grad, self._plan, self._starts, self._layout, self._num_actions, self._activation,
            x, actions, q if target is None else target, self._ones[: len(x)] if weight is None else weight,
            loss, self._delta, self._acts, self._hats, self._inverse, self._deltas, self._pairs, self._spare, q,
        )  # fmt: skip
        if wrong >= 0:
            raise ValueError(f"actions must lie in 0..{self._num_actions - 1}, got {actions[wrong]}")
        return q

    def loss_gradient(self, s: Tensor, a: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
        """Errors and, in ``flat.grad``, the gradient of the mean weighted loss."""
        _check_samples(a, target, weight)
        self._check_legal(s, a, weight)
        wanted = target.to(self._dtype).reshape(-1).numpy()
        weights = None if weight is None else weight.to(self._dtype).reshape(-1).numpy()
        q = self._loss_gradient(self._rows(s)[0], a.reshape(-1).numpy(), wanted, weights, self._loss)
        return torch.from_numpy(wanted - q).view(a.shape)

    def loss_gradient_arrays(self, s: Array, a: Array, target: Array, weight: Array | None = None) -> Array:
        """As `loss_gradient` for ``[B]`` samples in arrays, target and weight in the network's precision."""
        if not len(a) == len(target) == (len(a) if weight is None else len(weight)):
            raise ValueError(f"actions, targets and weights must pair up; got {len(a)} and {len(target)} of them")
        return cast(Array, target - self._loss_gradient(self._array_rows(s), a, target, weight, self._loss))

    def value_gradient(self, s: Tensor, a: Tensor) -> Tensor:
        """Value of one pair and, in ``flat.grad``, its gradient."""
        _check_single(a)
        self._check_legal(s, a)
        return torch.from_numpy(
            self._loss_gradient(self._rows(s)[0], a.reshape(-1).numpy(), None, None, kernels.VALUE)
        )[0]

    def _check_legal(self, s: Tensor, a: Tensor, weight: Tensor | None = None) -> None:
        if self._mask is not None:
            _check_actions(a, self._num_actions)
            self._mask.check_legal(s, a, weight)

    def sync_target(self) -> None:
        """Copy the parameters into the target copy."""
        if self._target is None:
            self._target = torch.empty_like(self.flat.values)
            self._target_values = self._target.numpy()
        self._target.copy_(self.flat.values)

    def target_values(self) -> Tensor | None:
        """The target copy's flat vector, or None."""
        return self._target


def _plan_of(net: Any, flat: FlatParameters) -> tuple[Any, Any]:
    """One row per layer with its sizes and offsets, and where each layer's block starts in a one-row workspace."""
    base = flat.values.data_ptr()
    size = flat.values.element_size()

    def offset(parameter: Tensor) -> int:
        return (parameter.data_ptr() - base) // size

    plan = []
    for i, layer in enumerate(net.trunk.layers):
        _, fan_in, fan_out = layer.weight.shape
        norm = net.trunk.norms[i] if i < len(net.trunk.norms) else None
        # −1: no normalisation; −2: one without scale and shift.
        scale, shift = (-1, -1) if norm is None else (-2, -2)
        if norm is not None and norm.weight is not None:
            scale, shift = offset(norm.weight), offset(norm.bias)
        plan.append((fan_in, fan_out, offset(layer.weight), offset(layer.bias), scale, shift))
    table = np.array(plan, dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(table[:-1, 1])]).astype(np.int64)
    return table, starts


def on_arrays(engine: Engine) -> MlpEngine | None:
    """The engine if it also computes from arrays to arrays: compiled, on observations that go in as they are.

    Example:
        >>> from neuralq.q import MLP, ActionOutputQ, TableQ
        >>> on_arrays(make_engine(TableQ(2, 2), Loss())) is None
        True
        >>> on_arrays(make_engine(ActionOutputQ((4,), 2, MLP((8,))), Loss())).all_arrays(np.zeros((3, 4), "f")).shape
        (3, 2)
    """
    return engine if isinstance(engine, MlpEngine) and engine.plain_input else None


def array_values(engine: Engine) -> Callable[[Array], Array] | None:
    """Observations ``[B, *obs]`` to action values ``[B, A]`` without tensors, where the engine can.

    Example:
        >>> from neuralq.q import MLP, ActionOutputQ
        >>> array_values(make_engine(ActionOutputQ((4,), 2, MLP((8,))), Loss()))(np.zeros((3, 4), np.float32)).shape
        (3, 2)
    """
    arrays = on_arrays(engine)
    return None if arrays is None else arrays.all_arrays


def make_engine(q: QFunction, loss: Loss, kind: str = "auto") -> Engine:
    """The engine for a representation: compiled where it applies, autograd otherwise.

    Args:
        q: the representation.
        loss: squared or Huber.
        kind: "auto", "torch" or "compiled".

    Raises:
        ValueError: for "compiled" where there are no kernels for ``q``.
    """
    check_choice("engine", kind, ("auto", "torch", "compiled"))
    if kind == "compiled" or (kind == "auto" and runs_compiled(q)):
        return MlpEngine(q, loss)
    return TorchEngine(q, loss)

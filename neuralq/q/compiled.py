"""The compiled engine: the three layouts with an MLP body on a CPU, without a framework between the passes.

`MlpEngine` computes on the same flat parameters as `neuralq.q.engine.TorchEngine`, through the kernels of
`neuralq.q.kernels.batch`; `make_engine` takes it where it applies.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_choice
from neuralq.q.bodies import ACTIVATIONS, GroupedLinear, Trunk
from neuralq.q.engine import Engine, Loss, TorchEngine, check_actions, check_samples, check_single, follow, no_target
from neuralq.q.flat import FlatParameters
from neuralq.q.kernels import batch as kernels
from neuralq.q.layouts import ActionInputQ, ActionOutputQ, SeparateQ
from neuralq.q.masked import MaskedQ
from neuralq.types import Array, QFunction

__all__ = ["MlpEngine", "array_values", "layer_places", "make_engine", "on_arrays", "runs_compiled"]


def runs_compiled(q: Any) -> bool:
    """Whether `MlpEngine` knows this module: one of the three layouts, an MLP body, on a CPU, float32 or float64."""
    inner: Any = q.inner if type(q) is MaskedQ else q
    if type(inner) not in (ActionOutputQ, SeparateQ, ActionInputQ) or type(inner.trunk) is not Trunk:
        return False
    # A stem has parameters, and so may a feature map of the user's: only autograd knows their gradient, and noise's.
    if any(True for _ in inner.input.parameters()) or any(type(x) is not GroupedLinear for x in inner.trunk.layers):
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
        self._input: Any = net.input
        self._width: int = net.input.num_features
        self._num_actions: int = net.num_actions
        self._layout = {ActionOutputQ: kernels.ACTION_OUTPUT, SeparateQ: kernels.SEPARATE}.get(
            type(net), kernels.ACTION_INPUT
        )
        self._loss = (kernels.HUBER if loss.kind == "huber" else kernels.SQUARED, loss.delta)
        self.plain_input = self._mask is None and net.input.features is None
        self._dtype: torch.dtype = self.flat.values.dtype
        self._values, self._grad = self.flat.values.numpy(), self.flat.grad.numpy()
        self._kind = self._values.dtype
        self._target: Tensor | None = None
        self._target_values: Any = None
        layers, norms = net.trunk.layers, net.trunk.norms
        places = [layer_places(self.flat, x.weight, x.bias, norms, i) for i, x in enumerate(layers)]
        plan = np.array([(*x.weight.shape[1:], *at, 0) for x, at in zip(layers, places, strict=True)], np.int64)
        plan[1:, 6] = np.cumsum(plan[:-1, 1])
        activation = list(ACTIVATIONS).index(net.trunk.activation)
        self._network: Any = plan, self._layout, self._num_actions, activation
        self._units = int(plan[:, 1].sum())
        widest, largest = int(plan[:, :2].max()), int((plan[:, 0] * plan[:, 1]).max())
        self._spare = self._space(2 * max(widest, largest))
        self._capacity = 0
        self._reserve(1)

    def _space(self, size: int) -> Any:
        """Zeros; torch's allocator aligns them, which keeps BLAS reproducible."""
        return torch.zeros(size, dtype=self._dtype).numpy()

    def _reserve(self, rows: int) -> None:
        """Workspaces for that many samples."""
        if rows <= self._capacity:
            return
        self._capacity = rows
        wide = rows * (self._num_actions if self._layout == kernels.ACTION_INPUT else 1)
        acts, hats, self._deltas = (self._space(wide * self._units) for _ in range(3))
        inverse = self._space(wide * len(self._network[0]))
        self._work: Any = acts, hats, inverse, self._space(wide * (self._width + self._num_actions))
        self._ones = torch.ones(rows, dtype=self._dtype).numpy()

    def _rows(self, s: Tensor) -> tuple[Any, tuple[int, ...]]:
        if self.plain_input:
            shape = self._input.input_shape
            cut = s.dim() - len(shape)
            leading = tuple(s.shape[:cut])
            if s.shape[cut:] != shape:
                raise ValueError(f"this network takes observations of shape {shape}, got {tuple(s.shape)}")
            if s.dtype != self._dtype:
                s = s.to(self._dtype)
            rows = s.numpy().reshape(-1, self._width)
        else:
            obs = s if self._mask is None else self._mask.observation(s)
            x, size = self._input.rows(obs)
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
            raise no_target()
        out = np.empty((len(x), self._num_actions), self._kind)
        arguments: Any = (values, *self._network, x, *self._work, out)
        kernels.all_values(*arguments)
        return out

    def _loss_gradient(self, x: Array, actions: Array, target: Any, weight: Any, loss: tuple[int, float]) -> Any:
        if actions.size != len(x):
            raise ValueError(f"got {len(x)} states and {actions.size} actions; they must pair up")
        q = np.empty(len(x), self._kind)
        wanted = q if target is None else target, self._ones[: len(x)] if weight is None else weight
        work = *self._work, self._deltas, self._spare
        samples = (np.ascontiguousarray(column) for column in (actions, *wanted))  # views would be compiled for anew
        arguments: Any = (self._values, self._grad, *self._network, x, *samples, *loss, *work, q)
        wrong = kernels.loss_gradient(*arguments)
        if wrong >= 0:
            raise ValueError(f"actions must lie in 0..{self._num_actions - 1}, got {actions[wrong]}")
        return q

    def loss_gradient(
        self, s: Tensor, a: Tensor, target: Tensor, weight: Tensor | None = None, last: Tensor | None = None
    ) -> Tensor:
        """Errors and, in ``flat.grad``, the gradient of the mean weighted loss."""
        check_samples(a, target, weight)
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
        check_single(a)
        self._check_legal(s, a)
        q = self._loss_gradient(self._rows(s)[0], a.reshape(-1).numpy(), None, None, (kernels.VALUE, 1.0))
        return torch.from_numpy(q)[0]

    def sum_gradient(self, s: Tensor, c: Tensor) -> None:
        """Leaves the gradient of Σ c·Q(s, ·), for coefficients ``[B, A]`` of states ``[B, *obs]``, in ``flat.grad``."""
        x = self._rows(s)[0]
        if c.shape != (len(x), self._num_actions):
            raise ValueError(f"coefficients must be one for each action of {len(x)} states, got {tuple(c.shape)}")
        actions = np.tile(np.arange(self._num_actions), len(x))
        each = np.repeat(x, self._num_actions, axis=0)
        self._reserve(len(each))
        weights = np.ascontiguousarray(c.to(self._dtype).numpy()).reshape(-1)
        self._loss_gradient(each, actions, None, weights, (kernels.VALUE, 1.0))

    def _check_legal(self, s: Tensor, a: Tensor, weight: Tensor | None = None) -> None:
        if self._mask is not None:
            check_actions(a, self._num_actions)
            self._mask.check_legal(s, a, weight)

    def sync_target(self, rate: float = 1.0) -> None:
        """Move the target copy by this share of the way to the parameters; the first is a copy."""
        if self._target is None:
            self._target = self.flat.values.clone()
            self._target_values = self._target.numpy()
        follow(self._target, self.flat.values, rate)

    def target_values(self) -> Tensor | None:
        """The target copy's flat vector, or None."""
        return self._target


def layer_places(flat: FlatParameters, weight: Tensor, bias: Tensor, norms: Any, i: int) -> tuple[int, int, int, int]:
    """Where in the flat vector layer i's weight and bias begin, and scale and shift of its normalisation.

    Scale and shift are −1 where there is no normalisation, −2 where there is one without them.
    """
    scale, shift = -1, -1
    if i < len(norms):
        learned = norms[i].weight is not None
        scale, shift = (flat.offset(norms[i].weight), flat.offset(norms[i].bias)) if learned else (-2, -2)
    return flat.offset(weight), flat.offset(bias), scale, shift


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

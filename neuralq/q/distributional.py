"""Action values as means of distributions: what is learned is how the return is distributed, what acts is its mean.

Both classes wrap any function with A·K outputs, action by action: a table, a linear function, an action-output or a
dueling network made with A·K actions. (An action-input network and the separate networks give one value each.) They are
Q-functions like any other, so that acting, evaluation and masks know nothing of distributions; a learner asks for the
K numbers of every action with `atoms`.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor, nn

from neuralq.checks import check_whole
from neuralq.q.masked import MaskedQ
from neuralq.types import QFunction

__all__ = ["CategoricalQ", "Distributional", "QuantileQ", "atoms", "distribution_of"]

_LEAST_STEP = 64  # roundings between two atoms; with fewer, what is shared between neighbours adds up to another mass


def _actions_of(inner: QFunction, num_atoms: int) -> int:
    check_whole("num_atoms", num_atoms)
    if inner.num_actions % num_atoms:
        raise ValueError(
            f"the function below has {inner.num_actions} outputs, which is no multiple of {num_atoms} per action; make "
            "it with num_actions * num_atoms actions"
        )
    return inner.num_actions // num_atoms


class QuantileQ(nn.Module):
    """Equally likely values for every action; the action's value is their mean.

    Args:
        inner: function with A·K outputs, the K of the first action first.
        num_atoms: K.

    Raises:
        ValueError: if the outputs do not divide evenly among K.

    Source: Dabney et al. 2018, eq. 6.

    Example:
        >>> from neuralq.q import TableQ
        >>> q = QuantileQ(TableQ(3, 2 * 5), num_atoms=5)
        >>> q.all(torch.tensor(0)).shape, q.outputs(torch.tensor(0)).shape
        (torch.Size([2]), torch.Size([2, 5]))
    """

    def __init__(self, inner: QFunction, num_atoms: int) -> None:
        super().__init__()
        self.num_actions = _actions_of(inner, num_atoms)
        self.num_atoms = num_atoms
        self.inner = inner

    def outputs(self, s: Tensor) -> Tensor:
        """The values of every action: ``[*n, *obs] -> [*n, A, K]``, in no particular order until they are learned."""
        flat = self.inner.all(s)
        return flat.reshape(*flat.shape[:-1], self.num_actions, self.num_atoms)

    def mean(self, outputs: Tensor) -> Tensor:
        """What is expected of an action with these outputs: ``[*n, K] -> [*n]``."""
        return outputs.mean(-1)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, *obs] -> [*n, A]``."""
        return self.mean(self.outputs(s))

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        return self.all(s).gather(-1, a[..., None])[..., 0]


class CategoricalQ(nn.Module):
    """Probabilities on a fixed grid of values for every action; the action's value is their mean.

    Values outside the grid cannot be represented: they count as its nearest end. Outputs of 0 are equal probabilities,
    so values start in the middle of the grid.

    Args:
        inner: function with A·K outputs, the K of the first action first: logits.
        num_atoms: K, at least 2.
        value_min: smallest value of the grid.
        value_max: largest value of the grid.

    Raises:
        ValueError: if the outputs do not divide evenly among K, or the grid is empty.

    Source: Bellemare, Dabney & Munos 2017, section 4.

    Example:
        >>> from neuralq.q import TableQ
        >>> q = CategoricalQ(TableQ(3, 2 * 5), num_atoms=5, value_min=0.0, value_max=4.0)
        >>> q.all(torch.tensor(0)).tolist()
        [2.0, 2.0]
    """

    support: Tensor

    def __init__(self, inner: QFunction, num_atoms: int, value_min: float, value_max: float) -> None:
        super().__init__()
        self.num_actions = _actions_of(inner, num_atoms)
        check_whole("num_atoms", num_atoms, 2)
        if not -float("inf") < value_min < value_max < float("inf"):
            raise ValueError(
                f"value_min must lie below value_max, got {value_min!r} and {value_max!r}; name the smallest and the "
                "largest return to expect"
            )
        self.num_atoms = num_atoms
        self.inner = inner
        first = next(iter(inner.parameters()))  # type: ignore[attr-defined]
        step, size = (value_max - value_min) / (num_atoms - 1), max(abs(value_min), abs(value_max))
        if step < _LEAST_STEP * torch.finfo(first.dtype).eps * size or size > torch.finfo(first.dtype).max / 2:
            raise ValueError(
                f"{num_atoms} atoms from {value_min:g} to {value_max:g} lie closer together than {first.dtype} tells "
                "apart at their size; take fewer, a wider range, or one nearer 0"
            )
        grid = torch.linspace(value_min, value_max, num_atoms, dtype=torch.float64)
        self.register_buffer("support", grid.to(first.dtype), persistent=False)

    def outputs(self, s: Tensor) -> Tensor:
        """Logits of every action: ``[*n, *obs] -> [*n, A, K]``."""
        flat = self.inner.all(s)
        return flat.reshape(*flat.shape[:-1], self.num_actions, self.num_atoms)

    def mean(self, outputs: Tensor) -> Tensor:
        """What is expected of an action with these logits: ``[*n, K] -> [*n]``."""
        return (torch.softmax(outputs, -1) * self.support).sum(-1)

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for, traced and compiled."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, *obs] -> [*n, A]``."""
        return self.mean(self.outputs(s))

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        return self.all(s).gather(-1, a[..., None])[..., 0]


class Distributional(Protocol):
    """A Q-function whose values are means of what it says of returns."""

    num_actions: int

    def outputs(self, s: Tensor) -> Tensor:
        """The numbers that describe the return of every action, ``[*n, *obs] -> [*n, A, K]``."""
        ...

    def mean(self, outputs: Tensor) -> Tensor:
        """What is expected of an action with these numbers, ``[*n, K] -> [*n]``."""
        ...


def distribution_of(q: QFunction) -> Any:
    """The `Distributional` function that a Q-function is the mean of, without its mask.

    Raises:
        ValueError: if it is the mean of none.

    Example:
        >>> from neuralq.q import TableQ
        >>> distribution_of(MaskedQ(QuantileQ(TableQ(3, 10), 5), ())).num_atoms
        5
    """
    inner = q.inner if isinstance(q, MaskedQ) else q
    if not hasattr(inner, "outputs"):  # asked at every update, and asking for a protocol is slow
        raise ValueError(f"{type(inner).__name__} has no distribution; wrap it in QuantileQ or CategoricalQ")
    return inner


def atoms(q: QFunction, s: Tensor, levels: Tensor | None = None) -> Tensor:
    """The K outputs of every action, legal or not: ``[*n, *obs] -> [*n, A, K]``; a mask in ``s`` is taken off.

    Args:
        q: a `Distributional` function, masked or not.
        s: observations.
        levels: ``[*n, K]`` for a function that takes levels; None for its own.

    Raises:
        ValueError: if ``q`` is the mean of no distribution.

    Example:
        >>> from neuralq.q import TableQ
        >>> q = MaskedQ(QuantileQ(TableQ(3, 10), 5), ())
        >>> atoms(q, torch.tensor([[2, 1, 0], [1, 1, 1]])).shape
        torch.Size([2, 2, 5])
    """
    described, s = distribution_of(q), q.observation(s) if isinstance(q, MaskedQ) else s
    outputs: Tensor = described.outputs(s) if levels is None else described.outputs(s, levels)
    return outputs

"""The shapes that everything else speaks: a `Transition`, a `QFunction`, and arrays by what they hold.

Subscripts follow the field: ``_tm1`` is the near side of a transition (the state that was left), ``_t`` the far side
(the state that was reached). Two facts end an episode and are never merged: `discount_t` is zero where the world
terminated, so nothing is bootstrapped; `last_t` is true wherever the stream of experience breaks (termination, a time
limit, an autoreset), so traces and λ-returns stop there although the bootstrap stays.

Importing this module does not import PyTorch: rooms that know arrays only name their types from here, too.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Array", "Floats", "Indices", "Metrics", "QFunction", "Transition"]

Array = NDArray[Any]
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Metrics = dict[str, float]


@dataclass(frozen=True, slots=True)
class Transition:
    """One step of experience, or many with the same leading axes.

    Leading axes ``*n``: none for a single step, ``[B]`` from a replay buffer, ``[T, B]`` for a rollout (time first).

    Args:
        s_tm1: observation before the action, ``[*n, *obs]``.
        a_tm1: action taken, ``[*n]``, int64.
        mu_tm1: probability with which the behaviour policy took it, ``[*n]``, in (0, 1].
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 where the world terminated, ``[*n]``. It multiplies the bootstrap.
        s_t: the true successor, ``[*n, *obs]``, also at a time limit or an autoreset.
        last_t: whether the stream breaks here, ``[*n]``, bool. It cuts traces and λ-returns, never the bootstrap.

    Example:
        >>> import torch
        >>> step = Transition(torch.zeros(4), torch.tensor(1), torch.tensor(0.5), torch.tensor(1.0),
        ...                   torch.tensor(0.99), torch.ones(4), torch.tensor(False))
        >>> step.map(lambda x: x[None]).r_t.shape
        torch.Size([1])
    """

    s_tm1: Tensor
    a_tm1: Tensor
    mu_tm1: Tensor
    r_t: Tensor
    discount_t: Tensor
    s_t: Tensor
    last_t: Tensor

    def map(self, function: Any) -> Transition:
        """A new transition with ``function`` applied to every field (indexing, reshaping, moving to a device)."""
        return Transition(*(function(getattr(self, f.name)) for f in fields(self)))


@runtime_checkable
class QFunction(Protocol):
    """Anything that gives action values. Structural: an `nn.Module` with these three names is one.

    ``at(s, a)`` must equal ``all(s)`` gathered at ``a``. A state-value function is a `QFunction` with one action.
    """

    num_actions: int

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, *obs] -> [*n, A]``."""
        ...

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        ...

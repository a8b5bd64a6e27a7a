"""Experience in sequences for representations with a memory: which memories it has by now, and where to begin.

Stored memories were made with the parameters of then. The first of a sequence is kept, or brought up to date by a few
steps before it that are not learned from (stored state and burn-in, Kapturowski et al. 2019); those after it are made
anew.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from neuralq.q.engine import Engine, TorchEngine
from neuralq.q.recurrent import RecurrentQ, recurrent_part
from neuralq.types import Transition

__all__ = ["after_burn_in", "has_memory", "recalled", "stream_weights"]


def has_memory(engine: Engine) -> bool:
    """Whether the representation remembers, so that its gradient needs sequences."""
    return recurrent_part(engine.q) is not None


def _network(engine: Engine, target: bool) -> RecurrentQ:
    assert isinstance(engine, TorchEngine)  # kernels know no memory
    found = recurrent_part(engine.network(target))
    assert found is not None
    return found


@torch.no_grad()
def recalled(engine: Engine, transition: Transition, target: bool = False) -> Transition:
    """A sequence with the memories that the present parameters, or the target copy's, have along it.

    Args:
        engine: of a representation with a memory.
        transition: rows ``[T, B]``.
        target: whether the target copy's.
    """
    q = _network(engine, target)
    s_tm1, after = q.recalled(transition.s_tm1, transition.last_t)
    return dataclasses.replace(transition, s_tm1=s_tm1, s_t=q.with_memory(transition.s_t, after))


@torch.no_grad()
def after_burn_in(engine: Engine, transition: Transition, burn_in: int) -> Transition:
    """The rows from ``burn_in`` on, the first with the memory that the present parameters have of those before it.

    Args:
        engine: of a representation with a memory.
        transition: rows ``[T, B]``.
        burn_in: rows that are remembered and not learned from, below T.
    """
    if burn_in == 0:
        return transition
    first = recalled(engine, transition.map(lambda x: x[: burn_in + 1])).s_tm1[burn_in:]
    rest = transition.map(lambda x: x[burn_in:])
    return dataclasses.replace(rest, s_tm1=torch.cat([first, rest.s_tm1[1:]]))


def stream_weights(weight: Tensor, dtype: torch.dtype) -> Tensor:
    """Weights of rows of which some are no experience, so that their mean loss is that over the others.

    Example:
        >>> stream_weights(torch.tensor([[1.0, 0.0]]), torch.float32).tolist()
        [[2.0, 0.0]]
    """
    held = weight.to(dtype)
    return held / held.mean().clamp(min=torch.finfo(dtype).tiny)

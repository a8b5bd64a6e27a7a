"""What a run saves of a learner: a learner names its parts, and takes the methods that stand here.

A part in ``_parts`` is a tensor, the flat parameters, None, or has `state_dict`, with `load_state_dict` where there is
more to it than tensors to copy. What connects one step of a stream to the next has `clear` as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuralq.q.flat import FlatParameters

__all__ = ["begin_streams", "load_state_dict", "state_dict"]


def begin_streams(self: Any) -> None:
    """Every stream of experience starts anew: what connects one step to the next is dropped."""
    for part in self._parts.values():
        if hasattr(part, "clear"):
            part.clear()


def state_dict(self: Any) -> dict[str, Any]:
    """Counter and parts: everything that a continued run needs."""
    return {"num_updates": self.num_updates, **{name: _saved(part) for name, part in self._parts.items()}}


def load_state_dict(self: Any, state: Mapping[str, Any]) -> None:
    """Continue from `state_dict`, bit for bit; a `ValueError` if the state belongs to another network."""
    self.num_updates = int(state["num_updates"])
    for name, part in self._parts.items():
        if part is not None:
            _restore(name, part, state[name])


def _saved(part: Any) -> Any:
    if isinstance(part, FlatParameters):
        return part.values
    return part if part is None or isinstance(part, Tensor) else part.state_dict()


def _restore(name: str, part: Any, saved: Any) -> None:
    if isinstance(part, FlatParameters):
        part.load(torch.as_tensor(saved))
    elif isinstance(part, Tensor):
        found = torch.as_tensor(saved)
        if found.shape != part.shape:
            raise ValueError(
                f"{name} has {part.numel()} entries here, the saved one has {found.numel()}; load it with the network "
                "it was saved with"
            )
        part.copy_(found)
    elif hasattr(part, "load_state_dict"):
        part.load_state_dict(saved)
    else:
        for inner, tensor in part.state_dict().items():
            _restore(inner, tensor, saved[inner])

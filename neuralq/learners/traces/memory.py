"""What connects one step of a stream to the next: eligibility traces with their decay, and the state that is saved.

A trace decays by the discount *into* the state whose gradient is added, which is that of the previous transition, and
it is dropped *after* the last step of a stream. Both stand here, once for all learners with parallel streams.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

__all__ = ["Traces", "begin_streams", "copy_into", "load_state_dict", "state_dict"]


class Traces:
    """Named tensors ``[N, …]`` of N streams, and the decay ``[N]`` that is due before the next gradient is added.

    Args:
        lambda_: λ.
        num_envs: N.
        like: a tensor of the dtype and on the device of the traces.
        shapes: of one stream's entry of each tensor, by name.
    """

    def __init__(self, lambda_: float, num_envs: int, like: Tensor, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self.lambda_ = lambda_
        self.z = {name: like.new_zeros(num_envs, *shape) for name, shape in shapes.items()}
        self.decay = like.new_zeros(num_envs)

    def close(self, discount_t: Tensor, last_t: Tensor, moved: Tensor | None = None) -> None:
        """The discount into the next state is due; everything is dropped after the last step of a stream.

        ``last_t`` is not asked whether it is true: an accelerator would have to be waited for.

        Args:
            discount_t: of the transitions, ``[N]``.
            last_t: whether their streams break, ``[N]``.
            moved: streams that took this step, ``[N]``; None for all.
        """
        due = self.lambda_ * discount_t.to(self.decay.dtype)
        if moved is not None:
            due, last_t = torch.where(moved, due, self.decay), last_t & moved
        self.decay.copy_(due).masked_fill_(last_t, 0.0)
        for z in self.z.values():
            z.masked_fill_(last_t.reshape(-1, *[1] * (z.dim() - 1)), 0.0)

    def clear(self) -> None:
        """Every stream starts anew."""
        for tensor in self.state_dict().values():
            tensor.zero_()

    def state_dict(self) -> dict[str, Tensor]:
        """The traces and the decay."""
        return {**self.z, "decay": self.decay}


# Methods of learners that move their parameters themselves. What such a learner keeps beside them is in ``_memory`` by
# name: tensors, or parts with `state_dict` and `clear`.


def begin_streams(self: Any) -> None:
    """Every stream of experience starts anew: what connects one step to the next is dropped."""
    for part in self._memory.values():
        if not isinstance(part, Tensor):
            part.clear()


def state_dict(self: Any) -> dict[str, Any]:
    """Counter, parameters, and what is kept beside them: everything that a continued run needs."""
    kept = {name: part if isinstance(part, Tensor) else part.state_dict() for name, part in self._memory.items()}
    return {"num_updates": self.num_updates, "parameters": self.engine.flat.values, **kept}


def load_state_dict(self: Any, state: Mapping[str, Any]) -> None:
    """Continue from `state_dict`, bit for bit; a `ValueError` if the state belongs to another network."""
    self.num_updates = int(state["num_updates"])
    self.engine.flat.load(torch.as_tensor(state["parameters"]))
    mine = self.state_dict()
    copy_into({name: mine[name] for name in self._memory}, state)


def copy_into(mine: Mapping[str, Any], saved: Mapping[str, Any]) -> None:
    """Copy saved tensors, in mappings or not, into those of the same name.

    Raises:
        ValueError: if a shape differs.
    """
    for name, value in mine.items():
        if not isinstance(value, Tensor):
            copy_into(value, saved[name])
            continue
        found = torch.as_tensor(saved[name])
        if found.shape != value.shape:
            raise ValueError(
                f"{name} has {value.numel()} entries here, the saved one has {found.numel()}; load it with the "
                "network it was saved with"
            )
        value.copy_(found)

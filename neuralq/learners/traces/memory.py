"""What connects one step of a stream to the next: eligibility traces with their decay.

A trace decays by the discount *into* the state whose gradient is added, which is that of the previous transition, and
it is dropped *after* the last step of a stream. Both stand here, once for all learners with parallel streams.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

__all__ = ["Traces"]


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

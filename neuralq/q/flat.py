"""One contiguous vector per learner: a module's parameters and gradients become views into it."""

from __future__ import annotations

import hashlib
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["FlatParameters"]


class FlatParameters:
    """Two contiguous vectors, values and gradients, that the parameters of a module are views of.

    Optimisers, traces, target copies, step bounds and checkpoints are then expressions on one vector. Autograd
    accumulates into the same memory, because it adds in place to a gradient that is already there.

    ``grad_array`` is the memory of ``grad`` as an array, None on other devices than the CPU. ``layers`` tells where a
    parameter lies, by the name that ``module.state_dict()`` has for it: first entry and shape.

    Args:
        module: its parameters (in the order of ``module.parameters()``) are moved; they must share dtype and device.

    Example:
        >>> from neuralq.q import TableQ
        >>> q = TableQ(2, 2)
        >>> flat = FlatParameters(q)
        >>> flat.values[:] = torch.arange(4.0)
        >>> q.all(torch.tensor(1)).tolist()
        [2.0, 3.0]
        >>> flat.layers
        {'weight': [0, [2, 2]]}
    """

    def __init__(self, module: nn.Module) -> None:
        parameters = list(module.parameters())
        if not parameters:
            raise ValueError(f"{type(module).__name__} has no parameters to learn")
        kinds = {(p.dtype, p.device) for p in parameters}
        if len(kinds) > 1:
            raise ValueError(f"the parameters must share one dtype and device, got {sorted(map(str, kinds))}")
        first = parameters[0]
        total = sum(p.numel() for p in parameters)
        self.values = torch.empty(total, dtype=first.dtype, device=first.device)
        self.grad = torch.zeros_like(self.values)
        on_cpu = first.device.type == "cpu"
        self.grad_array = self.grad.numpy() if on_cpu else None
        self.layers: dict[str, list[Any]] = {}
        start = 0
        for name, p in module.named_parameters():
            end = start + p.numel()
            self.values[start:end] = p.detach().reshape(-1)
            p.data = self.values[start:end].view(p.shape)
            p.grad = self.grad[start:end].view(p.shape)
            self.layers[name] = [start, list(p.shape)]
            start = end

    def offset(self, parameter: Tensor) -> int:
        """Where one of the module's parameters begins in the vector."""
        return (parameter.data_ptr() - self.values.data_ptr()) // self.values.element_size()

    def sha256(self) -> str:
        """SHA-256 of the vector's bytes (little-endian, in the order of ``module.parameters()``)."""
        return hashlib.sha256(self.values.detach().cpu().contiguous().numpy().tobytes()).hexdigest()

    def load(self, values: Tensor) -> None:
        """Copy ``values`` in, in place, so that every view follows.

        Raises:
            ValueError: if the lengths differ: the checkpoint belongs to another network.
        """
        if values.shape != self.values.shape:
            raise ValueError(
                f"this network has {self.values.numel()} parameters, the saved one has {values.numel()}; "
                "load it with the configuration it was saved with"
            )
        self.values.copy_(values)

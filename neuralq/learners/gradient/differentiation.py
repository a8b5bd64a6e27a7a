"""Derivatives of any Q-function as vectors over its flat parameters: of a number, of many, and once more.

Everything goes through autograd and leaves the gradients stored in the parameters alone, so it works for every module
and beside every engine. Parameters that a value does not depend on get a derivative of 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from neuralq.types import QFunction

__all__ = ["gradient", "gradient_rows", "greedy_value", "module_parameters"]


def module_parameters(q: QFunction) -> list[nn.Parameter]:
    """The parameters of a Q-function, in the order of `neuralq.q.FlatParameters`.

    Example:
        >>> from neuralq.q import TableQ
        >>> [p.shape for p in module_parameters(TableQ(3, 2))]
        [torch.Size([3, 2])]
    """
    return list(cast(nn.Module, q).parameters())


def _flatten(found: Sequence[Tensor | None], parameters: Sequence[Tensor], rows: tuple[int, ...]) -> Tensor:
    """Derivatives of each parameter, with the leading axes ``rows``, as one vector or matrix."""
    return torch.cat(
        [
            p.new_zeros(*rows, p.numel()) if g is None else g.reshape(*rows, p.numel())
            for p, g in zip(parameters, found, strict=True)
        ],
        -1,
    )


def gradient(value: Tensor, parameters: Sequence[Tensor], differentiable: bool = False) -> Tensor:
    """The gradient of one number: ``[] -> [d]``; the graph stays usable, the result has one if ``differentiable``.

    Example:
        >>> w = torch.tensor([2.0, 3.0], requires_grad=True)
        >>> gradient(w[0] * w[1], [w])
        tensor([3., 2.])
    """
    if not value.requires_grad:
        return _flatten([None] * len(parameters), parameters, ())
    found = torch.autograd.grad(value, parameters, retain_graph=True, create_graph=differentiable, allow_unused=True)
    return _flatten(found, parameters, ())


def gradient_rows(values: Tensor, parameters: Sequence[Tensor], differentiable: bool = False) -> Tensor:
    """The gradient of each value by itself: ``[N] -> [N, d]``; the graph stays usable.

    With ``differentiable`` the rows can be differentiated again: `gradient_rows` of ``rows @ direction`` are the
    Hessian-vector products ∇²v_i · direction (Pearlmutter 1994). Two derivatives in a row are all that this takes; the
    shorter way by the derivative of a vector-Jacobian product takes three, and torch's third derivative of a layer
    normalisation is wrong without a word.

    Example:
        >>> w = torch.tensor([2.0, 3.0], requires_grad=True)
        >>> rows = gradient_rows(torch.stack([w[0] ** 2 * w[1], w.sum()]), [w], differentiable=True)
        >>> rows.tolist()  # (2 w0 w1, w0²) and (1, 1)
        [[12.0, 4.0], [1.0, 1.0]]
        >>> gradient_rows(rows @ torch.tensor([1.0, 0.0]), [w]).tolist()  # (2 w1, 2 w0) and (0, 0)
        [[6.0, 4.0], [0.0, 0.0]]
    """
    if len(values) == 1:  # one stream is the common case, and batched differentiation costs more than it saves there
        return gradient(values[0], parameters, differentiable)[None]
    if not values.requires_grad:
        return _flatten([None] * len(parameters), parameters, (len(values),))
    each = torch.eye(len(values), dtype=values.dtype, device=values.device)
    found = torch.autograd.grad(
        values,
        parameters,
        each,
        retain_graph=True,
        create_graph=differentiable,
        allow_unused=True,
        is_grads_batched=True,
    )
    return _flatten(found, parameters, (len(values),))


def greedy_value(q: Tensor) -> Tensor:
    """The value of the best action, the lowest index among ties: ``[*n, A] -> [*n]``.

    It equals the maximum; its gradient is that of one action, where the maximum would share it among ties.

    Example:
        >>> q = torch.tensor([1.0, 3.0, 3.0], requires_grad=True)
        >>> gradient(greedy_value(q), [q])
        tensor([0., 1., 0.])
    """
    return q.gather(-1, q.argmax(-1, keepdim=True))[..., 0]

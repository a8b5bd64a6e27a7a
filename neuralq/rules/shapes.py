"""Shape checks of the rules: nothing in `neuralq.rules` broadcasts between ranks behind the caller's back.

The checks read shapes and dtypes only, never values, so they cost no synchronisation on an accelerator.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["align_leading", "check_actions", "check_flags", "check_same_shape", "check_time_major"]


def check_same_shape(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Both tensors have the same shape.

    Raises:
        ValueError: otherwise; a [B] against a [B, 1] would silently become [B, B].
    """
    if tensor.shape != other.shape:
        raise ValueError(
            f"{name} must have the shape of {other_name}, got {list(tensor.shape)} against {list(other.shape)}; "
            f"reshape or expand it explicitly"
        )


def check_actions(name: str, a: Tensor, q_name: str, q: Tensor) -> None:
    """``a`` holds one int64 action per row of ``q``: ``[*n]`` against ``[*n, A]``.

    Raises:
        ValueError: otherwise.
    """
    if a.dtype != torch.int64:
        raise ValueError(f"{name} must be int64 action indices, got {a.dtype}; convert with {name}.long()")
    if a.shape != q.shape[:-1]:
        raise ValueError(
            f"{name} must have the leading axes of {q_name}, got {list(a.shape)} against {list(q.shape[:-1])}"
        )


def check_flags(name: str, flags: Tensor, other_name: str, other: Tensor) -> None:
    """``flags`` is a bool tensor with the shape of ``other``.

    Raises:
        ValueError: otherwise; ~ on integer flags would not negate them.
    """
    if flags.dtype != torch.bool:
        raise ValueError(f"{name} must be a bool tensor, got {flags.dtype}; convert with {name}.bool()")
    check_same_shape(name, flags, other_name, other)


def check_time_major(r_t: Tensor, discount_t: Tensor, v_t: Tensor, last_t: Tensor) -> None:
    """A rollout has at least one row and ``[T, *n]`` everywhere.

    Raises:
        ValueError: otherwise.
    """
    if r_t.ndim == 0 or r_t.shape[0] == 0:
        raise ValueError(f"r_t must be time-major [T, *n] with T of at least 1, got {list(r_t.shape)}")
    check_same_shape("discount_t", discount_t, "r_t", r_t)
    check_same_shape("v_t", v_t, "r_t", r_t)
    check_flags("last_t", last_t, "r_t", r_t)


def align_leading(name: str, factor: Tensor | float, other_name: str, other: Tensor) -> Tensor | float:
    """``factor`` with trailing axes of length 1 added until it lines up with ``other`` from the left.

    A number passes through; a tensor must match the leading axes of ``other`` one by one (``[B]`` against ``[B, d]``).

    Raises:
        ValueError: otherwise.
    """
    if not isinstance(factor, Tensor) or factor.ndim == 0:
        return factor
    if factor.shape != other.shape[: factor.ndim]:
        raise ValueError(
            f"{name} must be a number or match the leading axes of {other_name}, "
            f"got {list(factor.shape)} against {list(other.shape)}"
        )
    return factor.reshape(factor.shape + (1,) * (other.ndim - factor.ndim))

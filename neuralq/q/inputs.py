"""What a network does to its input first: indices become one-hot vectors, bytes brightness."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_whole
from neuralq.types import Array

__all__ = ["OneHot", "Pixels", "shape_of"]


def shape_of(given: Any) -> tuple[int, ...]:
    """The shape of an observation, of which a vector's may be given as its length.

    Raises:
        ValueError: for anything else, with what a Gymnasium space has for it.

    Example:
        >>> shape_of(4), shape_of((84, 84, 4))
        ((4,), (84, 84, 4))
    """
    sides = given if isinstance(given, Iterable) else (given,)
    try:
        found = tuple(operator.index(side) for side in sides)
    except TypeError:
        found = (0,)
    if any(side < 1 for side in found):
        raise ValueError(
            f"input_shape must be the length of a vector or a tuple of whole numbers of at least 1, got {given!r}; a "
            "Gymnasium Box has it as its shape (and a Discrete the number of actions as its n); states go to "
            "TableQ(space.n, num_actions)"
        )
    return found


class OneHot(nn.Module):
    """State indices to one-hot vectors; has no parameters.

    Args:
        num_categories: number of states, at least 1.
        dtype: of the result.

    Example:
        >>> OneHot(3)(torch.tensor([2, 0])).tolist()
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    """

    def __init__(self, num_categories: int, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        check_whole("num_categories", num_categories)
        self.num_categories = int(num_categories)
        self.dtype = dtype

    def forward(self, index: Tensor) -> Tensor:
        """One-hot rows: ``[*n] int64 -> [*n, num_categories]``."""
        zeros = torch.zeros(*index.shape, self.num_categories, dtype=self.dtype, device=index.device)
        return zeros.scatter(-1, index.unsqueeze(-1), 1.0)


class Pixels(nn.Module):
    """Bytes to brightness in [0, 1]: ``x / 255``, or ``(x − origin) / divisor``; has no parameters.

    Args:
        divisor: a number, or one for each entry of an observation.
        origin: likewise.

    Example:
        >>> Pixels()(torch.tensor([0, 255], dtype=torch.uint8)).tolist()
        [0.0, 1.0]
    """

    def __init__(self, divisor: float | Array = 255.0, origin: float | Array = 0.0) -> None:
        super().__init__()
        for name, value in (("divisor", divisor), ("origin", origin)):
            self.register_buffer(name, torch.as_tensor(np.asarray(value, np.float32)), persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        """Scaled bytes: ``[*n, *obs] uint8 -> [*n, *obs] float32``.

        Raises:
            ValueError: ``image`` is not uint8 (scaling it twice would go unnoticed).
        """
        if image.dtype != torch.uint8:
            raise ValueError(f"Pixels takes uint8 images, got {image.dtype}; leave Pixels out for scaled images")
        return (image.to(torch.float32) - self.get_buffer("origin")) / self.get_buffer("divisor")

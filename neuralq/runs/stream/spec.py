"""What a stream hands to a representation, in shape and kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from neuralq.runs.stream.scaling import Scaling

__all__ = ["ObservationSpec"]


@dataclass(frozen=True, slots=True)
class ObservationSpec:
    """What a representation is handed.

    Args:
        shape: of one encoded observation, memory and mask included.
        dtype: NumPy dtype it is stored in.
        inner_shape: shape without memory and mask.
        num_categories: number of states if the observation is a state index, else None.
        masked: whether an action mask is appended.
        num_actions: A.
        frame_scaling: of frames of bytes, how the network is to scale them; other numbers are scaled already.
        memory_size: numbers that are remembered, which come after the observation and before the mask; with them
            everything is float32.
        inner_dtype: of the observation alone; None where that is ``dtype``.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    inner_shape: tuple[int, ...]
    num_categories: int | None
    masked: bool
    num_actions: int
    frame_scaling: Scaling | None = None
    memory_size: int = 0
    inner_dtype: np.dtype[Any] | None = None

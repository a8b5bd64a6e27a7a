"""What the numbers of a space are divided by before a value function sees them: its bounds decide, not its dtype.

One rule for every `Box`, wherever it stands and whatever its dtype: an entry whose bounds are finite and reach beyond
±32 is brought to [0, 1], or to [−1, 1] where it may have either sign. What is smaller has a size that networks take as
it is, and bounds as wide as an int32 only say that there are none. Planes of 0 and 1 stay so in bytes as in floats, and
pictures of 0..255 become brightness in floats as in bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from neuralq.types import Array

__all__ = ["Scaling", "scaling_of"]

_SMALL = 32.0
_NO_BOUND = float(np.iinfo(np.int32).max)


@dataclass(frozen=True, slots=True, eq=False)
class Scaling:
    """Numbers x are seen as (x − origin) / divisor, each a float64 array of the observation's shape, or a number.

    Args:
        origin: 0 where the bounds allow it, else the bound that is nearer to 0.
        divisor: how far the bounds are from there; 1 for entries that are left as they are.

    Example:
        >>> found = scaling_of(spaces.Box(-128, 127, (3,), np.int8))
        >>> found.apply(np.array([-128, 0, 64], np.int8)).tolist()
        [-1.0, 0.0, 0.5]
    """

    origin: Array
    divisor: Array

    def apply(self, x: Array) -> Array:
        """The numbers as they are seen, float64."""
        return (x.astype(np.float64) - self.origin) / self.divisor

    def plain(self) -> list[list[float]]:
        """Both as lists of numbers, for checkpoints; one number each where all entries have the same."""
        return [np.unique(x).tolist() if np.ptp(x) == 0 else x.ravel().tolist() for x in (self.origin, self.divisor)]


def scaling_of(space: spaces.Box) -> Scaling | None:
    """How the numbers of a space are scaled; None where all of them are left as they are.

    Example:
        >>> scaling_of(spaces.Box(0, 1, (2,), np.uint8)) is None
        True
        >>> scaling_of(spaces.Box(0, 255, (2,), np.float32)).divisor.item()
        255.0
    """
    low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
    reach = np.maximum(np.abs(low), np.abs(high))
    scaled = (reach > _SMALL) & (reach < _NO_BOUND) & (high > low)
    if not scaled.any():
        return None
    origin = np.where(scaled, np.clip(0.0, low, high), 0.0)
    with np.errstate(invalid="ignore", over="ignore"):  # of bounds that are none
        divisor = np.where(scaled, np.maximum(np.abs(low - origin), np.abs(high - origin)), 1.0)
    if np.ptp(origin) == 0 and np.ptp(divisor) == 0:
        return Scaling(origin.ravel()[0], divisor.ravel()[0])
    return Scaling(origin, divisor)

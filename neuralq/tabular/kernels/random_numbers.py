"""Random numbers inside compiled kernels: xoshiro256++ with its state in an array, one state per seed.

NumPy's generators cannot be handed to a kernel that is cached on disk, so kernels carry their own: 256 bits of state,
seeded from `numpy.random.SeedSequence`, whose children are independent streams. (Blackman & Vigna 2021.)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel

__all__ = ["Seed", "new_stream", "uniform"]

Seed = int | np.random.SeedSequence
"""What seeds a run: a whole number, or a sequence (one child per run gives independent streams)."""

_STEP = np.uint64(17)
_ROTATE_OUT, _ROTATE_OUT_BACK = np.uint64(23), np.uint64(41)
_ROTATE_LAST, _ROTATE_LAST_BACK = np.uint64(45), np.uint64(19)
_TOP_BITS = np.uint64(11)
_UNIT = 1.0 / (1 << 53)


def new_stream(seed: Seed) -> NDArray[np.uint64]:
    """The state of a fresh generator, ``[4]`` uint64.

    Example:
        >>> new_stream(0).shape, bool((new_stream(0) == new_stream(1)).any())
        ((4,), False)
    """
    sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.asarray(sequence.generate_state(4, np.uint64), dtype=np.uint64)


@lean_kernel
def uniform(state: NDArray[np.uint64]) -> Any:
    """The next number in [0, 1), a multiple of 2⁻⁵³; advances ``state``.

    Example:
        >>> stream = new_stream(0)
        >>> 0.0 <= uniform(stream) < 1.0, uniform(stream) == uniform(stream)
        (True, False)
    """
    s0, s1, s2, s3 = state[0], state[1], state[2], state[3]
    total = s0 + s3
    result = ((total << _ROTATE_OUT) | (total >> _ROTATE_OUT_BACK)) + s0
    shifted = s1 << _STEP
    s2 ^= s0
    s3 ^= s1
    s1 ^= s2
    s0 ^= s3
    s2 ^= shifted
    s3 = (s3 << _ROTATE_LAST) | (s3 >> _ROTATE_LAST_BACK)
    state[0], state[1], state[2], state[3] = s0, s1, s2, s3
    return np.float64(result >> _TOP_BITS) * _UNIT

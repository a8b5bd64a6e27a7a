"""Bodies by name, and which one observations get where none is asked for."""

from __future__ import annotations

from dataclasses import replace

from neuralq.q.bodies import MLP, Conv
from neuralq.q.frames import channels_first
from neuralq.q.recurrent import GRU

__all__ = ["NAMED_BODIES", "body_for"]

# PQN (Gallici et al., 2024) for MinAtar, whose frames are [10, 10, C]; Seaquest's ten channels look like a side.
_MINATAR = Conv(init="he", channel_order="last")
# The network of Mnih et al. (2015) for 84 × 84 frames, with PQN's layer normalisation.
_CONV = Conv((32, 64, 64), (8, 4, 3), (4, 2, 1), (512,), init="he")

NAMED_BODIES: dict[str, MLP | Conv | GRU] = {"mlp": MLP(), "minatar": _MINATAR, "conv": _CONV, "gru": GRU()}
"""Bodies by the names that configurations and the command line know them by."""


def body_for(shape: tuple[int, ...], is_frame: bool) -> MLP | Conv:
    """The body for observations where none is asked for.

    Frames of at least 36 a side get the "conv" body, smaller ones "minatar", with the channel order found out; what is
    too small for a kernel, or no frame at all, gets an `MLP`.

    Args:
        shape: of one observation.
        is_frame: whether it is stored as bytes or flags; other arrays are frames where they have three axes, or four.

    Example:
        >>> body_for((84, 84, 4), True).kernel_sizes, body_for((10, 10), True).kernel_sizes
        ((8, 4, 3), (3,))
        >>> body_for((4,), False).hidden
        (128, 128)
    """
    if len(shape) in (3, 4) or (len(shape) == 2 and is_frame):
        sides = channels_first(shape)[1:]
        if min(sides) >= 3:
            return replace(_CONV if min(sides) >= 36 else _MINATAR, channel_order="auto")
    return MLP()

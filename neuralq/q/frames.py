"""Where the channels of a frame are: Gymnasium's environments put them last, torch's convolutions want them first.

Several frames in one observation, as Gymnasium's `FrameStackObservation` makes them of frames with three axes, are one
frame with all their channels.
"""

from __future__ import annotations

__all__ = ["channels_first"]


def channels_first(shape: tuple[int, ...], order: str = "auto") -> tuple[int, int, int]:
    """The frame's sides as ``(C, H, W)``.

    Args:
        shape: of one frame, three axes, or two for one channel, or four, the first of which counts frames.
        order: "first", "last" or "auto": the smaller of the two end axes has the channels.

    Raises:
        ValueError: for other shapes, and with "auto" where a frame's end axes are equal.

    Example:
        >>> channels_first((84, 84, 3)), channels_first((4, 84, 84)), channels_first((10, 10))
        ((3, 84, 84), (4, 84, 84), (1, 10, 10))
        >>> channels_first((4, 84, 84, 3))
        (12, 84, 84)
    """
    if len(shape) == 4:
        channels, height, width = channels_first(shape[1:], order)
        return shape[0] * channels, height, width
    if len(shape) == 2:
        return 1, shape[0], shape[1]
    if len(shape) != 3:
        raise ValueError(
            "a Conv body needs frames [height, width, channels], [channels, height, width] or [height, width], or a "
            f"stack of three axes each, got shape {shape}; use an MLP body, or make it one of these"
        )
    if order == "auto" and shape[0] == shape[2]:
        raise ValueError(
            f"frames of shape {shape} do not show which axis has the channels; give the Conv body "
            "channel_order='first' or 'last'"
        )
    last = order == "last" or (order == "auto" and shape[2] < shape[0])
    return (shape[2], shape[0], shape[1]) if last else (shape[0], shape[1], shape[2])

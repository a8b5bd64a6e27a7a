"""What a run on an environment says before it begins: how it sees its observations."""

from __future__ import annotations

from neuralq.runs.offline.playback import Playback
from neuralq.runs.stream import Interaction
from neuralq.runs.stream.table import TableWalk

__all__ = ["opening_lines"]


def opening_lines(stream: Interaction | TableWalk | Playback) -> list[str]:
    """One line on what a value function is handed, and how it was scaled.

    Example:
        >>> import gymnasium as gym
        >>> from neuralq.runs.stream import make_vector_env
        >>> opening_lines(Interaction(make_vector_env(lambda: gym.make("CartPole-v1"), 1), 0.9, 0))
        ['observations: 4 numbers as they come']
    """
    spec, seen, scalings = stream.spec, stream.normalisation, stream.encoder.scalings
    if spec.num_categories is not None:
        what = f"one of {spec.num_categories:,} states"
    else:
        size = f"{spec.inner_shape[0]:,}" if len(spec.inner_shape) == 1 else " × ".join(map(str, spec.inner_shape))
        what = f"{size or 1} {_KINDS.get(spec.dtype.name, 'numbers')}"
        if seen is not None and seen.observations:
            what += " over their mean and spread so far"
        elif not scalings:
            what += " as they come"
    for name, (origin, divisor) in scalings.items():
        what += f", {name.removeprefix('observation') or 'all'} over {_shown(origin, divisor)}"
    return ["observations: " + what + (f", and which of {spec.num_actions} actions are legal" if spec.masked else "")]


_KINDS = {"uint8": "bytes", "bool": "flags"}


def _shown(origin: list[float], divisor: list[float]) -> str:
    if len(origin) > 1 or len(divisor) > 1:
        return "the bounds of its space, each entry by its own"
    less = f" after {origin[0]:g} is subtracted" if origin[0] else ""
    return f"{divisor[0]:g}, the bound of its space{less}"

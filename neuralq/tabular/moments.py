"""What learners that keep every moment of a trial have in common."""

from __future__ import annotations

from typing import Any

import numpy as np

from neuralq.checks import check_whole

__all__ = ["check_moment", "double"]


def check_moment(a: int, num_actions: int, o_t: int | None, terminated: bool) -> None:
    """What is told of a step: an action, and what is observed after it unless the trial has ended.

    Raises:
        ValueError: another action or observation, or none although the trial goes on.

    Example:
        >>> check_moment(1, 2, None, terminated=False)
        Traceback (most recent call last):
            ...
        ValueError: o_t must be given unless the trial has ended; say terminated=True if it has
    """
    if not 0 <= a < num_actions:
        raise ValueError(f"a must be a whole number from 0 to {num_actions - 1}, got {a!r}")
    if o_t is not None:
        check_whole("o_t", o_t, 0)
    elif not terminated:
        raise ValueError("o_t must be given unless the trial has ended; say terminated=True if it has")


def double(memory: Any, names: tuple[str, ...]) -> None:
    """Makes room in these arrays of a memory for as many moments again.

    Example:
        >>> from types import SimpleNamespace
        >>> memory = SimpleNamespace(o=np.array([3, 4]))
        >>> double(memory, ("o",))
        >>> memory.o.tolist()
        [3, 4, 0, 0]
    """
    for name in names:
        old = getattr(memory, name)
        setattr(memory, name, np.concatenate([old, np.zeros_like(old)]))

"""What an origin of value functions is: how its files are recognised and how they become a subject."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuralq.doctor.subject import Subject

__all__ = ["Origin"]


@dataclass(frozen=True)
class Origin:
    """A kind of file or folder.

    Args:
        name: in words.
        recognises: whether a path may be one, by what it is called and what it begins with; nothing is loaded.
        load: the subject in it; beside the path it is given ``--net`` and the environment, None where there are none.
        place: origins are asked in this order.
    """

    name: str
    recognises: Callable[[Path], bool]
    load: Callable[[Path, str | None, Any], Subject]
    place: int

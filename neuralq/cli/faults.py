"""The errors that are answers to what was asked; a command prints their message and no traceback."""

from __future__ import annotations

from neuralq.checkpoint import CheckpointError
from neuralq.interact import EnvironmentFault
from neuralq.record import RunFolderError
from neuralq.report import MissingExtra
from neuralq.training import Diverged

__all__ = ["USER_FAULTS"]

USER_FAULTS = (
    CheckpointError,
    Diverged,
    EnvironmentFault,
    MemoryError,
    MissingExtra,
    OSError,
    RunFolderError,
    ValueError,
)

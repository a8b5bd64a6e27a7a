"""The errors that are answers to what was asked; a command prints their message and no traceback."""

from __future__ import annotations

from neuralq.checks import MissingExtra
from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.run_folder import RunFolderError
from neuralq.runs.loop import Diverged, HookFault
from neuralq.runs.stream import EnvironmentFault

__all__ = ["USER_FAULTS"]

USER_FAULTS = (
    CheckpointError,
    Diverged,
    EnvironmentFault,
    HookFault,
    MemoryError,
    MissingExtra,
    OSError,
    RunFolderError,
    ValueError,
)

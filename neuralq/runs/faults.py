"""The errors that are answers to what was asked: their message is told, and no traceback.

Environments, bodies and hooks are somebody's own code: where that raised, its file and line are named too.
"""

from __future__ import annotations

import re
import site
import sys
import sysconfig
import traceback
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import torch

import neuralq
import neuralq_envs
from neuralq.checks import MissingExtra
from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.run_folder import RunFolderError
from neuralq.runs.loop import Diverged, HookFault
from neuralq.runs.stream import EnvironmentFault

__all__ = ["USER_FAULTS", "explained", "own_frame"]

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
    gym.error.Error,
)

_INSTALLED = tuple(
    f"{Path(str(place)).resolve()}/"
    for place in (
        *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
        *site.getsitepackages(), site.getusersitepackages(),
        Path(neuralq.__file__).parent, Path(neuralq_envs.__file__).parent,
    )
)  # fmt: skip


def explained(error: BaseException) -> list[str] | None:
    """What to print of an error: its message, and where in somebody's own code it arose; None if it is a fault of ours.

    Example:
        >>> explained(ValueError("gamma must lie in [0, 1]"))
        ['gamma must lie in [0, 1]']
    """
    error = _in_words(error)
    own = own_frame(error)
    if own is None or own.filename in str(error):
        return [str(error) or type(error).__name__] if isinstance(error, USER_FAULTS) else None
    told = str(error) if isinstance(error, USER_FAULTS) else f"{type(error).__name__}: {error}"
    line = f"    {own.line}" if own.line else ""
    return [told, f"  in {own.filename}, line {own.lineno}, {own.name}{line} (--debug shows the whole traceback)"]


def _in_words(error: BaseException) -> BaseException:
    """The same error, or one in words where torch was refused memory and says so in its own."""
    asked = re.search(r"allocate (?:memory: you tried to allocate )?([\d.]+ \w+)", str(error))
    refused = isinstance(error, torch.OutOfMemoryError) or "DefaultCPUAllocator" in str(error)
    if not refused or not isinstance(error, RuntimeError):
        return error
    told = MemoryError(
        f"torch was refused {'memory' if asked is None else asked[1] + ' of memory'}; take a smaller network, smaller "
        "batches or fewer environments at a time"
    )
    told.__cause__ = error
    return told


def own_frame(error: BaseException) -> traceback.FrameSummary | None:
    """The innermost frame of an error, or of what caused it, that belongs to no installed package; None without one."""
    seen: set[int] = set()
    found: traceback.FrameSummary | None = None
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        found = _innermost_own(_frames(cause)) or found
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)
    return found


def _frames(error: BaseException) -> Sequence[traceback.FrameSummary]:
    """Of an error, also of one in another process."""
    remote: Sequence[traceback.FrameSummary] = getattr(error, "remote_frames", ())
    return remote or traceback.extract_tb(error.__traceback__)


def _innermost_own(frames: Sequence[traceback.FrameSummary]) -> traceback.FrameSummary | None:
    return next((frame for frame in reversed(frames) if _is_own(frame.filename)), None)


def _is_own(filename: str) -> bool:
    if filename.startswith("<") or Path(filename).name == Path(sys.argv[0]).name:  # the script that starts commands
        return False
    return not str(Path(filename).resolve()).startswith(_INSTALLED)

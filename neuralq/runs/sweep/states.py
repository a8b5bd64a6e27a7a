"""How far each run of a sweep has come, by what its folder says and nothing else.

A run is finished when its summary says so, has failed when its folder holds ``failure.json``, and is running while
somebody holds its lock. Whoever begins a run again removes the failure.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neuralq.runs.folder.files import (
    RunFolderError,
    clear_left_overs,
    open_regular,
    parse_json,
    read_json,
    read_tail,
    refuse_links,
    to_json,
    write_durably,
)
from neuralq.runs.folder.run_folder import is_run_folder, read_summary

__all__ = [
    "FAILURE",
    "RunState",
    "attempts_path",
    "forget_failure",
    "is_being_written",
    "note_failure",
    "numbered",
    "saved_steps",
    "state_of",
    "steps_so_far",
]

FAILURE = "failure.json"
_NUMBER = re.compile(r"[1-9][0-9]*")


@dataclass(frozen=True)
class RunState:
    """How far a run has come.

    Args:
        state: "finished", "failed", "running", "stopped" before its end with nobody at it, or "not begun".
        reason: why it failed, in a line; "" otherwise.
        summary: of a finished run; empty otherwise.
    """

    state: str
    reason: str = ""
    summary: dict[str, Any] = field(default_factory=dict)


def state_of(path: Path, total_steps: int | None = None) -> RunState:
    """How far the run in a folder has come.

    Args:
        path: its folder, which may be missing.
        total_steps: its budget, where that may have become larger since; None where its summary decides.

    Example:
        >>> state_of(Path("/nowhere"))
        RunState(state='not begun', reason='', summary={})
    """
    summary = _finished(path, total_steps)
    if summary is not None:
        return RunState("finished", summary=summary)
    if os.path.lexists(path / FAILURE):
        return RunState("failed", _failure_in(path))
    if is_being_written(path):
        return RunState("running")
    if is_run_folder(path):
        return RunState("stopped")
    states = {state_of(attempt, total_steps).state for attempt in numbered(attempts_path(path))}
    if "running" in states:
        return RunState("running")
    return RunState("stopped" if states - {"not begun"} else "not begun")


def attempts_path(path: Path) -> Path:
    """Where a cluster's attempts at the run in a folder are (`neuralq.runs.sweep.attempts`).

    Example:
        >>> attempts_path(Path("s/seed-3")).as_posix()
        's/seed-3.attempts'
    """
    return path.with_name(f"{path.name}.attempts")


def numbered(folder: Path) -> list[Path]:
    """The attempts in a folder, newest first.

    Example:
        >>> numbered(Path("/nowhere"))
        []
    """
    try:
        names = [name for name in os.listdir(folder) if _NUMBER.fullmatch(name)]
    except OSError:
        return []
    return [folder / name for name in sorted(names, key=int, reverse=True)]


def _finished(path: Path, total_steps: int | None) -> dict[str, Any] | None:
    """The summary of a run whose budget is spent, whose target is reached or that a hook has stopped; else None."""
    if not (path / "summary.json").exists():
        return None
    try:
        summary = read_summary(path)
    except RunFolderError:  # damaged, or no run; the run writes it anew
        return None
    if summary.get("interrupted_by") is not None:
        return None
    steps = summary.get("env_steps")
    if summary.get("stopped_by") is not None or summary.get("reached"):  # a hook would stop it again
        return summary
    return summary if isinstance(steps, int) and (total_steps is None or steps >= total_steps) else None


def is_being_written(path: Path) -> bool:
    """Whether another process holds the lock of a folder."""
    try:
        descriptor = open_regular(path / "run.lock", os.O_RDONLY)
    except (OSError, RunFolderError):
        return False
    try:  # a writer that died has left its number, and one that ended has not: an empty file is nobody's
        if os.fstat(descriptor).st_size:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def note_failure(path: Path, reason: str) -> None:
    """Writes into the folder of a run, which is made if missing, why it failed; where that cannot be, nothing."""
    with contextlib.suppress(OSError, RunFolderError):
        refuse_links(path.parent, [path.name])
        path.mkdir(parents=True, exist_ok=True)
        write_durably(path / FAILURE, to_json({"reason": " ".join(reason.split())}, "failure", sealed=True))


def forget_failure(path: Path) -> None:
    """The run in a folder is begun again: it has not failed."""
    with contextlib.suppress(OSError):
        clear_left_overs(path, [FAILURE])
        (path / FAILURE).unlink()


def _failure_in(path: Path) -> str:
    try:
        return str(read_json(path / FAILURE)["reason"])
    except (RunFolderError, KeyError) as error:
        return f"for a reason that cannot be read: {error}"


def saved_steps(path: Path) -> int:
    """Environment steps of the newest checkpoint in a run folder, by its name; 0 without one."""
    with contextlib.suppress(OSError):
        names = (re.fullmatch(r"step-(\d+)", name) for name in os.listdir(path / "checkpoints"))
        return max((int(name[1]) for name in names if name is not None), default=0)
    return 0


def steps_so_far(run_dir: Path) -> int:
    """Environment steps in the last whole line of ``metrics.jsonl``; the file may grow meanwhile.

    Of a run that has attempts only, those of the newest.
    """
    if not run_dir.is_dir():
        return next((steps_so_far(attempt) for attempt in numbered(attempts_path(run_dir))), 0)
    try:
        *_, last, _ = [b"", *read_tail(run_dir / "metrics.jsonl").split(b"\n")]
        return int(parse_json(last)["env_steps"])
    except (RunFolderError, OSError, ValueError, KeyError, TypeError, OverflowError):
        return 0

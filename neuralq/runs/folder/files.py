"""Files that survive a kill: JSON replaced in one step, rows that may be cut short, and the lock of the one writer."""

from __future__ import annotations

import fcntl
import json
import math
import os
from collections.abc import Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from neuralq.checks import check_whole

__all__ = [
    "FolderLock",
    "RunFolderBusy",
    "RunFolderError",
    "plain_values",
    "read_json",
    "read_rows",
    "to_json",
    "write_durably",
]


class RunFolderError(RuntimeError):
    """A folder is not what the call needs: no run where one is expected, a run where none may be, or a damaged one."""


class RunFolderBusy(RunFolderError):
    """Another process is writing this folder; the message names the folder and that process."""


class FolderLock:
    """The exclusive lock of a folder, which the system drops when the process dies, however it dies.

    Args:
        file: the lock; it tells others whose it is.
        busy: what is going on, in an error, if another process holds it.

    Raises:
        RunFolderBusy: if another process holds it.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "run.lock"
        >>> lock = FolderLock(file, "the folder is being written")
        >>> file.read_text().strip() == str(os.getpid())
        True
        >>> lock.close()
    """

    def __init__(self, file: Path, busy: str) -> None:
        self._descriptor: int | None = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BaseException as error:
            holder = os.pread(self._descriptor, 32, 0).decode(errors="replace").strip() or "unknown"
            os.close(self._descriptor)
            if not isinstance(error, BlockingIOError):
                raise
            raise RunFolderBusy(
                f"{busy} by process {holder}; wait for it, stop it, or choose another folder"
            ) from error
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    @property
    def is_held(self) -> bool:
        """Whether it has not been given back."""
        return self._descriptor is not None

    def close(self) -> None:
        """Gives it back; closing twice is fine."""
        if self._descriptor is not None:
            os.ftruncate(self._descriptor, 0)
            os.close(self._descriptor)
            self._descriptor = None


def write_durably(path: Path, text: str) -> None:
    """Readers see the old content or the new, also after a power cut."""
    temporary = path.with_name(f".{path.name}.tmp")
    with open(temporary, "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def to_json(value: Mapping[str, Any], name: str) -> str:
    r"""The text of a JSON file.

    Raises:
        ValueError: if it holds NaN or an infinity, which JSON has no word for.
        TypeError: if it holds what JSON cannot express.

    Example:
        >>> to_json({"seed": 3}, "run")
        '{\n  "seed": 3\n}\n'
    """
    try:
        return json.dumps(dict(value), indent=2, allow_nan=False) + "\n"
    except ValueError as error:
        raise ValueError(f"{name} holds a number that JSON has no word for ({error}); use null instead") from error


def plain_values(value: Any, place: str) -> Any:
    """``value`` in what JSON has words for; scalars of NumPy and 0-d tensors as numbers, the non-finite as None.

    Raises:
        TypeError: for anything else, naming its place.

    Example:
        >>> plain_values({"loss": float("nan"), "returns": (1.0, 2.0)}, "row")
        {'loss': None, 'returns': [1.0, 2.0]}
    """
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, Mapping):
        return {str(k): plain_values(v, f"{place}[{k!r}]") for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(v, f"{place}[{i}]") for i, v in enumerate(value)]
    if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):
        return plain_values(value.item(), place)
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, Real):
        return float(value) if math.isfinite(value) else None
    raise TypeError(f"{place} must be a number, a string or None, got {type(value).__name__}")


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        RunFolderError: if it is missing, or holds something else.
    """
    try:
        value = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{path} is damaged or missing: {error}; restore it") from error
    if not isinstance(value, dict):
        raise RunFolderError(f"{path} is damaged: it must hold a JSON object, got {type(value).__name__}; restore it")
    return value


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a ``metrics.jsonl`` in the order written, also while it is being written; a missing file has none.

    A last line that is cut short is passed over: its writer was killed, or is at it now.

    Raises:
        RunFolderError: if any other line is no row of metrics; names the line.
    """
    lines = path.read_bytes().split(b"\n") if path.exists() else []
    rows = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
            check_whole("env_steps", row["env_steps"], 0)
        except (ValueError, TypeError, KeyError) as error:
            if number == len(lines):
                break
            raise RunFolderError(f"{path}, line {number}, is no row of metrics ({error}); delete the line") from error
        rows.append(row)
    return rows

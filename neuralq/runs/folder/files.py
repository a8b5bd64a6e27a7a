"""Files that survive a kill: JSON replaced in one step, rows that may be cut short, and the lock of the one writer.

A run folder may come from somebody else. So nothing is written through a link that stands in it, temporary files have
names that nobody can foresee, and a pipe or a device in place of a file is refused instead of waited for.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import secrets
import stat
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from neuralq.checks import ELSEWHERE, check_whole

try:
    import fcntl
except ImportError as error:
    raise ImportError(ELSEWHERE) from error

__all__ = [
    "FolderLock",
    "RunFolderBusy",
    "RunFolderError",
    "append_line",
    "as_float",
    "clear_left_overs",
    "open_regular",
    "parse_json",
    "plain_values",
    "read_json",
    "read_regular",
    "read_rows",
    "read_tail",
    "refuse_links",
    "replacing",
    "row_line",
    "to_json",
    "write_durably",
]

_MOST_NESTED = 64
_TAIL_BYTES = 1 << 16
_GLANCES, _GLANCE_SECONDS = 3, 0.02
_TEMPORARY = re.compile(r"\.tmp-[0-9a-f]{16}-(.+)")
_SEAL = re.compile(rb',\s*"crc32": "([0-9a-f]{8})"\s*\}\s*\Z')


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
        RunFolderError: if a link stands in its place, whose target would be emptied.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "run.lock"
        >>> lock = FolderLock(file, "the folder is being written")
        >>> file.read_text().strip() == str(os.getpid())
        True
        >>> lock.close()
    """

    def __init__(self, file: Path, busy: str) -> None:
        self._descriptor: int | None = open_regular(file, os.O_RDWR | os.O_CREAT)
        try:
            self._take()
        except BaseException as error:
            holder = os.pread(self._descriptor, 32, 0).decode(errors="replace").strip() or "unknown"
            os.close(self._descriptor)
            if not isinstance(error, BlockingIOError):
                raise
            raise RunFolderBusy(
                f"{busy} by process {holder}; wait for it, stop it, or choose another folder"
            ) from error
        os.ftruncate(self._descriptor, 0)
        with contextlib.suppress(OSError):  # a full disk has no room for the number, and holds the lock all the same
            os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    def _take(self) -> None:
        """Whoever only looks whether somebody holds it (`neuralq.runs.sweep.states`) has it for a moment."""
        assert self._descriptor is not None
        for _ in range(_GLANCES):
            with contextlib.suppress(BlockingIOError):
                return fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            time.sleep(_GLANCE_SECONDS)
        fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)

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


def open_regular(path: Path, flags: int) -> int:
    """A descriptor of a plain file; to write only where no other name leads to it.

    Raises:
        RunFolderError: if a link, a pipe, a device or a folder stands there, or another file is the same one.
        OSError: if it cannot be opened.
    """
    writes = flags & os.O_ACCMODE != os.O_RDONLY
    try:  # without waiting for the other end of a pipe
        descriptor = os.open(path, flags | os.O_NONBLOCK | (os.O_NOFOLLOW if writes else 0), 0o666)
    except OSError as error:
        if writes and os.path.lexists(path) and not stat.S_ISREG(os.lstat(path).st_mode):
            raise _no_file(path) from error
        raise
    found = os.fstat(descriptor)
    if stat.S_ISREG(found.st_mode) and not (writes and found.st_nlink > 1):
        return descriptor
    os.close(descriptor)
    raise _no_file(path)


def _no_file(path: Path) -> RunFolderError:
    kinds = {stat.S_IFLNK: "a link", stat.S_IFIFO: "a pipe", stat.S_IFDIR: "a folder", stat.S_IFREG: "a second name"}
    what = kinds.get(stat.S_IFMT(os.lstat(path).st_mode), "a device")
    of = " of another file" if what == "a second name" else ""
    return RunFolderError(f"{path} is {what}{of} and no file of its own; delete it, or use a copy of the folder")


def refuse_links(folder: Path, names: Iterable[str]) -> None:
    """Raises `RunFolderError` where a link stands in ``folder`` by one of these names: what it leads to stays whole."""
    for name in names:
        if (folder / name).is_symlink():
            raise _no_file(folder / name)


def read_regular(path: Path) -> bytes:
    """The content of a plain file.

    Raises:
        RunFolderError: if a pipe, a device or a folder stands there.
        OSError: if it cannot be read.
    """
    with open(open_regular(path, os.O_RDONLY), "rb") as file:
        return file.read()


def read_tail(path: Path) -> bytes:
    """The last 64 KiB of a plain file, or all of it; it may grow meanwhile.

    Raises:
        RunFolderError: if a pipe, a device or a folder stands there.
        OSError: if it cannot be read.
    """
    with open(open_regular(path, os.O_RDONLY), "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL_BYTES))
        return file.read()


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A fresh empty file to be written in the block; it then takes the place of ``path``, and no link is followed.

    Readers see the old content or the new, also after a power cut; what fails leaves the old and no temporary file.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "page.html"
        >>> with replacing(path) as temporary:
        ...     _ = temporary.write_text("new")
        >>> path.read_text(), len(list(path.parent.iterdir()))
        ('new', 1)
    """
    temporary = path.with_name(f".tmp-{secrets.token_hex(8)}-{path.name[-200:]}")
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    _sync(path.parent)


def write_durably(path: Path, content: str | bytes) -> None:
    """Readers see the old content or the new, also after a power cut."""
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode("utf-8", "replace") if isinstance(content, str) else content)


def clear_left_overs(folder: Path, names: Iterable[str]) -> None:
    """Deletes what a killed writer left of these files; the folder's lock must be held."""
    wanted = set(names)
    for path in folder.iterdir():
        match = _TEMPORARY.fullmatch(path.name)
        if match is not None and match[1] in wanted and not path.is_dir():
            path.unlink()


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def append_line(path: Path, line: str) -> None:
    """One line more in a plain file, made if missing; out of this process's hands when the call returns.

    Where the disk refuses, the file ends as it did before.
    """
    descriptor = open_regular(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        size = os.fstat(descriptor).st_size
        rest = memoryview(line.encode() + b"\n")
        try:
            while rest:
                rest = rest[os.write(descriptor, rest) :]
        except OSError:
            os.ftruncate(descriptor, size)
            raise
    finally:
        os.close(descriptor)


def to_json(value: Mapping[str, Any], name: str, *, sealed: bool = False) -> str:
    r"""The text of a JSON file; with a checksum, where no person is meant to change it.

    Raises:
        ValueError: if it holds NaN or an infinity, which JSON has no word for.
        TypeError: if it holds what JSON cannot express.

    Example:
        >>> to_json({"seed": 3}, "run")
        '{\n  "seed": 3\n}\n'
    """
    try:
        text = json.dumps(dict(value), indent=2, allow_nan=False) + "\n"
    except ValueError as error:
        raise ValueError(f"{name} holds a number that JSON has no word for ({error}); use null instead") from error
    if not sealed or not value:
        return text
    body = text.removesuffix("\n}\n")
    return f'{body},\n  "crc32": "{_checksum(body.encode())}"\n}}\n'


def row_line(row: Mapping[str, Any]) -> str:
    """A row of metrics as a line, with a checksum as its last member.

    Example:
        >>> row_line({"env_steps": 64})
        '{"env_steps": 64, "crc32": "68898cfa"}'
    """
    body = json.dumps(row, allow_nan=False).removesuffix("}")
    return f'{body}, "crc32": "{_checksum(body.encode())}"}}'


def _checksum(body: bytes) -> str:
    return f"{zlib.crc32(body):08x}"


def _unsealed(raw: bytes) -> tuple[bytes, bool]:
    """A JSON object without its checksum, and whether it had one.

    Raises:
        ValueError: if it is not what was written.
    """
    match = _SEAL.search(raw)
    if match is None:
        return raw, False
    body = raw[: match.start()]
    if _checksum(body) != match[1].decode():
        raise ValueError("it is not what was written: the checksum differs")
    return body + b"}", True


def parse_json(raw: bytes | str) -> Any:
    """The value that JSON stands for.

    Raises:
        ValueError: if it is no JSON, or is nested deeper than anything that neuralq writes.

    Example:
        >>> parse_json("[1, 2]")
        [1, 2]
    """
    text = raw.encode() if isinstance(raw, str) else raw
    deep = f"it is nested deeper than {_MOST_NESTED} levels"
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise ValueError(deep) from error
    if text.count(b"[") + text.count(b"{") > _MOST_NESTED:
        level = [value]
        for _ in range(_MOST_NESTED + 1):
            level = [
                inner
                for item in level
                if isinstance(item, dict | list)
                for inner in (item.values() if isinstance(item, dict) else item)
            ]
        if level:
            raise ValueError(deep)
    return value


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
    """The object in a JSON file; its checksum, where it has one, is compared and left out.

    Raises:
        RunFolderError: if it is missing, damaged, or holds something else.
    """
    try:
        value = parse_json(_unsealed(read_regular(path))[0])
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{path} is damaged or missing: {error}; restore it") from error
    if not isinstance(value, dict):
        raise RunFolderError(f"{path} is damaged: it must hold a JSON object, got {type(value).__name__}; restore it")
    return value


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a ``metrics.jsonl`` in the order written, also while it is being written; a missing file has none.

    A last line that is cut short is passed over: its writer was killed, or is at it now.

    Raises:
        RunFolderError: if any other line is no row of metrics, or not the one that was written; names the line.
    """
    try:
        lines = read_regular(path).split(b"\n") if os.path.lexists(path) else []
    except OSError as error:
        raise RunFolderError(f"{path} cannot be read: {error}; restore it") from error
    rows, sealed_before = [], False
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            body, sealed = _unsealed(line)
            row = parse_json(body)
            check_whole("env_steps", row["env_steps"], 0)
            if sealed_before and not sealed:
                raise ValueError("its checksum is missing")
        except (ValueError, TypeError, KeyError) as error:
            if number == len(lines):
                break
            raise RunFolderError(f"{path}, line {number}, is no row of metrics ({error}); delete the line") from error
        sealed_before = sealed
        rows.append(row)
    return rows


def as_float(value: Any) -> float:
    """The number that ``value`` is; NaN when it is none (null, text, a flag), ±inf beyond float64."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf  # type: ignore[operator]

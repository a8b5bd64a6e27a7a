"""The run folder: what a run was told, what it ran on and what it measured, in text files that outlive the process.

    config.json     the effective configuration       run.json       seed and format; written last, so it marks a run
    versions.json   of Python and the libraries       metrics.jsonl  one JSON object per line, flushed
                                                      (each with a checksum, ``crc32``)
    changes.jsonl   what it went on with otherwise
    summary.json    the final result                  checkpoints/   see `neuralq.runs.folder.checkpoint`
    run.lock        held by the one writer            report.html    see `neuralq.runs.report`

One process writes a run folder at a time, guarded by a lock that the system drops when the process dies, however it
dies. Reading needs no lock: whole files are replaced in one step, and a half-written last line is passed over.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import itertools
import os
import platform
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any

from neuralq.checks import check_whole
from neuralq.runs.folder.files import (
    FolderLock,
    RunFolderBusy,
    RunFolderError,
    append_line,
    clear_left_overs,
    open_regular,
    plain_values,
    read_json,
    read_regular,
    read_rows,
    refuse_links,
    row_line,
    to_json,
    write_durably,
)

__all__ = [
    "RunFolder",
    "RunFolderBusy",
    "RunFolderError",
    "claimed",
    "default_run_path",
    "is_run_folder",
    "library_versions",
    "read_changes",
    "read_config",
    "read_metrics",
    "read_seed",
    "read_summary",
    "refuse_old_run",
    "warn_of_lost_rows",
]

FORMAT_NAME = "neuralq-run"
FORMAT_VERSION = 1
_FILES = ("config.json", "versions.json", "run.json", "metrics.jsonl", "summary.json", "exact.json")
_FOLDERS = ("checkpoints", "best", "tensorboard", "wandb")
_LIBRARIES = ("torch", "numpy", "scipy", "gymnasium", "numba", "safetensors")


class RunFolder:
    """The one writer of a run folder; holds the folder's lock until closed.

    Get one from `RunFolder.create` or `RunFolder.open`, and use it in a ``with`` statement.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "first"
        >>> with RunFolder.create(path, config={"env": "CartPole-v1"}, seed=3) as run:
        ...     run.append_metrics({"env_steps": 100, "loss": 0.5})
        ...     run.append_metrics({"env_steps": 200, "loss": float("nan")})
        >>> read_metrics(path)
        [{'env_steps': 100, 'loss': 0.5}, {'env_steps': 200, 'loss': None}]
    """

    def __init__(self, path: Path) -> None:
        self.path = self.named = path
        self.config: dict[str, Any] = {}
        """The effective configuration, as ``config.json`` has it."""
        self.free: frozenset[str] = frozenset()
        """Names of the configuration that do not decide what is learned: checkpoints do not depend on them."""
        self._lock = FolderLock(path / "run.lock", f"{path} is being written")
        self._num_rows: int | None = None

    @classmethod
    def create(cls, path: str | Path, *, config: Mapping[str, Any], seed: int) -> RunFolder:
        """A new run in ``path``, which is made if missing and must not hold a run already.

        Raises:
            RunFolderError: if there is a run in ``path``.
            RunFolderBusy: if another process is making one there at this moment.
            ValueError: if ``config`` holds NaN or an infinity, which JSON has no word for.
            TypeError: if ``config`` holds what JSON cannot express.
        """
        check_whole("seed", seed, 0)
        document = to_json(config, "config")
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        run = cls(path)
        try:
            refuse_old_run(path)
            run._clear()
            run.config = dict(config)
            write_durably(path / "config.json", document)
            write_durably(path / "versions.json", to_json(library_versions(), "versions", sealed=True))
            marker = {"format": FORMAT_NAME, "version": FORMAT_VERSION, "seed": int(seed)}
            write_durably(path / "run.json", to_json(marker, "run", sealed=True))
        except BaseException:
            run.close()
            raise
        return run

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """The existing run in ``path``, to go on writing it.

        Raises:
            RunFolderError: if there is no run in ``path``.
            RunFolderBusy: if another process is writing it.
        """
        path = Path(path)
        _read_marker(path)
        run = cls(path)
        try:
            run._clear()
            run.config = read_json(path / "config.json")
            _cut_torn_line(run.metrics_path)
        except BaseException:
            run.close()
            raise
        return run

    @property
    def checkpoints_path(self) -> Path:
        """Where `neuralq.runs.folder.checkpoint` keeps this run's checkpoints."""
        return self.path / "checkpoints"

    @property
    def metrics_path(self) -> Path:
        """One JSON object per line."""
        return self.path / "metrics.jsonl"

    @property
    def num_rows(self) -> int:
        """Lines of ``metrics.jsonl``."""
        if self._num_rows is None:
            there = os.path.lexists(self.metrics_path)
            self._num_rows = read_regular(self.metrics_path).count(b"\n") if there else 0
        return self._num_rows

    def append_metrics(self, row: Mapping[str, float | int | str | None]) -> None:
        """One line more in ``metrics.jsonl``, out of this process's hands when the call returns.

        Args:
            row: must hold ``env_steps``, a whole number. NaN and infinities, for which JSON has no word, become null.

        Raises:
            ValueError: if ``env_steps`` is missing or not a whole number.
            TypeError: for a value that is neither a number, a string nor None.
        """
        self._check_open()
        if "env_steps" not in row:
            raise ValueError(f"a row of metrics must hold env_steps, got only {sorted(row)}")
        check_whole("env_steps", row["env_steps"], 0)  # type: ignore[arg-type]  # it checks what it is given
        line = row_line({name: plain_values(value, name) for name, value in row.items()})
        num_rows = self.num_rows
        append_line(self.metrics_path, line)
        self._num_rows = num_rows + 1

    def truncate_metrics(self, after_env_steps: int) -> int:
        """Drops the rows beyond ``after_env_steps``: those that the resumed run will write again.

        Returns:
            How many rows were dropped. The file is replaced in one step.

        Raises:
            RunFolderError: if a line other than the last is damaged.
        """
        self._check_open()
        rows = read_rows(self.metrics_path)
        kept = [row for row in rows if row["env_steps"] <= after_env_steps]
        if len(kept) < len(rows):
            write_durably(self.metrics_path, "".join(row_line(row) + "\n" for row in kept))
        self._num_rows = len(kept)
        return len(rows) - len(kept)

    def replace_config(self, config: Mapping[str, Any]) -> None:
        """The effective configuration from now on (a resumed run may have a new budget), replaced in one step."""
        self._check_open()
        write_durably(self.path / "config.json", to_json(config, "config"))
        self.config = dict(config)

    def record_changes(self, env_steps: int, changes: Mapping[str, tuple[Any, Any]]) -> None:
        """One line more in ``changes.jsonl``: from here on the run goes on otherwise than it was told before.

        Args:
            env_steps: where it stands.
            changes: old and new value by name.
        """
        self._check_open()
        told = {name: list(values) for name, values in changes.items()}
        row = {"env_steps": env_steps, "time": datetime.now().isoformat(timespec="seconds"), "changes": told}
        append_line(self.path / "changes.jsonl", row_line(plain_values(row, "changes")))

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """The final result, replaced in one step; NaN and infinities become null.

        With it goes how many rows of metrics there are, so that rows that are lost later are missed.

        Raises:
            TypeError: for a value that JSON cannot express.
        """
        self._check_open()
        values = {**summary, "num_rows": self.num_rows}
        document = to_json(plain_values(values, "summary"), "summary", sealed=True)
        write_durably(self.path / "summary.json", document)

    def close(self) -> None:
        """Gives the lock back; closing twice is fine."""
        self._lock.close()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _clear(self) -> None:
        """Nothing is written through a link out of the folder, and what a killed writer left is gone."""
        refuse_links(self.path, _FOLDERS)
        clear_left_overs(self.path, _FILES)

    def _check_open(self) -> None:
        if not self._lock.is_held:
            raise RunFolderError(f"{self.path} was closed, and is no longer ours to write; open it again")


def default_run_path(env_id: str, layout: str, seed: int, timestamp: datetime, root: str | Path = "runs") -> Path:
    """``runs/<env>-<layout>-s<seed>-<timestamp>``, one plain folder name whatever the environment's id holds.

    Example:
        >>> default_run_path("my_games:neuralq/Grid-v0", "table", 3, datetime(2024, 5, 17, 9, 30)).as_posix()
        'runs/my_games-neuralq-Grid-v0-table-s3-20240517-093000'
    """
    slug = re.sub(r"[^A-Za-z0-9._]+", "-", f"{env_id}-{layout}")[:120].strip(".-") or "run"
    return Path(root) / f"{slug}-s{int(seed)}-{timestamp:%Y%m%d-%H%M%S}"


@contextlib.contextmanager
def claimed(run_dir: str | Path | None, default: Callable[[], Path]) -> Iterator[Path]:
    """The folder for a run: the one that is named, or one that is made here and that nobody else is given.

    Two runs that begin within one second have one default path; the later one gets a number behind it. Where the block
    fails before anything is in it, the folder is removed.

    Example:
        >>> import tempfile
        >>> root = Path(tempfile.mkdtemp())
        >>> with claimed(None, lambda: root / "run"), claimed(None, lambda: root / "run") as path:
        ...     path.name
        'run-2'
    """
    if run_dir is not None:
        yield Path(run_dir)
        return
    first = path = default()
    for number in itertools.count(2):
        try:
            path.mkdir(parents=True)
            break
        except FileExistsError:
            path = first.with_name(f"{first.name}-{number}")
    try:
        yield path
    except BaseException:
        with contextlib.suppress(OSError):  # something is in it
            path.rmdir()
        raise


def library_versions() -> dict[str, str]:
    """What the run ran on: versions and platform, and nothing that names the machine or its folders.

    Example:
        >>> sorted(library_versions())[:4]
        ['gymnasium', 'neuralq', 'numba', 'numpy']
    """
    versions = {"python": platform.python_version(), **_installed()}
    return {**versions, "platform": f"{platform.system()} {platform.machine()}"}


@functools.cache
def _installed() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in ("neuralq", *_LIBRARIES)}


def is_run_folder(path: str | Path) -> bool:
    """Whether a run was made in ``path``.

    Example:
        >>> is_run_folder("/nowhere")
        False
    """
    return (Path(path) / "run.json").is_file()


def read_config(path: str | Path) -> dict[str, Any]:
    """The effective configuration of a run.

    Raises:
        RunFolderError: if there is no run in ``path``, or its file is damaged.
    """
    _read_marker(Path(path))
    return read_json(Path(path) / "config.json")


def read_changes(path: str | Path) -> list[dict[str, Any]]:
    """What a run went on with otherwise than it was told before: ``env_steps``, ``time``, and old and new by name.

    Raises:
        RunFolderError: if a line other than the last is damaged.

    Example:
        >>> read_changes("/nowhere")
        []
    """
    return read_rows(Path(path) / "changes.jsonl")


def read_seed(path: str | Path) -> int:
    """The seed of a run.

    Raises:
        RunFolderError: if there is no run in ``path``, or its file is damaged.
    """
    return int(_read_marker(Path(path))["seed"])


def read_summary(path: str | Path) -> dict[str, Any]:
    """The final result of a run.

    Raises:
        RunFolderError: if there is no run in ``path``, if it has not finished, or its file is damaged.
    """
    _read_marker(Path(path))
    file = Path(path) / "summary.json"
    if not file.exists():
        raise RunFolderError(f"the run in {path} has no summary yet: finish it with `neuralq resume {path}`")
    summary = read_json(file)
    summary.pop("num_rows", None)
    return summary


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """The rows of ``metrics.jsonl`` in the order written, also while the run is being written.

    A last line without its end is passed over: its writer was killed, or is at it now. Where rows are missing that the
    summary has counted, a warning says so.

    Raises:
        RunFolderError: if there is no run in ``path``, or a line other than the last is damaged.
    """
    path = Path(path)
    _read_marker(path)
    rows, summary = read_rows(path / "metrics.jsonl"), path / "summary.json"
    with contextlib.suppress(RunFolderError):  # whoever needs the summary says what is wrong with it
        warn_of_lost_rows(path, len(rows), read_json(summary).get("num_rows") if summary.is_file() else None)
    return rows


def warn_of_lost_rows(path: Path, num_rows: int, counted: Any) -> None:
    """A warning where ``metrics.jsonl`` holds fewer rows than there were."""
    if isinstance(counted, int) and num_rows < counted:
        warnings.warn(
            f"{path / 'metrics.jsonl'} has lost rows: it held {counted:,}, and {num_rows:,} are left; what is drawn "
            "or compared from it is incomplete",
            stacklevel=3,
        )


def _read_marker(path: Path) -> dict[str, Any]:
    file = path / "run.json"
    if not file.is_file():
        raise RunFolderError(f"there is no neuralq run in {path}; start one with `neuralq train ENV --run-dir {path}`")
    marker = read_json(file)
    if marker.get("format") != FORMAT_NAME or type(marker.get("seed")) is not int:
        raise RunFolderError(f"{file} was not written by neuralq; choose another folder with --run-dir")
    if not isinstance(marker.get("version"), int) or marker["version"] > FORMAT_VERSION:
        raise RunFolderError(
            f"{path} has format version {marker.get('version')!r}, and this neuralq reads up to {FORMAT_VERSION}; "
            "upgrade neuralq"
        )
    return marker


def refuse_old_run(path: Path) -> None:
    """Raises `RunFolderError` if there is a run in ``path``, whole or in part."""
    for name in ("run.json", "metrics.jsonl", "checkpoints", "summary.json"):
        if os.path.lexists(path / name):  # also a link that leads nowhere
            raise RunFolderError(
                f"{path} already holds a run ({name}); continue it with `neuralq resume {path}`, "
                "or choose another folder with --run-dir"
            )


def _cut_torn_line(path: Path) -> None:
    """So that the next row does not continue the line that a killed writer left."""
    if os.path.lexists(path):
        content = read_regular(path)
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            descriptor = open_regular(path, os.O_WRONLY)
            try:
                os.ftruncate(descriptor, whole)
            finally:
                os.close(descriptor)

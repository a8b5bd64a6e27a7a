"""Attempts at a run on machines that may be taken for dead and still be writing: each in a run folder of its own.

    seed-3.attempts/1/   the first attempt, which was given up      seed-3/   the run, once it has ended
    seed-3.attempts/2/   the second, begun from the first's newest checkpoint

A number is taken by making the folder, which one only can. What an attempt begins from is copied, and compared with its
checksums after that, so no attempt waits for another or writes where another does. The one that ends first becomes
the run by a rename, which one only can; whoever comes second throws its own away. Nothing here needs torch.
"""

from __future__ import annotations

import contextlib
import io
import os
import secrets
import shutil
import tarfile
from collections.abc import Collection, Iterator
from pathlib import Path

from neuralq.runs.folder.files import FolderLock, read_json, to_json, write_durably
from neuralq.runs.folder.run_folder import is_run_folder
from neuralq.runs.folder.whole import newest_whole, step_of
from neuralq.runs.sweep.states import FAILURE, attempts_path, is_being_written, numbered, state_of

__all__ = ["begin", "pack", "publish", "take_over", "unpack"]

_LOCK = frozenset(("run.lock",))
_OF_THE_WRITER = _LOCK | {"summary.json", FAILURE}
_TRIES = 5


def begin(path: Path, total_steps: int) -> Path | None:
    """The folder of a new attempt, with a copy of the newest checkpoint that is whole; None where the run is finished.

    What stands in the run's place unfinished becomes an attempt, from which others may begin.

    Args:
        path: the run folder.
        total_steps: its budget.

    Raises:
        RunFolderBusy: if another process is at the run in its own place.
        OSError: if the disk refuses.
    """
    folder = attempts_path(path)
    folder.mkdir(parents=True, exist_ok=True)
    _move_aside(path, total_steps)
    if not _is_finished(path, total_steps):
        for attempt in numbered(folder):
            if _is_finished(attempt, total_steps) and not is_being_written(attempt):  # its worker died before it told
                publish(attempt, path, total_steps)
                break
    if _is_finished(path, total_steps):
        _remove(folder)
        return None
    own = _new_in(folder)
    before = [attempt for attempt in numbered(folder) if attempt != own]
    begun_from = _begin_from_newest(before, own)
    for attempt in before:  # each begins with what was the newest: older ones hold nothing more
        if begun_from is not None and attempt != begun_from and not is_being_written(attempt):
            shutil.rmtree(attempt, ignore_errors=True)
            _unlink(_log(attempt))
    return own


def publish(attempt: Path, path: Path, total_steps: int) -> None:
    """An attempt that has ended becomes the run, unless that is finished already; what is left over then is removed.

    Raises:
        OSError: if the disk refuses.
    """
    _tell_its_name(attempt, path)
    for _ in range(_TRIES):
        try:
            os.rename(attempt, path)
        except FileNotFoundError:
            if attempt.is_dir():  # no, it is the place to go to that is missing
                path.parent.mkdir(parents=True, exist_ok=True)
                continue
            break  # somebody has found it finished and did the same
        except OSError:
            if not path.is_dir():
                raise
            if _is_finished(path, total_steps):
                break
            _move_aside(path, total_steps)
        else:
            with contextlib.suppress(OSError):
                os.replace(_log(attempt), _log(path))
            break
    if _is_finished(path, total_steps):
        _remove(attempts_path(path))
    with contextlib.suppress(OSError):  # there are others
        attempts_path(path).rmdir()


def take_over(path: Path, total_steps: int) -> None:
    """A run of which there are attempts only is put in its own place, so that it can be gone on with there."""
    if attempts_path(path).is_dir() and not is_run_folder(path):
        attempt = begin(path, total_steps)
        if attempt is not None:
            publish(attempt, path, total_steps)
            _remove(attempts_path(path))


def pack(path: Path) -> bytes | None:
    """A run folder and its log in one parcel, with the newest checkpoint that is whole alone; None where it vanishes.

    Args:
        path: the run folder; it may be written meanwhile.
    """
    checkpoint = newest_whole(path / "checkpoints")
    out = io.BytesIO()
    try:
        with tarfile.open(fileobj=out, mode="w") as parcel:
            for file, name in _listed(path, checkpoint, _LOCK):
                parcel.add(file, f"run/{name}", recursive=False)
            if _log(path).is_file():
                parcel.add(_log(path), "run.log", recursive=False)
    except OSError:  # pruned or replaced while it was read
        return None
    return out.getvalue()


def unpack(parcel: bytes, folder: Path) -> None:
    """What `pack` took, as ``run`` and ``run.log`` in a folder; nothing in it leads out of that.

    Raises:
        tarfile.TarError: if a parcel is damaged, or would write elsewhere.
        OSError: if the disk refuses.
    """
    with tarfile.open(fileobj=io.BytesIO(parcel)) as opened:
        opened.extractall(folder, filter="data")


def _is_finished(path: Path, total_steps: int) -> bool:
    return state_of(path, total_steps).state == "finished"


def _log(path: Path) -> Path:
    return path.with_name(f"{path.name}.log")


def _unlink(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


def _new_in(folder: Path) -> Path:
    """A folder of the next number, made here and by nobody else."""
    number = max((int(attempt.name) for attempt in numbered(folder)), default=0)
    while True:
        number += 1
        try:
            (folder / str(number)).mkdir()
        except FileExistsError:
            continue
        except FileNotFoundError:  # removed as somebody finished the run
            folder.mkdir(parents=True, exist_ok=True)
            continue
        return folder / str(number)


def _move_aside(path: Path, total_steps: int) -> None:
    """What stands in a run's place unfinished becomes an attempt; where it was finished meanwhile, it goes back."""
    if not os.path.lexists(path) or _is_finished(path, total_steps):
        return
    with contextlib.suppress(FileNotFoundError):  # somebody else has moved it
        with contextlib.closing(FolderLock(path / "run.lock", f"{path} is being written")):
            aside = _new_in(attempts_path(path))
            os.rename(path, aside)
        with contextlib.suppress(OSError):
            os.replace(_log(path), _log(aside))
        if _is_finished(aside, total_steps):
            publish(aside, path, total_steps)


def _begin_from_newest(before: list[Path], own: Path) -> Path | None:
    """Fills an attempt from that with the newest checkpoint, which is returned; None where there is no checkpoint."""
    refused: set[Path] = set()
    while True:
        found = [
            (step_of(checkpoint), attempt, checkpoint)
            for attempt in before
            if attempt not in refused and (checkpoint := newest_whole(attempt / "checkpoints")) is not None
        ]
        if not found:
            return None
        _, attempt, checkpoint = max(found)
        if _copied(attempt, checkpoint, own):
            return attempt
        refused.add(attempt)


def _copied(attempt: Path, checkpoint: Path, own: Path) -> bool:
    """Whether all of an attempt could be copied that a run goes on from; it may be written meanwhile."""
    for _ in range(_TRIES):
        copy = own.with_name(f".tmp-{own.name}-{secrets.token_hex(8)}")
        try:
            best = newest_whole(attempt / "best")
            for file, name in _listed(attempt, checkpoint, _OF_THE_WRITER):
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, copy / name)
            if newest_whole(copy / "checkpoints") and (best is None or newest_whole(copy / "best")):
                os.rename(copy, own)
                return True
        except FileNotFoundError:  # pruned while it was read: by now there is a newer one
            pass
        finally:
            shutil.rmtree(copy, ignore_errors=True)
        newer = newest_whole(attempt / "checkpoints")
        if newer is None:
            return False
        checkpoint = newer
    return False


def _listed(attempt: Path, checkpoint: Path | None, left_out: Collection[str]) -> Iterator[tuple[Path, str]]:
    """Files that a run goes on from and their names in it: the checkpoint first, so that rows cover at least that."""
    found = [] if checkpoint is None else [file for file in checkpoint.iterdir() if file.is_file()]
    for place, folders, names in os.walk(attempt):
        at_the_top = Path(place) == attempt
        folders[:] = [n for n in folders if not (n.startswith(".tmp-") or (at_the_top and n == "checkpoints"))]
        wanted = [n for n in names if not (n.startswith(".tmp-") or (at_the_top and n in left_out))]
        found += [file for file in (Path(place, name) for name in wanted) if not file.is_symlink()]
    for file in found:
        yield file, file.relative_to(attempt).as_posix()


def _tell_its_name(attempt: Path, path: Path) -> None:
    """The summary of an attempt names the folder where it will be."""
    file = attempt / "summary.json"
    with contextlib.suppress(FileNotFoundError):
        if file.exists():
            write_durably(file, to_json({**read_json(file), "run_dir": str(path)}, "summary", sealed=True))


def _remove(folder: Path) -> None:
    """Renamed before it is deleted: who is still at an attempt finds it gone, and not half of it."""
    doomed = folder.with_name(f".tmp-{folder.name}-{secrets.token_hex(8)}")
    with contextlib.suppress(OSError):
        os.rename(folder, doomed)
    shutil.rmtree(doomed, ignore_errors=True)

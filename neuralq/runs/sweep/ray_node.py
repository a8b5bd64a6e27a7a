"""What goes on at the nodes of a Ray cluster: a task of Ray's makes one attempt at a run, in a child of its worker.

Ray begins a task again elsewhere when its worker or node is gone; the attempt's number keeps the two apart
(`neuralq.runs.sweep.attempts`). With a folder that all nodes see an attempt writes there. Without one it writes to the
node's own disk, and its newest checkpoint goes to a `Shelf` beside the command, from which another attempt begins.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import secrets
import shutil
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import wait
from pathlib import Path
from typing import Any

from neuralq.runs.folder.files import RunFolderError
from neuralq.runs.folder.whole import newest_whole
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.sweep.attempts import begin, pack, publish, unpack
from neuralq.runs.sweep.forked import reason_of, run_forked
from neuralq.runs.sweep.states import attempts_path, saved_steps
from neuralq.runs.sweep.task import Task

__all__ = ["Shelf", "attempt", "last_line"]

_POLL_SECONDS = 0.2
_SENDING = 10
"""After a parcel nothing is sent for so many times as long as it took: a run is not held up by being saved."""


def attempt(
    folder: str, mark: str, name: str, config: Mapping[str, Any], options: tuple[str, ...], shelf: Any = None
) -> str:
    """One attempt at a run, until it has ended or is asked to; why it did not come to that, "" where it did.

    Args:
        folder: of all the runs, as the nodes see it; without a meaning where there is a shelf.
        mark: of a file in it, which says that it is the same folder.
        name: of the run within it.
        config: of the run, whole.
        options: what else was asked for, as words of the command line.
        shelf: the `Shelf` where no folder is shared; None where one is.
    """
    _end_with_the_node()
    request = StopRequest()
    with request.listening((signal.SIGINT,)):  # which is what `ray.cancel` comes to in a worker
        try:
            task = Task(name, Path(folder, name), dict(config), options)
            if shelf is not None:
                return _beside_a_shelf(task, shelf, request)
            if not Path(folder, mark).exists():
                return (
                    f"node {socket.gethostname()} does not see {folder}: name a folder that every node sees by that "
                    "name, or take --storage none, which sends runs home"
                )
            return _in_a_shared_folder(task, request)
        except (OSError, RunFolderError) as error:
            return f"{last_line(error)} (on node {socket.gethostname()})"


@functools.cache
def _end_with_the_node() -> None:
    """From now on this process ends as soon as the one that Ray began it from is gone, and with it its run.

    Ray itself leaves workers behind where a node was silent, was taken for dead, and found that out.
    """
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def last_line(error: BaseException) -> str:
    r"""What an error says; of one that Ray brings from elsewhere, whose traceback comes first, the end.

    Example:
        >>> last_line(OSError("Traceback (most recent call last):\n  ...\nOSError: No space left on device\n"))
        'OSError: No space left on device'
    """
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def _in_a_shared_folder(task: Task, request: StopRequest) -> str:
    total_steps = int(task.config["total_steps"])
    path = begin(task.path, total_steps)
    if path is None:
        return ""
    reason = _perform(dataclasses.replace(task, path=path), request)
    publish(path, task.path, total_steps)
    return reason


def _beside_a_shelf(task: Task, shelf: Any, request: StopRequest) -> str:
    total_steps = int(task.config["total_steps"])
    given = _answer(shelf.begin.remote(task.name, total_steps))
    if given is None:
        return ""
    number, parcel = given
    place = Path(tempfile.mkdtemp(prefix="neuralq-"))
    try:
        if parcel is not None:
            unpack(parcel, place)
        sender = _Sender(shelf, task.name, number, place / "run")
        reason = _perform(dataclasses.replace(task, path=place / "run"), request, sender.look, place)
        _answer(shelf.end.remote(task.name, number, pack(place / "run"), total_steps))
        return reason
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _answer(reference: Any) -> Any:
    """What an actor answers. While `ray.get` waits, Ray gives the processor to another task: of that there is none."""
    future = reference.future()
    while not wait([future], _POLL_SECONDS)[0]:
        pass
    return future.result()


def _perform(
    task: Task, request: StopRequest, look: Callable[[], None] = lambda: None, place: Path | None = None
) -> str:
    """Performs a task in a child; what happened to its process where that was killed or broke, "" otherwise."""
    process = run_forked(task, int(task.config.get("threads", 1)), task.config, place)
    told = False
    while process.is_alive():
        process.join(_POLL_SECONDS)
        if request.name is not None and not told:
            process.terminate()
            told = True
        look()
    status = process.exitcode or 0
    process.close()
    return "" if told else reason_of(status, task.log_path)


class _Sender:
    """Sends the newest checkpoint of an attempt to the shelf, whenever there is a new one and the last has arrived."""

    def __init__(self, shelf: Any, name: str, number: int, path: Path) -> None:
        self.shelf, self.name, self.number, self.path = shelf, name, number, path
        self.sent = saved_steps(path)
        self.on_its_way: Any = None
        self.began = self.not_before = -1.0

    def look(self) -> None:
        now = time.monotonic()
        if self.on_its_way is not None:
            if not wait([self.on_its_way], 0)[0]:
                return
            self.on_its_way, self.not_before = None, now + _SENDING * (now - self.began)
        newest = saved_steps(self.path)
        if newest > self.sent and now >= self.not_before and (parcel := pack(self.path)) is not None:
            self.began, self.sent = now, newest
            self.on_its_way = self.shelf.keep.remote(self.name, self.number, parcel).future()


class Shelf:
    """An actor on the machine of the command: keeps what attempts send it in the folder of all the runs.

    Everything that it knows is in that folder, so that it can be killed and begun again.

    Args:
        folder: which.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        _end_with_the_node()

    def begin(self, name: str, total_steps: int) -> tuple[int, bytes | None] | None:
        """The number of a new attempt and what it begins from; None where the run is finished."""
        path = begin(self.folder / name, total_steps)
        return None if path is None else (int(path.name), pack(path) if saved_steps(path) else None)

    def keep(self, name: str, number: int, parcel: bytes) -> None:
        """Puts what an attempt has come to in its folder, unless that was given up."""
        own = attempts_path(self.folder / name) / str(number)
        if not own.is_dir():
            return
        place = own.with_name(f".tmp-{number}-{secrets.token_hex(8)}")
        try:
            unpack(parcel, place)
            (place / "run").mkdir(exist_ok=True)  # of a run that failed before it began
            if saved_steps(place / "run") and newest_whole(place / "run" / "checkpoints") is None:
                return  # damaged on its way or on this disk
            os.rename(own, place / "before")
            os.rename(place / "run", own)
            with contextlib.suppress(OSError):
                os.replace(place / "run.log", own.with_name(f"{number}.log"))
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def end(self, name: str, number: int, parcel: bytes | None, total_steps: int) -> None:
        """An attempt has ended: it becomes the run."""
        path = self.folder / name
        if parcel is not None:
            self.keep(name, number, parcel)
        own = attempts_path(path) / str(number)
        if own.is_dir():
            publish(own, path, total_steps)

"""A run in a process of its own, forked of one that has everything in memory; whoever asks for it need not.

It has a session, a log and an end of its own, and ends with the process that asked for it: it saves and stops.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import shutil
import signal
import sys
import threading
from collections.abc import Mapping
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from neuralq.runs.children import safe_path, with_environment, without_main
from neuralq.runs.folder.files import open_regular, read_tail
from neuralq.runs.sweep.task import Task

__all__ = ["reason_of", "run_forked"]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_GRACE_SECONDS = 120
"""That a run has to save once the process that asked for it is gone."""


def run_forked(
    task: Task, num_threads: int = 1, config: Mapping[str, Any] | None = None, place: Path | None = None
) -> BaseProcess:
    """A process that performs a task, started.

    Args:
        task: what it does.
        num_threads: that libraries of its have.
        config: of a run like those that will be made; its kernels are made ready in the process that all are forked of.
        place: a folder that nobody needs any more if the process that asks is gone when this one ends.
    """
    context: Any = multiprocessing.get_context("spawn" if sys.platform == "darwin" else "forkserver")
    if sys.platform != "darwin":  # where a process that has loaded frameworks of the system may not be forked
        context.set_forkserver_preload(["neuralq.runs.sweep.warm", "neuralq.runs.sweep.work"])
    ready = {"NEURALQ_WARM": json.dumps(dict(config))} if config and num_threads == 1 else {}
    process: BaseProcess = context.Process(target=_child, args=(task, place), name=task.name)
    with safe_path(), without_main(), with_environment({**dict.fromkeys(_THREADS, str(num_threads)), **ready}):
        process.start()
    return process


def _child(task: Task, place: Path | None) -> None:
    os.setsid()  # the terminal's Ctrl-C reaches the parent alone, which passes it on in order
    log = open_regular(task.log_path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for descriptor in (1, 2):
        os.dup2(log, descriptor)
    sys.stdout = open(1, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)
    sys.stderr = open(2, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)
    _stop_with_parent()
    from neuralq.runs.sweep.work import perform  # which brings PyTorch

    perform(task)
    parent = multiprocessing.parent_process()
    if place is not None and parent is not None and wait([parent.sentinel], 0):
        shutil.rmtree(place, ignore_errors=True)


def _stop_with_parent() -> None:
    """Ask this process to stop, as SIGTERM does, as soon as the one that asked for it is gone, however it went."""

    def watch() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(_GRACE_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def reason_of(status: int, log: Path) -> str:
    """What happened to a process: the signal that killed it, or the last that it printed; "" if it ended well."""
    if status <= 0:
        return f"killed by {signal.Signals(-status).name}" if status else ""
    lines: list[str] = []
    with contextlib.suppress(OSError):
        lines = [line for line in read_tail(log).decode(errors="replace").splitlines() if line.strip()]
    said = lines[-1].strip().removeprefix("neuralq: ").removeprefix("error: ") if lines else ""
    return said or f"ended with status {status}"

"""One run of a sweep, made in the process that it is given: begun, or gone on with where its folder stands."""

from __future__ import annotations

import contextlib
import sys
import traceback
import warnings
from collections.abc import Iterator
from typing import Any

from neuralq.runs.control import CONTROL
from neuralq.runs.faults import explained
from neuralq.runs.folder.files import RunFolderBusy
from neuralq.runs.folder.origin import flat_names
from neuralq.runs.folder.run_folder import is_run_folder, read_config
from neuralq.runs.hooks import watching_hooks
from neuralq.runs.loop import Hook
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.sweep.attempts import take_over
from neuralq.runs.sweep.states import forget_failure, note_failure
from neuralq.runs.sweep.task import Task

__all__ = ["perform"]


def perform(task: Task) -> None:
    """Begin a run, or go on with it, in this process; why it failed is left in its folder and on standard error.

    A signal that asks for the end saves the run, which has then not finished. Where another process is at the run,
    nothing happens.
    """
    forget_failure(task.path)
    try:
        with _hooks(task) as hooks, _warnings():
            budget = int(task.config["total_steps"])
            take_over(task.path, budget)
            if not is_run_folder(task.path):
                CONTROL.train(config_from_dict(task.config), task.path, hooks)
            else:
                CONTROL.resume(task.path, budget, hooks, _moved(task))
    except RunFolderBusy as error:
        print(f"neuralq: {error}", file=sys.stderr)
    except Exception as error:
        lines = explained(error)
        if lines is None:
            traceback.print_exception(error)
            lines = [f"{type(error).__name__}: {error}"]
        print(f"neuralq: error: {lines[0]}", *lines[1:], sep="\n", file=sys.stderr, flush=True)
        note_failure(task.path, " ".join(lines))


def _moved(task: Task) -> dict[str, Any]:
    """What the run may go on with otherwise than it began, and the sweep by now has otherwise."""
    began, wanted = flat_names(read_config(task.path)), flat_names(task.config)
    names = [name for name in sorted(CONTROL.may_change() - {CONTROL.budget}) if name in wanted and name in began]
    return {name: wanted[name] for name in names if wanted[name] != began[name]}


@contextlib.contextmanager
def _hooks(task: Task) -> Iterator[list[Hook]]:
    own = [name for word, name in zip(task.options, task.options[1:], strict=False) if word == "--hook"]
    board, tracker = (f"--{name}" in task.options for name in ("tensorboard", "wandb"))
    with watching_hooks(task.path, config_from_dict(task.config), board, tracker, own) as hooks:
        yield hooks


@contextlib.contextmanager
def _warnings() -> Iterator[None]:
    """Warnings as lines of the log."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: print(f"neuralq: warning: {message}", file=sys.stderr)
        yield

"""What hooks may do: take rows of metrics, look at the session when something happens in it, and ask it to stop.

A hook is any object with one of the methods below; several may be in one. Hooks read, never write: what they are shown
refuses it, and a run ends with the same bits with and without them. A hook with ``state_dict`` and ``load_state_dict``
is saved in every checkpoint under its name and goes on with the run. What is not asked for is not called: a run
without ``on_step`` looks once per step whether anybody wants to know.
"""

from __future__ import annotations

import functools
import logging
import traceback
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeAlias, runtime_checkable

from neuralq.learners.learner import Learner
from neuralq.runs.folder.checkpoint import storable
from neuralq.runs.folder.files import read_rows
from neuralq.runs.folder.run_folder import RunFolder
from neuralq.runs.session_view import SessionView, Watchable
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.stream.experience import Sample

__all__ = [
    "EVENTS",
    "Hook",
    "HookFault",
    "Listener",
    "Observer",
    "Watch",
    "say_to",
]

EVENTS = ("on_step", "on_update", "on_evaluation", "on_end")
"""Methods that are given the session when something has happened in it."""


class TakesRows(Protocol):
    """Takes every row of metrics (``kind`` "train" or "evaluation") as it is recorded."""

    def __call__(self, row: Mapping[str, Any], /) -> None:
        """Take in one row."""
        ...


@runtime_checkable
class Observer(Protocol):
    """A hook that also looks at the learner: what was last learned from is shown to it before each row.

    It reads, never writes: neither the learner nor the sample, of which it copies what it wants to keep.
    """

    def observe(self, learner: Learner, sample: Sample, /) -> None:
        """Read the learner and the sample it last learned from."""
        ...

    def __call__(self, row: Mapping[str, Any], /) -> None:
        """Take in one row."""
        ...


@runtime_checkable
class Listener(Protocol):
    """A hook that is also told, in a line each, what is worth knowing of a run before it begins."""

    def say(self, line: str, /) -> None:
        """Take in one line."""
        ...


class SeesSteps(Protocol):
    """Is called after each step of the environments, before anything is learned from it."""

    def on_step(self, session: SessionView, /) -> None:
        """Look at ``session.step``."""
        ...


class SeesUpdates(Protocol):
    """Is called after each update of the learner."""

    def on_update(self, session: SessionView, /) -> None:
        """Look at ``session.update``."""
        ...


class SeesEvaluations(Protocol):
    """Is called after each evaluation, once its row is recorded."""

    def on_evaluation(self, session: SessionView, /) -> None:
        """Look at ``session.evaluation``."""
        ...


class SeesEnd(Protocol):
    """Is called once the run has ended, however it did, and is saved."""

    def on_end(self, session: SessionView, /) -> None:
        """Look at ``session.ended_by``."""
        ...


Hook: TypeAlias = TakesRows | SeesSteps | SeesUpdates | SeesEvaluations | SeesEnd


class HookFault(RuntimeError):
    """A hook raised; the run was saved where it stood."""


def say_to(hooks: Sequence[Hook], line: str) -> None:
    """A line to every hook that listens; a warning that nobody listens to goes to the log ``neuralq``."""
    listeners = [hook for hook in hooks if isinstance(hook, Listener)]
    for listener in listeners:
        listener.say(line)
    if not listeners and line.startswith("warning: "):
        logging.getLogger("neuralq").warning(line.removeprefix("warning: "))


class Watch:
    """The hooks of one run: calls them, remembers what they ask, and keeps their states.

    Args:
        hooks: in the order in which they are called.
        trainee: what trains.
        progress: how far the run has come; `Progress`, whose ``hook_states`` are brought up to date.
        folder: of the run.
        config: of the run, to be shown.
        request: how a stop is asked for.
    """

    def __init__(
        self, hooks: Sequence[Hook], trainee: Any, progress: Any, folder: RunFolder, config: Any, request: StopRequest
    ) -> None:
        self.hooks: dict[str, Any] = {}
        for hook in hooks:
            name, number = _name_of(hook), 2
            while name in self.hooks:
                name, number = f"{_name_of(hook)} #{number}", number + 1
            self.hooks[name] = hook
        self.trainee, self.progress, self.folder, self.config = trainee, progress, folder, config
        self.request = request
        self._watchable = trainee if isinstance(trainee, Watchable) else None
        self.view = SessionView(self)
        self.fault: HookFault | None = None
        self.stopped_by: str | None = None
        self.ended_by: str | None = None
        self._calling = ""
        self._rows: list[dict[str, Any]] | None = None
        self._with_state = {name for name, hook in self.hooks.items() if _has_state(hook)}
        self._wanting = {
            event: [n for n, h in self.hooks.items() if callable(getattr(h, event, None))] for event in EVENTS
        }
        self._attach()

    def _attach(self) -> None:
        """Single steps and updates are told where somebody wants to know them."""
        for event in ("on_step", "on_update"):
            wanted = self._wanting[event]
            if self._watchable is not None:
                setattr(self._watchable, event, functools.partial(self._soon, event) if wanted else None)
            elif wanted:
                told = f"{event} of {', '.join(wanted)} is never called: a run of this kind tells of no single ones"
                say_to(list(self.hooks.values()), f"warning: {told}")

    def restore(self) -> None:
        """Give the hooks back the states that were saved with the run.

        Raises:
            HookFault: if one cannot take it back; nothing has been trained then.
        """
        for name, state in self.progress.hook_states.items():
            if name not in self._with_state:
                missing = (
                    "has no load_state_dict" if name in self.hooks else f"is missing (--hook {name.split(' ')[0]})"
                )
                say_to(
                    list(self.hooks.values()),
                    f"warning: the run was trained with the hook {name}, which {missing}; its state is kept",
                )
                continue
            try:
                self.hooks[name].load_state_dict(state)
            except Exception as error:
                raise HookFault(
                    f"{_told_of(name, error)} when it was given back its state; the run is as it was: mend the hook or "
                    f"leave it out, then neuralq resume {self.folder.named}"
                ) from error

    def states(self) -> dict[str, Any]:
        """The states of all hooks, for a checkpoint; that of one that cannot be stored stays as it was last."""
        kept = self.progress.hook_states
        for name in sorted(self._with_state):
            try:
                state = self.hooks[name].state_dict()
                storable({"state": state})
            except Exception as error:
                self._with_state.discard(name)
                self.fault = self.fault or _fault(name, error)
            else:
                kept[name] = state
        return dict(kept)

    def stop(self, why: str) -> None:
        """As `SessionView.stop`."""
        self.stopped_by = self.stopped_by or f"the hook {self._calling}: {why}"
        self.request.ask()

    def complete(self, row: dict[str, Any]) -> None:
        """What hooks with ``columns`` add to a row, before it is written; they take it in first."""
        self._show(row, {name: hook for name, hook in self.hooks.items() if _has_columns(hook)})
        for hook in self.hooks.values():
            if _has_columns(hook):
                row |= {name: value for name, value in hook.columns().items() if name not in row}

    def row(self, row: Mapping[str, Any]) -> None:
        """A row of metrics to every hook that takes them, and the learner to those that look at it."""
        if self._rows is not None:
            self._rows.append(dict(row))
        self._show(row, {name: hook for name, hook in self.hooks.items() if not _has_columns(hook)})

    def _show(self, row: Mapping[str, Any], hooks: Mapping[str, Any]) -> None:
        observed = self.trainee.observed
        for name, hook in hooks.items():
            self._calling = name
            try:
                if observed is not None and isinstance(hook, Observer):
                    hook.observe(*observed)
                if callable(hook):
                    hook(row)
            except Exception as error:
                raise _fault(name, error) from error

    def call(self, event: str) -> None:
        """Call the hooks that want to know of this.

        Raises:
            HookFault: if one raises.
        """
        for name in self._wanting[event]:
            self._calling = name
            try:
                getattr(self.hooks[name], event)(self.view)
            except Exception as error:
                raise _fault(name, error) from error

    def _soon(self, event: str) -> None:
        """As `call`, where the run cannot be saved: what was raised waits in ``fault`` until it can."""
        if self.fault is None:
            try:
                self.call(event)
            except HookFault as fault:
                self.fault = fault
                self.request.ask()

    def require_sound(self) -> None:
        """Raises what a hook has raised where the run could not be saved."""
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise fault

    def rows(self) -> list[dict[str, Any]]:
        """Every row of metrics so far, read from the folder when they are first asked for."""
        if self._rows is None:
            self._rows = list(read_rows(self.folder.metrics_path))
        return self._rows

    def watchable(self, what: str) -> Watchable:
        """The trainee, if its parts can be shown."""
        if self._watchable is not None:
            return self._watchable
        raise ValueError(f"runs of this kind show no {what} to hooks; session.metrics has what they measure")


def _has_columns(hook: Any) -> bool:
    return callable(getattr(hook, "columns", None))


def _has_state(hook: Any) -> bool:
    return callable(getattr(hook, "state_dict", None)) and callable(getattr(hook, "load_state_dict", None))


def _name_of(hook: Any) -> str:
    """By what a hook's state is kept: as ``--hook`` names it."""
    named = hook if hasattr(hook, "__qualname__") else type(hook)
    return f"{named.__module__}:{named.__qualname__}"


def _fault(name: str, error: Exception) -> HookFault:
    fault = HookFault(_told_of(name, error))
    fault.__cause__ = error
    return fault


def _told_of(name: str, error: Exception) -> str:
    """Which hook, what it raised, and where in its code."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename != __file__]
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"the hook {name.partition(':')[2]} raised {type(error).__name__}: {error}{place}"

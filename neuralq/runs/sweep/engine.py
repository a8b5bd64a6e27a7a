"""What makes the runs of a sweep, whatever machines it has, and the loop that hands them out.

Nothing is remembered between one time and the next but what the run folders say, so that a loop that was killed is
begun again and goes on. A run whose process died without a word (killed, out of memory) is begun again from its newest
checkpoint, three times at most without a new one in between.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from neuralq.runs.folder.files import FolderLock, RunFolderError, to_json, write_durably
from neuralq.runs.play_off import score_of
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.sweep.folder import Member, Sweep
from neuralq.runs.sweep.results import RunResult, Status, SweepResult
from neuralq.runs.sweep.states import RunState, note_failure, saved_steps, steps_so_far
from neuralq.runs.sweep.task import Task

__all__ = ["Attempts", "Ended", "Engine", "run_sweep", "share_of"]

_POLL_SECONDS = 0.25
_ELSEWHERE_SECONDS = 2.0
"""Between looks at runs that another process is at."""
_MOST_ATTEMPTS = 3


@dataclass(frozen=True)
class Ended:
    """A task that an engine is through with.

    Args:
        task: which.
        reason: "" where the run ended by itself or was asked to; what happened to its process otherwise.
    """

    task: Task
    reason: str = ""


class Attempts:
    """How often each run was begun again without getting further than the time before."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[int, int]] = {}

    def given_up(self, ended: Ended) -> str | None:
        """Why a run that ended before its end is not begun again; None where it is, from its newest checkpoint."""
        name = ended.task.name
        saved, (before, count) = saved_steps(ended.task.path), self._known.get(name, (-1, 0))
        count = count + 1 if saved == before else 1
        self._known[name] = (saved, count)
        if count < _MOST_ATTEMPTS:
            return None
        return f"{ended.reason or 'it ended before its end'}, {_MOST_ATTEMPTS} times over"


class Engine(Protocol):
    """What makes runs. A run that it knows will fail again gets its failure noted (`note_failure`) by the engine."""

    @property
    def title(self) -> str:
        """For people: "2 processes on this machine"."""
        ...

    def has_room(self) -> bool:
        """Whether another task may be started now."""
        ...

    def start(self, task: Task) -> None:
        """Begin a task.

        Raises:
            OSError: if it cannot be begun; others may.
        """
        ...

    def collect(self, seconds: float) -> list[Ended]:
        """What has ended since the last call, as soon as something has, and after so many seconds at the latest."""
        ...

    def running(self) -> list[Task]:
        """Tasks that were started and have not been collected."""
        ...

    def stop(self) -> None:
        """Ask every task to save and end, once."""
        ...

    def close(self) -> None:
        """End at once whatever is left; no process stays behind."""
        ...


def share_of(sweep: Sweep, index: int = 0, of: int = 1) -> list[Member]:
    """The runs of a sweep that belong to one of several that divide it between them.

    Raises:
        ValueError: if there is no such share.

    Example:
        >>> from pathlib import Path
        >>> [member.seed for member in share_of(Sweep(Path(), {"total_steps": 1}, (0, 1, 2, 3, 4)), 1, 2)]
        [1, 3]
    """
    if not 0 <= index < of:
        raise ValueError(f"there are the shares 0 to {of - 1} of {of}, got {index}")
    return [member for number, member in enumerate(sweep.members()) if number % of == index]


def run_sweep(
    sweep: Sweep,
    engine: Engine,
    watch: Callable[[Status], None] | None = None,
    retry_failed: bool = True,
    members: Iterable[Member] | None = None,
) -> SweepResult:
    """Make every run that has not finished; one that fails is named and the others go on.

    SIGINT, SIGTERM and SIGUSR1 are passed on to the runs, which save and end; a second one ends them at once.

    Args:
        sweep: which.
        engine: makes the runs; closed in any case.
        watch: told how far it has come, a few times a second.
        retry_failed: whether runs that have failed before are begun again.
        members: some of its runs; all by default, which one process at a time may ask for.

    Raises:
        RunFolderBusy: if another process is running the whole sweep.
    """
    request, whole = StopRequest(), members is None
    with contextlib.ExitStack() as stack:
        stack.callback(engine.close)
        if whole:
            busy = f"the sweep in {sweep.path} is being run"
            stack.enter_context(contextlib.closing(FolderLock(sweep.path / "sweep.lock", busy)))
        stack.enter_context(request.listening())
        loop = _Loop(sweep, engine, list(sweep.members() if members is None else members), retry_failed)
        told = -math.inf
        while loop.waiting or loop.elsewhere or engine.running():
            if request.name is not None:
                loop.stop()
            loop.hand_out()
            loop.collect(_POLL_SECONDS)
            if watch is not None and time.monotonic() - told > _POLL_SECONDS:
                told = time.monotonic()
                watch(loop.status())
        if watch is not None:
            watch(loop.status())
        engine.close()
        result = SweepResult(tuple(loop.result(member) for member in loop.members), request.name)
        if whole:
            write_durably(sweep.path / "summary.json", to_json(result.plain(), "summary", sealed=True))
    return result


class _Loop:
    """Which runs wait, which another process is at, and what is known of the others."""

    def __init__(self, sweep: Sweep, engine: Engine, members: list[Member], retry_failed: bool) -> None:
        self.sweep, self.engine, self.members = sweep, engine, members
        self.by_name = {member.name: member for member in members}
        self.states: dict[str, RunState] = {}
        self.elsewhere: list[Member] = []
        self.attempts = Attempts()
        self.stopping = False
        self._looked = time.monotonic()
        self._budgets = {m.name: m.total_steps or int(sweep.configuration(m)["total_steps"]) for m in members}
        self._steps: dict[str, int] = {}
        self._returns: dict[str, float] = {}
        self._failed: dict[str, None] = {}
        for member in members:
            self._note(member, sweep.state(member))
        passed = ("finished",) if retry_failed else ("finished", "failed")
        self.waiting = deque(m for m in members if self.states[m.name].state not in passed)

    def _note(self, member: Member, state: RunState) -> None:
        """What is known of a run from now on; sums over thousands of runs are not made anew for each look at them."""
        name = member.name
        self.states[name] = state
        self._failed.pop(name, None)
        if state.state == "finished":
            self._steps[name] = self._budgets[name]
            if (score := score_of(state.summary)) is not None:
                self._returns[name] = score.mean
        elif state.state == "failed":
            self._failed[name] = None
        elif state.state == "stopped":
            self._steps[name] = min(self._budgets[name], steps_so_far(self.sweep.path / name))

    def stop(self) -> None:
        """Nothing new is begun, and what goes on is asked to end."""
        self.waiting.clear()
        self.elsewhere.clear()
        if not self.stopping:
            self.engine.stop()
        self.stopping = True

    def hand_out(self) -> None:
        if self.elsewhere and time.monotonic() - self._looked > _ELSEWHERE_SECONDS:
            self._looked = time.monotonic()
            self.waiting.extend(self.elsewhere)
            self.elsewhere.clear()
        while self.waiting and self.engine.has_room():
            member = self.waiting.popleft()
            state = self.sweep.state(member)
            if state.state == "finished":  # meanwhile, by another process
                self._note(member, state)
            elif state.state == "running":
                self.elsewhere.append(member)
            else:
                self._start(member)

    def _start(self, member: Member) -> None:
        self._note(member, RunState("running"))
        try:
            self.engine.start(self.sweep.task(member))
        except (OSError, RunFolderError, ValueError) as error:  # no room for a process or a log: this run's alone
            self._fail(member, str(error))

    def collect(self, seconds: float) -> None:
        for ended in self.engine.collect(seconds):
            member = self.by_name[ended.task.name]
            state = self.sweep.state(member)
            if state.state in ("finished", "failed") or self.stopping:
                self._note(member, state)
                continue
            given_up = self.attempts.given_up(ended)
            if state.state == "running":  # somebody else was there first
                self.elsewhere.append(member)
            elif given_up is not None:
                self._fail(member, given_up)
            else:
                self._note(member, state)
                self.waiting.append(member)

    def _fail(self, member: Member, reason: str) -> None:
        note_failure(self.sweep.path / member.name, reason)
        self._note(member, RunState("failed", reason))

    def result(self, member: Member) -> RunResult:
        state = self.states[member.name]
        if state.state in ("running", "stopped", "not begun"):
            state = self.sweep.state(member)
        if state.state not in ("finished", "failed"):
            state = RunState("stopped")
        path = self.sweep.path / member.name
        return RunResult(member.seed, path, state.state, state.reason, state.summary, member.options)

    def status(self) -> Status:
        running = {task.name: task.path for task in self.engine.running()}
        for name, path in running.items():
            self._steps[name] = min(self._budgets[name], steps_so_far(path))
        return Status(
            env_steps=sum(self._steps.values()),
            total_steps=sum(self._budgets.values()),
            running=tuple(running),
            num_finished=sum(state.state == "finished" for state in self.states.values()),
            failed=tuple(self._failed),
            returns=self._returns,
        )

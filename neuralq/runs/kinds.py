"""The kinds of runs there are, and what makes a kind: a system that trains is one folder and one line in `KINDS`.

Kinds are named as "module:name", so that nothing here imports what stands above.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import os
import signal
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, Protocol, TypeVar

import torch
from threadpoolctl import threadpool_limits

from neuralq.runs.changes import differences, names_of_changes, replaced, told, with_new_periods
from neuralq.runs.folder.files import RunFolderError
from neuralq.runs.folder.origin import ARITHMETIC
from neuralq.runs.folder.run_folder import RunFolder, claimed, is_run_folder, read_changes, read_config, refuse_old_run
from neuralq.runs.loop import Hook, Plan, Progress, Speaks, Trainee, continued, fit, say_to
from neuralq.runs.stop_request import StopRequest

__all__ = ["KINDS", "Kind", "Result", "kind_in", "kind_named", "kind_of", "limited_threads"]

KINDS = {
    "control": "neuralq.runs.control:CONTROL",
    "td-gammon": "neuralq.systems.backgammon.run:TD_GAMMON",
}
"""By what ``config.json`` says under ``kind``; where it says nothing, it is control."""


class Result(Protocol):
    """The result of a run."""

    def plain(self) -> dict[str, Any]:
        """Plain values, for JSON; among them ``run_dir``, ``env_steps`` and ``interrupted_by``."""
        ...

    def lines(self) -> list[str]:
        """The same for people."""
        ...


Changes = Mapping[str, Any]
NO_CHANGES: Changes = MappingProxyType({})
C = TypeVar("C")
T = TypeVar("T", bound=Trainee)
R = TypeVar("R", bound=Result)


@dataclass(frozen=True)
class CommandLine:
    """A kind of run on the command line: ``neuralq train NAME`` has an option for each field of its configuration.

    Args:
        description: what training does, for the help.
        examples: command lines for the help.
        short: options whose names are shorter than the fields that they set, by field.
        measure: "module:function" of the command that evaluates such runs.
        measures: beginnings and endings of words that ask for that command where no run is named.
        instead: what to do where a command knows runs on environments only; ``{run}`` stands for the folder.
        report: "module:function" that writes the page of a run folder and returns its path; None where there is none.
    """

    description: str
    examples: tuple[str, ...]
    short: Mapping[str, str]
    measure: str
    measures: tuple[str, ...]
    instead: str
    report: str | None = None


@dataclass(frozen=True)
class Kind(Generic[C, T, R]):
    """All that has to be known of a kind of run.

    Args:
        name: in `KINDS`.
        title: for people, with its article.
        config: the dataclass that decides a run.
        budget: its field that says how much training.
        to_plain: a configuration as plain values, for JSON.
        from_plain: the configuration that ``to_plain`` wrote; raises ValueError for what it cannot be.
        default_path: where a run goes that was given no folder.
        num_threads: CPU threads for linear algebra.
        build: what trains, freshly made, with compiled kernels warm.
        plan: when a run is evaluated, saved and stopped.
        result: of a run that has ended, which is told by the name it was given; may leave files there.
        load: the agent of a run folder; of the best parameters, if that is asked and they are kept, of the last, or
            with None of those that the run ended with.
        opening: what is worth saying of a run, once, before it trains; what begins with "warning: " is said to whoever
            listens to nothing else, too.
        notes: what is worth saying beside a progress bar, of the latest value of each column of metrics.
        changeable: fields, with a dot those of a part, that a run may go on with otherwise than it began; those of a
            part decide what is learned from there on.
        command: what the command line has to know to train by options of the kind's own.
        start: puts what was freshly built where its configuration says that a run begins; the configuration as it is
            to be kept.
        watchers: of a configuration and the hooks that were given, what else watches a run, before them.
    """

    name: str
    title: str
    config: type[C]
    budget: str
    to_plain: Callable[[C], dict[str, Any]]
    from_plain: Callable[[Mapping[str, Any]], C]
    default_path: Callable[[C], Path]
    num_threads: Callable[[C], int]
    build: Callable[[C], T]
    plan: Callable[[C], Plan]
    result: Callable[[C, T, Progress, RunFolder], R]
    load: Callable[[Path, bool | None], Any]
    notes: Callable[[C, Mapping[str, Any]], list[str]]
    changeable: frozenset[str] = frozenset()
    command: CommandLine | None = None
    opening: Callable[[C, T], list[str]] | None = None
    start: Callable[[C, T], C] = lambda config, trainee: config
    watchers: Callable[[C, Sequence[Hook]], list[Hook]] | None = None

    def train(self, config: C, run_dir: str | Path | None = None, hooks: Sequence[Hook] = ()) -> R:
        """As `neuralq.train`."""
        seed, request = self.plan(config).seed, StopRequest()
        with claimed(run_dir, lambda: self.default_path(config)) as path, same_folder() as here:
            refuse_old_run(path)  # `RunFolder.create` does too, but building takes seconds
            with (
                request.listening((signal.SIGINT,)),
                limited_threads(self.num_threads(config)),
                contextlib.closing(self.build(config)) as trainee,
            ):
                _end_if_asked(request)
                config = self.start(config, trainee)
                torch.set_num_threads(self.num_threads(config))  # whatever environments asked for when they were made
                with RunFolder.create(here / path, config=self.to_plain(config), seed=seed) as folder:
                    folder.named = path
                    folder.free = self.free
                    result = self._finish(config, trainee, Progress(), folder, hooks)
                _end_if_asked(request)
                return result

    def resume(
        self, run_dir: str | Path, budget: int | None = None, hooks: Sequence[Hook] = (), changes: Changes = NO_CHANGES
    ) -> R:
        """As `neuralq.resume`.

        Raises:
            ValueError: if the run is of another kind, or a change is not one that it can take.
        """
        stored, request = self.from_plain(read_config(run_dir)), StopRequest()
        config = self.changed(stored, budget, changes)
        with (
            same_folder() as here,
            request.listening((signal.SIGINT,)),
            limited_threads(self.num_threads(config)),
            RunFolder.open(here / run_dir) as folder,
            contextlib.closing(self.build(config)) as trainee,
        ):
            _end_if_asked(request)
            torch.set_num_threads(self.num_threads(config))
            folder.free, folder.named = self.free, Path(run_dir)
            if not any(folder.checkpoints_path.glob("step-*")):
                self.start(config, trainee)
            progress = continued(trainee, folder)
            plan, before = self.plan(config), self.plan(stored)
            if trainee.amount > plan.budget and plan.budget < before.budget:
                raise ValueError(
                    f"{self.budget}={plan.budget} is less than what {run_dir} has spent, {trainee.amount:,}; name more "
                    "than that, or leave it out"
                )
            if plan.stop_at_return != before.stop_at_return:
                score, target = progress.greedy_return, plan.stop_at_return
                met = score is not None and target is not None and score >= target
                progress.reached_at = progress.evaluated_at if met else None
            with_new_periods(progress, before, plan, trainee.amount)
            if config != stored:
                self._record(stored, config, trainee, folder, hooks)
            result = self._finish(config, trainee, progress, folder, hooks)
            _end_if_asked(request)
            return result

    def _record(self, stored: C, config: C, trainee: T, folder: RunFolder, hooks: Sequence[Hook]) -> None:
        """What changes is kept in the folder and said, before anything goes on with it."""
        names = set(names_of_changes(stored, self.may_change()).values())
        changes = differences(stored, config, names)
        folder.record_changes(trainee.env_steps, changes)
        folder.replace_config(self.to_plain(config))
        say_to(hooks, told({"env_steps": trainee.env_steps, "changes": changes}))

    @property
    def free(self) -> frozenset[str]:
        """Names of the configuration that do not decide what is learned."""
        return frozenset(name for name in self.changeable if "." not in name) | {self.budget}

    def changed(self, config: C, budget: int | None, changes: Changes = NO_CHANGES) -> C:
        """The same configuration but for how much training there is, and what else does not decide what is learned.

        Raises:
            ValueError: for anything else, which would make another run of it.
        """
        values = {self.full_name(config, name): value for name, value in changes.items()}
        return replaced(config, values | ({} if budget is None else {self.budget: budget}))

    def full_name(self, config: C, name: str) -> str:
        """The name of a setting that may change, with its part where it is in one.

        Raises:
            ValueError: if it may not, with what may.
        """
        known = names_of_changes(config, self.may_change())
        if name not in known:
            raise ValueError(
                f"{name} cannot be changed where {self.title} goes on: it would be another run; what can is "
                f"{', '.join(sorted(set(known.values())))}"
            )
        return known[name]

    def may_change(self) -> frozenset[str]:
        """Names of all that may be otherwise where a run goes on."""
        return self.changeable | {self.budget} | (ARITHMETIC & {f.name for f in dataclasses.fields(self.config)})  # type: ignore[arg-type]

    def _finish(self, config: C, trainee: T, progress: Progress, folder: RunFolder, hooks: Sequence[Hook]) -> R:
        plan = self.plan(config)
        reached = plan.stop_at_return is not None and progress.reached_at is not None
        if not (progress.finished and (reached or trainee.amount >= plan.budget)):
            for line in [] if self.opening is None else self.opening(config, trainee):
                say_to(hooks, line)
            if isinstance(trainee, Speaks):
                trainee.say = functools.partial(say_to, hooks)
            watching = [] if self.watchers is None else self.watchers(config, hooks)
            fit(trainee, plan, progress, folder, [*watching, *hooks], config)
        else:
            warnings.warn(_nothing_left(self, plan, progress, folder.named, reached), stacklevel=3)
        result = self.result(config, trainee, progress, folder)
        changes = read_changes(folder.path)
        folder.write_summary(result.plain() | ({"changes": changes} if changes else {}))
        return result


@contextlib.contextmanager
def same_folder() -> Iterator[Path]:
    """The present folder, which is the present folder again after the block: environments may change it.

    Example:
        >>> import os
        >>> with same_folder() as here:
        ...     os.chdir("/")
        >>> Path.cwd() == here
        True
    """
    here = Path.cwd()
    try:
        yield here
    finally:
        with contextlib.suppress(OSError):  # it may be gone
            os.chdir(here)


def _end_if_asked(request: StopRequest) -> None:
    """Raises KeyboardInterrupt if Ctrl-C came while a run was prepared or put away: a compiler may swallow it there."""
    if request.name is not None:
        raise KeyboardInterrupt


def _nothing_left(kind: Kind[Any, Any, Any], plan: Plan, progress: Progress, path: Path, reached: bool) -> str:
    unit = plan.unit.replace("_", " ")
    if reached:
        return (
            f"nothing is left to do: {path} has reached its target of {plan.stop_at_return:g} at "
            f"{progress.reached_at:,} {unit}; to go on, set a higher one or none: neuralq resume {path} "
            "--stop-at-return none"
        )
    option = "--games" if kind.budget == "num_games" else "--" + kind.budget.replace("_", "-")
    return (
        f"nothing is left to do: {path} has spent its budget of {plan.budget:,} {unit}; to go on, give it a larger "
        f"one: neuralq resume {path} {option} {2 * plan.budget}"
    )


@contextlib.contextmanager
def limited_threads(num_threads: int) -> Iterator[None]:
    """Within the block linear algebra has so many threads.

    Example:
        >>> with limited_threads(1):
        ...     torch.get_num_threads()
        1
    """
    before = torch.get_num_threads()
    torch.set_num_threads(num_threads)
    try:
        with threadpool_limits(num_threads):
            yield
    finally:
        torch.set_num_threads(before)


def kind_named(name: str) -> Kind[Any, Any, Any]:
    """The kind of this name.

    Raises:
        RunFolderError: if there is none.

    Example:
        >>> kind_named("control").budget
        'total_steps'
    """
    if name not in KINDS:
        raise RunFolderError(f"there are runs of the kinds {', '.join(KINDS)}, got {name!r}; upgrade neuralq")
    module, _, attribute = KINDS[name].partition(":")
    kind: Kind[Any, Any, Any] = getattr(importlib.import_module(module), attribute)
    return kind


def kind_in(path: str | Path) -> str | None:
    """The name of the kind of run in a folder; None where there is no run.

    Example:
        >>> kind_in("/nowhere") is None
        True
    """
    return str(read_config(path).get("kind", "control")) if is_run_folder(path) else None


def kind_of(run_dir: str | Path) -> Kind[Any, Any, Any]:
    """The kind of the run in a folder.

    Raises:
        RunFolderError: if there is no run in it, or one of no known kind.
    """
    return kind_named(str(read_config(run_dir).get("kind", "control")))

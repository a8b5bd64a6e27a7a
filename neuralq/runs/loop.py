"""The training loop, whatever trains: when rows are written, and when the run is evaluated, saved and stopped.

It knows no algorithm and no kind of run. What trains is a `Trainee`, what is asked of it a `Plan`, how far it has come
its `Progress`; a checkpoint holds exactly the first and the last, so a run that stops anywhere goes on bit for bit.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol, runtime_checkable

import numpy as np

from neuralq.learners.learner import Learner
from neuralq.runs.folder import checkpoint, origin
from neuralq.runs.folder.best import Best, keep_best, load_best
from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.run_folder import RunFolder, read_changes, warn_of_lost_rows
from neuralq.runs.stop_request import StopAsked, StopRequest
from neuralq.runs.stream.experience import Sample
from neuralq.runs.watching import Hook, HookFault, Listener, Observer, Watch, say_to

__all__ = [
    "NOT_EXACT",
    "Diverged",
    "Hook",
    "HookFault",
    "Listener",
    "Observer",
    "Plan",
    "PlaysOff",
    "Progress",
    "Speaks",
    "Trainee",
    "continued",
    "fit",
    "say_to",
    "seed_for",
]


NOT_EXACT = "the run goes on from the state that was saved, but not with the same bits for certain"


@runtime_checkable
class Speaks(Protocol):
    """A trainee that may have something to say while it trains; it is given ``say``."""

    say: Callable[[str], None]


class Diverged(RuntimeError):
    """The parameters are no longer finite numbers; the last checkpoint is from before that."""


@runtime_checkable
class PlaysOff(Protocol):
    """A trainee whose last parameters can be held against its best."""

    def play_off(self, best: Best, seed: int) -> dict[str, Any]:
        """Which of both is the agent of the run ("agent": "final" or "best"), and what that was decided by."""
        ...


class Trainee(Protocol):
    """What the loop asks of whatever trains."""

    @property
    def amount(self) -> int:
        """Training so far, in the plan's unit."""
        ...

    @property
    def env_steps(self) -> int:
        """Environment steps so far, by which rows and checkpoints are numbered."""
        ...

    @property
    def observed(self) -> tuple[Learner, Sample] | None:
        """What an `Observer` is shown, if there is a learner that has learned from a sample."""
        ...

    def advance(self, until: int, request: StopRequest) -> None:
        """Train at least once, up to ``until`` units at most where it can, to a point where it may be saved.

        It may come back earlier, and does at the next such point once a stop is requested.
        """
        ...

    def training_row(self) -> dict[str, Any]:
        """Columns of training metrics, beside those that every run has."""
        ...

    def evaluate(self, seed: int) -> tuple[dict[str, Any], Best | None]:
        """Measure what has been learned; training goes on as if it had not been measured.

        Returns:
            Columns of metrics, none where nothing is measured; and the parameters with their score, by which the best
            of the run are chosen and a target is met, or None where neither is wanted.
        """
        ...

    def require_finite(self) -> None:
        """Raises `Diverged` if the parameters are no longer finite."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that a continued run needs; what `Progress` does not know of its progress, under ``progress``."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        ...

    def close(self) -> None:
        """Give back what it holds of the system."""
        ...


@dataclass(frozen=True)
class Plan:
    """What is asked of a run.

    Args:
        unit: what training is counted in, as its column of metrics is called: "env_steps", "games".
        budget: how much training.
        evaluate_every: between evaluations.
        checkpoint_every: between checkpoints.
        log_every: between rows of training metrics.
        seed: from which evaluation seeds are derived.
        stop_at_return: stop once an evaluation scores at least this; None to use the whole budget.
        log_whole_periods: whether rows of training metrics come at multiples of ``log_every`` and at the end, or at
            the very beginning and ``log_every`` after each other.
    """

    unit: str
    budget: int
    evaluate_every: int
    checkpoint_every: int
    log_every: int
    seed: int
    stop_at_return: float | None = None
    log_whole_periods: bool = False


@dataclass
class Progress:
    """How far a run has come, beside what only what trains knows.

    Args:
        cpu_seconds: CPU time of training, evaluations excluded.
        wall_seconds: wall time of training and evaluation.
        greedy_return: score of the last evaluation, None before the first.
        best_return: best score so far.
        evaluated_at: amount of training at the last evaluation.
        reached_at: amount at which ``stop_at_return`` was first met.
        finished: whether the run has ended by itself.
        interrupted_by: name of the signal that ended it early.
        stopped_by: which hook ended it early, and why.
        moved: what decides the arithmetic and was not the same all along, in words.
        hook_states: what hooks have to remember, by name.
        agent: of a finished run that ended below its best evaluation: which of both is its agent, and by what that was
            decided (`PlaysOff`); None where the last parameters are.
    """

    cpu_seconds: float = 0.0
    wall_seconds: float = 0.0
    greedy_return: float | None = None
    best_return: float | None = None
    evaluated_at: int | None = None
    reached_at: int | None = None
    finished: bool = False
    next_evaluation: int = 0
    next_checkpoint: int = 0
    next_log: int = 0
    interrupted_by: str | None = None
    stopped_by: str | None = None
    moved: str | None = None
    hook_states: dict[str, Any] = field(default_factory=dict)
    agent: dict[str, Any] | None = None


def seed_for(seed: int, *purpose: int) -> int:
    """A seed that belongs to one purpose of one run; different runs and purposes do not overlap.

    Example:
        >>> seed_for(0, 1) != seed_for(0, 2) != seed_for(1, 1)
        True
    """
    return int(np.random.SeedSequence([seed, *purpose]).generate_state(1)[0] >> 1)


def continued(trainee: Trainee, folder: RunFolder) -> Progress:
    """How far the run in a folder has come, with ``trainee``, freshly built, put where its newest checkpoint stood.

    Rows of metrics beyond the checkpoint are dropped. What computes otherwise than it did is named in a warning.

    Raises:
        CheckpointError: if there are checkpoints and none is intact, or the newest belongs to another configuration.
    """
    if not any(folder.checkpoints_path.glob("step-*")):
        folder.truncate_metrics(trainee.env_steps)
        return Progress()
    saved = checkpoint.load_newest(folder.checkpoints_path)
    state = saved.state
    moved = origin.compared(state.get("origin"), folder.config, saved.path, read_changes(folder.path))
    trainee.load_state_dict(state)
    folder.truncate_metrics(trainee.env_steps)
    warn_of_lost_rows(folder.path, folder.num_rows, state["progress"].get("num_rows"))
    known = {f.name for f in fields(Progress)}
    progress = Progress(**{name: value for name, value in state["progress"].items() if name in known})
    progress.hook_states = dict(state.get("hooks", {}))
    if moved is not None:
        progress.moved = moved if progress.moved is None else f"{progress.moved}; {moved}"
        warnings.warn(f"{NOT_EXACT}: {moved}", stacklevel=2)
    return progress


def fit(
    trainee: Trainee, plan: Plan, progress: Progress, folder: RunFolder, hooks: Sequence[Hook] = (), config: Any = None
) -> None:
    """Train until the plan is met, the budget is spent, or a hook or a signal asks to stop; then there is a checkpoint.

    Args:
        trainee: what trains; changed in place.
        plan: when to evaluate, save and stop.
        progress: where to begin; changed in place.
        folder: an open run folder.
        hooks: called with each row of metrics, and shown what they ask for.
        config: of the run, for hooks.

    Raises:
        EnvironmentFault: if an environment breaks its contract. The last checkpoint stays as it is.
        Diverged: if the parameters stop being finite. Likewise.
        HookFault: if a hook raises, once the run is saved.
    """
    request = StopRequest()
    watch = Watch(hooks, trainee, progress, folder, config, request)
    watch.restore()
    loop = _Loop(trainee, plan, progress, folder, watch)
    with request.listening():
        try:
            try:
                loop.run(request)
            except StopAsked:  # an evaluation is abandoned; it is due again when the run goes on
                loop._book(training=False)
                loop.interrupted(request)
            loop.ended()
        except HookFault as fault:
            loop._save(request)
            raise HookFault(
                f"{fault}; the run is saved at {trainee.amount:,} {plan.unit.replace('_', ' ')}: mend the hook or "
                f"leave it out, then neuralq resume {folder.named}"
            ) from fault.__cause__
        except ValueError:  # NaN among the values: the policy notices before the next checkpoint would
            trainee.require_finite()
            raise


class _Loop:
    def __init__(self, trainee: Trainee, plan: Plan, progress: Progress, folder: RunFolder, watch: Watch) -> None:
        self.trainee, self.plan, self.progress, self.folder, self.watch = trainee, plan, progress, folder, watch
        progress.finished = False
        progress.interrupted_by = progress.stopped_by = progress.agent = None
        progress.next_evaluation = progress.next_evaluation or plan.evaluate_every
        progress.next_checkpoint = progress.next_checkpoint or plan.checkpoint_every
        if plan.log_whole_periods:
            progress.next_log = progress.next_log or plan.log_every
        self._cpu, self._wall = time.process_time(), time.perf_counter()
        self._rate_since = (trainee.amount, time.perf_counter())

    def run(self, request: StopRequest) -> None:
        trainee, plan, progress = self.trainee, self.plan, self.progress
        if 0 < progress.next_evaluation <= trainee.amount:  # one was abandoned
            self._evaluate(request)
        reached = plan.stop_at_return is not None and progress.reached_at is not None
        while not reached and trainee.amount < plan.budget:
            next_look = min(progress.next_log, progress.next_evaluation, progress.next_checkpoint, plan.budget)
            trainee.advance(next_look, request)
            self.watch.require_sound()
            amount = trainee.amount
            if amount >= progress.next_log or (plan.log_whole_periods and amount >= plan.budget):
                self._log()
            if amount >= progress.next_evaluation:
                self._evaluate(request)
                reached = plan.stop_at_return is not None and progress.reached_at is not None
            if reached:
                break
            if request.by_hook:  # nothing is abandoned: the run ends here as it would at its budget
                progress.stopped_by = self.watch.stopped_by if amount < plan.budget else None
                break
            if request.name is not None:
                self.interrupted(request)
                return
            if amount >= progress.next_checkpoint:
                self._save(request)
        if progress.evaluated_at != trainee.amount:
            self._evaluate(request)
        self._choose_agent(request)
        progress.finished = True
        self._save(request)

    def ended(self) -> None:
        """Tell the hooks, once all is saved."""
        progress = self.progress
        reached = self.plan.stop_at_return is not None and progress.reached_at is not None
        self.watch.ended_by = progress.interrupted_by or progress.stopped_by or ("target" if reached else "budget")
        self.watch.call("on_end")

    def _choose_agent(self, request: StopRequest) -> None:
        """Where the last evaluation was not the best, both play on, and the better is the agent of the run."""
        trainee, progress = self.trainee, self.progress
        last, best = progress.greedy_return, progress.best_return
        if last is None or best is None or last >= best or not isinstance(trainee, PlaysOff):
            return
        try:
            kept = load_best(self.folder.path)
        except CheckpointError:  # deleted meanwhile
            return
        self._book()
        try:
            with request.abandoning():
                progress.agent = trainee.play_off(kept, seed_for(self.plan.seed, 12, trainee.amount))
        except KeyboardInterrupt:  # asked twice, as in an evaluation
            self._book(training=False)
            self.interrupted(request)
            raise
        self._book(training=False)

    def interrupted(self, request: StopRequest) -> None:
        self.progress.interrupted_by = request.name
        self._save(request)

    def _book(self, training: bool = True) -> None:
        """Books the time since this was last called; what is no training counts as wall time only."""
        cpu, wall = time.process_time(), time.perf_counter()
        if training:
            self.progress.cpu_seconds += cpu - self._cpu
        self.progress.wall_seconds += wall - self._wall
        self._cpu, self._wall = cpu, wall

    def _after(self, period: int) -> int:
        return (self.trainee.amount // period + 1) * period

    def _record(self, kind: str, columns: dict[str, Any]) -> None:
        trainee, progress = self.trainee, self.progress
        row = {
            "kind": kind,
            "env_steps": trainee.env_steps,
            self.plan.unit: trainee.amount,
            "cpu_seconds": progress.cpu_seconds,
            "wall_seconds": progress.wall_seconds,
            **columns,
        }
        self.watch.complete(row)
        self.folder.append_metrics(row)
        self.watch.row(row)
        if kind == "evaluation":
            self.watch.call("on_evaluation")
        self._book(training=False)  # whoever watches costs wall time only

    def _log(self) -> None:
        self._book()
        trainee, period = self.trainee, self.plan.log_every
        columns = trainee.training_row()
        self.progress.next_log = self._after(period) if self.plan.log_whole_periods else trainee.amount + period
        then, now = self._rate_since, (trainee.amount, time.perf_counter())
        self._rate_since = now
        rate = (now[0] - then[0]) / max(now[1] - then[1], 1e-9)
        self._record("train", {f"{self.plan.unit.removeprefix('env_')}_per_second": rate, **columns})

    def _evaluate(self, request: StopRequest) -> None:
        self._book()
        trainee, plan, progress = self.trainee, self.plan, self.progress
        try:
            with request.abandoning():
                columns, scored = trainee.evaluate(seed_for(plan.seed, 9, trainee.amount))
        except KeyboardInterrupt:  # asked twice; what has been learned is not at work here, and can be saved
            self._book(training=False)
            self.interrupted(request)
            raise
        progress.next_evaluation = self._after(plan.evaluate_every)
        progress.evaluated_at = trainee.amount
        if scored is not None:
            score = progress.greedy_return = scored.greedy_return
            if progress.best_return is None or score > progress.best_return:
                progress.best_return = score
                keep_best(self.folder.path, scored, self._origin())
            if plan.stop_at_return is not None and progress.reached_at is None and score >= plan.stop_at_return:
                progress.reached_at = trainee.amount
        self._book(training=False)
        self._rate_since = (trainee.amount, time.perf_counter())
        if columns:
            self._record("evaluation", columns)

    def _origin(self) -> dict[str, Any]:
        return origin.present(self.folder.config, self.folder.free)

    def _save(self, request: StopRequest) -> None:
        with request.saving():
            self._checkpoint()
        self.watch.require_sound()

    def _checkpoint(self) -> None:
        self.progress.next_checkpoint = self._after(self.plan.checkpoint_every)
        self.trainee.require_finite()
        self._book()
        state = self.trainee.state_dict()
        known = {f.name: getattr(self.progress, f.name) for f in fields(self.progress) if f.name != "hook_states"}
        state["progress"] |= {name: value for name, value in known.items() if value is not None}
        state["progress"]["num_rows"] = self.folder.num_rows
        if hooks := self.watch.states():
            state["hooks"] = hooks
        state["origin"] = self._origin()
        checkpoint.save(self.folder.checkpoints_path, self.trainee.env_steps, state)

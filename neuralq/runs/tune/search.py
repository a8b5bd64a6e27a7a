"""The loop of a study: what is to be run next, until enough is known, the time is up or somebody asks for the end."""

from __future__ import annotations

import contextlib
import functools
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from neuralq.runs.folder.files import RunFolderError
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.sweep.engine import Attempts, Ended, Engine
from neuralq.runs.sweep.states import state_of
from neuralq.runs.tune.asking import choose
from neuralq.runs.tune.confirming import CANDIDATES, best_so_far, candidates
from neuralq.runs.tune.study import FRESH, Study
from neuralq.runs.tune.trials import Outcome, Trial, outcome_of

__all__ = ["Limits", "Progress", "StudyFailed", "tune"]

_POLL_SECONDS = 0.25
_CONFIRMING = 0.5
"""Of a time limit, at most, is kept aside for the confirmation."""
_MARGIN = 1.2

Run = tuple[Trial, int]


class StudyFailed(RuntimeError):
    """Nothing can be tuned: the runs of the preset fail."""


@dataclass(frozen=True)
class Limits:
    """When a study is to come to its confirmation.

    Args:
        trials: how many there are to be, the preset among them; None for no limit.
        seconds: until everything is to be over, the confirmation too; None for no limit.
        stop_when: an interquartile mean with which a trial is good enough; None for none.
    """

    trials: int | None = 50
    seconds: float | None = None
    stop_when: float | None = None


class Progress(NamedTuple):
    """How far a study has come.

    Args:
        confirming: whether the race is over.
        runs: of the confirmation that have ended, and of how many; (0, 0) in the race.
        running: runs that go on.
        seconds: since it was begun.
    """

    confirming: bool
    runs: tuple[int, int]
    running: int
    seconds: float


def tune(
    study: Study,
    engines: Callable[[], Engine],
    limits: Limits,
    watch: Callable[[Progress], None] = lambda progress: None,
    clock: Callable[[], float] = time.monotonic,
) -> str:
    """Go on with a study until its best trials are confirmed; why the race ended, in words, or the signal's name.

    SIGINT and SIGTERM save the runs that go on and end it; a second one ends them at once.

    Args:
        study: whose folder is locked.
        engines: makes an engine; the race has one, and the confirmation another.
        limits: when it is to end.
        watch: told how far it has come, a few times a second.
        clock: tells the time in seconds.

    Raises:
        StudyFailed: the preset's own runs fail.
        ValueError: nothing in the space can be run.
    """
    request = StopRequest()
    study.look_up()
    loop = _Loop(study, limits, request, watch, clock)
    with request.listening():
        with contextlib.closing(engines()) as engine:
            why = loop.race(engine)
        if request.name is None:
            with contextlib.closing(engines()) as engine:
                loop.confirm(engine)
    return request.name or why


class _Loop:
    """What both parts of a study share: runs that are handed out, collected and noted."""

    def __init__(
        self,
        study: Study,
        limits: Limits,
        request: StopRequest,
        watch: Callable[[Progress], None],
        clock: Callable[[], float],
    ) -> None:
        self.study, self.limits, self.request, self.watch, self.clock = study, limits, request, watch, clock
        self.began = clock()
        self.at_work: dict[str, tuple[Trial, int, float | None]] = {}
        self.attempts = Attempts()
        self.side_by_side = 1
        self.is_exhausted = False

    def race(self, engine: Engine) -> str:
        """Trials until there are enough; why they are."""
        while (why := self._is_over()) is None:
            self._hand_out(engine, self._next)
            if not self.at_work:
                why = (
                    "every trial has run" if not self.is_exhausted else "nothing else is left in the space to be tried"
                )
                break
            self._collect(engine, Progress(False, (0, 0), len(self.at_work), self._seconds()))
        self._finish(engine)
        return why or ""

    def confirm(self, engine: Engine) -> None:
        """The best trials on fresh seeds, as many as there is time for."""
        chosen = self._affordable(1.0, self._left())
        first, rest = chosen[:2], chosen[2:]
        order = [(trial, seed) for seed in self.study.fresh_seeds for trial in first]
        order += [(trial, seed) for trial in rest for seed in self.study.fresh_seeds]
        while self.request.name is None and self._left() > 0:
            waiting = [run for run in order if run[1] not in run[0].runs]
            self._hand_out(engine, functools.partial(self._first, waiting))
            if not self.at_work:
                break
            ended = len(order) - len(waiting)
            self._collect(engine, Progress(True, (ended, len(order)), len(self.at_work), self._seconds()))
        self._finish(engine)

    def _seconds(self) -> float:
        return self.clock() - self.began

    def _left(self) -> float:
        return math.inf if self.limits.seconds is None else self.limits.seconds - self._seconds()

    def _is_over(self) -> str | None:
        """Why no further run of the race is to be begun; None where one is."""
        self._check_preset()
        best, limits = best_so_far(self.study), self.limits
        if self.request.name is not None:
            return self.request.name
        if limits.stop_when is not None and best is not None and best[1].iqm >= limits.stop_when:
            return f"trial {best[0].number} reached {limits.stop_when:g}"
        if limits.seconds is not None:
            half = _CONFIRMING * limits.seconds
            kept = self._cost(self._affordable(_MARGIN, half))
            if self._left() <= _MARGIN * kept:
                return "the time for the race is up"
        return None

    def _check_preset(self) -> None:
        preset, few = self.study.trials[0], self.study.seeds[: self.study.few]
        found = [preset.runs[seed] for seed in few if seed in preset.runs]
        if len(found) == len(few) and all(outcome.score is None for outcome in found):
            log = self.study.task(preset, few[0]).log_path
            raise StudyFailed(
                f"every run of the preset fails: {found[0].reason} (see {log}); mend that and give the command again"
            )

    def _affordable(self, margin: float, seconds: float) -> list[Trial]:
        """The preset and as many of the best as can be confirmed in so many seconds; none where not even one can."""
        found: list[Trial] = []
        for count in range(CANDIDATES, 0, -1):
            found = candidates(self.study, count)
            if margin * self._cost(found) <= seconds:
                return found
        return []

    def _cost(self, trials: Iterable[Trial]) -> float:
        """Seconds that it takes to confirm these, by what their runs have taken."""
        fresh, each = self.study.fresh_seeds, []
        known = [run.seconds for trial in self.study.trials for run in trial.runs.values() if run.seconds is not None]
        for trial in trials:
            own = [run.seconds for run in trial.runs.values() if run.seconds is not None] or known
            seconds = sum(own) / len(own) if own else 0.0
            each += [seconds] * (FRESH - sum(seed in trial.runs for seed in fresh))
        rounds = math.ceil(len(each) / self.side_by_side)
        return rounds * sum(each) / len(each) if each else 0.0

    def _next(self) -> Run | None:
        """What the race wants to know next: what it waits for, another trial, and else a seed ahead."""
        racing = [trial for trial in self.study.trials if not self.study.standing(trial.number).is_settled]
        needed = self._first(run for trial in racing for run in self._wanted(trial, 1))
        if needed is not None:
            return needed
        if self._may_begin():
            chosen = choose(self.study)
            if chosen is not None:
                return self._first(self._wanted(self.study.begin(chosen), 1))
            self.is_exhausted = True
        return self._first(run for trial in racing for run in self._wanted(trial, 2))

    def _may_begin(self) -> bool:
        most = self.limits.trials
        enough = most is not None and len(self.study.trials) >= most
        return not enough and not self.is_exhausted and self.study.may_begin_another()

    def _wanted(self, trial: Trial, ahead: int) -> Iterator[Run]:
        seeds, known = self.study.seeds, len(trial.scores(self.study.seeds))
        return ((trial, seed) for seed in seeds[: max(self.study.few, known + ahead)])

    def _first(self, runs: Iterable[Run]) -> Run | None:
        """The first that has not ended and does not go on."""
        names = ((trial, seed, self.study.task(trial, seed).name) for trial, seed in runs if seed not in trial.runs)
        return next(((trial, seed) for trial, seed, name in names if name not in self.at_work), None)

    def _hand_out(self, engine: Engine, following: Callable[[], Run | None]) -> None:
        while engine.has_room():
            run = following()
            if run is None:
                return
            self._start(engine, *run)
        self.side_by_side = max(self.side_by_side, len(self.at_work))

    def _start(self, engine: Engine, trial: Trial, seed: int) -> None:
        task = self.study.task(trial, seed)
        task.path.parent.mkdir(parents=True, exist_ok=True)
        is_new = not task.path.exists()
        try:
            engine.start(task)
        except (OSError, RunFolderError, ValueError) as error:  # no room for a process or a log: this run's alone
            self.study.note(trial, seed, Outcome(None, str(error)))
            return
        self.at_work[task.name] = (trial, seed, self.clock() if is_new else None)

    def _collect(self, engine: Engine, progress: Progress) -> None:
        self.watch(progress)
        for ended in engine.collect(_POLL_SECONDS):
            self._note(ended, stopping=self.request.name is not None)

    def _note(self, ended: Ended, stopping: bool) -> None:
        trial, seed, begun = self.at_work.pop(ended.task.name)
        state = state_of(ended.task.path, int(ended.task.config["total_steps"]))
        outcome = outcome_of(state, None if begun is None else self.clock() - begun)
        if outcome is None and not stopping:  # killed, or out of memory: again, from its newest checkpoint
            given_up = self.attempts.given_up(ended)
            outcome = None if given_up is None else Outcome(None, given_up)
        if outcome is not None:
            self.study.note(trial, seed, outcome)

    def _finish(self, engine: Engine) -> None:
        """Runs that still go on save and end."""
        if self.at_work:
            engine.stop()
        while engine.running():
            for ended in engine.collect(_POLL_SECONDS):
                self._note(ended, stopping=True)
        self.at_work.clear()

"""A study: its folder, its trials, and what they say. All of it follows from the files, in whatever order runs ended.

Trial k is chosen by the results of the trials before k − n + 1, n being how many are under way at a time, and races
against the best of those: trials that were settled before it began. So which trials there are does not depend on which
run happens to end first, nor on whether the study was killed in between.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neuralq.checks import check_whole
from neuralq.runs.folder.files import RunFolderError, read_json, to_json, write_durably
from neuralq.runs.sweep.states import state_of
from neuralq.runs.sweep.statistics import Estimate
from neuralq.runs.sweep.task import Task
from neuralq.runs.tune.racing import Standing, raced
from neuralq.runs.tune.space import Space, Start, read_space
from neuralq.runs.tune.trials import Outcome, Trial, outcome_of, read_trials, write_trial

__all__ = ["FRESH", "Study", "create_study", "is_study_folder", "open_study"]

FORMAT_NAME = "neuralq-study"
FORMAT_VERSION = 1
FRESH = 10
"""Seeds of the confirmation."""
_APART = 1_000
"""From the first seed of the race to the first of the confirmation."""
_FEWEST = 2
"""Seeds without which there is no interval."""


@dataclass
class Study:
    """A study and its trials.

    Args:
        path: its folder.
        start: what every trial begins with; the first has nothing else.
        space: where the others look.
        few: seeds of every trial.
        most: seeds of a trial that is not dropped.
        at_once: trials under way at a time.
        seed: of what is chosen, and the first seed of the runs.
        trials: in their order.
    """

    path: Path
    start: Start
    space: Space
    few: int = 3
    most: int = 10
    at_once: int = 2
    seed: int = 0
    trials: list[Trial] = field(default_factory=list)
    _standings: dict[int, tuple[list[float], Standing]] = field(default_factory=dict)

    @property
    def seeds(self) -> range:
        """Of the race."""
        return range(self.seed, self.seed + self.most)

    @property
    def fresh_seeds(self) -> range:
        """Of the confirmation, which no trial is chosen by."""
        return range(self.seed + _APART, self.seed + _APART + FRESH)

    def known(self, number: int) -> list[Trial]:
        """The trials that a trial is chosen by, and races against."""
        return self.trials[: max(1, number - self.at_once + 1)] if number else []

    def standing(self, number: int) -> Standing:
        """How a trial stands in the race."""
        before, found = self._standings.get(number, (None, None))
        if found is not None and found.is_settled:
            return found
        scores = self.trials[number].scores(self.seeds, self.worst(number))
        if found is None or scores != before:
            found = raced(scores, self.best(number), self.few, self.most)
            self._standings[number] = (scores, found)
        return found

    def best(self, number: int) -> Estimate | None:
        """What a trial has to reach: the highest that those before it have come to with all seeds; None for none."""
        standings = [self.standing(trial.number) for trial in self.known(number)]
        found = [one.estimate for one in standings if one.state == "through" and one.estimate is not None]
        return max(found, key=lambda one: one.iqm, default=None)

    def worst(self, number: int) -> float:
        """What a failed run of a trial counts as: the lowest score that the runs before it and its own first have."""
        own = self.seeds[: self.few]
        known = [(trial, self.seeds[: self.standing(trial.number).num_seeds]) for trial in self.known(number)]
        runs = [trial.runs.get(seed) for trial, seeds in [*known, (self.trials[number], own)] for seed in seeds]
        return min((run.score for run in runs if run is not None and run.score is not None), default=-math.inf)

    def may_begin_another(self) -> bool:
        """Whether what the next trial is chosen by is settled."""
        return all(self.standing(trial.number).is_settled for trial in self.known(len(self.trials)))

    def task(self, trial: Trial, seed: int) -> Task:
        """A run of a trial."""
        name = f"{trial.number:04d}/seed-{seed}"
        return Task(name, self.path / "runs" / name, {**trial.config, "seed": seed})

    def begin(self, chosen: Mapping[str, Any]) -> Trial:
        """Another trial, with its file."""
        trial = Trial(len(self.trials), dict(chosen), self.start.plain_config(chosen))
        self._write(trial)
        self.trials.append(trial)
        return trial

    def note(self, trial: Trial, seed: int, outcome: Outcome) -> None:
        """What a run of a trial came to, into its file."""
        trial.runs[seed] = outcome
        self._write(trial)

    def look_up(self) -> None:
        """Runs that ended while nobody looked: their folders say so. The preset's are tried anew if all failed."""
        if all(run.score is None for run in self.trials[0].runs.values()):
            self.trials[0].runs.clear()
        for trial in self.trials:
            for seed in (*self.seeds, *self.fresh_seeds):
                path = self.task(trial, seed).path
                if seed not in trial.runs and path.is_dir():
                    state = state_of(path, int(trial.config["total_steps"]))
                    if state.state == "finished" and (outcome := outcome_of(state, None)) is not None:
                        self.note(trial, seed, outcome)

    def _write(self, trial: Trial) -> None:
        folder = self.path / "trials"
        folder.mkdir(exist_ok=True)
        write_trial(folder / f"{trial.number:04d}.json", trial)


def is_study_folder(path: str | Path) -> bool:
    """Whether a study was made in ``path``.

    Example:
        >>> is_study_folder("/nowhere")
        False
    """
    return (Path(path) / "study.json").is_file()


def create_study(
    path: str | Path, start: Start, space: Space, *, most: int = 10, at_once: int = 2, seed: int = 0
) -> Study:
    """A new study in ``path``, which is made if missing, with its first trial: what every one begins with.

    Raises:
        ValueError: for numbers out of range.
        RunFolderError: there is something in ``path`` already.
    """
    path, study = Path(path), Study(Path(path), start, space, min(3, most), most, at_once, seed)
    check_whole("seeds_most", most, _FEWEST)
    check_whole("at_once", at_once)
    check_whole("seed", seed, 0)
    if most > _APART:
        raise ValueError(f"seeds_most must be at most {_APART:,}, got {most:,}; as many seeds tell any two apart")
    if path.exists() and any(path.iterdir()):
        raise RunFolderError(f"{path} holds something else than a study; choose another folder with --dir")
    path.mkdir(parents=True, exist_ok=True)
    numbers = {"few": study.few, "most": most, "at_once": at_once, "seed": seed}
    marker = {"format": FORMAT_NAME, "version": FORMAT_VERSION, **numbers}
    plain = {**marker, "start": dict(start.plain), "space": space.plain()}
    write_durably(path / "study.json", to_json(plain, "study", sealed=True))
    study.begin({})
    return study


def open_study(path: str | Path) -> Study:
    """The study in ``path``.

    Raises:
        RunFolderError: there is none, or its files are damaged.
    """
    path = Path(path)
    try:
        plain = read_json(path / "study.json")
        if plain["format"] != FORMAT_NAME or plain["version"] > FORMAT_VERSION:
            raise ValueError(f"it is of format {plain['format']!r}, version {plain['version']!r}")
        numbers = {name: plain[name] for name in ("few", "most", "at_once", "seed")}
        for name, least in {"few": _FEWEST, "most": _FEWEST, "at_once": 1, "seed": 0}.items():
            check_whole(name, numbers[name], least)
        start = Start(plain["start"])
        study = Study(path, start, read_space(plain["space"], start), **numbers, trials=read_trials(path / "trials"))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RunFolderError(f"the study in {path} cannot be read: {error!s}; restore its files") from error
    if not study.trials:
        study.begin({})
    return study

"""A trial: what was chosen, and what each of its runs came to. One JSON file, replaced when a run has ended."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neuralq.runs.folder.files import RunFolderError, as_float, read_json, to_json, write_durably
from neuralq.runs.play_off import score_of
from neuralq.runs.sweep.states import RunState

__all__ = ["Outcome", "Trial", "outcome_of", "read_trials", "write_trial"]


@dataclass(frozen=True)
class Outcome:
    """What a run came to.

    Args:
        score: of its agent; None where it failed.
        reason: why it failed; "" otherwise.
        seconds: that it took; None where it was interrupted in between.
    """

    score: float | None
    reason: str = ""
    seconds: float | None = None


@dataclass
class Trial:
    """A configuration that is tried.

    Args:
        number: counted from 0, which is the preset.
        chosen: options by name, of the space.
        config: the whole configuration, without a seed of its own.
        runs: what runs came to, by seed; those of the race and those of the confirmation.
    """

    number: int
    chosen: dict[str, Any]
    config: dict[str, Any]
    runs: dict[int, Outcome] = field(default_factory=dict)

    def scores(self, seeds: range, worst: float = -math.inf) -> list[float]:
        """The scores of the first seeds that are known without a gap; a failed run counts as the worst."""
        found = []
        for seed in seeds:
            if seed not in self.runs:
                break
            score = self.runs[seed].score
            found.append(worst if score is None else score)
        return found


def outcome_of(state: RunState, seconds: float | None) -> Outcome | None:
    """What a run came to, by its folder; None where it has not ended.

    Example:
        >>> outcome_of(RunState("finished", summary={"greedy_return": 5.0}), 1.0).score
        5.0
        >>> outcome_of(RunState("finished", summary={"greedy_return": None}), 1.0).reason
        'its agent has no score'
    """
    if state.state == "failed":
        return Outcome(None, state.reason or "it failed", seconds)
    if state.state != "finished":
        return None
    score = score_of(state.summary)
    return Outcome(None, "its agent has no score", seconds) if score is None else Outcome(score.mean, "", seconds)


def write_trial(path: Path, trial: Trial) -> None:
    """Writes a trial's file in one step."""
    runs = [{"seed": seed, **_plain(trial.runs[seed])} for seed in sorted(trial.runs)]
    plain = {"number": trial.number, "chosen": trial.chosen, "config": trial.config, "runs": runs}
    write_durably(path, to_json(plain, "trial", sealed=True))


def _plain(outcome: Outcome) -> dict[str, Any]:
    return {"score": outcome.score, "reason": outcome.reason, "seconds": outcome.seconds}


def read_trials(folder: Path) -> list[Trial]:
    """The trials of a study in their order; those behind a gap in the numbers are not there.

    Raises:
        RunFolderError: a file is damaged.
    """
    found: list[Trial] = []
    while (path := folder / f"{len(found):04d}.json").exists():
        plain = read_json(path)
        try:
            runs = {int(row["seed"]): _outcome(row) for row in plain["runs"]}
            found.append(Trial(int(plain["number"]), dict(plain["chosen"]), dict(plain["config"]), runs))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise RunFolderError(f"{path} is no trial ({error!r}); restore it, or delete it to try anew") from error
    return found


def _outcome(row: Mapping[str, Any]) -> Outcome:
    numbers = [as_float(row[name]) for name in ("score", "seconds")]
    score, seconds = (number if math.isfinite(number) else None for number in numbers)
    return Outcome(score, str(row["reason"]), seconds)

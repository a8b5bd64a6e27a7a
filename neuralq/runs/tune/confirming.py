"""Confirmation: what the best trials score on seeds that nothing was chosen by, and only that is a result.

The best of many scores is high for two reasons: its configuration is good, and its seeds were lucky. On fresh seeds
only the first is left; what is lost is how much the selection had flattered (Cawley & Talbot 2010, "On over-fitting in
model selection").
"""

from __future__ import annotations

from dataclasses import dataclass

from neuralq.runs.sweep.statistics import Estimate, estimate
from neuralq.runs.tune.racing import Difference, difference
from neuralq.runs.tune.study import Study
from neuralq.runs.tune.trials import Trial

__all__ = ["CANDIDATES", "Confirmed", "best_so_far", "candidates", "confirmed", "winner"]

CANDIDATES = 3
"""Trials that are confirmed, beside the preset."""
_LEVEL = 0.05
"""Probability that any trial is said to be better which is not; divided between those that are compared."""


@dataclass(frozen=True)
class Confirmed:
    """A trial with all its fresh runs.

    Args:
        trial: which.
        searched: what it came to in the race.
        fresh: what it comes to on fresh seeds.
        gain: over the preset on the same seeds; None for the preset itself.
    """

    trial: Trial
    searched: Estimate
    fresh: Estimate
    gain: Difference | None

    @property
    def flattery(self) -> float:
        """By how much the race had it higher."""
        return self.searched.iqm - self.fresh.iqm

    @property
    def is_better(self) -> bool:
        """Whether it beats the preset beyond chance."""
        return self.gain is not None and self.gain.low > 0


def _ranked(study: Study) -> list[tuple[Trial, Estimate]]:
    """The trials that came through the race, the best first; of equals the earlier."""
    found = []
    for trial in study.trials:
        standing = study.standing(trial.number)
        if standing.state == "through" and standing.estimate is not None:
            found.append((trial, standing.estimate))
    return sorted(found, key=lambda one: -one[1].iqm)


def best_so_far(study: Study) -> tuple[Trial, Estimate] | None:
    """The trial that is ahead in the race; None before the first has all its seeds."""
    return next(iter(_ranked(study)), None)


def candidates(study: Study, count: int = CANDIDATES) -> list[Trial]:
    """What is to be confirmed: the preset, and the best trials that came through the race.

    Args:
        study: which.
        count: trials at most, the preset among them where it is one of the best; another than that in any case.
    """
    ranked = [trial for trial, _ in _ranked(study)]
    others = [trial for trial in ranked[:count] if trial.number] or [trial for trial in ranked if trial.number][:1]
    return study.trials[:1] + others if ranked else []


def confirmed(study: Study) -> list[Confirmed]:
    """Every trial whose fresh runs have all ended, the preset first; empty where the preset's have not."""
    whole = [trial for trial in study.trials if all(seed in trial.runs for seed in study.fresh_seeds)]
    known = [run.score for trial in study.trials for run in trial.runs.values() if run.score is not None]
    if not known or not whole or whole[0].number:
        return []
    scores = {trial.number: trial.scores(study.fresh_seeds, min(known)) for trial in whole}
    confidence = 1.0 - _LEVEL / max(len(whole) - 1, 1)
    found = []
    for trial in whole:
        searched = study.standing(trial.number).estimate
        assert searched is not None, "what is confirmed came through the race"
        gain = difference(scores[trial.number], scores[0], confidence) if trial.number else None
        found.append(Confirmed(trial, searched, estimate(scores[trial.number]), gain))
    return found


def winner(found: list[Confirmed]) -> Confirmed | None:
    """The best of those that beat the preset, else the preset; None where nothing is confirmed."""
    better = [one for one in found if one.is_better]
    return max(better, key=lambda one: one.fresh.iqm) if better else next(iter(found), None)

"""X5: do the same settings succeed with some seeds only? Then it was luck, and more seeds are what it takes.

A run has succeeded where it returns more than halfway from what no skill returns to the best that is at hand. No skill
is the random policy, or the best action alone, and a standard deviation of its episodes, which a few may average.
With the share p of runs that succeed, one of n does with a chance of 1 − (1 − p)ⁿ; n is given for 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.findings import Finding

__all__ = ["luck", "luck_of", "seeds_needed"]

_CHANCE = 0.95


def luck(case: Case) -> Finding:
    """X5 of runs that were given together: a sweep, of which the worst is the subject."""
    if not case.subject.siblings:
        raise CannotMeasure(
            "one run was given; a sweep's folder (neuralq train ENV --seeds 10), or --level experiments, shows what "
            "the seed decides"
        )
    return luck_of(case, case.subject.siblings, "the sweep's settings")


def luck_of(case: Case, returns: Sequence[float], whose: str) -> Finding:
    """X5 of runs that differ by nothing but their seed.

    Args:
        case: of a subject; where it has succeeded itself there is nothing to explain.
        returns: greedy return of each run.
        whose: settings, in words.

    Raises:
        CannotMeasure: there are fewer than two runs.
    """
    scores = np.array([x for x in returns if math.isfinite(x)])
    if len(scores) < 2:
        raise CannotMeasure("one run says nothing of what the seed decides; give more with --seeds")
    own = float(np.mean([one.score for one in case.greedy]))
    level, num = _level(case, [own, *scores]), len(scores)
    good = int((scores >= level).sum())
    needed = seeds_needed(good / num)
    said = (
        f"with {whose} {good} of {num} seeds return {level:.4g} or more, halfway from no skill to the best at hand "
        f"({', '.join(f'{x:.4g}' for x in np.sort(scores))})"
    )
    some = bool(0 < good < num and own < level)
    if some:
        said += f"; the subject returns {own:.4g}: of {needed} seeds one succeeds, 95 times in 100"
    return Finding(
        "X5", "the same settings succeed with some seeds only", "luck", "A", good / num, _exact_bounds(good, num), 1.0,
        "our own: more than none of the seeds and fewer than all", some, said,
        f"train {needed} seeds and keep the best, or change settings until all succeed, and compare those over seeds",
        f"neuralq train {case.world.name} --seeds {max(needed, 2)}  # with the settings as they were",
    )  # fmt: skip


def _level(case: Case, returns: Sequence[float]) -> float:
    """From which return on a run has succeeded; infinite where none does better than no skill."""
    groups = [case.chance, *case.constant.values()]
    without_skill = max(float(np.mean(x) + np.std(x)) for group in groups if (x := [one.score for one in group]))
    best = max(returns)
    return (without_skill + best) / 2 if best > without_skill else math.inf


def seeds_needed(share: float, chance: float = _CHANCE) -> int:
    """How many seeds have one that succeeds with this chance: ⌈ln(1 − chance) / ln(1 − share)⌉; 0 where none does.

    Example:
        >>> seeds_needed(0.5), seeds_needed(0.1), seeds_needed(1.0), seeds_needed(0.0)
        (5, 29, 1, 0)
    """
    if not 0 < share < 1:
        return int(share >= 1)
    return math.ceil(math.log(1 - chance) / math.log(1 - share))


def _exact_bounds(good: int, num: int) -> tuple[float, float]:
    """95 % of a share, by Clopper and Pearson (1934)."""
    from scipy.stats import binomtest

    found = binomtest(good, num).proportion_ci(0.95, "exact")
    return float(found.low), float(found.high)

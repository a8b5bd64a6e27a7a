"""Littman's maze as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.littman.oracle import best_policy, oracle
from neuralq.systems.littman.pictures import policy_picture, steps_picture
from neuralq.systems.littman.trainings import METHODS, Training, train

__all__ = ["BEST", "LITTMAN"]

TRACED, *PLAIN = METHODS
BEST = 416
"""Steps from all starts that the best policy of percepts takes; proved with every page."""
_NEAR = 420


def _contender(method: str) -> Callable[[np.random.SeedSequence, bool], Training]:
    return lambda seed, full: train(seed, method)


def _page(found: Mapping[str, tuple[Training, ...]], full: bool) -> ChapterPage:
    totals = {name: np.array([one.total for one in trainings]) for name, trainings in found.items()}
    best = min(found[TRACED], key=lambda one: one.total)
    return ChapterPage(
        "littman",
        "A maze in which cells look alike",
        "13.8",
        _text(totals, found),
        (_reached(totals), _without(totals), *_ours(found)),
        (
            policy_picture(best.policy, f"Sarsa(λ), in {best.total} steps,"),
            steps_picture(found, -46 * best_policy().value),
        ),
        source="Littman 1994; Loch & Singh 1998",
        measured=tuple(
            Measured(f"{name}: steps from all starts", tuple(values.tolist())) for name, values in totals.items()
        ),
        facts={
            "what is seen": "which of the 8 neighbouring cells are walls: 30 percepts of 46 cells",
            "constants": "α = .05, γ = .95, λ = .9 with replacing traces, ε from .2 to 0, −1 a step, at most 500 "
            "steps an episode",
            "length of a training": "1,000,000 steps",
        },
    )


def _text(totals: Mapping[str, np.ndarray], found: Mapping[str, tuple[Training, ...]]) -> tuple[str, ...]:
    at_best = int((totals[TRACED] == BEST).sum())
    num = len(totals[TRACED])
    lost = {name: f"{np.mean([one.num_lost for one in trainings]):.0f}" for name, trainings in found.items()}
    return (
        f"{'Reproduced' if _is_reproduced(totals) else 'Not reproduced with these seeds'}: {at_best} of {num} "
        f"trainings of Sarsa(λ) end with a policy that takes {BEST} steps from the 46 starts together, and no policy "
        "of percepts that always does the same takes fewer. Without traces none comes to 420.",
        "The learner does not see the cell, but which of the cells around it are walls, and 46 cells look like 30. Who "
        "sees the cell needs 404 steps from everywhere. What acts on percepts alone, without a memory, has to do the "
        f"same in all cells that look alike; branch and bound proves that {BEST} is the least it can need "
        f"({best_policy().num_bounds} bounds, a tenth of a second, though in general this is NP-hard).",
        "For values to be learned one step at a time, the value of what is seen next has to say what will come, and "
        "here it is an average over cells that are far apart. Sarsa(λ) with a long trace hardly asks it: it hands what "
        "an episode really cost to all that was done in it. One-step Sarsa and Q-learning believe the average, and "
        f"their policies never arrive from {lost['Sarsa(0)']} and {lost['Q(0)']} of the 46 starts in the mean.",
    )


def _is_reproduced(totals: Mapping[str, np.ndarray]) -> bool:
    few = all(not (totals[name] <= _NEAR).any() for name in PLAIN)
    return bool((totals[TRACED] == BEST).mean() >= 0.8 and few)


def _reached(totals: Mapping[str, np.ndarray]) -> Row:
    at_best = int((totals[TRACED] == BEST).sum())
    return published(
        "Sarsa(λ) finds the best policy of percepts",
        "the best, or a very good one",
        f"{at_best} of {len(totals[TRACED])} at {BEST}",
        at_best >= 0.8 * len(totals[TRACED]),
        "steps from the 46 starts together; from four fifths on it counts as agreeing",
    )


def _without(totals: Mapping[str, np.ndarray]) -> Row:
    near = {name: int((totals[name] <= _NEAR).sum()) for name in PLAIN}
    return published(
        f"Sarsa(0) and Q(0) come within {_NEAR} steps",
        "hardly ever",
        ", ".join(f"{name}: {count} of {len(totals[name])}" for name, count in near.items()),
        not any(near.values()),
    )


def _ours(found: Mapping[str, tuple[Training, ...]]) -> tuple[Row, ...]:
    return tuple(
        own(
            f"{name}: starts from which it never arrives",
            str(Measured("", tuple(one.num_lost for one in trainings))),
            f"of 46; {sum(one.num_lost == 0 for one in trainings)} of {len(trainings)} arrive from everywhere",
        )
        for name, trainings in found.items()
    )


LITTMAN = System(
    name="littman",
    environment="neuralq/LittmanMaze-v0",
    learner="neuralq.tabular:sarsa_lambda",
    contenders={method: _contender(method) for method in METHODS},
    baselines=tuple(PLAIN),
    oracle=oracle,
    page=_page,
    num_seeds=10,
    full_num_seeds=30,
)

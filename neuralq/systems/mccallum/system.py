"""McCallum's maze as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.mccallum.oracle import BEST, oracle
from neuralq.systems.mccallum.pictures import learning_picture, maze_picture, tree_picture
from neuralq.systems.mccallum.trials import NUM_LAST, Training, forgetful, train
from neuralq_envs.aliased import mccallum

__all__ = ["FEW", "MCCALLUM", "MOST_LEAVES", "mean_steps", "split_percepts"]

NSM, USM, SHORT, FORGETFUL = "NSM", "USM", "NSM, match 1", "Q-learning on percepts"
FEW, MOST_LEAVES = 1.2 * BEST, 40
_LOST = 5 * BEST


def _contender(
    learner: str, num_trials: int, full_num_trials: int
) -> Callable[[np.random.SeedSequence, bool], Training]:
    return lambda seed, full: train(seed, learner, full_num_trials if full else num_trials)


def mean_steps(trainings: tuple[Training, ...]) -> float:
    """Of the last trials, over seeds.

    Example:
        >>> mean_steps((Training(np.array([4, 6])), Training(np.array([4, 4]))))
        4.5
    """
    return float(np.mean([one.steps for one in trainings]))


def split_percepts(training: Training) -> set[int]:
    """Percepts that the tree tells apart by what came before.

    Example:
        >>> split_percepts(Training(np.zeros(1), leaves={(0,): np.zeros(4), (3, 1): np.zeros(4)}))
        {3}
    """
    return {suffix[0] for suffix in training.leaves if len(suffix) > 1}


def _ambiguous() -> set[int]:
    """Percepts whose cells need different moves: the strokes and the top."""
    return {int(mccallum().observation[cell]) for cell in (5, 1)}


def _page(found: Mapping[str, tuple[Training, ...]], full: bool) -> ChapterPage:
    steps = {name: mean_steps(trainings) for name, trainings in found.items()}
    remembered = {name: found[name] for name in (NSM, USM)}
    return ChapterPage(
        "mccallum",
        "A maze that needs a memory",
        "13.8",
        _text(steps, found),
        (*_near(steps), *_tree(found[USM]), _without(steps), *_ours(found)),
        (maze_picture(), tree_picture(found[USM][0]), learning_picture(remembered)),
        source="McCallum 1995",
        measured=(
            *(
                Measured(f"{name}: mean steps of the last trials", tuple(one.steps for one in trainings))
                for name, trainings in found.items()
            ),
            Measured(f"{USM}: leaves", tuple(len(one.leaves) for one in found[USM])),
        ),
        facts={
            "what is seen": "which of the 4 neighbouring cells are walls: 6 percepts of 11 cells",
            "rewards": "5 at the goal, −1 for a bump, −.1 for any other step; a trial is cut off after 200",
            "constants": "γ = .9, ε = .1, then 0 in the last 50 trials; NSM: 8 neighbours, α = .2; USM: p < 10⁻⁴, "
            "depth up to 4, a look at the fringe every 25 steps; Q-learning: α = .1, 40,000 steps",
        },
    )


def _is_reproduced(steps: Mapping[str, float], found: Mapping[str, tuple[Training, ...]]) -> bool:
    return (
        max(steps[NSM], steps[USM]) <= FEW
        and min(steps[SHORT], steps[FORGETFUL]) >= _LOST
        and all(split_percepts(one) == _ambiguous() for one in found[USM])
    )


def _text(steps: Mapping[str, float], found: Mapping[str, tuple[Training, ...]]) -> tuple[str, ...]:
    leaves = [len(one.leaves) for one in found[USM]]
    return (
        f"{'Reproduced' if _is_reproduced(steps, found) else 'Not reproduced with these seeds'}: two learners that "
        f"remember come to {steps[NSM]:.2f} (NSM) and {steps[USM]:.2f} steps (USM) in the mean, where 4.3 is the "
        f"best that memory can do; Q-learning on what is seen takes {steps[FORGETFUL]:.0f}, where a trial is cut off "
        "after 200.",
        "Eleven cells in the shape of an M look like six, for only the walls next to a cell are seen. In the three "
        "strokes one has to go up in the outer ones and down in the middle one, and at the top right or left. Nothing "
        "that is seen says which; where one came from does. Who remembers everything needs 4.3 steps, four tenths more "
        "than who sees the cell, since it does not know where it begins.",
        "Nearest sequence memory (NSM) keeps every moment, and asks those eight for a move that came about most like "
        "the present one. Utile suffix memory (USM) grows a tree over what came before, and only where values in a "
        "branch differ from the rest by more than chance: what looks alike and is worth the same, like the two feet, "
        f"is not told apart. It ends with {min(leaves)} to {max(leaves)} leaves.",
        "Allowed to look at the present percept only (match 1), NSM gets lost like Q-learning. So would any policy of "
        "percepts that always does the same; with the best coins it takes 8.03.",
    )


def _near(steps: Mapping[str, float]) -> tuple[Row, ...]:
    return tuple(
        published(
            f"{name} learns the maze",
            "it does",
            f"{steps[name]:.2f} steps",
            steps[name] <= FEW,
            f"mean of the last {NUM_LAST} trials over seeds; up to 1.2 times 4.3 counts as agreeing",
        )
        for name in (NSM, USM)
    )


def _tree(trainings: tuple[Training, ...]) -> tuple[Row, ...]:
    right = sum(split_percepts(one) == _ambiguous() for one in trainings)
    most = max(len(one.leaves) for one in trainings)
    return (
        published(
            "USM tells apart what needs different moves, and nothing else",
            "it does",
            f"{right} of {len(trainings)} trees",
            right == len(trainings),
        ),
        published("the tree stays small", f"at most {MOST_LEAVES} leaves", f"at most {most}", most <= MOST_LEAVES),
    )


def _without(steps: Mapping[str, float]) -> Row:
    return published(
        "without memory",
        "lost",
        ", ".join(f"{name}: {steps[name]:.0f}" for name in (SHORT, FORGETFUL)),
        min(steps[SHORT], steps[FORGETFUL]) >= _LOST,
        "mean steps of a trial; from 5 times 4.3 on it counts as agreeing",
    )


def _ours(found: Mapping[str, tuple[Training, ...]]) -> tuple[Row, ...]:
    rows = [
        own(
            f"{name}: steps of all trials until ten in a row take 6 or fewer",
            str(Measured("", tuple(one.learned_after(6.0) for one in found[name]))),
        )
        for name in (NSM, USM)
    ]
    return (*rows, *(own(f"{name}: mean steps", str(Measured("", tuple(one.steps for one in trainings))))
                     for name, trainings in found.items()))  # fmt: skip


MCCALLUM = System(
    name="mccallum",
    environment="neuralq/McCallumMaze-v0",
    learner="neuralq.tabular:UtileSuffixMemory",
    contenders={
        NSM: _contender(NSM, 200, 200),
        USM: _contender(USM, 200, 200),
        SHORT: _contender(SHORT, 75, 200),
        FORGETFUL: lambda seed, full: forgetful(seed),
    },
    baselines=(SHORT, FORGETFUL),
    oracle=oracle,
    page=_page,
    num_seeds=8,
    full_num_seeds=30,
)

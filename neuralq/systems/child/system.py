"""Ring's CHILD as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.child.lives import FROM_NOTHING_LIMIT, GOAL_ONLY, LIMIT, NO_GROWTH, Life, live
from neuralq.systems.child.oracle import oracle
from neuralq.systems.child.pictures import mazes_picture, steps_picture, tree_picture
from neuralq_envs.ring_mazes import NUM_MAZES

__all__ = ["CHILD", "MOST_STEPS", "steps_to_seven"]

LEARNER, NOTHING, BLIND, GOAL = "CHILD", "each maze from nothing", "without growth", "paid at the goal only"
MOST_STEPS = 80_000
_ENOUGH, _SEVEN, _LATE = 7, 7, 5
_SHARE = 0.75  # of the seeds
_FEW = 3  # units a maze


def _contender(**given: Any) -> Callable[[np.random.SeedSequence, bool], Life]:
    return lambda seed, full: live(seed, **given)


def steps_to_seven(life: Life) -> int:
    """Steps of the first seven mazes together.

    Example:
        >>> steps_to_seven(live(0, mazes=(1,), limit=1))
        2
    """
    return sum(life.steps[:_SEVEN])


def _solved(lives: tuple[Life, ...], maze: int) -> int:
    return sum(one.solved[maze - 1] for one in lives)


def _page(found: Mapping[str, tuple[Life, ...]], full: bool) -> ChapterPage:
    rows = _claims(found)
    return ChapterPage(
        "child",
        "Mazes that build on each other",
        "13.8",
        _text(found, all(row.verdict == "agrees" for row in rows[:4])),
        (*rows, *_ours(found)),
        (
            mazes_picture(),
            tree_picture(found[LEARNER][0]),
            steps_picture({name: found[name] for name in (LEARNER, NOTHING, BLIND)}),
        ),
        source="Ring 1994, 1997",
        measured=(
            *(
                Measured(f"{name}: mazes walked the shortest way, of 9", tuple(sum(one.solved) for one in lives))
                for name, lives in found.items()
            ),
            Measured(f"{LEARNER}: steps of mazes 1 to 7 together", tuple(map(steps_to_seven, found[LEARNER]))),
            *(
                Measured(f"{name}: units at the end", tuple(one.num_units[-1] for one in found[name]))
                for name in (LEARNER, GOAL)
            ),
        ),
        facts={
            "what is seen": "which of the 4 sides of the cell are walls, and the move before: one of 80 inputs",
            "constants": "−1 a step, γ = .97, ε-greedy .1, η = .15, σ = .03, θ = .7, ε = .75; paid at the goal only: "
            "γ = .91, η = .3, σ = .03, θ = .9, ε = .2",
            "a maze ends": f"when a walk without exploring, after every fifth trial, is the shortest; it is given up "
            f"after {LIMIT:,} steps, from nothing after {FROM_NOTHING_LIMIT:,}",
        },
    )


def _text(found: Mapping[str, tuple[Life, ...]], held: bool) -> tuple[str, ...]:
    solved = {name: Measured("", tuple(sum(one.solved) for one in lives)) for name, lives in found.items()}
    third, ninth = (np.median([one.steps[maze - 1] for one in found[LEARNER]]) for maze in (3, NUM_MAZES))
    return (
        f"{'Reproduced' if held else 'Not reproduced with these seeds'}: who meets nine mazes one after the other "
        f"walks {solved[LEARNER]} of them the shortest way, who begins each from nothing {solved[NOTHING]}, though it "
        f"is given three times as long, and who cannot grow {solved[BLIND]}.",
        "The mazes look alike almost everywhere, so that the next move depends on what was seen moments ago. A "
        "temporal transition hierarchy is a linear network, one output for each move, that finds this out: a weight "
        "that is told now this and now that is given a unit, whose value of the moment before is added to it, and "
        "whose weights may be given units in turn. A context of k moments is a chain of k units, and no more is "
        "remembered than was asked for.",
        "Each maze is the one before with a corridor more in front. What was learned is not unlearned, since what is "
        f"new is told apart by new units: the third maze takes {third:,.0f} steps in the median, the ninth "
        f"{ninth:,.0f}. From nothing the goal of a long maze is hardly ever found, and what is worth remembering never "
        "shows: the gain is one of exploring as much as one of memory.",
    )


def _claims(found: Mapping[str, tuple[Life, ...]]) -> tuple[Row, ...]:
    lives, nothing, blind = found[LEARNER], found[NOTHING], found[BLIND]
    enough = sum(sum(one.solved) >= _ENOUGH for one in lives)
    soon = sum(one.solved[_SEVEN - 1] and steps_to_seven(one) <= MOST_STEPS for one in lives)
    beyond = sum(sum(one.solved[2:]) for one in blind)
    late, their_late = (sum(sum(one.solved[_LATE - 1 :]) for one in some) for some in (lives, nothing))
    num_late = (NUM_MAZES - _LATE + 1) * len(lives)
    few = [[one.num_units[-1] for one in found[name]] for name in (LEARNER, GOAL)]
    return (
        published(
            f"lives in which at least {_ENOUGH} of 9 mazes are walked the shortest way",
            "all mazes are learned",
            f"{enough} of {len(lives)}",
            enough >= _SHARE * len(lives),
            "from three quarters on it counts as agreeing",
        ),
        published(
            f"lives in which the first {_SEVEN} take at most {MOST_STEPS:,} steps together",
            "",
            f"{soon} of {len(lives)}",
            soon >= _SHARE * len(lives),
            "the same",
        ),
        published(
            f"mazes {_LATE} to 9 walked the shortest way, one after the other and from nothing",
            "hard or impossible from nothing",
            f"{late} and {their_late} of {num_late}",
            their_late <= 0.25 * late,
            "from four times as many on it counts as agreeing",
        ),
        published("without growth: mazes beyond the second", "none", f"{beyond}", beyond == 0, "the control"),
        published(
            "units at the end, one after the other, and paid at the goal only",
            f"fewer than {_FEW} a maze",
            f"{np.median(few[0]):g} and {np.median(few[1]):g}",
            bool(np.median(few[0]) < _FEW * NUM_MAZES),
            "medians; in mazes of ours, not Ring's",
        ),
    )


def _ours(found: Mapping[str, tuple[Life, ...]]) -> tuple[Row, ...]:
    rows = [
        own(
            f"{name}: lives that walk maze 1, 2, …, 9 the shortest way",
            ", ".join(str(_solved(lives, maze)) for maze in range(1, NUM_MAZES + 1)),
            f"of {len(lives)}",
        )
        for name, lives in found.items()
    ]
    units = [[one.num_units[maze] for one in found[GOAL] if sum(one.solved) == NUM_MAZES] for maze in (6, 8)]
    if units[0]:
        rows.append(
            own(
                f"{GOAL}, lives that walk all nine: units after maze 7, and 9",
                ", ".join(f"{np.median(one):g}" for one in units),
                f"medians of {len(units[0])} lives",
            )
        )
    return tuple(rows)


CHILD = System(
    name="child",
    environment="neuralq/RingMaze-v0",
    learner="neuralq.tabular:hierarchy_learn",
    contenders={
        LEARNER: _contender(),
        NOTHING: _contender(from_nothing=True, limit=FROM_NOTHING_LIMIT),
        BLIND: _contender(settings=NO_GROWTH),
        GOAL: _contender(settings=GOAL_ONLY),
    },
    baselines=(NOTHING, BLIND),
    oracle=oracle,
    page=_page,
    num_seeds=20,
    full_num_seeds=100,
)

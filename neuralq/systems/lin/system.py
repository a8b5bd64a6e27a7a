"""Lin's world as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.lin.kernels import ACTOR_CRITIC, PLANNING, RANDOM, TEACHER, Rates
from neuralq.systems.lin.oracle import oracle
from neuralq.systems.lin.pictures import film_picture, learning_picture
from neuralq.systems.lin.trainings import NUM_PLAYS, Settings, Training, baseline, train

__all__ = ["CONTENDERS", "EARLY", "LIN", "early_food", "last_food"]

QCON, REPLAY, TAUGHT, MODEL = "QCON", "QCON-R", "QCON-T", "QCON-M"
UNFILTERED, SEPARATE, UNTURNED = "QCON-R, nothing passed over", "QCON-R, a net for each action", "QCON-R, no rotation"
CRITIC, CRITIC_REPLAY = "AHCON", "AHCON-R"
TEACHING, RANDOMLY = "the teacher", "random moves"
EARLY = 50
"""Plays after which teaching and replay are compared."""
_AGAIN, _TAUGHT_AGAIN = (12, 4), (6, 2)

CONTENDERS = {
    QCON: Settings(),
    REPLAY: Settings(replays=_AGAIN),
    TAUGHT: Settings(replays=_AGAIN, taught_replays=_TAUGHT_AGAIN),
    MODEL: Settings(PLANNING),
    CRITIC: Settings(ACTOR_CRITIC),
    CRITIC_REPLAY: Settings(ACTOR_CRITIC, replays=_AGAIN),
    UNFILTERED: Settings(replays=_AGAIN, rates=Rates(least_chance=0.0)),
    SEPARATE: Settings(replays=_AGAIN, turned=False, shared=False),
    UNTURNED: Settings(replays=_AGAIN, turned=False),
}
_FASTER, _BETTER, _GOOD, _PASSING = 1.3, 1.2, 11.0, 0.5  # what counts as agreeing


def _contender(settings: Settings) -> Callable[[np.random.SeedSequence, bool], Training]:
    return lambda seed, full: train(seed, settings)


def _baseline(kind: int) -> Callable[[np.random.SeedSequence, bool], Training]:
    return lambda seed, full: baseline(seed, kind)


def early_food(trainings: tuple[Training, ...]) -> float:
    """Food of the test after 50 plays, mean over seeds.

    Example:
        >>> early_food((Training(np.array([25, 50]), np.array([1.0, 5.0])),))
        5.0
    """
    return float(np.mean([one.at(EARLY) for one in trainings]))


def last_food(trainings: tuple[Training, ...]) -> float:
    """Food of the last four tests, mean over seeds.

    Example:
        >>> last_food((Training(np.arange(5), np.array([0.0, 4.0, 4.0, 6.0, 6.0])),))
        5.0
    """
    return float(np.mean([one.last for one in trainings]))


def _page(found: Mapping[str, tuple[Training, ...]], full: bool) -> ChapterPage:
    early = {name: early_food(found[name]) for name in CONTENDERS}
    last = {name: last_food(trainings) for name, trainings in found.items()}
    shown = {name: found[name] for name in (QCON, REPLAY, TAUGHT, CRITIC, SEPARATE, TEACHING, RANDOMLY)}
    return ChapterPage(
        "lin",
        "To eat and not to be eaten",
        "13.8",
        _text(early, last),
        (*_claims(early, last), *_ours(found)),
        (film_picture(found[REPLAY]), learning_picture(shown)),
        source="Lin 1992",
        measured=(
            *(
                Measured(f"{name}: food after {EARLY} plays", tuple(one.at(EARLY) for one in found[name]))
                for name in CONTENDERS
            ),
            *(
                Measured(f"{name}: food, last four tests", tuple(one.last for one in trainings))
                for name, trainings in found.items()
            ),
        ),
        facts={
            "what is seen": "145 bits: food 52, enemies 32, obstacles 40, energy 16, last action 4, bumped 1",
            "rewards": ".4 for food, −1 for being caught or starving",
            "network": "145-30-1, tanh(z/2), for all actions; weights within ±.1 at first",
            "constants": "α = .3 (merits .2, critic .1), γ = .9, softmax of temperature 1/20 falling to 1/60 over "
            f"{NUM_PLAYS} plays; tests of 50 plays every 25",
            "replay": "12 lessons after the first play, 4 after the last, of the latest 100, the later the likelier; "
            "actions of a probability under .01 are passed over; teaching: 10 lessons, 6 falling to 2 replays more",
        },
    )


def _is_reproduced(early: Mapping[str, float], last: Mapping[str, float]) -> bool:
    return (
        early[REPLAY] >= _FASTER * early[QCON]
        and early[TAUGHT] >= early[REPLAY]
        and last[REPLAY] >= max(last[QCON] + _BETTER, _GOOD)
    )


def _text(early: Mapping[str, float], last: Mapping[str, float]) -> tuple[str, ...]:
    return (
        f"{'Reproduced' if _is_reproduced(early, last) else 'Not reproduced with these seeds'}: replay makes learning "
        f"faster and better, and teaching makes it faster still. After {EARLY} plays QCON eats {early[QCON]:.1f} of "
        f"15, with replay {early[REPLAY]:.1f}, and with ten lessons of a teacher {early[TAUGHT]:.1f}; in the end "
        f"{last[QCON]:.1f}, {last[REPLAY]:.1f} and {last[TAUGHT]:.1f}. The teacher eats {last[TEACHING]:.1f}, who "
        f"moves at random {last[RANDOMLY]:.1f}.",
        "The agent sees some of what is around it, pays an energy for every step, and gains fifteen with every meal; "
        "four enemies come nearer, the surer the closer they are. One network judges all four moves: it is shown the "
        "world turned so that the move points north, so what was learned of one direction holds for all.",
        "After each play some of the latest hundred are lived through again, from the end to the beginning, so that "
        "what an action led to reaches those before it at once. Actions that the present policy would hardly take are "
        f"passed over; without that, replay ends at {last[UNFILTERED]:.1f}. A network for each action, without "
        f"rotation, comes to {last[SEPARATE]:.1f}; one network without rotation cannot tell moves apart and ends at "
        f"{last[UNTURNED]:.1f}.",
        "Lin also lets the agent learn a model of what enemies do, and learn from what other actions would have led "
        f"to. Here that {'gains' if _models_gain(early, last) else 'does not gain what he reports'}: "
        f"{early[MODEL]:.1f} after {EARLY} plays and {last[MODEL]:.1f} in the end, although the agent is told where "
        "enemies stand. The actor-critic learns more slowly and stops earlier than Q-learning "
        f"({last[CRITIC]:.1f}, with replay {last[CRITIC_REPLAY]:.1f}).",
    )


def _models_gain(early: Mapping[str, float], last: Mapping[str, float]) -> bool:
    return early[MODEL] >= _FASTER * early[QCON] and last[MODEL] >= last[QCON]


def _claims(early: Mapping[str, float], last: Mapping[str, float]) -> tuple[Row, ...]:
    def said(figures: Mapping[str, float], one: str, other: str) -> str:
        return f"{figures[one]:.2f} against {figures[other]:.2f}"

    return (
        published(
            f"replay, after {EARLY} plays", "faster", said(early, REPLAY, QCON),
            early[REPLAY] >= _FASTER * early[QCON],
            f"food of 15, means over seeds; {early[REPLAY] / early[QCON]:.2f} times, from {_FASTER} on it agrees",
        ),
        published(
            f"teaching, after {EARLY} plays", "faster still", said(early, TAUGHT, REPLAY),
            early[TAUGHT] >= early[REPLAY],
        ),
        published(
            "replay, last four tests", "better", said(last, REPLAY, QCON), last[REPLAY] >= last[QCON] + _BETTER,
            f"from {_BETTER} more on it agrees",
        ),
        published("replay eats most of it", "it does", f"{last[REPLAY]:.2f}", last[REPLAY] >= _GOOD, f"from {_GOOD:g}"),
        published(
            "passing over what would hardly be done, last four tests", "needed", said(last, REPLAY, UNFILTERED),
            last[REPLAY] >= last[UNFILTERED] + _PASSING, f"from {_PASSING} more on it agrees",
        ),
        published(
            "one network that turns against one for each action", "better", said(last, REPLAY, SEPARATE),
            last[REPLAY] >= last[SEPARATE] + _BETTER, f"from {_BETTER} more on it agrees",
        ),
        published(
            "one network without rotation", "cannot learn", f"{last[UNTURNED]:.2f}", last[UNTURNED] <= last[RANDOMLY],
            "the control: no more than by moving at random",
        ),
        published(
            f"action models, after {EARLY} plays and in the end", "faster",
            f"{said(early, MODEL, QCON)}, {said(last, MODEL, QCON)}", _models_gain(early, last),
            f"from {_FASTER} times on, and no worse in the end, it agrees",
        ),
    )  # fmt: skip


def _ours(found: Mapping[str, tuple[Training, ...]]) -> tuple[Row, ...]:
    rows = [
        own(f"{name}: food after {EARLY} plays", str(Measured("", tuple(one.at(EARLY) for one in found[name]))))
        for name in CONTENDERS
    ]
    return (
        *rows,
        *(
            own(f"{name}: food, last four tests" if name in CONTENDERS else f"{name}: food",
                str(Measured("", tuple(one.last for one in trainings))))
            for name, trainings in found.items()
        ),
    )  # fmt: skip


LIN = System(
    name="lin",
    environment="neuralq/LinWorld-v0",
    learner="neuralq.learners:turned_q_update",
    contenders={
        **{name: _contender(settings) for name, settings in CONTENDERS.items()},
        TEACHING: _baseline(TEACHER),
        RANDOMLY: _baseline(RANDOM),
    },
    baselines=(UNTURNED, TEACHING, RANDOMLY),
    oracle=oracle,
    page=_page,
    num_seeds=6,
    full_num_seeds=30,
)

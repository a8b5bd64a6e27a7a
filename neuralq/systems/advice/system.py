"""Advice as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.advice.oracle import oracle
from neuralq.systems.advice.pictures import curve_picture, film_picture
from neuralq.systems.advice.rules import BAD, GOOD, Advice
from neuralq.systems.advice.studies import NUM_HIDDEN, Study, study

__all__ = ["ADVICE", "difference"]

NONE, FIRST, EARLY, LATE = "no advice", "all rules, at the start", "all rules, after 2,000", "all rules, after 4,000"
BAD_FIRST, BAD_LATE, UNITS = "bad advice, at the start", "bad advice, after 4,000", "20 random units more"
BESIDE, FARTHER = "rules on what is beside", "rules on what is farther"
_SHOWN = (NONE, FIRST, EARLY, LATE, BAD_FIRST, BAD_LATE, UNITS)
_NAMES = tuple(GOOD)
_ENOUGH, _UNLEARNED = 0.9, 0.05


def _contender(
    advice: Advice | None = None, told_at: int = 0, num_hidden: int = NUM_HIDDEN
) -> Callable[[np.random.SeedSequence, bool], Study]:
    return lambda seed, full: study(seed, advice, told_at=told_at, num_hidden=num_hidden)


def difference(one: tuple[Study, ...], other: tuple[Study, ...]) -> tuple[float, float]:
    """By how much the mean return of the last quarter differs, and the standard error of that.

    Example:
        >>> made = study(np.random.SeedSequence(0), num_games=10, test_every=10)
        >>> difference((made, made), (made, made))
        (0.0, 0.0)
    """
    late = [np.array([study.late for study in studies]) for studies in (one, other)]
    error = np.sqrt(sum(x.var(ddof=1) / len(x) if len(x) > 1 else np.inf for x in late))
    return float(late[0].mean() - late[1].mean()), float(error)


def _mean(studies: tuple[Study, ...]) -> float:
    return float(np.mean([one.late for one in studies]))


def _followed(studies: tuple[Study, ...], last: bool = False) -> float:
    return float(np.mean([one.followed[last] for one in studies]))


def _page(found: Mapping[str, tuple[Study, ...]], full: bool) -> ChapterPage:
    claims = _claims(found)
    return ChapterPage(
        "advice",
        "Advice that becomes part of the network",
        "13.8",
        _text(found, claims),
        (*claims, *_ours(found)),
        (film_picture(found[FIRST][0]), curve_picture({name: found[name] for name in _SHOWN})),
        source="Maclin & Shavlik 1996",
        measured=tuple(
            Measured(f"{name}: return in the last quarter of training", tuple(one.late for one in studies))
            for name, studies in found.items()
        ),
        facts={
            "game": "7 x 7 cells, 8 blocks, 5 pieces of food, 2 enemies; 44 inputs; 4 moves, 4 pushes; up to 60 steps",
            "rewards": "food 1, an enemy crushed .9, caught −1",
            "learner": "44 inputs, 20 sigmoid units, 8 outputs; one-step Q-learning, α = .05, γ = .9, softmax of "
            "temperature .3 to .05 over four fifths of 8,000 games",
            "rules": f"16 units: for each direction {'; '.join(_NAMES)}",
            "tests": "the same 200 greedy games every 500 games, for everybody",
        },
    )


def _claims(found: Mapping[str, tuple[Study, ...]]) -> tuple[Row, ...]:
    none = found[NONE]
    return (
        *(_gain(f"{name}: return in the last quarter", found[name], none) for name in (FIRST, EARLY, LATE)),
        published(
            "told after 4,000 games: states in which the advised action is at once the best",
            "advice is followed",
            f"{_followed(found[LATE]):.2f}",
            _followed(found[LATE]) >= _ENOUGH,
            f"of the states for which rules name one action; from {_ENOUGH:g} on it counts as agreeing",
        ),
        *(_unlearned(f"{name}: return in the last quarter", found[name], none) for name in (BAD_FIRST, BAD_LATE)),
        _no_gain(found),
    )


def _against(studies: tuple[Study, ...], none: tuple[Study, ...]) -> str:
    gain, error = difference(studies, none)
    return f"{_mean(studies):.2f} against {_mean(none):.2f} ({gain:+.2f}, standard error {error:.2f})"


def _gain(what: str, studies: tuple[Study, ...], none: tuple[Study, ...]) -> Row:
    gain, error = difference(studies, none)
    return published(
        what, "more, at any stage", _against(studies, none), gain >= 2 * error, "more by two standard errors or above"
    )


def _unlearned(what: str, studies: tuple[Study, ...], none: tuple[Study, ...]) -> Row:
    share = _mean(studies) / _mean(none) - 1
    return published(
        what, "soon overcome", _against(studies, none), abs(share) <= _UNLEARNED, f"{share:+.1%} of what nobody told"
    )


def _no_gain(found: Mapping[str, tuple[Study, ...]]) -> Row:
    gain, error = difference(found[UNITS], found[NONE])
    return published(
        f"{UNITS}: return in the last quarter",
        "it is not the units",
        _against(found[UNITS], found[NONE]),
        gain < 2 * error,
        "the control that must fail: as many units and more, that say nothing",
    )


def _when(late: tuple[Study, ...]) -> int:
    """The test at which these were told."""
    return int(np.searchsorted(late[0].games, late[0].told_at or 0))


def _text(found: Mapping[str, tuple[Study, ...]], claims: tuple[Row, ...]) -> tuple[str, ...]:
    held = all(row.verdict == "agrees" for row in claims)
    first, late = difference(found[FIRST], found[NONE])[0], difference(found[LATE], found[NONE])[0]
    early = [np.mean([one.returns[1:5].mean() for one in found[name]]) for name in (FIRST, NONE)]
    told = {name: np.mean([one.returns[_when(found[LATE])] for one in found[name]]) for name in (NONE, LATE, BAD_LATE)}
    return (
        f"{'Reproduced' if held else 'Not reproduced with these seeds'}: who is told 16 plain rules plays better for "
        f"good, whenever that is. In the last quarter of 8,000 games it is {first:+.2f} for who was told at the start "
        f"and {late:+.2f} for who was told after 4,000 games, on {_mean(found[NONE]):.2f} without advice.",
        "A rule becomes one more unit of the network: weights from the inputs that it names, such that the unit says "
        ".95 where all its conditions hold and at most .05 where one fails, and a weight of 1 to the action that it "
        "advises. From then on it learns as all others do: what is right is sharpened, what is wrong loses its weight, "
        "or changes its sign.",
        f"The gain is largest at first: over games 500 to 2,000 the mean return is {early[0]:.2f}, against "
        f"{early[1]:.2f}. Just told, a network that has learned for 4,000 games does what it is told in "
        f"{_followed(found[LATE]):.2f} of the states, one with weights drawn at random in "
        f"{_followed(found[FIRST]):.2f}. At the end it is {_followed(found[LATE], True):.2f} and "
        f"{_followed(found[FIRST], True):.2f}: the rules are not always right. Nor are all of use: those on what is "
        f"farther away come to {_mean(found[FARTHER]):.2f} alone, those on what is beside the player to "
        f"{_mean(found[BESIDE]):.2f}; that much is soon found out without advice.",
        f"Told after 4,000 games, play goes from {told[NONE]:.2f} to {told[LATE]:.2f} before anything more is learned. "
        f"Bad advice, to leave food alone and to walk into enemies, takes it to {told[BAD_LATE]:.2f} and is unlearned.",
    )


def _ours(found: Mapping[str, tuple[Study, ...]]) -> tuple[Row, ...]:
    worth = {name: np.mean([one.worth[name] for one in found[FIRST]]) for name in GOOD}
    wrong = {name: np.mean([one.worth[name] for one in found[BAD_FIRST]]) for name in BAD}
    return (
        *(
            own(f"{name}: return in the last quarter", _against(found[name], found[NONE]), "one kind of rules alone")
            for name in (BESIDE, FARTHER)
        ),
        *(
            own(f"worth of a rule at the end, 1 at first: {name}", f"{value:.2f}")
            for name, value in (worth | wrong).items()
        ),
        *(
            own(
                f"{name}: states in which the advised action is the best one",
                f"{_followed(found[name]):.2f}, {_followed(found[name], True):.2f}",
                "just after insertion, and at the end",
            )
            for name in (FIRST, EARLY, LATE)
        ),
    )


ADVICE = System(
    name="advice",
    environment="neuralq/Pengo-v0",
    learner="neuralq.q:insert_rules",
    contenders={
        NONE: _contender(),
        FIRST: _contender(GOOD),
        EARLY: _contender(GOOD, 2000),
        LATE: _contender(GOOD, 4000),
        BAD_FIRST: _contender(BAD),
        BAD_LATE: _contender(BAD, 4000),
        UNITS: _contender(num_hidden=NUM_HIDDEN + 20),
        BESIDE: _contender({name: GOOD[name] for name in _NAMES[:2]}),
        FARTHER: _contender({name: GOOD[name] for name in _NAMES[2:]}),
    },
    baselines=(NONE, UNITS),
    oracle=oracle,
    page=_page,
    num_seeds=16,
    full_num_seeds=100,
)

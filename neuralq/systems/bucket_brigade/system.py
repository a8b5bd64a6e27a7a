"""The bucket brigade, as a chain and in ZCS, as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.bucket_brigade.lives import Life, best_moves, live, random_life
from neuralq.systems.bucket_brigade.oracle import oracle, shortest_steps
from neuralq.systems.bucket_brigade.pictures import chain_picture, curve_picture, woods_picture
from neuralq.tabular import ZcsRates

__all__ = ["BUCKET_BRIGADE"]

_RATES = {"ZCS": ZcsRates(), "no tax": ZcsRates(tax=0.0), "no breeding": ZcsRates(breeding=0.0)}
LEARNER, NO_TAX, NO_BREEDING = _RATES
RANDOM = "random moves"
_MOST, _LEAST = 3.6, 4.5  # steps: with all its parts, and without the tax
_NUM_PROBLEMS, _FULL_PROBLEMS = 10_000, 30_000


def _contender(rates: ZcsRates) -> Callable[[np.random.SeedSequence, bool], Life]:
    return lambda seed, full: live(seed, rates, _FULL_PROBLEMS if full else _NUM_PROBLEMS)


def _random(seed: np.random.SeedSequence, full: bool) -> Life:
    return random_life(seed, _FULL_PROBLEMS if full else _NUM_PROBLEMS)


def _page(found: Mapping[str, tuple[Life, ...]], full: bool) -> ChapterPage:
    late = {
        name: Measured(f"{name}: steps to food, last tenth of the problems", tuple(one.late for one in lives))
        for name, lives in found.items()
    }
    shortest = shortest_steps()
    return ChapterPage(
        "bucket-brigade",
        "Rules that pay each other",
        "13.8",
        _text(late),
        (*_claims(late), *_ours(found)),
        (chain_picture(), woods_picture(found[LEARNER][0]), curve_picture(found, shortest)),
        source="Holland 1986; Wilson 1994",
        measured=tuple(late.values()),
        facts={
            "Woods1": "5 x 5 cells that repeat themselves; two bits for each of the 8 cells around; 8 moves, food 1000",
            "ZCS": "400 classifiers, S = 20, β = .2, γ = .71, τ = .1, χ = .5, μ = .002, ρ = .25, φ = .5, blind to a "
            "third of the bits",
            "problems": f"{len(found[LEARNER][0].steps):,}, each from a free cell",
        },
    )


def _text(late: Mapping[str, Measured]) -> tuple[str, ...]:
    learned, untaxed = late[LEARNER], late[NO_TAX]
    held = learned.median <= _MOST and untaxed.median >= _LEAST
    return (
        f"{'Reproduced' if held else 'Not reproduced with these seeds'}: in the end ZCS takes {learned} steps to its "
        f"food, where the shortest ways have 1.69 and random moves take {late[RANDOM]}. Without the tax on those that "
        f"match and are not listened to it takes {untaxed}.",
        "Holland's classifiers are rules that bid for being used. Who is used pays its bid to those that were used "
        "just before, and lives on what the next ones pay; only the last rule before a reward is paid by the world. "
        "With V = b S that is TD(0): in a chain of rules the bids are known in closed form, and a long chain "
        "needs about n / b passes until its first rule hears of the reward.",
        "ZCS is Wilson's simplest system that learns by it. Rules look at some of the bits that an animal sees; the "
        "strong ones have children, and what a rule is worth is all that decides what is done. What holds it together "
        "is the tax: rules that would do something else lose strength whenever they match, so that the best move in a "
        "place pulls away from the others.",
    )


def _claims(late: Mapping[str, Measured]) -> tuple[Row, ...]:
    return (
        published(
            "steps to food, last tenth of the problems, median [95 %]",
            "near the optimum, not at it",
            str(late[LEARNER]),
            late[LEARNER].median <= _MOST,
            f"near: at most {_MOST:g}; the shortest ways have 1.69",
        ),
        published(
            "the same without the tax",
            "worse",
            str(late[NO_TAX]),
            late[NO_TAX].median >= _LEAST,
            f"the control: at least {_LEAST:g}",
        ),
    )


def _ours(found: Mapping[str, tuple[Life, ...]]) -> tuple[Row, ...]:
    rows = []
    for name in _RATES:
        first, second = (
            np.mean([one.steps[part].mean() for one in found[name]]) for part in (slice(50), slice(500, 1000))
        )
        best = Measured("", tuple(best_moves(one.moves) for one in found[name]))
        rows.append(own(f"{name}: steps, first 50 problems, and 500 to 1,000", f"{first:.1f}, {second:.2f}"))
        rows.append(own(f"{name}: cells of 16 whose strongest move is on a shortest way", str(best)))
    return tuple(rows)


BUCKET_BRIGADE = System(
    name="bucket-brigade",
    environment="neuralq/Woods1-v0",
    learner="neuralq.tabular:zcs_update",
    contenders={**{name: _contender(rates) for name, rates in _RATES.items()}, RANDOM: _random},
    baselines=(NO_TAX, NO_BREEDING, RANDOM),
    oracle=oracle,
    page=_page,
    num_seeds=8,
    full_num_seeds=30,
)

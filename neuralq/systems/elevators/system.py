"""Elevators as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.elevators.contenders import BASELINES, CONTENDERS, CONTROLS, LEARNED, NAMES, Outcome
from neuralq.systems.elevators.controllers import ALWAYS_STOP, HUFF, LQF, SECTOR_TOP
from neuralq.systems.elevators.oracle import oracle
from neuralq.systems.elevators.pictures import bars_picture, curve_picture, film

__all__ = ["ELEVATORS"]

Found = Mapping[str, tuple[Outcome, ...]]


def _ratio(found: Found, name: str) -> float:
    """Squared wait of the network over that of a rule of thumb in the same hours: the median of the seeds."""
    pairs = zip(found[LEARNED], found[name], strict=True)
    return float(np.median([ours.waits.squared / theirs.waits.squared for ours, theirs in pairs]))


def _better_hours(found: Found, name: str) -> tuple[int, int]:
    """In how many hours fewer seconds squared were waited, and of how many."""
    pairs = zip(found[LEARNED], found[name], strict=True)
    better = np.concatenate([ours.waits.squared_by_hour < theirs.waits.squared_by_hour for ours, theirs in pairs])
    return int(better.sum()), len(better)


def _page(found: Found, full: bool) -> ChapterPage:
    squared = {
        name: Measured(f"{name}: mean squared wait (s²)", _each(ones, "squared")) for name, ones in found.items()
    }
    average = {name: Measured(f"{name}: mean wait (s)", _each(ones, "average")) for name, ones in found.items()}
    long = {
        name: Measured(f"{name}: waits above a minute (%)", _each(ones, "long_percent")) for name, ones in found.items()
    }
    learned = found[LEARNED][0]
    return ChapterPage(
        "elevators",
        "Four elevators that learn to share a building",
        "13.8",
        _text(found),
        (*_claims(found), *_ours(found, squared)),
        (film(learned), bars_picture(found), curve_picture(found)),
        source="Crites & Barto 1996",
        measured=(*squared.values(), *average.values(), *long.values()),
        facts={
            "what is seen": "47 numbers: calls and how old they are, where the deciding car is, where the others are",
            "what is learned from": f"{learned.num_hours:,} simulated hours, of 400 different ones",
            "constants": "one 47-20-2 network, β = .01 per second, α .02 to .001, T .3 to .003, errors within ±.1",
        },
    )


def _each(outcomes: Sequence[Outcome], what: str) -> tuple[float, ...]:
    return tuple(float(getattr(one.waits, what)) for one in outcomes)


def _wins(found: Found) -> bool:
    return all(_ratio(found, NAMES[rule]) < 1 for rule in (LQF, HUFF, SECTOR_TOP))


def _text(found: Found) -> tuple[str, ...]:
    ratio, (better, hours) = _ratio(found, NAMES[LQF]), _better_hours(found, NAMES[LQF])
    verdict = "Reproduced: " if _wins(found) else "Not reproduced with these seeds: "
    return (
        f"{verdict}mean squared waits are {ratio:.2f} times those of the best rule of thumb, which sends each rising "
        f"car to the call that has waited longest, and lower in {better} of {hours} hours that the network had never "
        "seen.",
        "It is the hour when everybody goes home: four cars, ten floors, 756 people expected. Cars stop where somebody "
        "leaves, never turn with people aboard, and never stop beside another car. What is left to decide is whether "
        "to stop for a call that could be served, or to leave it to others.",
        "Actions last, each for another time, so this is a semi-Markov decision process: a decision is worth what "
        "waiting costs until the same car decides again, plus what that car expects then, discounted by e^(−βτ) for "
        "the τ seconds in between. All cars learn one function, each from its own decisions, and what the others do is "
        "part of the world.",
        "Waiting costs its square, so an hour of congestion asks for values a hundred times as large as all others. "
        f"That is why errors are clipped. {_faults(found)}",
        "A car that always stops gathers whoever waits on the lowest floors and hardly ever comes to the top: stopping "
        "helps whoever is in front of it, going on helps everybody.",
    )


def _faults(found: Found) -> str:
    """What became of the learners with a planted fault."""
    stopping = np.array(_each(found[NAMES[ALWAYS_STOP]], "squared"))
    said = []
    for name in CONTROLS:
        failed = int((np.array(_each(found[name], "squared")) > 0.8 * stopping).sum())
        said.append(f"{name}: {failed} of {len(stopping)} trainings")
    return f"With a planted fault, they end no better than always stop: {'; '.join(said)}."


def _claims(found: Found) -> tuple[Row, ...]:
    lqf, huff, sector = (NAMES[rule] for rule in (LQF, HUFF, SECTOR_TOP))
    ratios = [f"{_ratio(found, name):.2f}" for name in (lqf, huff, sector)]
    in_hours = ", ".join("{} of {}".format(*_better_hours(found, name)) for name in (lqf, huff, sector))
    theirs, ours = (float(np.median(_each(found[name], "squared"))) for name in (lqf, huff))
    return (
        published(
            f"squared wait, against {lqf}, {huff}, {sector}",
            "below 1",
            ", ".join(ratios),
            _wins(found),
            f"medians over seeds; lower in {in_hours} hours",
        ),
        published(
            f"by as much, against {lqf}",
            "0.59",
            ratios[0],
            _ratio(found, lqf) <= 0.6,
            "their network had learned from 60,000 hours, and in their own simulator",
        ),
        published(f"{lqf} waits less than {huff} (their basic one)", "0.92", f"{theirs / ours:.2f}", theirs < ours),
    )


def _ours(found: Found, squared: Mapping[str, Measured]) -> tuple[Row, ...]:
    """Each contender in a line."""
    rows = []
    for name, outcomes in found.items():
        middle, long = (float(np.median(_each(outcomes, what))) for what in ("average", "long_percent"))
        note = f"squared wait {squared[name]}"
        if outcomes[0].training is not None:
            errors = np.median([one.training.td_error for one in outcomes if one.training is not None])
            note += f"; {outcomes[0].num_hours:,} hours of learning, mean |TD error| {errors:.2g} in the end"
        rows.append(own(name, f"{squared[name].median:,.0f} s², {middle:.1f} s, {long:.1f} %", note))
    return (own("mean squared wait, mean wait, waits above a minute", "medians over seeds"), *rows)


ELEVATORS = System(
    name="elevators",
    environment="neuralq/Elevators-v0",
    learner="neuralq.learners:smdp_network_update",
    contenders=CONTENDERS,
    baselines=BASELINES,
    oracle=oracle,
    page=_page,
    num_seeds=5,
    full_num_seeds=10,
)

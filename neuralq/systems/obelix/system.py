"""OBELIX as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.obelix.lives import GENERALISERS, Life, spend
from neuralq.systems.obelix.oracle import oracle
from neuralq.systems.obelix.pictures import curve_picture, film_picture

__all__ = ["OBELIX", "mean_share"]

_FULL_STEPS = 20_000
_LEARNERS = {
    f"{control}, {generaliser}": (control, generaliser)
    for generaliser in GENERALISERS
    for control in ("monolith", "behaviours")
}
HAND, RANDOM = "by hand", "random moves"


def mean_share(lives: tuple[Life, ...]) -> float:
    """The mean over seeds of how many steps of the last quarter pushed.

    Example:
        >>> mean_share((spend(0, "random", num_steps=400),)) < 0.2
        True
    """
    return float(np.mean([life.share for life in lives]))


def _contender(control: str, generaliser: str) -> Callable[[np.random.SeedSequence, bool], Life]:
    return lambda seed, full: spend(seed, control, generaliser, num_steps=_FULL_STEPS if full else 8000)


def _page(found: Mapping[str, tuple[Life, ...]], full: bool) -> ChapterPage:
    steps = len(found[RANDOM][0].pushed)
    shares = {name: mean_share(lives) for name, lives in found.items()}
    return ChapterPage(
        "obelix",
        "A robot that learns to push boxes",
        "13.8",
        _text(shares, steps),
        (*_modular(shares), *_against_hand(shares), _general(shares), *_ours(found)),
        (film_picture(found["behaviours, table"]), curve_picture(found)),
        source="Mahadevan & Connell 1992",
        measured=tuple(
            Measured(f"{name}: share of steps that push, last quarter", tuple(life.share for life in lives))
            for name, lives in found.items()
        ),
        facts={
            "what is seen": "18 bits: NEAR and FAR of eight sonars, BUMP, STUCK",
            "constants": "α = .5, γ = .9, ε = .1; Hamming radius 1 (weights NEAR 2, FAR 1, BUMP and STUCK 5); clusters "
            "from a likelihood of 10⁻⁴, lessons within 1.5, a say by size times likelihood",
            "steps of a life": f"{steps:,}, in another room every 100",
        },
    )


def _ratio(shares: Mapping[str, float], generaliser: str) -> float:
    return shares[f"behaviours, {generaliser}"] / max(shares[f"monolith, {generaliser}"], 1e-9)


def _text(shares: Mapping[str, float], steps: int) -> tuple[str, ...]:
    reproduced = all(_ratio(shares, one) >= 1.5 for one in GENERALISERS)
    ratios = ", ".join(f"{_ratio(shares, one):.1f} ({one})" for one in GENERALISERS)
    return (
        f"{'Reproduced' if reproduced else 'Not reproduced with these seeds'}: after {steps:,} steps three behaviours, "
        f"each with a reward of its own, push boxes more often than one learner that is rewarded for pushing, by "
        f"factors of {ratios}.",
        "The robot sees little: whether something is near, far or not at all in eight directions, whether it touches "
        "something, and whether its last move was refused. A wall looks much like a box. One learner that is told 1 "
        "for a push and −3 for being stuck has to find out everything at once. Three behaviours split it: one looks "
        "for boxes, one pushes what it touches, one gets free, and the later takes precedence. Q-learning is "
        "off-policy, so each also learns from moves that another one chose, as long as it applies.",
        "Of 262,144 states few are ever seen twice, so a lesson should reach further than the state that it was "
        "learned in: to states that differ in bits of small weight, or to clusters of states that look alike and in "
        "which the action was worth as much.",
    )


def _modular(shares: Mapping[str, float]) -> tuple[Row, ...]:
    return tuple(
        published(
            f"behaviours against one learner, {one}",
            "better",
            f"{shares[f'behaviours, {one}']:.3f} against {shares[f'monolith, {one}']:.3f}",
            _ratio(shares, one) >= 1.5,
            f"share of steps that push, means; {_ratio(shares, one):.2f} times, from 1.5 on it counts as agreeing",
        )
        for one in GENERALISERS
    )


def _against_hand(shares: Mapping[str, float]) -> tuple[Row, ...]:
    return tuple(
        published(
            f"behaviours against what was written by hand, {one}",
            "as good or better",
            f"{shares[f'behaviours, {one}']:.3f} against {shares[HAND]:.3f}",
            shares[f"behaviours, {one}"] >= shares[HAND],
            f"{shares[f'behaviours, {one}'] / shares[HAND]:.2f} times",
        )
        for one in GENERALISERS
    )


def _general(shares: Mapping[str, float]) -> Row:
    ratio = shares["monolith, clusters"] / shares["monolith, table"]
    return published(
        "clusters against a table, one learner",
        "better",
        f"{shares['monolith, clusters']:.3f} against {shares['monolith, table']:.3f}",
        ratio >= 1.3,
        f"{ratio:.2f} times; from 1.3 on it counts as agreeing",
    )


def _ours(found: Mapping[str, tuple[Life, ...]]) -> tuple[Row, ...]:
    rows = []
    for name, lives in found.items():
        error = np.std([life.share for life in lives]) / np.sqrt(len(lives))
        rows.append(own(f"{name}: share of steps that push", f"{mean_share(lives):.3f}", f"standard error {error:.3f}"))
    return tuple(rows)


OBELIX = System(
    name="obelix",
    environment="neuralq/Obelix-v0",
    learner="neuralq.tabular:bit_update",
    contenders={
        **{name: _contender(*given) for name, given in _LEARNERS.items()},
        HAND: _contender("by hand", "table"),
        RANDOM: _contender("random", "table"),
    },
    baselines=(HAND, RANDOM),
    oracle=oracle,
    page=_page,
    num_seeds=20,
    full_num_seeds=60,
)

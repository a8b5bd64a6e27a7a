"""Checkers as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.checkers.oracle import oracle
from neuralq.systems.checkers.pictures import announced_picture, board_picture, rote_picture, weights_picture
from neuralq.systems.checkers.terms import MATERIAL_ONLY, NUM_TERMS
from neuralq.systems.checkers.training import (
    Endgames,
    Match,
    Wins,
    carry_out,
    look_deeper,
    new_program,
    play_match,
    study,
    train,
)
from neuralq.tabular.kernels.random_numbers import Seed

__all__ = ["CHECKERS", "Learned", "learned"]

LEARNED, MATERIAL, RANDOM = "learned", "pieces alone", "random weights"
ROTE, WANDERING, DEEPER, NEARER = "rote learning", "rote, no ply penalty", "no memory", "ply penalty"
_DEPTHS = (3, 5, 7)
_ROUND = 2000


@dataclass(frozen=True, eq=False)
class Learned:
    """A training by backed-up scores, and its matches against who counts pieces alone.

    Args:
        history: weights after each game, ``[N, 14]``.
        match: by the average over the last half, at the depth of the training.
        deeper: both looking two plies further.
        last: by the weights after the last game.
    """

    history: NDArray[np.float64]
    match: Match
    deeper: Match
    last: Match

    @property
    def weights(self) -> NDArray[np.float64]:
        """Averaged over the last half of the games."""
        return cast("NDArray[np.float64]", self.history[len(self.history) // 2 :].mean(axis=0))


Outcome = Learned | Match | tuple[Endgames, ...] | Wins


def learned(seed: Seed, full: bool = False) -> Learned:
    """Trains, and plays its matches.

    Example:
        >>> learned(0).history.shape
        (500, 14)
    """
    openings, depth = (400, 5) if full else (100, 3)
    history = train(seed, 2000 if full else 500, depth=depth)
    weights = history[len(history) // 2 :].mean(axis=0)

    def against_pieces(played: NDArray[np.float64], plies: int) -> Match:
        return play_match(new_program(played, plies), new_program(MATERIAL_ONLY, plies), seed, openings)

    return Learned(
        history, against_pieces(weights, depth), against_pieces(weights, depth + 2), against_pieces(history[-1], depth)
    )


def _untrained(drawn: bool) -> Callable[[np.random.SeedSequence, bool], Match]:
    def play(seed: np.random.SeedSequence, full: bool) -> Match:
        weights = MATERIAL_ONLY.copy()
        if drawn:
            weights[1:] = np.random.default_rng(seed).normal(size=NUM_TERMS - 1)
        depth = 5 if full else 3
        return play_match(new_program(weights, depth), new_program(MATERIAL_ONLY, depth), seed, 400 if full else 100)

    return play


def _page(found: Mapping[str, tuple[Outcome, ...]], full: bool) -> ChapterPage:
    trainings = cast("tuple[Learned, ...]", found[LEARNED])
    nearer = cast("tuple[Wins, ...]", found[NEARER])
    studies = {name: cast("tuple[tuple[Endgames, ...], ...]", found[name]) for name in (ROTE, WANDERING)}
    deeper = cast("tuple[tuple[Endgames, ...], ...]", found[DEEPER])
    untrained = {name: cast("tuple[Match, ...]", found[name]) for name in (MATERIAL, RANDOM)}
    measured = {**_of_matches(trainings, untrained, 5 if full else 3), **_of_endgames(studies, deeper, nearer)}
    drawings = (
        board_picture(trainings[0].weights),
        weights_picture([one.history for one in trainings]),
        rote_picture(studies, deeper, _ROUND, _DEPTHS),
        announced_picture(nearer),
    )
    return ChapterPage(
        "checkers",
        "Checkers, learned from backed-up scores and by rote",
        "13.8",
        _text(measured),
        (*_published(measured), *_ours(measured, trainings)),
        drawings,
        source="Samuel 1959",
        measured=tuple(measured.values()),
        facts={
            "what is known": "the rules, fourteen terms, and that pieces are worth having",
            "constants": (
                f"{len(trainings[0].history):,} games, α from .001 to .0003, ε = .05, backed-up scores cut at ±12, "
                "weights averaged over the last half"
            ),
            "draws": "60 plies without a capture or a move of a man, 40 in training",
        },
    )


def _of_matches(
    trainings: tuple[Learned, ...], untrained: Mapping[str, tuple[Match, ...]], depth: int
) -> dict[str, Measured]:
    score = f"score against pieces alone, {depth} plies"
    return {
        LEARNED: Measured(f"{LEARNED}: {score}", tuple(one.match.score for one in trainings)),
        "losses": Measured(f"{LEARNED}: games lost (%)", tuple(_lost(one.match) for one in trainings)),
        "deeper": Measured(f"{LEARNED}: the same, {depth + 2} plies", tuple(one.deeper.score for one in trainings)),
        "last": Measured(f"{LEARNED}: the same by the last weights", tuple(one.last.score for one in trainings)),
        **{
            name: Measured(f"{name}: {score}", tuple(one.score for one in matches))
            for name, matches in untrained.items()
        },
    }


def _of_endgames(
    studies: Mapping[str, tuple[tuple[Endgames, ...], ...]],
    deeper: tuple[tuple[Endgames, ...], ...],
    nearer: tuple[Wins, ...],
) -> dict[str, Measured]:
    looked_at = "positions looked at per endgame"
    return {
        **{
            name: Measured(f"{name}: endgames won (%)", tuple(100 * tests[-1].won for tests in trainings))
            for name, trainings in studies.items()
        },
        **{
            f"{plies} plies": Measured(f"{DEEPER}, {plies} plies: endgames won (%)", _won_of(deeper, i))
            for i, plies in enumerate(_DEPTHS)
        },
        "nodes": Measured(f"{ROTE}: {looked_at}", tuple(_nodes(one[-1]) for one in studies[ROTE])),
        "nodes alone": Measured(f"{DEEPER}, 3 plies: {looked_at}", tuple(_nodes(one[0]) for one in deeper)),
        **{
            f"penalty {penalty:g}": Measured(
                f"{NEARER} {penalty:g}: plies until a win that is seen is won",
                tuple(float(one.endgames[penalty].plies.mean()) for one in nearer),
            )
            for penalty in nearer[0].endgames
        },
    }


def _lost(match: Match) -> float:
    return 100 * match.counts[2] / match.results.size


def _nodes(one: Endgames) -> float:
    return one.nodes / len(one.results)


def _won_of(deeper: tuple[tuple[Endgames, ...], ...], i: int) -> tuple[float, ...]:
    return tuple(100 * one[i].won for one in deeper)


def _text(measured: Mapping[str, Measured]) -> tuple[str, ...]:
    return (
        f"The program begins with one thing that it knows, that pieces are worth having, and plays "
        f"itself. Against a program that knows no more than that and looks as far ahead it then scores "
        f"{measured[LEARNED].median:.2f} of the points, a draw counting half.",
        "Nobody tells it who has won. What it learns from is its own look-ahead: the score that a search brings back "
        "from several moves on is a better judgement than that of the board at hand, so the judgement of the board at "
        "hand is moved towards it. That is temporal-difference learning twenty-nine years before it had the name, and "
        "since no reward is ever seen, one weight is fixed to give the others something to mean.",
        "Rote learning keeps every position that was searched, with its score. Where a later search ends on one of "
        "them it sees as far as the search did that gave the score, at no cost. For this to lead anywhere a win must "
        "be worth a little less for each ply that it is away: else all wins look alike, and the program is content to "
        "have a won position without ever winning it.",
    )


def _published(measured: Mapping[str, Measured]) -> tuple[Row, ...]:
    learned_, alone, rote, wandering = (measured[name] for name in (LEARNED, "3 plies", ROTE, WANDERING))
    near, far = measured["penalty 0.01"], measured["penalty 0"]
    return (
        published(
            "learning from its own look-ahead makes it play better", "it does", str(learned_),
            learned_.median > 0.5 and (learned_.interval or (min(learned_.values), 1))[0] > 0.5,
            "score against pieces alone; .5 is equal",
        ),
        published(
            "weights after a game can be worse than before", "self-play is unstable",
            f"last weights {measured['last']}", min(measured["last"].values) < 0.5,
            "with a small falling step size they hardly are here",
        ),
        published(
            "rote learning plays better, looking no further", "it does",
            f"{rote} % of endgames won, {alone} % without", rote.median > alone.median,
            f"and looks at {measured['nodes']} positions each, {measured['nodes alone']} without",
        ),
        published(
            "of two wins the ply penalty takes the nearer", "it does", f"{near} plies, {far} without",
            near.median < far.median,
        ),
        published(
            "a memory without the ply penalty wanders", "it does", f"{wandering} % of endgames won",
            wandering.median < rote.median,
        ),
    )  # fmt: skip


def _ours(measured: Mapping[str, Measured], trainings: tuple[Learned, ...]) -> tuple[Row, ...]:
    won, drawn, lost = np.sum([one.match.counts for one in trainings], axis=0).tolist()
    return (
        own("games won, drawn and lost, all seeds", f"{won}, {drawn}, {lost}"),
        own("both looking two plies further", str(measured["deeper"])),
        own("pieces alone against itself", str(measured[MATERIAL]), "what the openings' chance amounts to"),
        own("weights drawn at random", str(measured[RANDOM])),
        own("endgames won without a memory, 5 plies (%)", str(measured["5 plies"])),
        own("endgames won without a memory, 7 plies (%)", str(measured["7 plies"])),
    )


CHECKERS: System[Outcome] = System(
    name="checkers",
    environment="neuralq/Checkers-v0",
    learner="neuralq.tabular:backup_update",
    contenders={
        LEARNED: learned,
        MATERIAL: _untrained(drawn=False),
        RANDOM: _untrained(drawn=True),
        ROTE: lambda seed, full: study(seed, num_games=_ROUND),
        WANDERING: lambda seed, full: study(seed, 0.0, num_games=_ROUND),
        DEEPER: lambda seed, full: look_deeper(seed, _DEPTHS),
        NEARER: lambda seed, full: carry_out(seed),
    },
    baselines=(MATERIAL, RANDOM, WANDERING, DEEPER),
    oracle=oracle,
    page=_page,
    num_seeds=6,
    full_num_seeds=10,
)

"""Explanation-based neural network learning on a linear-quadratic task as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.ebnn.fits import (
    BAD,
    BELIEVED,
    EXACT,
    EXPLAINED,
    GOOD,
    LARGEST,
    NONE,
    NUM_POINTS,
    WEIGHED,
    Fit,
    fit,
)
from neuralq.systems.ebnn.oracle import oracle
from neuralq.systems.ebnn.pictures import cut_picture, error_picture, map_picture

__all__ = ["EBNN", "error_ratio"]

_NAMES = {
    "values alone": NONE,
    "good theory, LOB*": EXPLAINED,
    "bad theory, LOB*": WEIGHED,
    "bad theory, believed": BELIEVED,
    "exact slopes": EXACT,
}
PLAIN, GOOD_THEORY, BAD_THEORY, BELIEVED_THEORY, EXACT_SLOPES = _NAMES
_FEW = (5, 10)  # episodes for which a claim is judged


def error_ratio(found: Mapping[str, tuple[Fit, ...]], name: str, num_points: int, beside: str = PLAIN) -> float:
    """The mean error of one contender in units of another's.

    Example:
        >>> one = Fit(*(np.zeros((1, 2)),) * 3, {}, {5: 2.0})
        >>> error_ratio({"values alone": (one, one), "exact slopes": (one, one)}, "exact slopes", 5)
        1.0
    """
    means = [float(np.mean([one.errors[num_points] for one in found[which]])) for which in (name, beside)]
    return means[0] / means[1]


def _contender(source: str) -> Callable[[np.random.SeedSequence, bool], Fit]:
    return lambda seed, full: fit(seed, source)


def _page(found: Mapping[str, tuple[Fit, ...]], full: bool) -> ChapterPage:
    measured = {
        name: tuple(
            Measured(f"{name}: mean squared error after {n} episodes", tuple(one.errors[n] for one in fits))
            for n in NUM_POINTS
        )
        for name, fits in found.items()
    }
    cut = cut_picture(np.random.SeedSequence(0))
    drawings = (cut, error_picture(measured), map_picture(found[PLAIN][0], found[GOOD_THEORY][0]))
    return ChapterPage(
        "ebnn",
        "A value learned from episodes and from what explains them",
        "13.8",
        _text(found),
        (_fewer(found), *(_explained(found, n) for n in _FEW), _weighed(found), _believed(found), *_ours(found)),
        drawings,
        source="Mitchell & Thrun 1993",
        measured=tuple(one for cells in measured.values() for one in cells),
        facts={
            "what is learned": "the value of one push, after which a fixed law steers; a network with 10 hidden units",
            "theories": f"networks for the reward and for what follows, learned from {GOOD} or from {BAD} single steps",
            "LOB*": f"nothing is believed of a theory that predicts the return {LARGEST:g} too high or too low",
        },
    )


def _text(found: Mapping[str, tuple[Fit, ...]]) -> tuple[str, ...]:
    ratios = {n: error_ratio(found, GOOD_THEORY, n) for n in _FEW}
    said = " and ".join(f"{1 / ratio:.1f} times with {n}" for n, ratio in ratios.items())
    verdict = "Reproduced" if _helps(found) else "Not reproduced with these seeds"
    return (
        f"{verdict}: slopes that a good theory explains make the error smaller, {said} episodes. A theory that is bad "
        f"and weighed leaves it at {error_ratio(found, BAD_THEORY, 10):.2f} of what values alone give with 10; the "
        f"same theory, believed, makes it {error_ratio(found, BELIEVED_THEORY, 10):.1f} times as large.",
        "An episode tells a network one number: what it earned from where it began. Whoever has a theory of the world "
        "knows more. The theory, networks for reward and next state that were learned before, explains the episode "
        "step by step, and the chain rule along the states that were really seen says how the return would have "
        "changed had it begun elsewhere: a slope. The network is then fitted to points and to tangents.",
        "Theories are wrong in places. LOB* believes an explanation only as far as it predicted the return that was "
        "observed; where it did not, what is left is learning from values alone.",
        "The task is linear with quadratic costs, so that value and slope are known in closed form and nothing that is "
        "said of an error here depends on a sample of the truth.",
    )


def _helps(found: Mapping[str, tuple[Fit, ...]]) -> bool:
    return all(error_ratio(found, GOOD_THEORY, n) <= 0.3 for n in _FEW)


def _explained(found: Mapping[str, tuple[Fit, ...]], n: int) -> Row:
    ratio = error_ratio(found, GOOD_THEORY, n)
    return published(
        f"{n} episodes: error with a good theory against values alone",
        "smaller",
        f"{ratio:.2f}",
        ratio <= 0.3,
        "means over seeds; up to .3 counts as agreeing",
    )


def _fewer(found: Mapping[str, tuple[Fit, ...]]) -> Row:
    """How many episodes values alone need for what a theory makes of ten."""
    wanted = np.median([one.errors[10] for one in found[GOOD_THEORY]])
    enough = [n for n in NUM_POINTS if np.median([one.errors[n] for one in found[PLAIN]]) <= wanted]
    least = f"{enough[0]}" if enough else f"over {NUM_POINTS[-1]}"
    return published(
        "episodes for the same error, with a theory against without",
        "25 against 90",
        f"10 against {least}",
        not enough or enough[0] > 20,
        "theirs is a task of a robot (Mitchell 1997, chapter 12); medians of ours",
    )


def _weighed(found: Mapping[str, tuple[Fit, ...]]) -> Row:
    ratio, against = error_ratio(found, BAD_THEORY, 10), error_ratio(found, BAD_THEORY, 10, BELIEVED_THEORY)
    return published(
        "10 episodes: error with a bad theory and LOB* against values alone",
        "no worse",
        f"{ratio:.2f}",
        ratio <= 1.3 and against <= 0.7,
        f"{against:.2f} of what the same theory makes of it when it is believed",
    )


def _believed(found: Mapping[str, tuple[Fit, ...]]) -> Row:
    ratio = error_ratio(found, BELIEVED_THEORY, 10)
    return published(
        "10 episodes: error with a bad theory, believed", "worse", f"{ratio:.2f}", ratio >= 1.5, "against values alone"
    )


def _ours(found: Mapping[str, tuple[Fit, ...]]) -> tuple[Row, ...]:
    rows = []
    for name in found:
        errors = [float(np.median([one.errors[n] for one in found[name]])) for n in NUM_POINTS]
        said = ", ".join(f"{error:.2g}" for error in errors)
        weight = np.mean([one.weights for one in found[name]])
        rows.append(
            own(f"{name}: median error, {', '.join(map(str, NUM_POINTS))} episodes", said, f"slopes count {weight:.2f}")
        )
    return tuple(rows)


EBNN = System(
    name="ebnn",
    environment="neuralq/LinearQuadratic-v0",
    learner="neuralq.learners:fit_slopes",
    contenders={name: _contender(source) for name, source in _NAMES.items()},
    baselines=(PLAIN, BELIEVED_THEORY, EXACT_SLOPES),
    oracle=oracle,
    page=_page,
    num_seeds=20,
    full_num_seeds=100,
)

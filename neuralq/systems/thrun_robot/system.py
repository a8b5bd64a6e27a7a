"""Thrun's robot as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.thrun_robot.learning import GAMMA, LARGEST
from neuralq.systems.thrun_robot.oracle import oracle
from neuralq.systems.thrun_robot.pictures import curve_picture, path_picture
from neuralq.systems.thrun_robot.trainings import (
    BAD,
    EXPLAINED,
    FLAT,
    GOOD,
    HAND,
    NONE,
    RANDOM,
    WEIGHED,
    Training,
    train,
)

__all__ = ["THRUN_ROBOT", "speed_up"]

_NAMES = {
    "EBNN-Q": EXPLAINED,
    "Q-learning": NONE,
    "EBNN-Q, bad theory": WEIGHED,
    "slopes of 0": FLAT,
    "by geometry": HAND,
    "random moves": RANDOM,
}
WITH, WITHOUT, BAD_THEORY, SLOPES_OF_0, GEOMETRY, RANDOM_MOVES = _NAMES
_LEARNERS = (WITH, WITHOUT, BAD_THEORY, SLOPES_OF_0)
_NUM_EPISODES, _FULL_EPISODES = 40, 80
_ENOUGH = 0.8  # share of targets reached that episodes are counted to


def speed_up(found: Mapping[str, tuple[Training, ...]], name: str = WITH) -> Measured:
    """By how much one reaches more targets than Q-learning in the mean over all episodes, for each seed.

    Example:
        >>> half, most = (Training(np.array([0.0, share]), np.zeros(1), {}) for share in (0.5, 0.75))
        >>> speed_up({"EBNN-Q": (most,), "Q-learning": (half,)}).values
        (0.25,)
    """
    pairs = zip(found[name], found[WITHOUT], strict=True)
    return Measured(
        f"{name} less {WITHOUT}: share of targets reached, mean over episodes",
        tuple(float(np.mean(one.success[1:] - other.success[1:])) for one, other in pairs),
    )


def _contender(source: str) -> Callable[[np.random.SeedSequence, bool], Training]:
    return lambda seed, full: train(seed, source, _FULL_EPISODES if full else _NUM_EPISODES)


def _page(found: Mapping[str, tuple[Training, ...]], full: bool) -> ChapterPage:
    pictures = (path_picture({name: found[name][0] for name in (WITH, WITHOUT)}), curve_picture(found))
    return ChapterPage(
        "thrun-robot",
        "A robot that finds its target, with a theory and without",
        "13.8",
        _text(found),
        (_faster(found), _sooner(found), *_ours(found)),
        pictures,
        source="Thrun 1996; Mitchell & Thrun 1993",
        measured=(
            speed_up(found),
            *(_mean_share(found, name) for name in found),
            *(_last_share(found, name) for name in found),
            *(_episodes(found, name) for name in _LEARNERS),
        ),
        facts={
            "task": "target in the robot's frame; .35 m forward or 25 degrees to either side; reached within .45 m "
            "ahead (1), lost behind or beyond 4.2 m (−1); 30 steps",
            "networks": f"one for each move, 10 hidden units; fitted to all episodes after each, γ = {GAMMA:g}",
            "exploration": "ε from .3 to 0 in a line; returns are followed to the next move that explores (Watkins)",
            "theory": f"networks for each move, of {GOOD} steps of it made beforehand (bad: {BAD})",
            "LOB*": f"nothing is believed of an explanation that misses the return by {LARGEST:g}",
        },
    )


def _text(found: Mapping[str, tuple[Training, ...]]) -> tuple[str, ...]:
    flat = np.mean([one.success[-1] for one in found[SLOPES_OF_0]])
    plain = np.mean([one.success[-1] for one in found[WITHOUT]])
    return (
        f"{_verdict(found)} The share of targets reached, in the mean over all episodes, differs by "
        f"{speed_up(found)} (with the theory less without), the same targets and random moves for both.",
        "The robot knows how far ahead its target is and how far to the left, and learns what each of three moves is "
        "worth by Q-learning. EBNN-Q also has a theory: networks that were fitted beforehand to single steps, for "
        "where a move leads and what it earns. After an episode the theory explains it. The chain rule along the "
        "states that were seen says how the return would have changed with the state, and the networks are fitted to "
        "returns and to these slopes, each weighed by LOB*.",
        "What an exact theory would explain can be said here without one. The reward is a step, where the "
        "target comes within reach and where it is lost: with the moves of an episode kept, a slightly different start "
        "earns the same, so that the slope of a return is 0 nearly everywhere. A theory of smooth networks has slopes "
        "because it smooths these edges. Who is told slopes of 0 from the start, always believed, reaches "
        f"{flat:.0%} of the targets in the end, and who is told none {plain:.0%}.",
        "Thrun's robot had a camera and sonars, this one is told two numbers: what is found here is about this one.",
    )


def _verdict(found: Mapping[str, tuple[Training, ...]]) -> str:
    low, high = _bounds(speed_up(found))
    if low > 0:
        return "Reproduced: with a theory the robot learns from fewer episodes."
    if high < 0:
        return "Not reproduced, and the other way round: with a theory the robot needs more episodes."
    return "Not reproduced: with a theory the robot does not learn from fewer episodes, as far as these seeds tell."


def _bounds(measured: Measured) -> tuple[float, float]:
    return measured.interval or (min(measured.values), max(measured.values))


def _faster(found: Mapping[str, tuple[Training, ...]]) -> Row:
    gain = speed_up(found)
    return published(
        "targets reached, mean over episodes: with a theory less without",
        "above 0",
        str(gain),
        _bounds(gain)[0] > 0,
        f"more with the theory in {sum(value > 0 for value in gain.values)} of {len(gain.values)} seeds",
    )


def _sooner(found: Mapping[str, tuple[Training, ...]]) -> Row:
    ours, plain = (_episodes(found, name) for name in (WITH, WITHOUT))
    return published(
        f"episodes until {_ENOUGH:.0%} of the targets are reached, with a theory against without",
        "25 against 90",
        f"{ours} against {plain}",
        ours.median < plain.median,
        "theirs is a task of a robot with a camera (Mitchell 1997, chapter 12)",
    )


def _ours(found: Mapping[str, tuple[Training, ...]]) -> tuple[Row, ...]:
    return tuple(
        own(
            f"{name}: share of targets reached in the end",
            str(_last_share(found, name)),
            f"slopes count {np.mean([one.believed for one in trainings]):.2f}" if name in _LEARNERS else "",
        )
        for name, trainings in found.items()
    )


def _mean_share(found: Mapping[str, tuple[Training, ...]], name: str) -> Measured:
    values = tuple(float(one.success[1:].mean()) for one in found[name])
    return Measured(f"{name}: share of targets reached, mean over episodes", values)


def _last_share(found: Mapping[str, tuple[Training, ...]], name: str) -> Measured:
    values = tuple(float(one.success[-1]) for one in found[name])
    return Measured(f"{name}: share of targets reached in the end", values)


def _episodes(found: Mapping[str, tuple[Training, ...]], name: str) -> Measured:
    """Until that share is reached for the first time; one more than there are where it never is."""
    values = []
    for one in found[name]:
        enough = np.nonzero(one.success >= _ENOUGH)[0]
        values.append(float(enough[0]) if len(enough) else float(len(one.success)))
    limit = float(len(found[name][0].success) - 1)
    return Measured(f"{name}: episodes until {_ENOUGH:.0%} of the targets are reached", tuple(values), limit)


THRUN_ROBOT = System(
    name="thrun-robot",
    environment="neuralq/ThrunRobot-v0",
    learner="neuralq.learners:fit_slopes",
    contenders={name: _contender(source) for name, source in _NAMES.items()},
    baselines=(WITHOUT, SLOPES_OF_0, GEOMETRY, RANDOM_MOVES),
    oracle=oracle,
    page=_page,
    num_seeds=10,
    full_num_seeds=30,
)

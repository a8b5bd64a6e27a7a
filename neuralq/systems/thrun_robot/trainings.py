"""One seed of one contender: from the same targets and random moves, how many targets it learns to reach."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_positive, check_whole
from neuralq.learners import new_slope_net
from neuralq.systems.thrun_robot.learning import Episodes, Nets, action_values, refit, walk
from neuralq.systems.thrun_robot.theory import Theory, learn_theory
from neuralq_envs.thrun_robot import MAX_STEPS, NUM_MOVES, by_geometry, draw_targets, outcomes, successors

__all__ = [
    "BAD",
    "EXPLAINED",
    "FLAT",
    "GOOD",
    "HAND",
    "NONE",
    "RANDOM",
    "SHOWN",
    "SOURCES",
    "WEIGHED",
    "Training",
    "drive",
    "train",
]

Array = NDArray[np.float64]
Moves = NDArray[np.int64]
Fit = Callable[[Nets, Episodes], tuple[Nets, float]]

GOOD, BAD = 200, 5
"""Steps of each move that a theory was learned from."""
SHOWN = (10, 40)
"""Episodes after which paths are kept."""
_NUM_HIDDEN, _NUM_FITS, _EPSILON = 10, 2, 0.3
_NUM_TESTS = 100

EXPLAINED, WEIGHED, NONE, FLAT, HAND, RANDOM = "good theory", "bad theory", "none", "flat", "by hand", "random"
SOURCES = (EXPLAINED, WEIGHED, NONE, FLAT, HAND, RANDOM)
"""Where slopes come from, or who moves without learning."""


@dataclass(frozen=True, eq=False)
class Training:
    """What one seed of one contender came to.

    Args:
        success: share of the test's targets that are reached, before the first episode and after each.
        believed: mean weight of slopes after each episode.
        paths: by number of episodes, the target on its way in the robot's frame, ``[31, tests, 2]``; it stays where it
            was reached or lost.
    """

    success: Array
    believed: Array
    paths: Mapping[int, Array]


def drive(choose: Callable[[Array], Moves], targets: Array) -> Array:
    """Where targets are seen on the way to each, as in `Training.paths`, ``[N, 2]`` to ``[31, N, 2]``.

    Example:
        >>> path = drive(by_geometry, np.array([[1.0, 0.0]]))[:, 0]
        >>> path[:4, 0].round(2).tolist()
        [1.0, 0.65, 0.3, 0.3]
    """
    seen = [targets]
    for _ in range(MAX_STEPS):
        s = seen[-1].copy()
        moves, under_way = choose(s), outcomes(s) == 0
        for move in range(NUM_MOVES):
            here = under_way & (moves == move)
            s[here] = successors(s[here], move)
        seen.append(s)
    return np.stack(seen)


def train(seed: np.random.SeedSequence, source: str, num_episodes: int = 40, weight: float = 1.0) -> Training:
    """From nothing, with ε falling from .3 to 0; tests are greedy.

    Args:
        seed: of targets, random moves, the first networks, the theory and the test.
        source: one of `SOURCES`.
        num_episodes: to learn from.
        weight: of an explained slope that is wholly believed, beside that of a value, which is 1.

    Raises:
        ValueError: another source, no episode, or a weight that is not above 0.

    Example:
        >>> train(np.random.SeedSequence(0), "by hand", 3).success.tolist()
        [1.0, 1.0, 1.0, 1.0]
    """
    check_choice("source", source, SOURCES)
    check_whole("num_episodes", num_episodes)
    check_positive("weight", weight)
    rng = np.random.default_rng(seed)
    tests, targets = draw_targets(_NUM_TESTS, rng), draw_targets(num_episodes, rng)
    explores = rng.random((num_episodes, MAX_STEPS)) < _EPSILON * np.linspace(1, 0, num_episodes)[:, None]
    moves = np.where(explores, rng.integers(NUM_MOVES, size=explores.shape), -1)
    if source in (HAND, RANDOM):
        path = drive(by_geometry if source == HAND else lambda s: rng.integers(NUM_MOVES, size=len(s)), tests)
        shown = {n: path for n in SHOWN if n <= num_episodes}
        return Training(np.full(num_episodes + 1, _reached(path)), np.zeros(num_episodes), shown)
    nets = [new_slope_net(2, _NUM_HIDDEN, rng) for _ in range(NUM_MOVES)]
    slopes: Theory | float = float(source == FLAT)
    if source in (EXPLAINED, WEIGHED):
        slopes = learn_theory(GOOD if source == EXPLAINED else BAD, rng)
    return _learned(nets, partial(refit, source=slopes, weight=weight), tests, targets, moves)


def _learned(nets: Nets, fit: Fit, tests: Array, targets: Array, moves: Moves) -> Training:
    walked: list[Episodes] = []
    believed, paths = [], [drive(partial(_best, nets), tests)]
    for target, instead in zip(targets, moves, strict=True):
        walked.append(walk(nets, target, instead))
        episodes = Episodes(*(np.concatenate(arrays, axis=1) for arrays in zip(*walked, strict=True)))
        for _ in range(_NUM_FITS):
            nets, believes = fit(nets, episodes)
        believed.append(believes)
        paths.append(drive(partial(_best, nets), tests))
    success = np.array([_reached(path) for path in paths])
    return Training(success, np.array(believed), {n: paths[n] for n in SHOWN if n < len(paths)})


def _best(nets: Nets, s: Array) -> Moves:
    return np.asarray(action_values(nets, s).argmax(-1))


def _reached(path: Array) -> float:
    return float((outcomes(path[-1]) > 0).mean())

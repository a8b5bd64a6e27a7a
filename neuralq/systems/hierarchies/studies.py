"""Three ways to learn six tasks, and how soon the composite ones are done nearly as fast as they can be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gymnasium
import numpy as np
from numpy.typing import NDArray

import neuralq_envs
from neuralq.checks import check_whole
from neuralq.systems.hierarchies.kernels import Path, RoomArrays, compositional_trials
from neuralq.tabular import (
    CompositionalQ,
    CompositionalRates,
    EpsilonGreedy,
    RunOptions,
    compile_model,
    new_compositional_q,
    new_stream,
    q_learning,
    run_option,
    smdp_q_update,
)
from neuralq_envs.landmarks import NUM_CELLS, TASKS, mdp, room

__all__ = [
    "COMPOSITE",
    "ENOUGH",
    "ROOM",
    "SHORTEST",
    "Study",
    "flat_study",
    "mean_steps",
    "modules_study",
    "skills_study",
]

neuralq_envs.register()

ROOM = room()
COMPOSITE = np.array([i for i, task in enumerate(TASKS) if len(task) > 1])
ELEMENTAL = np.array([i for i, task in enumerate(TASKS) if len(task) == 1])
ENOUGH = 1.25
"""In units of the shortest ways: when a composite task counts as learned."""
MOST_STEPS = 300
PRACTICE = 1500
"""Trials of elemental tasks before the composite ones begin."""
_ALPHA, _EPSILON = 0.5, 0.1
_MOST_OPTION_STEPS = 40


@dataclass(frozen=True, eq=False)
class Study:
    """What came of learning.

    Args:
        trials: of composite tasks (flat: of all six) before each test, ``[tests]``.
        ratios: mean steps of composite tasks in each test, in units of the shortest ways, ``[tests]``.
        gates: which module or skill each stage takes, as probabilities, ``[stages, 3]``; zeros where there are none.
        biases: K of each stage; zeros where there is none.
        values: of each module or skill, ``[3, 64]``; zeros where there are none.
    """

    trials: NDArray[np.int64]
    ratios: NDArray[np.float64]
    gates: NDArray[np.float64]
    biases: NDArray[np.float64]
    values: NDArray[np.float64]

    @property
    def enough(self) -> float:
        """Trials before the first test in which the ratio is at most 1.25; all of them where there is none."""
        passed = np.flatnonzero(self.ratios <= ENOUGH)
        return float(self.trials[passed[0]] if len(passed) else self.trials[-1])


def mean_steps(policy: NDArray[np.int64], most_steps: int = MOST_STEPS) -> NDArray[np.float64]:
    """Steps of each of the six tasks by fixed moves, means over all starts; at most so many each, ``[6]``.

    Args:
        policy: the move in every cell of every stage, ``[stages, 64]``.
        most_steps: at which an episode is broken off.

    Example:
        >>> mean_steps(np.zeros((10, 64), int), 50)[0].tolist()  # north, against the wall
        45.27118644067797
    """
    means = np.zeros(len(TASKS))
    last = ROOM.is_last
    for task, stage in enumerate(ROOM.first[:-1].tolist()):
        cells = ROOM.free[ROOM.free != ROOM.goals[stage]]
        num, stages = len(cells), np.full(len(cells), stage)
        for _ in range(most_steps):
            if not len(cells):
                break
            means[task] += len(cells) / num
            cells = ROOM.led[cells, policy[stages, cells]]
            reached = cells == ROOM.goals[stages]
            goes_on = ~(reached & last[stages])
            cells, stages = cells[goes_on], (stages + reached)[goes_on]
    return means


def _shortest_policy() -> NDArray[np.int64]:
    """Down the number of steps to the goal of each stage."""
    policy = np.zeros((len(ROOM.goals), NUM_CELLS), np.int64)
    for stage, goal in enumerate(ROOM.goals):
        away = np.where(np.arange(NUM_CELLS) == goal, 0.0, np.inf)
        for _ in ROOM.free:
            away[ROOM.free] = np.minimum(away[ROOM.free], 1.0 + away[ROOM.led[ROOM.free]].min(axis=1))
        policy[stage] = away[ROOM.led].argmin(axis=1)
    return policy


SHORTEST = mean_steps(_shortest_policy())
"""Mean steps of the shortest ways, by task."""


def _ratio(policy: NDArray[np.int64]) -> float:
    return float(mean_steps(policy)[COMPOSITE].mean() / SHORTEST[COMPOSITE].mean())


def flat_study(seed: np.random.SeedSequence, num_trials: int = 3000) -> Study:
    """One table for all stages of all tasks, Q-learning on six tasks mixed.

    Args:
        seed: of the streams.
        num_trials: after which it ends, about half of them composite.

    Raises:
        ValueError: no trial.

    Example:
        >>> study = flat_study(np.random.SeedSequence(0), 100)
        >>> bool(study.ratios[0] > 5), int(study.trials[0])
        (True, 0)
    """
    check_whole("num_trials", num_trials)
    model, stages = compile_model(mdp(), "model"), len(ROOM.goals)
    q, tests, trials = np.zeros((stages * NUM_CELLS, 4)), [], 0
    while True:
        policy = np.nan_to_num(q, nan=-np.inf).argmax(axis=1).reshape(stages, NUM_CELLS)
        tests.append((trials, _ratio(policy)))
        if trials >= num_trials:
            break
        learned = q_learning(
            model, 500, 1.0, policy=EpsilonGreedy(_EPSILON), step_size=_ALPHA, seed=seed.spawn(1)[0],
            options=RunOptions(initial_q=np.nan_to_num(q), max_episode_steps=MOST_STEPS),
        )  # fmt: skip
        q, trials = learned.q, trials + learned.num_episodes
    at, ratios = zip(*tests, strict=True)
    return Study(np.array(at), np.array(ratios), np.zeros((stages, 3)), np.zeros(stages), np.zeros((3, NUM_CELLS)))


def modules_study(
    seed: np.random.SeedSequence,
    rates: CompositionalRates = CompositionalRates(),  # noqa: B008 - frozen
    *,
    labelled: bool = True,
    num_trials: int = 2000,
    test_every: int = 20,
    num_practised: int = PRACTICE,
) -> Study:
    """CQ-L: elemental tasks first, then the composite ones.

    Args:
        seed: of the stream.
        rates: constants of the learner.
        labelled: whether each elemental task is given a module of its own; else the gate has to find one.
        num_trials: of composite tasks.
        test_every: so many of them.
        num_practised: trials of elemental tasks before.

    Raises:
        ValueError: no trial.

    Example:
        >>> study = modules_study(np.random.SeedSequence(0), num_trials=20)
        >>> study.trials.tolist(), study.gates.shape
        ([0, 20], (10, 3))
    """
    check_whole("num_trials", num_trials)
    check_whole("test_every", test_every)
    learned = new_compositional_q(3, NUM_CELLS, 4, len(ROOM.goals))
    place = RoomArrays(ROOM.free, ROOM.led, ROOM.first, ROOM.goals, -0.05, 1.0)
    path = Path(np.zeros(MOST_STEPS, np.int64), np.zeros(MOST_STEPS, np.int64), np.zeros(MOST_STEPS))
    stream, practice = new_stream(seed), rates
    if labelled:
        learned.gates[: len(ELEMENTAL)] = np.where(np.eye(3, dtype=bool), 4.0, -4.0)
        practice = rates._replace(gate_step=0.0, bias_step=0.0)
    compositional_trials(learned, practice, place, ELEMENTAL, path, num_practised, stream)
    tests, trials = [(0, _ratio(_policy(learned)))], 0
    while trials < num_trials:
        compositional_trials(learned, rates, place, COMPOSITE, path, test_every, stream)
        trials += test_every
        tests.append((trials, _ratio(_policy(learned))))
    at, ratios = zip(*tests, strict=True)
    gates = np.exp(learned.gates)
    values = learned.q.max(axis=2)
    return Study(np.array(at), np.array(ratios), gates / gates.sum(axis=1, keepdims=True), learned.biases, values)


def _policy(learned: CompositionalQ) -> NDArray[np.int64]:
    """The best move of the likeliest module of each stage."""
    return np.asarray(learned.q.argmax(axis=2)[learned.gates.argmax(axis=1)])


def skills_study(seed: np.random.SeedSequence, num_trials: int = 200, test_every: int = 20) -> Study:
    """Lin's way: skills that were given and practised, and a coordinator that chooses among them.

    A skill is Q-learning of its own elemental task. The coordinator knows task and stage, not the cell; it runs a skill
    until that has reached its landmark or for 40 steps, and learns what that was worth by SMDP Q-learning.

    Args:
        seed: of the streams.
        num_trials: of composite tasks.
        test_every: so many of them.

    Raises:
        ValueError: no trial.

    Example:
        >>> skills_study(np.random.SeedSequence(0), num_trials=20).trials.tolist()
        [0, 20]
    """
    check_whole("num_trials", num_trials)
    check_whole("test_every", test_every)
    draws = seed.spawn(4)
    skills = [_practise(i, PRACTICE // 3, draws[i]) for i in range(3)]
    moves = [skill.argmax(axis=1) for skill in skills]
    rng, stages = np.random.default_rng(draws[3]), len(ROOM.goals)
    q, visits = np.zeros((stages, 3)), np.zeros((stages, 3), np.int64)
    env = gymnasium.make("neuralq/Landmarks-v0", tasks=tuple(TASKS[i] for i in COMPOSITE), disable_env_checker=True)
    offset = int(ROOM.first[COMPOSITE[0]])  # of its first stage among all
    env.reset(seed=int(rng.integers(2**31)))
    tests = [(0, _ratio(np.stack([moves[i] for i in q.argmax(axis=1)])))]
    for trial in range(1, num_trials + 1):
        _coordinate(env, q, visits, moves, offset, rng)
        if trial % test_every == 0:
            tests.append((trial, _ratio(np.stack([moves[i] for i in q.argmax(axis=1)]))))
    at, ratios = zip(*tests, strict=True)
    chosen = np.eye(3)[q.argmax(axis=1)]
    return Study(
        np.array(at), np.array(ratios), chosen, np.zeros(stages), np.stack([one.max(axis=1) for one in skills])
    )


def _practise(skill: int, num_trials: int, seed: np.random.SeedSequence) -> NDArray[np.float64]:
    """Q-learning of one elemental task for so many trials, or a few more."""
    model, q, trials = compile_model(mdp([TASKS[skill]]), "model"), np.zeros((NUM_CELLS, 4)), 0
    while trials < num_trials:
        learned = q_learning(
            model, 500, 1.0, policy=EpsilonGreedy(_EPSILON), step_size=_ALPHA, seed=seed.spawn(1)[0],
            options=RunOptions(initial_q=q, max_episode_steps=MOST_STEPS),
        )  # fmt: skip
        q, trials = np.nan_to_num(learned.q), trials + learned.num_episodes
    return q


def _coordinate(
    env: gymnasium.Env[int, int],
    q: NDArray[np.float64],
    visits: NDArray[np.int64],
    moves: list[NDArray[np.int64]],
    offset: int,
    rng: np.random.Generator,
) -> None:
    """One composite task: skills one after the other, and what each of them was worth."""
    s, _ = env.reset()
    steps, terminated = 0, False
    while not terminated and steps < MOST_STEPS:
        stage = offset + s // NUM_CELLS
        skill = int(rng.integers(3)) if rng.random() < _EPSILON else int(q[stage].argmax())
        ran = run_option(
            env, s, _acts(moves[skill]), _has_reached(int(ROOM.goals[skill])), most_steps=_MOST_OPTION_STEPS
        )
        visits[stage, skill] += 1
        step_size = max(0.1, 1.0 / visits[stage, skill])
        next_stage = offset + ran.s_t // NUM_CELLS
        smdp_q_update(q, stage, skill, ran.r_t, ran.duration, 0.0, next_stage, ran.terminated, step_size)
        s, terminated, steps = ran.s_t, ran.terminated, steps + ran.duration


def _acts(moves: NDArray[np.int64]) -> Callable[[int], int]:
    return lambda s: int(moves[s % NUM_CELLS])


def _has_reached(landmark: int) -> Callable[[int], bool]:
    return lambda s: s % NUM_CELLS == landmark

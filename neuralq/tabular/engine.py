"""One loop around every tabular learner: on a model in compiled code, on a Gymnasium environment step by step.

A learner owns its table and consumes transitions; where they come from is decided here. On an environment each step is
taken in Python and handed to the same kernel as a stored transition, so both engines make the same update.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice, check_discount, check_whole
from neuralq.mdp import AliasedMDP, FiniteMDP
from neuralq.tabular.kernels.acting import EPISODES, FORGET, RECORD, REPLAY, Log, Table, Walk, new_log, new_walk
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.learner import Learner
from neuralq.tabular.model import RESTARTS, Model, ModelArrays, compile_model, empty_arrays
from neuralq.tabular.results import Curve, Experience, Learned, masked
from neuralq.tabular.walking import EnvironmentWalk, WalkFault, state_reader

__all__ = ["RunOptions", "learn", "log_of", "new_table", "replay", "table_from"]

Source = FiniteMDP | AliasedMDP | Model | gymnasium.Env[Any, Any]
"""What can be learned on: a model, the same compiled once for many runs, or an environment with finite spaces."""


@dataclass(frozen=True)
class RunOptions:
    """What a run starts from and what it records.

    Args:
        initial_q: value of every legal pair at the start, a number or ``[S, A]``; above the true values it is optimism.
        max_episode_steps: a time limit: the episode is cut there, the bootstrap stays; None for none.
        restarts: where episodes of a model begin: ``"model"`` (its start distribution) or ``"uniform"``.
        record_every: steps between the records of the curve; None for no curve.
        exact_q: the exact action values ``[S, A]`` to measure distances from.
        record_experience: whether to return every transition.
        change: ``(step, model)``: from that step on transitions come from another model with the same legal actions,
            as in mazes whose walls move; None for a world that stays.

    Raises:
        ValueError: a value outside its range.
    """

    initial_q: ArrayLike = 0.0
    max_episode_steps: int | None = None
    restarts: str = "model"
    record_every: int | None = None
    exact_q: ArrayLike | None = None
    record_experience: bool = False
    change: tuple[int, FiniteMDP] | None = None

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_choice("restarts", self.restarts, RESTARTS)
        for name in ("max_episode_steps", "record_every"):
            value = getattr(self, name)
            if value is not None:
                check_whole(name, value)
        if self.change is not None:
            check_whole("change step", self.change[0])
        if self.exact_q is not None and self.record_every is None:
            raise ValueError("exact_q is used for the curve; set record_every too")


def new_table(source: Source, options: RunOptions) -> tuple[Table, Source]:
    """The table a run starts from, and the source ready to run.

    Raises:
        TypeError: a source of another kind, or an environment whose spaces are not finite.
        ValueError: initial values of another shape.

    Example:
        >>> table, _ = new_table(FiniteMDP.garnet(3, 2, 2, seed=0), RunOptions(initial_q=1.0))
        >>> table.q.tolist()
        [[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]]
    """
    if isinstance(source, FiniteMDP | AliasedMDP):
        source = compile_model(source, options.restarts)
    elif options.restarts != "model":
        raise ValueError(
            f"restarts={options.restarts!r} is for a FiniteMDP; a compiled model has its restarts built in, and an "
            "environment decides for itself"
        )
    if isinstance(source, Model):
        legal = source.legal
    elif isinstance(source, gymnasium.Env):
        states, actions = source.observation_space, source.action_space
        if not (isinstance(states, Discrete) and isinstance(actions, Discrete)):
            raise TypeError(f"a table needs Discrete spaces, got {states} and {actions}; encode them in a wrapper")
        legal = np.ones((int(states.n), int(actions.n)), dtype=bool)
    else:
        raise TypeError(f"learning needs a FiniteMDP, a compiled Model or a Gymnasium environment, got {source!r}")
    values = np.asarray(options.initial_q, dtype=np.float64)
    if values.shape not in ((), legal.shape):
        raise ValueError(f"initial_q must be a number or have shape {legal.shape}, got shape {values.shape}")
    start = np.broadcast_to(values, legal.shape)
    if not np.isfinite(start[legal]).all():
        s, a = np.argwhere(legal & ~np.isfinite(start))[0]
        raise ValueError(f"initial_q must be finite where an action is legal, got {start[s, a]} at s={s}, a={a}")
    return table_from(np.where(legal, start, -np.inf)), source


def table_from(q: ArrayLike) -> Table:
    """A table that starts from these values ``[S, A]``; NaN and −∞ mark illegal actions.

    Raises:
        ValueError: not a matrix.

    Example:
        >>> table_from([[1.0, np.nan]]).num_legal.tolist()
        [1]
    """
    values = np.array(q, dtype=np.float64)
    if values.ndim != 2:
        raise ValueError(f"q must have shape [S, A], got shape {values.shape}")
    values[np.isnan(values)] = -np.inf
    legal = values > -np.inf
    return Table(values, np.zeros(values.shape, dtype=np.int64), legal.sum(axis=1).astype(np.uint64))


def learn(learner: Learner, source: Source, num_steps: int, gamma: float, seed: Seed, options: RunOptions) -> Learned:
    """Run a learner for ``num_steps`` transitions.

    Raises:
        ValueError: a count or discount out of range, or an exact Q of another shape.
    """
    check_whole("num_steps", num_steps)
    check_discount("gamma", gamma)
    num_steps, gamma = int(num_steps), float(gamma)  # kernels are compiled anew for a 1 in the place of 1.0
    walk = new_walk(seed, options.max_episode_steps)
    log = new_log(num_steps if options.record_experience else 0, RECORD if options.record_experience else FORGET)
    later = _changed(source, options)
    if isinstance(source, Model):
        arrays, world = source.arrays, None
    else:
        assert isinstance(source, gymnasium.Env)
        arrays, world = empty_arrays(), EnvironmentWalk(source, _reader(source), learner, walk, _first_seed(seed))
    # Compiled here, so that the clock measures learning.
    _learn_some(learner, world, arrays, walk, log, gamma, 0)
    recorder = _Recorder(learner.table.q, options)
    chunk, seconds, taken = options.record_every or num_steps, 0.0, 0
    while taken < num_steps:
        count = min(chunk - taken % chunk, num_steps - taken)
        if options.change is not None and later is not None:
            if taken == options.change[0]:
                arrays = later.arrays
            elif taken < options.change[0]:
                count = min(count, options.change[0] - taken)
        began = time.thread_time()
        _learn_some(learner, world, arrays, walk, log._replace(offset=taken), gamma, count)
        seconds += time.thread_time() - began
        taken += count
        if taken % chunk == 0 or taken == num_steps:
            recorder.note(taken)
    return _result(learner, walk, log, recorder, num_steps, seconds)


def _learn_some(
    learner: Learner, world: EnvironmentWalk | None, arrays: ModelArrays, walk: Walk, log: Log, gamma: float, count: int
) -> None:
    """``count`` transitions more, of the model or of the environment."""
    if world is None:
        learner.run(arrays, walk, log, gamma, count)
        return
    try:
        world.run(gamma, count, log if log.mode == RECORD else None)
    except WalkFault as fault:
        raise fault.__cause__ or ValueError(str(fault)) from None


def _reader(env: gymnasium.Env[Any, Any]) -> Callable[[Any], int]:
    assert isinstance(env.observation_space, Discrete)
    return state_reader(env.observation_space)


def _first_seed(seed: Seed) -> int:
    """Of the environment: a draw of its own, which is not the policy's stream."""
    sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return int(sequence.generate_state(5)[4] >> 1)


def _changed(source: Source, options: RunOptions) -> Model | None:
    """The model that ``options.change`` brings, checked against the first."""
    if options.change is None:
        return None
    if not isinstance(source, Model):
        raise ValueError("change is for models; an environment changes by itself")
    later = compile_model(options.change[1])
    if not np.array_equal(later.legal, source.legal):
        raise ValueError("the model that change brings must have the same states and legal actions")
    return later


def replay(learner: Learner, experience: Experience, seed: Seed = 0) -> Learned:
    """Run a learner over recorded transitions, in their order.

    Raises:
        ValueError: a state or action outside the table, or no next action where an on-policy rule needs one.
    """
    num_states, num_actions = learner.table.q.shape
    for name, size in (("s_tm1", num_states), ("a_tm1", num_actions), ("s_t", num_states)):
        column = getattr(experience, name)
        bad = np.flatnonzero((column < 0) | (column >= size))
        if bad.size:
            raise ValueError(f"{name}[{bad[0]}] must lie in 0..{size - 1}, got {column[bad[0]]}")
    lacking = np.flatnonzero((experience.next_actions < 0) & (experience.discount_t != 0))
    beyond = np.flatnonzero(experience.next_actions >= num_actions)
    if learner.on_policy and (lacking.size or beyond.size):
        row = int(lacking[0] if lacking.size else beyond[0])
        raise ValueError(f"row {row} bootstraps from the next action, but a_t is {experience.next_actions[row]} there")
    log, walk, e = log_of(experience), new_walk(seed), experience
    learner.run(empty_arrays(), walk, log, 0.0, 0)
    began = time.thread_time()
    learner.run(empty_arrays(), walk, log, 0.0, len(e))
    seconds = time.thread_time() - began
    walk.counters[EPISODES] = int(e.last_t.sum())
    return _result(learner, walk, log, _Recorder(learner.table.q, RunOptions()), len(e), seconds)


def log_of(experience: Experience) -> Log:
    """Recorded transitions as kernels replay them.

    Example:
        >>> log_of(Experience([0], [0], [1.0], [0.0], [0], [True])).a_t.tolist()
        [-1]
    """
    e = experience
    return Log(REPLAY, 0, e.s_tm1, e.a_tm1, e.r_t, e.discount_t, e.s_t, e.next_actions, e.last_t)


def _result(learner: Learner, walk: Walk, log: Log, recorder: _Recorder, num_steps: int, seconds: float) -> Learned:
    experience = None
    lengths = np.zeros(0, dtype=np.int64)
    if log.mode == RECORD:
        experience = Experience(log.s_tm1, log.a_tm1, log.r_t, log.discount_t, log.s_t, log.last_t, log.a_t)
        lengths = np.diff(np.flatnonzero(log.last_t), prepend=-1)
    table, backups = learner.table, learner.backups
    return Learned(
        q=masked(table.q), visits=table.visits.copy(), num_steps=num_steps, episode_lengths=lengths,
        num_episodes=int(walk.counters[EPISODES]), num_backups=num_steps if backups is None else int(backups[0]),
        average_reward=np.nan, curve=recorder.curve(), experience=experience, cpu_seconds=seconds,
    )  # fmt: skip


class _Recorder:
    """The columns of a `Curve`, measured between chunks."""

    def __init__(self, q: NDArray[np.float64], options: RunOptions) -> None:
        self._q = q
        self._wanted = options.record_every is not None
        self._exact = None if options.exact_q is None else np.asarray(options.exact_q, dtype=np.float64)
        if self._exact is not None and self._exact.shape != q.shape:
            raise ValueError(f"exact_q must have shape {q.shape}, got {self._exact.shape}")
        self._before = q.copy()
        self._rows: list[tuple[float, ...]] = []

    def note(self, step: int) -> None:
        if not self._wanted:
            return
        legal = self._q > -np.inf
        distance = excess = np.nan
        if self._exact is not None:
            known = legal & np.isfinite(self._exact)  # an environment shows only on the way which actions are legal
            difference = self._q[known] - self._exact[known]
            distance, excess = float(np.max(np.abs(difference))), float(np.max(difference))
        fall = float(np.max(self._before[legal] - self._q[legal], initial=0.0))
        self._rows.append((step, distance, excess, float(np.min(self._q[legal])), fall))
        self._before[:] = self._q

    def curve(self) -> Curve | None:
        if not self._wanted:
            return None
        steps, *rest = np.array(self._rows, dtype=np.float64).T
        return Curve(steps.astype(np.int64), *rest)

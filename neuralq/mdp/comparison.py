"""Whether an environment does what its transition table says: its steps are drawn and looked up in the table.

A table can be wrong in three ways that a sample shows: an outcome that it does not have (another state, reward or end),
outcomes that come more or less often than it says, and first states that are not those of its start distribution. Draws
are made on a copy of the environment, wrappers and all, first along its own episodes, then from every state, where the
environment keeps it in an attribute ``s`` that can be set. What would be chance once in a million models is no finding.
"""

from __future__ import annotations

import copy
import itertools
import math
import time
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics, TimeLimit

if TYPE_CHECKING:
    from neuralq.mdp.model import FiniteMDP

__all__ = ["changing_wrapper", "difference"]

_Seen = tuple[int, float, bool]  # s', r, terminated
_Step = tuple[int, int, _Seen]  # s, a, what came of it
_Outcome = tuple[_Seen, float]  # what may come of it, and how probably

_NEUTRAL = (TimeLimit, OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics)
_MOST_STEPS = 4000  # half of them along episodes, half from states that are set
_MOST_SECONDS = 1.0
_LONGEST_WALK, _STEPS_FROM_A_SET_STATE = 50, 4
_SURPRISE = 20.0  # nats: e⁻²⁰ is once in 5·10⁸, over some thousand comparisons


def changing_wrapper(env: gymnasium.Env[Any, Any]) -> str | None:
    """The outermost wrapper that may change what the environment does, by its name; a time limit does not.

    Example:
        >>> changing_wrapper(gymnasium.make("FrozenLake-v1")) is None
        True
    """
    while isinstance(env, gymnasium.Wrapper):
        if type(env) not in _NEUTRAL:
            return type(env).__name__
        env = env.env
    return None


def difference(env: gymnasium.Env[Any, Any], mdp: FiniteMDP, start: Any) -> str | None:
    """What ``env`` does that its model does not have, in words; None where a few thousand steps show nothing.

    Args:
        env: the environment, which is not touched.
        mdp: its model, with outcomes.
        start: the model's start distribution where the environment states one, else None.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> lake = gymnasium.make("FrozenLake-v1")
        >>> difference(lake, FiniteMDP.from_gymnasium(lake, check=False), None) is None
        True
    """
    for what, outer, inner, size in (
        ("observations", env.observation_space, env.unwrapped.observation_space, mdp.num_states),
        ("actions", env.action_space, env.unwrapped.action_space, mdp.num_actions),
    ):
        if not isinstance(outer, Discrete) or outer != inner or outer.n != size or outer.start != 0:
            return f"its {what} are {outer}, and not the numbers 0..{size - 1} of the table"
    try:
        twin = copy.deepcopy(env)
    except Exception as error:  # whatever a foreign environment cannot copy
        warnings.warn(
            f"{env} cannot be copied ({type(error).__name__}), so its table was not compared with what step does",
            stacklevel=3,
        )
        return None
    return _Comparison(twin, mdp, start).difference()


class _Comparison:
    """The draws of one comparison: how often each outcome of each row came."""

    def __init__(self, twin: gymnasium.Env[Any, Any], mdp: FiniteMDP, start: Any) -> None:
        self._env, self._mdp, self._rng = twin, mdp, np.random.default_rng(0)
        self._start = start
        self._row_starts, self._actions = mdp.row_starts.tolist(), mdp.a_tm1.tolist()
        self._begins = np.zeros(mdp.num_states)
        self._cells: dict[int, list[_Outcome]] = {}  # of the rows that were drawn
        self._times: dict[int, list[int]] = {}
        self._ends = time.monotonic() + _MOST_SECONDS

    def difference(self) -> str | None:
        self._env.reset(seed=0)
        for step in self._walks():
            if not self._counts(step):
                return self._told(step)
        self._ends = time.monotonic() + _MOST_SECONDS
        walks = list(self._walks_from_set_states())
        misled = sum(not self._has(walk[0]) for walk in walks)
        if 2 * misled < len(walks):  # else the attribute is not the state
            for step in itertools.chain.from_iterable(walks):
                if not self._counts(step):
                    return self._told(step)
        return self._unlikely_outcome() or self._unlikely_start()

    def _walks(self) -> Iterator[_Step]:
        left = _MOST_STEPS // 2
        while left > 0 and time.monotonic() < self._ends:
            s = int(self._env.reset()[0])
            self._begins[s] += 1
            left -= 1
            for step in self._walk(s, min(left, _LONGEST_WALK)):
                left -= 1
                yield step

    def _walks_from_set_states(self) -> Iterator[list[_Step]]:
        inner: Any = self._env.unwrapped
        first = self._env.reset()[0]
        if not isinstance(getattr(inner, "s", None), int | np.integer) or int(inner.s) != int(first):
            return
        left = _MOST_STEPS // 2
        while left > 0:
            for s in self._rng.permutation(np.flatnonzero(~self._mdp.is_terminal)):
                if left <= 0 or time.monotonic() > self._ends:
                    return
                try:
                    self._env.reset()
                    inner.s = int(s)
                    steps = list(self._walk(int(s), _STEPS_FROM_A_SET_STATE))
                except Exception:  # it was no state that can be set
                    return
                left -= len(steps)
                yield steps

    def _walk(self, s: int, num_steps: int) -> Iterator[_Step]:
        for _ in range(num_steps):
            first, last = self._row_starts[s], self._row_starts[s + 1]
            if first == last:
                return
            a = self._actions[first + int((last - first) * self._rng.random())]
            s_t, reward, terminated, truncated, _ = self._env.step(a)
            yield s, a, (int(s_t), float(reward), bool(terminated))
            if terminated or truncated:
                return
            s = int(s_t)

    def _outcomes(self, row: int) -> list[_Outcome]:
        """What the table has for a row, as often as it lists it."""
        source = self._mdp.outcomes
        assert source is not None
        span = slice(source.indptr[row], source.indptr[row + 1])
        return [
            ((int(s_t), float(r_t), bool(ends)), float(p))
            for s_t, r_t, ends, p in zip(
                source.s_t[span], source.reward[span], source.terminated[span], source.probability[span], strict=True
            )
            if p > 0
        ]

    def _has(self, step: _Step) -> bool:
        """Whether the table has this step."""
        s, a, seen = step
        return any(_same(outcome, seen) for outcome, _ in self._outcomes(self._actions.index(a, self._row_starts[s])))

    def _counts(self, step: _Step) -> bool:
        """As `_has`; a step that the table has is counted, as the first of those that are the same."""
        s, a, seen = step
        row = self._actions.index(a, self._row_starts[s])
        if row not in self._cells:
            self._cells[row] = self._outcomes(row)
            self._times[row] = [0] * len(self._cells[row])
        for j, (outcome, _) in enumerate(self._cells[row]):
            if _same(outcome, seen):
                self._times[row][j] += 1
                return True
        return False

    def _told(self, step: _Step) -> str:
        s, a, (s_t, reward, terminated) = step
        end = " and the end of the episode" if terminated else ""
        return (
            f"in {self._mdp.state_name(s)} action {a} led to state {s_t} with reward {reward:g}{end}, "
            "which the table does not have"
        )

    def _unlikely_outcome(self) -> str | None:
        """An outcome of a row, or of one place in all rows, that came much more or less often than the table says."""
        places: dict[int, list[float]] = {}  # how often it came, was expected, and with what variance
        for row, cells in self._cells.items():
            num = sum(self._times[row])
            for j, (outcome, _) in enumerate(cells):
                if any(_same(outcome, earlier) for earlier, _ in cells[:j]):
                    continue  # counted there
                p = min(1.0, sum(share for other, share in cells if _same(other, outcome)))
                seen, expected, variance = self._times[row][j], num * p, num * p * (1 - p)
                if _surprise(seen, expected, variance) > _SURPRISE:
                    where = f"{self._mdp.row_name(row)} led to state {outcome[0]}"
                    return f"{where} {seen} times of {num}, where the table says {expected:.1f}"
                total = places.setdefault(j, [0.0, 0.0, 0.0])
                places[j] = [x + y for x, y in zip(total, (seen, expected, variance), strict=True)]
        for j, (came, wanted, spread) in places.items():
            if _surprise(came, wanted, spread) > _SURPRISE:
                what = f"the outcomes that stand at place {j} of their rows came {came:g} times"
                return f"{what}, where the table says {wanted:.1f}"
        return None

    def _unlikely_start(self) -> str | None:
        if self._start is None:
            return None
        num = float(self._begins.sum())
        for s, p in enumerate(self._mdp.start_distribution):
            if _surprise(self._begins[s], num * p, num * p * (1 - p)) > _SURPRISE or (p == 0 and self._begins[s] > 0):
                return (
                    f"{self._begins[s]:g} of {num:g} episodes began in {self._mdp.state_name(s)}, where its "
                    f"initial_state_distrib says {num * p:.1f}"
                )
        return None


def _same(one: tuple[int, float, bool], other: tuple[int, float, bool]) -> bool:
    return one[0] == other[0] and one[2] == other[2] and math.isclose(one[1], other[1], rel_tol=1e-6, abs_tol=1e-9)


def _surprise(seen: float, expected: float, variance: float) -> float:
    """−log of a bound on the chance of a sum of independent events so far from its mean (Bernstein's inequality)."""
    off = abs(seen - expected)
    return off * off / (2 * (variance + off / 3)) if off > 1e-9 else 0.0

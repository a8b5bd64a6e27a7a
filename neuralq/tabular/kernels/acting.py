"""Kernels that choose actions and make the next transition, shared by every tabular learner.

A transition comes from the model, or from recorded arrays: learners do not see which. So one compiled kernel per
family learns from a model, from stored experience and, one transition at a time, from any Gymnasium environment.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.random_numbers import Seed, new_stream, uniform
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import (
    EPSILON_GREEDY,
    K_TO_THE_Q,
    POWER,
    RANDOM,
    SEARCHING,
    SOFTMAX,
    VISITS,
    ActingCode,
    StepCode,
)

__all__ = [
    "BOOTSTRAPS",
    "Log",
    "Table",
    "Walk",
    "best_value",
    "choose",
    "expected_value",
    "moved",
    "new_log",
    "new_walk",
    "next_step",
    "step_length",
]

STEP, STATE, ACTION, EPISODE_STEPS, EPISODES, LIMIT = range(6)
FORGET, RECORD, REPLAY = range(3)
BOOTSTRAPS = ("q-learning", "sarsa", "expected-sarsa")
MAXIMUM, SARSA, EXPECTED = range(3)

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


class Table(NamedTuple):
    """Action values ``[S, A]`` (−∞ where illegal), visits of pairs ``[S, A]``, numbers of legal actions ``[S]``."""

    q: NDArray[np.float64]
    visits: NDArray[np.int64]
    num_legal: NDArray[np.uint64]


class Walk(NamedTuple):
    """Where the agent is: counters (indexed by the constants above) and its random stream."""

    counters: NDArray[np.int64]
    rng: NDArray[np.uint64]


class Log(NamedTuple):
    """Recorded transitions: written when ``mode`` is RECORD, read when it is REPLAY, from row ``offset`` on."""

    mode: int
    offset: int
    s_tm1: NDArray[np.int64]
    a_tm1: NDArray[np.int64]
    r_t: NDArray[np.float64]
    discount_t: NDArray[np.float64]
    s_t: NDArray[np.int64]
    a_t: NDArray[np.int64]
    last_t: NDArray[np.bool_]


def new_walk(seed: Seed, max_episode_steps: int | None = None) -> Walk:
    """A walk that has not begun.

    Example:
        >>> new_walk(0).counters.tolist()
        [0, -1, -1, 0, 0, 0]
    """
    return Walk(np.array([0, -1, -1, 0, 0, max_episode_steps or 0], dtype=np.int64), new_stream(seed))


def new_log(num_steps: int, mode: int) -> Log:
    """Arrays for ``num_steps`` transitions.

    Example:
        >>> new_log(3, RECORD).a_t.tolist()
        [-1, -1, -1]
    """
    n = num_steps
    whole, number = np.int64, np.float64
    return Log(
        mode, 0, np.zeros(n, whole), np.zeros(n, whole), np.zeros(n, number), np.zeros(n, number),
        np.zeros(n, whole), np.full(n, -1, whole), np.zeros(n, bool),
    )  # fmt: skip


@lean_kernel
def best_value(q: NDArray[np.float64], s: Any) -> Any:
    """The largest value of a state; NaN is skipped only if it is not first.

    Example:
        >>> best_value(np.array([[1.0, 3.0]]), np.uint64(0))
        3.0
    """
    top = q[s, _ZERO]
    for a in range(_ONE, np.uint64(q.shape[1])):
        if q[s, a] > top:
            top = q[s, a]
    return top


@lean_kernel
def _nth_legal(table: Table, s: Any, n: Any) -> Any:
    """Action number ``n`` among the legal ones of ``s``."""
    if table.num_legal[s] == np.uint64(table.q.shape[1]):
        return n
    left = n
    last = _ZERO
    for a in range(_ZERO, np.uint64(table.q.shape[1])):
        if table.q[s, a] > -np.inf:
            if left == _ZERO:
                return a
            left -= _ONE
            last = a
    return last


@lean_kernel
def _best_action(q: NDArray[np.float64], s: Any, random_ties: bool, rng: NDArray[np.uint64]) -> Any:
    """The best action, the lowest of those that tie or one of them drawn."""
    top, best, ties = q[s, _ZERO], _ZERO, _ONE
    for a in range(_ONE, np.uint64(q.shape[1])):
        value = q[s, a]
        if value > top:
            top, best, ties = value, a, _ONE
        elif value == top:
            ties += _ONE
    if random_ties and ties > _ONE:
        left = np.uint64(uniform(rng) * np.float64(ties))
        for a in range(best, np.uint64(q.shape[1])):
            if q[s, a] == top:
                if left == _ZERO:
                    return a
                left -= _ONE
    return best


@lean_kernel
def _inverse_temperature(policy: ActingCode, step: int) -> Any:
    """Ln k, or 1 / temperature: the factor of Q in the exponent."""
    level = policy.first + policy.slope * min(step, policy.num_steps)
    if policy.kind == K_TO_THE_Q:
        return math.log(level)
    return 1.0 / level


@lean_kernel
def _choose_boltzmann(table: Table, s: Any, beta: float, rng: NDArray[np.uint64]) -> Any:
    """An action in proportion to exp(β q), relative to the likeliest, so nothing overflows."""
    num_actions = np.uint64(table.q.shape[1])
    top = -np.inf
    for a in range(num_actions):
        if table.q[s, a] > -np.inf:
            top = max(top, beta * table.q[s, a])
    total = 0.0
    for a in range(num_actions):
        if table.q[s, a] > -np.inf:
            total += math.exp(beta * table.q[s, a] - top)
    left = uniform(rng) * total
    last = _ZERO
    for a in range(num_actions):
        if table.q[s, a] > -np.inf:
            left -= math.exp(beta * table.q[s, a] - top)
            last = a
            if left < 0:
                break
    return last


@lean_kernel
def _choose_by_bound(table: Table, s: Any, c: float, random_ties: bool, rng: NDArray[np.uint64]) -> Any:
    """The action with the largest upper confidence bound."""
    num_actions = np.uint64(table.q.shape[1])
    visits = 0
    for a in range(num_actions):
        visits += table.visits[s, a]
    top, best, ties = -np.inf, _ZERO, _ZERO
    for a in range(num_actions):
        value = table.q[s, a]
        if value > -np.inf:
            n = table.visits[s, a]
            bound = np.inf if n == 0 else value + c * math.sqrt(math.log(1.0 + visits) / n)
            if bound > top:
                top, best, ties = bound, a, _ONE
            elif bound == top:
                ties += _ONE
                # Reservoir sampling: the j-th of equals replaces the choice with probability 1/j.
                if random_ties and uniform(rng) * np.float64(ties) < 1.0:
                    best = a
    return best


@lean_kernel
def choose(table: Table, s: Any, step: int, policy: ActingCode, rng: NDArray[np.uint64]) -> Any:
    """The policy's action in state ``s`` at step ``step`` of the run.

    Example:
        >>> from neuralq.tabular.policies import EpsilonGreedy
        >>> table = Table(np.array([[1.0, 3.0, -np.inf]]), np.zeros((1, 3), np.int64), np.array([2], np.uint64))
        >>> choose(table, np.uint64(0), 0, EpsilonGreedy(0.0).code(), new_stream(0))
        1
    """
    if policy.kind == EPSILON_GREEDY or policy.kind == RANDOM:
        epsilon = 1.0
        if policy.kind == EPSILON_GREEDY:
            epsilon = policy.first + policy.slope * min(step, policy.num_steps)
        if epsilon > 0.0:
            u = uniform(rng)
            if u < epsilon:
                legal = table.num_legal[s]
                return _nth_legal(table, s, min(np.uint64(u / epsilon * np.float64(legal)), legal - _ONE))
        return _best_action(table.q, s, policy.random_ties, rng)
    if policy.kind == K_TO_THE_Q or policy.kind == SOFTMAX:
        return _choose_boltzmann(table, s, _inverse_temperature(policy, step), rng)
    return _choose_by_bound(table, s, policy.first, policy.random_ties, rng)


@lean_kernel
def expected_value(table: Table, s: Any, step: int, policy: ActingCode) -> Any:
    """Σ_a π(a|s) q(s, a) under the policy at step ``step``; not defined for confidence bounds.

    Example:
        >>> from neuralq.tabular.policies import RandomPolicy
        >>> table = Table(np.array([[1.0, 3.0, -np.inf]]), np.zeros((1, 3), np.int64), np.array([2], np.uint64))
        >>> expected_value(table, np.uint64(0), 0, RandomPolicy().code())
        2.0
    """
    num_actions = np.uint64(table.q.shape[1])
    if policy.kind == EPSILON_GREEDY or policy.kind == RANDOM:
        epsilon = 1.0
        if policy.kind == EPSILON_GREEDY:
            epsilon = policy.first + policy.slope * min(step, policy.num_steps)
        total = 0.0
        for a in range(num_actions):
            if table.q[s, a] > -np.inf:
                total += table.q[s, a]
        mean = total / np.float64(table.num_legal[s])
        return (1.0 - epsilon) * best_value(table.q, s) + epsilon * mean
    beta = _inverse_temperature(policy, step)
    top, total, mass = -np.inf, 0.0, 0.0
    for a in range(num_actions):
        if table.q[s, a] > -np.inf:
            top = max(top, beta * table.q[s, a])
    for a in range(num_actions):
        if table.q[s, a] > -np.inf:
            weight = math.exp(beta * table.q[s, a] - top)
            mass += weight
            total += weight * table.q[s, a]
    return total / mass


@lean_kernel
def moved(value: float, target: float, alpha: float) -> float:
    """(1 − α) value + α target; with α = 1 the target itself, to the last bit.

    Example:
        >>> moved(1.0, 3.0, 0.5), moved(1e300, 0.1, 1.0)
        (2.0, 0.1)
    """
    return target if alpha == 1.0 else value + alpha * (target - value)


@lean_kernel
def _draw_outcome(keep: NDArray[np.float64], alias: NDArray[np.uint64], first: Any, num: Any, u: float) -> Any:
    """The outcome of ``first:first + num`` that a uniform number picks from the alias tables."""
    x = u * np.float64(num)
    extra = np.uint64(x)
    j = first + extra
    return alias[j] if x - np.float64(extra) >= keep[j] else j


@lean_kernel
def step_length(rule: StepCode, n: int) -> Any:
    """α of the n-th visit of a pair.

    Example:
        >>> from neuralq.tabular.policies import step_code
        >>> step_length(step_code("visits", 1), 1)
        0.5
    """
    if rule.kind == VISITS:
        return 1.0 / (1.0 + n)
    if rule.kind == POWER:
        return float(n) ** -rule.value
    if rule.kind == SEARCHING:
        return rule.value / (1.0 + (n - 1) / rule.scale)
    if rule.listed.size > 0:
        return rule.listed[np.uint64(min(n, rule.listed.size) - 1)]
    return rule.value


@lean_kernel
def next_step(
    model: ModelArrays, policy: ActingCode, table: Table, walk: Walk, log: Log, i: int, gamma: float, on_policy: bool
) -> Any:
    """Transition number ``i`` of this call: ``(s_tm1, a_tm1, r_t, discount_t, s_t, a_t, last_t)``.

    ``a_t`` is the action that will be taken next, chosen before the update, if ``on_policy``; else −1.
    """
    counters, rng = walk.counters, walk.rng
    if log.mode == REPLAY:
        k = np.uint64(log.offset + i)
        counters[STEP] += 1
        return (
            np.uint64(log.s_tm1[k]), np.uint64(log.a_tm1[k]), log.r_t[k], log.discount_t[k],
            np.uint64(log.s_t[k]), log.a_t[k], log.last_t[k],
        )  # fmt: skip
    if counters[STATE] < 0:
        j = _draw_outcome(model.start_keep, model.start_alias, _ZERO, model.start_keep.size, uniform(rng))
        counters[STATE] = np.int64(model.start_state[j])
    hidden = np.uint64(counters[STATE])
    s = model.observe[hidden] if model.observe.size > 0 else hidden
    step = counters[STEP]
    a = np.uint64(counters[ACTION]) if counters[ACTION] >= 0 else choose(table, s, step, policy, rng)
    pair = hidden * np.uint64(table.q.shape[1]) + a
    j = model.first[pair]
    num_outcomes = model.first[pair + _ONE] - j
    if num_outcomes > _ONE:
        j = _draw_outcome(model.keep, model.alias, j, num_outcomes, uniform(rng))
    hidden_t, r_t, ends = model.s_t[j], model.reward[j], model.ends[j]
    s_t = model.observe[hidden_t] if model.observe.size > 0 else hidden_t
    discount_t = 0.0 if ends else gamma
    counters[STEP] = step + 1
    counters[EPISODE_STEPS] += 1
    last = ends or (counters[LIMIT] > 0 and counters[EPISODE_STEPS] >= counters[LIMIT])
    a_t = np.int64(-1)
    if on_policy and not ends:
        a_t = np.int64(choose(table, s_t, step + 1, policy, rng))
    if last:
        counters[STATE] = -1
        counters[ACTION] = -1
        counters[EPISODE_STEPS] = 0
        counters[EPISODES] += 1
    else:
        counters[STATE] = np.int64(hidden_t)
        counters[ACTION] = a_t
    if log.mode == RECORD:
        k = np.uint64(log.offset + i)
        log.s_tm1[k], log.a_tm1[k], log.r_t[k], log.discount_t[k] = np.int64(s), np.int64(a), r_t, discount_t
        log.s_t[k], log.a_t[k], log.last_t[k] = np.int64(s_t), a_t, last
    return s, a, r_t, discount_t, s_t, a_t, last

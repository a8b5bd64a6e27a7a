"""Q-learning from a model at full speed: the loop of `neuralq.tabular.kernels.one_step` with everything in registers.

It covers what is run most: Q-learning, no recording, ε-greedy or random actions. Draw for draw it does what the general
kernel does; tests/test_tabular.py holds the two to the same bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import EPISODE_STEPS, EPISODES, LIMIT, STATE, STEP, Table, Walk, moved, step_length
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import RANDOM, VISITS, ActingCode, StepCode

__all__ = ["run_q_learning"]

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)
_STEP, _OUT, _OUT_BACK = np.uint64(17), np.uint64(23), np.uint64(41)
_LAST, _LAST_BACK, _TOP_BITS = np.uint64(45), np.uint64(19), np.uint64(11)
_UNIT = 1.0 / (1 << 53)


@lean_kernel
def _draw(s0: Any, s1: Any, s2: Any, s3: Any) -> Any:
    """`random_numbers.uniform` with its state in registers."""
    total = s0 + s3
    result = ((total << _OUT) | (total >> _OUT_BACK)) + s0
    shifted = s1 << _STEP
    s2 ^= s0
    s3 ^= s1
    s1 ^= s2
    s0 ^= s3
    s2 ^= shifted
    s3 = (s3 << _LAST) | (s3 >> _LAST_BACK)
    return np.float64(result >> _TOP_BITS) * _UNIT, s0, s1, s2, s3


@lean_kernel
def run_q_learning(
    model: ModelArrays, policy: ActingCode, table: Table, walk: Walk, step_size: StepCode, gamma: float, num_steps: int
) -> None:
    """``num_steps`` transitions from the model, each followed by its update; ε-greedy or random."""
    q, visits, num_legal = table.q, table.visits, table.num_legal
    first, keep, alias = model.first, model.keep, model.alias
    successor, reward, ending = model.s_t, model.reward, model.ends
    counters, rng = walk.counters, walk.rng
    s0, s1, s2, s3 = rng[0], rng[1], rng[2], rng[3]
    num_actions = np.uint64(q.shape[1])
    limit = counters[LIMIT] if counters[LIMIT] > 0 else np.iinfo(np.int64).max
    left = limit - counters[EPISODE_STEPS]
    begin = counters[STATE] < 0
    s = _ZERO if begin else np.uint64(counters[STATE])
    random_ties, is_random, by_visits = policy.random_ties, policy.kind == RANDOM, step_size.kind == VISITS
    start_step = counters[STEP]
    epsilon, moving = policy.first, policy.slope != 0.0
    for i in range(num_steps):
        if begin:
            u, s0, s1, s2, s3 = _draw(s0, s1, s2, s3)
            x = u * model.start_keep.size
            j = np.uint64(x)
            if x - np.float64(j) >= model.start_keep[j]:
                j = model.start_alias[j]
            s = model.start_state[j]
        if is_random:
            epsilon = 1.0
        elif moving:
            epsilon = policy.first + policy.slope * min(start_step + i, policy.num_steps)
        greedy = True
        a = _ZERO
        if epsilon > 0.0:
            u, s0, s1, s2, s3 = _draw(s0, s1, s2, s3)
            if u < epsilon:
                greedy = False
                legal = num_legal[s]
                a = min(np.uint64(u / epsilon * np.float64(legal)), legal - _ONE)
                if legal != num_actions:
                    count = a
                    for b in range(num_actions):
                        if q[s, b] > -np.inf:
                            a = b
                            if count == _ZERO:
                                break
                            count -= _ONE
        if greedy:
            top, ties = q[s, _ZERO], _ONE
            for b in range(_ONE, num_actions):
                value = q[s, b]
                if value > top:
                    top, a, ties = value, b, _ONE
                elif value == top:
                    ties += _ONE
            if random_ties and ties > _ONE:
                u, s0, s1, s2, s3 = _draw(s0, s1, s2, s3)
                count = np.uint64(u * np.float64(ties))
                for b in range(a, num_actions):
                    if q[s, b] == top:
                        a = b
                        if count == _ZERO:
                            break
                        count -= _ONE
        pair = s * num_actions + a
        j = first[pair]
        num_outcomes = first[pair + _ONE] - j
        if num_outcomes > _ONE:
            u, s0, s1, s2, s3 = _draw(s0, s1, s2, s3)
            x = u * np.float64(num_outcomes)
            extra = np.uint64(x)
            j += extra
            if x - np.float64(extra) >= keep[j]:
                j = alias[j]
        s_t, target, ends = successor[j], reward[j], ending[j]
        n = visits[s, a] + 1
        visits[s, a] = n
        alpha = 1.0 / (1.0 + n) if by_visits else step_length(step_size, n)
        if not ends and gamma != 0.0:
            top = q[s_t, _ZERO]
            for b in range(_ONE, num_actions):
                top = max(top, q[s_t, b])
            target += gamma * top
        q[s, a] = moved(q[s, a], target, alpha)
        left -= 1
        begin = ends or left <= 0
        s = s_t
        if begin:
            left = limit
            counters[EPISODES] += 1
    counters[STATE] = -1 if begin else np.int64(s)
    counters[STEP] = start_step + num_steps
    counters[EPISODE_STEPS] = limit - left
    rng[0], rng[1], rng[2], rng[3] = s0, s1, s2, s3

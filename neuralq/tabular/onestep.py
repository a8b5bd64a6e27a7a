"""One-step control: Q-learning, Sarsa, expected Sarsa and double Q-learning, in one kernel.

Every rule moves the value of the pair just left towards a target,

    Q(s_tm1, a_tm1) ← (1 − α) Q(s_tm1, a_tm1) + α [r_t + discount_t · bootstrap]                   (Mitchell 13.10)

with bootstrap max_a Q(s_t, a) (Q-learning), Q(s_t, a_t) (Sarsa), Σ_a π(a|s_t) Q(s_t, a) (expected Sarsa), or the value
that one table gives to the best action of the other (double Q-learning). With α = 1 the value *is* the target, which is
Mitchell's rule 13.7. Q-learning chooses its action after the update of the step before, as Table 13.1 says.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import FORGET, Log, Table, Walk, best_value, expected_value, next_step, step_length
from neuralq.tabular.kernels.q_learning import run_q_learning
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import EPSILON_GREEDY, RANDOM, ActingCode, StepCode

__all__ = ["OneStep", "run_one_step"]

RULES = ("q-learning", "sarsa", "expected-sarsa", "double-q")
Q_LEARNING, SARSA, EXPECTED, DOUBLE = range(4)

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


@lean_kernel
def run_one_step(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    rule: int,
    halves: NDArray[np.float64],
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions, each followed by its update.

    Args:
        model: where transitions come from, unless ``log`` replays.
        policy: how to act.
        table: values and visits, changed in place. For double Q-learning the values are the mean of ``halves``.
        walk: where the agent is, changed in place.
        log: what to record, or to replay.
        step_size: α by visits of the pair.
        rule: index in ``RULES``.
        halves: the two tables of double Q-learning, ``[2, S, A]``; empty for the other rules.
        gamma: γ.
        num_steps: how many.
    """
    q, visits = table.q, table.visits
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, a_t, _last = next_step(model, policy, table, walk, log, i, gamma, rule == SARSA)
        n = visits[s, a] + 1
        visits[s, a] = n
        alpha = step_length(step_size, n)
        target = r_t
        if rule == DOUBLE:
            mine = _ZERO if uniform(walk.rng) < 0.5 else _ONE
            if discount_t != 0.0:
                best = _ZERO
                for b in range(_ONE, np.uint64(q.shape[1])):
                    if halves[mine, s_t, b] > halves[mine, s_t, best]:
                        best = b
                target = r_t + discount_t * halves[_ONE - mine, s_t, best]
            old = halves[mine, s, a]
            halves[mine, s, a] = target if alpha == 1.0 else old + alpha * (target - old)
            q[s, a] = 0.5 * (halves[_ZERO, s, a] + halves[_ONE, s, a])
            continue
        if discount_t != 0.0:
            if rule == Q_LEARNING:
                target = r_t + discount_t * best_value(q, s_t)
            elif rule == SARSA:
                target = r_t + discount_t * q[s_t, np.uint64(a_t)]
            else:
                target = r_t + discount_t * expected_value(table, s_t, walk.counters[0], policy)
        q[s, a] = target if alpha == 1.0 else q[s, a] + alpha * (target - q[s, a])


class OneStep:
    """The learner that `run_one_step` runs.

    Args:
        table: values and visits, changed in place.
        policy: how to act.
        step_size: α by visits of the pair.
        rule: one of ``RULES``.
    """

    def __init__(self, table: Table, policy: ActingCode, step_size: StepCode, rule: str) -> None:
        self.table = table
        self.policy = policy
        self.on_policy = rule == "sarsa"
        self._step_size = step_size
        self._rule = RULES.index(rule)
        self._halves = np.stack([table.q, table.q]) if rule == "double-q" else np.zeros((0, 0, 0))

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> Any:
        """``num_steps`` transitions from the model, or from the log if it replays."""
        plain = self._rule == Q_LEARNING and self.policy.kind in (EPSILON_GREEDY, RANDOM)
        if plain and log.mode == FORGET and model.observe.size == 0:
            run_q_learning(model, self.policy, self.table, walk, self._step_size, gamma, num_steps)
            return
        run_one_step(
            model, self.policy, self.table, walk, log, self._step_size, self._rule, self._halves, gamma, num_steps
        )

"""n-step control: Q^(n) of Mitchell's section 13.5, n-step Sarsa and n-step expected Sarsa.

    target = r_1 + γ r_2 + … + γ^{n−1} r_n + γ^n · bootstrap(s_n)

A pair is updated when the n-th reward after it has come, or at the end of its stream with the steps there are. The
bootstrap is max_a Q(s_n, a) (the book's Q^(n), uncorrected for exploring actions on the way), Q(s_n, a_n) or the
policy's expectation. n = 1 is the one-step rule, bit for bit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.jit import lean_kernel
from neuralq.tabular.engine import RunOptions, Source, learn, new_table, replay, table_from
from neuralq.tabular.kernels.acting import Log, Table, Walk, best_value, expected_value, next_step, step_length
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import (
    UPPER_CONFIDENCE,
    ActingCode,
    PolicyLike,
    StepCode,
    StepSizeLike,
    acting_code,
    step_code,
)
from neuralq.tabular.results import Experience, Learned

__all__ = ["Window", "apply_n_step", "n_step", "run_n_step"]

RULES = ("q-learning", "sarsa", "expected-sarsa")
Q_LEARNING, SARSA, EXPECTED = range(3)

_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


class Window(NamedTuple):
    """The last n pairs, rewards and discounts in a ring, and ``[position of the oldest, how many]``."""

    s: NDArray[np.uint64]
    a: NDArray[np.uint64]
    reward: NDArray[np.float64]
    discount: NDArray[np.float64]
    counters: NDArray[np.uint64]


@lean_kernel
def run_n_step(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    window: Window,
    rule: int,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions; each updates the pair n steps back, the last of a stream all that are left.

    Args:
        model: where transitions come from, unless ``log`` replays.
        policy: how to act.
        table: values and visits (counted at the update), changed in place.
        walk: where the agent is, changed in place.
        log: what to record, or to replay.
        step_size: α by visits of the pair.
        window: changed in place.
        rule: index in ``RULES``.
        gamma: γ.
        num_steps: how many.
    """
    q, visits = table.q, table.visits
    n = np.uint64(window.s.size)
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, a_t, last_t = next_step(model, policy, table, walk, log, i, gamma, rule == SARSA)
        at = (window.counters[_ZERO] + window.counters[_ONE]) % n
        window.s[at], window.a[at], window.reward[at], window.discount[at] = s, a, r_t, discount_t
        window.counters[_ONE] += _ONE
        while window.counters[_ONE] == n or (last_t and window.counters[_ONE] > _ZERO):
            target = 0.0
            if discount_t != 0.0:
                if rule == Q_LEARNING:
                    target = best_value(q, s_t)
                elif rule == SARSA:
                    target = q[s_t, np.uint64(a_t)]
                else:
                    target = expected_value(table, s_t, walk.counters[0], policy)
            first, size = window.counters[_ZERO], window.counters[_ONE]
            for back in range(_ZERO, size):
                k = (first + size - _ONE - back) % n
                target = window.reward[k] + (window.discount[k] * target if window.discount[k] != 0.0 else 0.0)
            x, b = window.s[first], window.a[first]
            visits[x, b] += 1
            alpha = step_length(step_size, visits[x, b])
            q[x, b] = target if alpha == 1.0 else q[x, b] + alpha * (target - q[x, b])
            window.counters[_ZERO] = (first + _ONE) % n
            window.counters[_ONE] = size - _ONE


class NStepLearner:
    """The learner that `run_n_step` runs.

    Args:
        table: values and visits, changed in place.
        policy: how to act.
        step_size: α by visits of the pair.
        rule: one of ``RULES``.
        n: how many rewards a target holds.

    Raises:
        ValueError: an argument out of range.
    """

    def __init__(self, table: Table, policy: ActingCode, step_size: StepCode, rule: str, n: int) -> None:
        check_choice("rule", rule, RULES)
        check_whole("n", n)
        if rule == "expected-sarsa" and policy.kind == UPPER_CONFIDENCE:
            raise ValueError("expected Sarsa needs the policy's probabilities, and confidence bounds have none")
        self.table = table
        self.policy = policy
        self.on_policy = rule == "sarsa"
        self._step_size, self._rule = step_size, RULES.index(rule)
        index = np.uint64
        self._window = Window(np.zeros(n, index), np.zeros(n, index), np.zeros(n), np.zeros(n), np.zeros(2, index))

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> Any:
        """``num_steps`` transitions from the model, or from the log if it replays."""
        run_n_step(
            model, self.policy, self.table, walk, log, self._step_size, self._window, self._rule, gamma, num_steps
        )


def n_step(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    n: int = 4,
    rule: str = "q-learning",
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """n-step learning sums n rewards before it bootstraps: Q^(n) of the book.

    Args:
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces.
        num_steps: transitions.
        gamma: γ in [0, 1].
        n: rewards in a target.
        rule: "q-learning", "sarsa" or "expected-sarsa": what the target bootstraps from.
        policy: how to act.
        step_size: α by visits of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range.

    Source: Mitchell 1997, section 13.5; Watkins 1989.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> n_step(mdp, 2, gamma=0.5, n=2, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    table, ready = new_table(source, options)
    learner = NStepLearner(table, acting_code(policy), step_code(step_size, num_steps), rule, n)
    return learn(learner, ready, num_steps, gamma, seed, options)


def apply_n_step(
    q: ArrayLike,
    experience: Experience,
    *,
    n: int,
    rule: str = "q-learning",
    step_size: StepSizeLike = "visits",
    policy: PolicyLike = "epsilon-greedy",
) -> Learned:
    """The same updates on recorded transitions; pairs whose n rewards have not all come at the end stay as they are.

    Args:
        q: values to start from, ``[S, A]``, NaN where illegal; not changed.
        experience: transitions, which carry their own discounts.
        n: rewards in a target.
        rule: "q-learning", "sarsa" or "expected-sarsa".
        step_size: α by visits of the pair, counted from 0.
        policy: whose expectation expected Sarsa takes; without meaning for the other rules.

    Raises:
        ValueError: an argument out of range, or transitions that do not fit the table.

    Example:
        >>> steps = Experience([0, 1], [0, 0], [0.0, 8.0], [0.5, 0.0], [1, 1], [False, True])
        >>> apply_n_step([[0.0], [0.0]], steps, n=2, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    code = step_code(step_size, len(experience))
    return replay(NStepLearner(table_from(q), acting_code(policy), code, rule, n), experience)

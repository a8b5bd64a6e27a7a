"""Control with eligibility traces: Watkins', Peng's and naive Q(λ), Sarsa(λ) and expected Sarsa(λ), in one kernel.

A trace z(x) says how much of the present error a pair x visited before deserves. One step, in this order, with
V(s) = max_a Q(s, a):

* Watkins: z ← 0 if the action explored; then decay by λ · (discount into s_tm1) and add 1 at the pair;
  Q(x) ← Q(x) + α δ z(x) with δ = r_t + discount_t V(s_t) − Q(s_tm1, a_tm1).
* naive: the same without the cut.
* Sarsa, expected Sarsa: the same without the cut; Q(s_t, a_t) or Σ_a π(a|s_t) Q(s_t, a) in place of V(s_t). (For
  expected Sarsa, as for naive Q(λ), the sum over an episode is that of the errors ahead, not a mixture of returns.)
* Peng: the pairs before move by δ' = r_t + discount_t V(s_t) − V(s_tm1), the present pair by δ. Values held fixed, the
  sum over an episode is exactly the book's Q^λ: Q^λ_t = r_t + discount_t [(1 − λ) V(s_t) + λ Q^λ_{t+1}].

The last line has s_t where the book prints the state before, which would not equal the book's own sum.

Every pair moves with the α of its own last visit. Only pairs with a trace are touched, in the order of their first
visit; a trace below 10⁻¹⁴ is dropped. With λ = 0 each rule is its one-step rule, bit for bit. Transitions after
``last_t`` begin with no trace.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice, check_fraction
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

__all__ = ["Traces", "apply_lambda", "new_traces", "q_lambda", "run_traces", "sarsa_lambda"]

RULES = ("watkins", "peng", "naive", "sarsa", "expected-sarsa")
WATKINS, PENG, NAIVE, SARSA, EXPECTED = range(5)
KINDS = ("accumulating", "replacing")

_SMALLEST = 1e-14
_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


class Traces(NamedTuple):
    """Traces and step sizes of pairs ``[S·A]``, the pairs that have a trace, their number, and the decay due next."""

    z: NDArray[np.float64]
    alpha: NDArray[np.float64]
    active: NDArray[np.uint64]
    num_active: NDArray[np.uint64]
    decay: NDArray[np.float64]


def new_traces(size: int) -> Traces:
    """No trace anywhere.

    Example:
        >>> new_traces(2).z.tolist()
        [0.0, 0.0]
    """
    return Traces(np.zeros(size), np.zeros(size), np.zeros(size, np.uint64), np.zeros(1, np.uint64), np.zeros(1))


@lean_kernel
def _drop(traces: Traces) -> None:
    for k in range(traces.num_active[_ZERO]):
        traces.z[traces.active[k]] = 0.0
    traces.num_active[_ZERO] = _ZERO
    traces.decay[_ZERO] = 0.0


@lean_kernel
def run_traces(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    traces: Traces,
    rule: int,
    replacing: bool,
    lambda_: float,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions, each followed by its update along the traces.

    Args:
        model: where transitions come from, unless ``log`` replays.
        policy: how to act.
        table: values and visits, changed in place.
        walk: where the agent is, changed in place.
        log: what to record, or to replay.
        step_size: α by visits of the pair.
        traces: changed in place.
        rule: index in ``RULES``.
        replacing: a visit sets the trace to 1 instead of adding 1.
        lambda_: λ.
        gamma: γ.
        num_steps: how many.
    """
    q, visits, z = table.q, table.visits, traces.z
    num_actions = np.uint64(q.shape[1])
    for i in range(num_steps):
        s, a, r_t, discount_t, s_t, a_t, last_t = next_step(model, policy, table, walk, log, i, gamma, rule == SARSA)
        n = visits[s, a] + 1
        visits[s, a] = n
        pair = s * num_actions + a
        alpha = step_length(step_size, n)
        traces.alpha[pair] = alpha
        v_tm1 = best_value(q, s)
        if rule == WATKINS and q[s, a] < v_tm1:
            _drop(traces)
        target = r_t
        if discount_t != 0.0:
            if rule == SARSA:
                target = r_t + discount_t * q[s_t, np.uint64(a_t)]
            elif rule == EXPECTED:
                target = r_t + discount_t * expected_value(table, s_t, walk.counters[0], policy)
            else:
                target = r_t + discount_t * best_value(q, s_t)
        delta = target - q[s, a]
        earlier = target - v_tm1 if rule == PENG else delta
        decay = traces.decay[_ZERO]
        kept = _ZERO
        own = 0.0
        for k in range(traces.num_active[_ZERO]):
            x = traces.active[k]
            z[x] *= decay
            if x == pair:
                own = z[x]
                z[x] = 0.0
            elif z[x] > _SMALLEST:
                q[x // num_actions, x % num_actions] += traces.alpha[x] * earlier * z[x]
                traces.active[kept] = x
                kept += _ONE
            else:
                z[x] = 0.0
        if replacing or own == 0.0:
            z[pair] = 1.0
            q[s, a] = target if alpha == 1.0 else q[s, a] + alpha * delta
        else:
            z[pair] = own + 1.0
            q[s, a] += alpha * (delta + earlier * own)
        traces.active[kept] = pair
        traces.num_active[_ZERO] = kept + _ONE
        traces.decay[_ZERO] = discount_t * lambda_
        if last_t or discount_t * lambda_ == 0.0:
            _drop(traces)


class TraceLearner:
    """The learner that `run_traces` runs.

    Args:
        table: values and visits, changed in place.
        policy: how to act.
        step_size: α by visits of the pair.
        rule: one of ``RULES``.
        lambda_: λ in [0, 1].
        trace: "accumulating" or "replacing".

    Raises:
        ValueError: an argument out of range.
    """

    def __init__(
        self, table: Table, policy: ActingCode, step_size: StepCode, rule: str, lambda_: float, trace: str
    ) -> None:
        check_choice("rule", rule, RULES)
        check_fraction("lambda_", lambda_, "for Monte Carlo use lambda_=1")
        check_choice("trace", trace, KINDS)
        if rule == "expected-sarsa" and policy.kind == UPPER_CONFIDENCE:
            raise ValueError("expected Sarsa needs the policy's probabilities, and confidence bounds have none")
        self.table = table
        self.policy = policy
        self.on_policy = rule == "sarsa"
        self._rest = (RULES.index(rule), trace == "replacing", float(lambda_))
        self._step_size = step_size
        self._traces = new_traces(table.q.size)

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> Any:
        """``num_steps`` transitions from the model, or from the log if it replays."""
        run_traces(
            model, self.policy, self.table, walk, log, self._step_size, self._traces, *self._rest, gamma, num_steps
        )


def q_lambda(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    lambda_: float = 0.9,
    rule: str = "watkins",
    trace: str = "accumulating",
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Q(λ) hands each step's error to the pairs that led to it: ``Q(x) ← Q(x) + α δ z(x)``.

    Args:
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces.
        num_steps: transitions.
        gamma: γ in [0, 1].
        lambda_: λ in [0, 1].
        rule: "watkins" (cut at exploring actions), "peng" (uncut, the book's Q^λ) or "naive" (uncut errors).
        trace: "accumulating" or "replacing".
        policy: how to act.
        step_size: α by visits of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range.

    Source: Watkins 1989; Peng & Williams 1996; Mitchell 1997, section 13.5.

    Example:
        The reward of the first episode reaches both steps.

        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> q_lambda(mdp, 2, gamma=0.5, lambda_=0.5, step_size=1.0).q.tolist()
        [[2.0], [8.0]]
    """
    check_choice("rule", rule, RULES[:3])
    table, ready = new_table(source, options)
    learner = TraceLearner(table, acting_code(policy), step_code(step_size, num_steps), rule, lambda_, trace)
    return learn(learner, ready, num_steps, gamma, seed, options)


def sarsa_lambda(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    lambda_: float = 0.9,
    expected: bool = False,
    trace: str = "accumulating",
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Sarsa(λ) hands each step's on-policy error to the pairs that led to it.

    Args:
        source: a `FiniteMDP`, a compiled `Model`, or a Gymnasium environment with finite spaces.
        num_steps: transitions.
        gamma: γ in [0, 1].
        lambda_: λ in [0, 1].
        expected: whether the target averages over the next action instead of taking the one drawn.
        trace: "accumulating" or "replacing".
        policy: how to act.
        step_size: α by visits of the pair.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range.

    Source: Rummery & Niranjan 1994; Singh & Sutton 1996.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> sarsa_lambda(mdp, 2, gamma=0.5, lambda_=1.0, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    rule = "expected-sarsa" if expected else "sarsa"
    table, ready = new_table(source, options)
    learner = TraceLearner(table, acting_code(policy), step_code(step_size, num_steps), rule, lambda_, trace)
    return learn(learner, ready, num_steps, gamma, seed, options)


def apply_lambda(
    q: ArrayLike,
    experience: Experience,
    *,
    lambda_: float,
    rule: str = "watkins",
    trace: str = "accumulating",
    step_size: StepSizeLike = "visits",
    policy: PolicyLike = "epsilon-greedy",
) -> Learned:
    """The same updates along traces on recorded transitions, in their order.

    Args:
        q: values to start from, ``[S, A]``, NaN where illegal; not changed.
        experience: transitions, which carry their own discounts.
        lambda_: λ in [0, 1].
        rule: "watkins", "peng", "naive", "sarsa" or "expected-sarsa".
        trace: "accumulating" or "replacing".
        step_size: α by visits of the pair, counted from 0.
        policy: whose expectation expected Sarsa takes; without meaning for the other rules.

    Raises:
        ValueError: an argument out of range, or transitions that do not fit the table.

    Example:
        >>> steps = Experience([0, 1], [0, 0], [0.0, 8.0], [0.5, 0.0], [1, 1], [False, True])
        >>> apply_lambda([[0.0], [0.0]], steps, lambda_=1.0, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    code = step_code(step_size, len(experience))
    return replay(TraceLearner(table_from(q), acting_code(policy), code, rule, lambda_, trace), experience)

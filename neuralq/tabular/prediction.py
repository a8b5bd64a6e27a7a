"""Prediction: TD(λ) for state values, on-line, once per episode, or over a whole batch; and true online TD(λ).

    δ_t = r_t + discount_t V(s_t) − V(s_tm1),    V(x) ← V(x) + α δ_t z(x)                       (Sutton 1988, eq. 4)

The trace z decays by λ · (discount into s_tm1) and grows by 1 at s_tm1 (accumulating) or is set to 1 (replacing). True
online TD(λ) has a dutch trace and one more term, and equals the on-line λ-return step for step. A batch is presented
again and again, its increments added at the end of each presentation, until nothing moves: TD(0) then gives the values
of the most likely Markov process (certainty equivalence), TD(1) the least squares fit to the returns seen.

A process to predict is an MDP with one action in every state; `under_policy` makes one of any model and policy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.jit import lean_kernel
from neuralq.mdp import FiniteMDP, Outcomes
from neuralq.tabular.engine import RunOptions, Source, learn, new_table, replay, table_from
from neuralq.tabular.kernels.acting import REPLAY, Log, Table, Walk, new_walk, next_step, step_length
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.model import ModelArrays, complete_outcomes, empty_arrays
from neuralq.tabular.policies import CONSTANT, ActingCode, StepCode, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Experience, Learned
from neuralq.tabular.traces import Traces, new_traces

__all__ = ["batch_td", "predict", "run_td", "td_lambda", "under_policy"]

KINDS = ("accumulating", "replacing", "true-online")
UPDATES = ("step", "episode", "batch")
REPLACING, TRUE_ONLINE = 1, 2
EVERY_STEP, EVERY_EPISODE = 0, 1

_SMALLEST = 1e-14
_ZERO: Any = np.uint64(0)
_ONE: Any = np.uint64(1)


@lean_kernel
def run_td(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    traces: Traces,
    pending: NDArray[np.float64],
    v_old: NDArray[np.float64],
    kind: int,
    update: int,
    lambda_: float,
    gamma: float,
    num_steps: int,
) -> None:
    """``num_steps`` transitions, each followed by its increments.

    Args:
        model: where transitions come from, unless ``log`` replays.
        policy: how to act.
        table: values ``[S, 1]`` and visits, changed in place.
        walk: where the agent is, changed in place.
        log: what to record, or to replay.
        step_size: α by visits of the state.
        traces: changed in place.
        pending: increments not yet added, ``[S]``.
        v_old: V(s_tm1) before the last update, ``[1]``.
        kind: index in ``KINDS``.
        update: index in ``UPDATES``.
        lambda_: λ.
        gamma: γ.
        num_steps: how many.
    """
    v, visits, z = table.q, table.visits, traces.z
    for i in range(num_steps):
        s, _a, r_t, discount_t, s_t, _a_t, last_t = next_step(model, policy, table, walk, log, i, gamma, False)
        n = visits[s, _ZERO] + 1
        visits[s, _ZERO] = n
        alpha = step_length(step_size, n)
        traces.alpha[s] = alpha
        v_tm1 = v[s, _ZERO]
        v_t = v[s_t, _ZERO] if discount_t != 0.0 else 0.0
        delta = r_t + discount_t * v_t - v_tm1
        change = v_tm1 - v_old[_ZERO] if kind == TRUE_ONLINE else 0.0
        decay = traces.decay[_ZERO]
        kept, own = _ZERO, 0.0
        for k in range(traces.num_active[_ZERO]):
            x = traces.active[k]
            z[x] *= decay
            if x == s:
                own = z[x]
            elif z[x] > _SMALLEST:
                traces.active[kept] = x
                kept += _ONE
            else:
                z[x] = 0.0
        if kind == TRUE_ONLINE:
            z[s] = own + (1.0 - alpha * own)
        else:
            z[s] = 1.0 if kind == REPLACING else own + 1.0
        traces.active[kept] = s
        kept += _ONE
        for k in range(kept):
            x = traces.active[k]
            step = traces.alpha[x] * (delta + change) * z[x]
            if x == s:
                step -= alpha * change
            if update == EVERY_STEP:
                v[x, _ZERO] += step
            else:
                pending[x] += step
        traces.num_active[_ZERO] = kept
        traces.decay[_ZERO] = discount_t * lambda_
        v_old[_ZERO] = v_t
        if last_t or discount_t * lambda_ == 0.0:
            for k in range(kept):
                z[traces.active[k]] = 0.0
            traces.num_active[_ZERO] = _ZERO
        if last_t:
            v_old[_ZERO] = 0.0
            if update == EVERY_EPISODE:
                for x in range(_ZERO, np.uint64(pending.size)):
                    v[x, _ZERO] += pending[x]
                    pending[x] = 0.0


class TDLearner:
    """The learner that `run_td` runs.

    Args:
        table: values ``[S, 1]`` and visits, changed in place.
        step_size: α by visits of the state.
        lambda_: λ in [0, 1].
        kind: "accumulating", "replacing" or "true-online".
        update: "step", "episode" or "batch" (increments are only collected).

    Raises:
        ValueError: an argument out of range, more than one action, or true online TD(λ) with anything but a constant
            step size at every step.
    """

    def __init__(self, table: Table, step_size: StepCode, lambda_: float, kind: str, update: str) -> None:
        check_choice("kind", kind, KINDS)
        check_choice("update", update, UPDATES)
        check_fraction("lambda_", lambda_, "for Monte Carlo use lambda_=1")
        if table.q.shape[1] != 1:
            raise ValueError(
                f"prediction needs a process with one action, got {table.q.shape[1]}; see tabular.under_policy(mdp, pi)"
            )
        if kind == "true-online" and (step_size.kind != CONSTANT or step_size.listed.size or update != "step"):
            raise ValueError('true online TD(λ) is derived for a constant step size and update="step"')
        self.table = table
        self.policy = acting_code("random")
        self.on_policy = False
        self.pending = np.zeros(len(table.q))
        self._step_size = step_size
        self._traces, self._v_old = new_traces(len(table.q)), np.zeros(1)
        self._rest = (KINDS.index(kind), UPDATES.index(update), float(lambda_))

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> Any:
        """``num_steps`` transitions from the model, or from the log if it replays."""
        run_td(
            model, self.policy, self.table, walk, log, self._step_size, self._traces, self.pending, self._v_old,
            *self._rest, gamma, num_steps,
        )  # fmt: skip


def td_lambda(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    lambda_: float = 0.9,
    kind: str = "accumulating",
    update: str = "step",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """TD(λ) learns the value of a process: ``V(x) ← V(x) + α δ z(x)``; read it from ``.v``.

    Args:
        source: an MDP, compiled model or environment with one action; see `under_policy`.
        num_steps: transitions.
        gamma: γ in [0, 1].
        lambda_: λ in [0, 1].
        kind: "accumulating", "replacing" or "true-online".
        update: whether increments are added at every "step" or at the end of each "episode".
        step_size: α by visits of the state.
        seed: of the random stream.
        options: what to start from and what to record.

    Raises:
        ValueError: an argument out of range, or more than one action.

    Source: Sutton 1988; Singh & Sutton 1996; van Seijen & Sutton 2014.

    Example:
        >>> walk = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> td_lambda(walk, 2, gamma=0.5, lambda_=0.5, step_size=1.0).v.tolist()
        [2.0, 8.0]
    """
    check_choice("update", update, UPDATES[:2])
    table, ready = new_table(source, options)
    learner = TDLearner(table, step_code(step_size, num_steps), lambda_, kind, update)
    return learn(learner, ready, num_steps, gamma, seed, options)


def predict(
    v: ArrayLike,
    experience: Experience,
    *,
    lambda_: float,
    kind: str = "accumulating",
    update: str = "step",
    step_size: StepSizeLike = "visits",
) -> Learned:
    """TD(λ) on recorded transitions, in their order; actions are not looked at.

    Args:
        v: values to start from, ``[S]``; not changed.
        experience: transitions, which carry their own discounts.
        lambda_: λ in [0, 1].
        kind: "accumulating", "replacing" or "true-online".
        update: whether increments are added at every "step" or at the end of each "episode".
        step_size: α by visits of the state, counted from 0.

    Raises:
        ValueError: an argument out of range, or transitions that do not fit the table.

    Example:
        >>> steps = Experience([0, 1], [0, 0], [0.0, 8.0], [0.5, 0.0], [1, 1], [False, True])
        >>> predict([0.0, 0.0], steps, lambda_=1.0, step_size=1.0).v.tolist()
        [4.0, 8.0]
    """
    check_choice("update", update, UPDATES[:2])
    code = step_code(step_size, len(experience))
    learner = TDLearner(table_from(np.asarray(v, dtype=np.float64)[:, None]), code, lambda_, kind, update)
    return replay(learner, _one_action(experience))


def batch_td(
    v: ArrayLike,
    experience: Experience,
    *,
    lambda_: float,
    step_size: float = 0.01,
    tol: float = 1e-10,
    max_presentations: int = 100_000,
) -> tuple[NDArray[np.float64], bool]:
    """A batch presented until no value moves by more than ``tol · step_size``; returns ``(V [S], converged)``.

    Args:
        v: values to start from, ``[S]``; those of states that are never left stay.
        experience: the batch.
        lambda_: λ in [0, 1]: 0 gives certainty equivalence, 1 the least squares fit.
        step_size: α, small against 1 / (visits of a state in the batch).
        tol: largest change of a value, divided by the step size, that counts as none.
        max_presentations: give up after so many.

    Raises:
        ValueError: an argument out of range, or transitions that do not fit.

    Source: Sutton 1988, section 4.

    Example:
        Two episodes: 0 → 1 → end with reward 1, and 1 → end with reward 0.

        >>> steps = Experience([0, 1, 1], [0, 0, 0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1, 1, 1], [False, True, True])
        >>> batch_td([0.0, 0.0], steps, lambda_=0.0, step_size=0.1)[0].round(6).tolist()
        [0.5, 0.5]
        >>> batch_td([0.0, 0.0], steps, lambda_=1.0, step_size=0.1)[0].round(6).tolist()
        [1.0, 0.5]
    """
    check_positive("step_size", step_size)
    check_positive("tol", tol)
    check_whole("max_presentations", max_presentations)
    table = table_from(np.asarray(v, dtype=np.float64)[:, None])
    learner = TDLearner(table, step_code(step_size, 1), lambda_, "accumulating", "batch")
    replay(learner, _one_action(experience))  # checks the batch; its increments are those of the first presentation
    e, walk, nothing = _one_action(experience), new_walk(0), empty_arrays()
    log = Log(REPLAY, 0, e.s_tm1, e.a_tm1, e.r_t, e.discount_t, e.s_t, e.next_actions, e.last_t)
    for _ in range(max_presentations):
        table.q[:, 0] += learner.pending
        moved = float(np.max(np.abs(learner.pending)))
        learner.pending[:] = 0
        if moved <= tol * step_size:
            return table.q[:, 0].copy(), True
        learner.run(nothing, walk, log, 0.0, len(e))
    return table.q[:, 0].copy(), False


def under_policy(mdp: FiniteMDP, policy: ArrayLike) -> FiniteMDP:
    """The process that a policy makes of a model: the same states, one action, outcomes weighted by the policy.

    Args:
        mdp: the model.
        policy: actions ``[S]`` or probabilities ``[S, A]``.

    Raises:
        ValueError: a policy of another shape, or that does not choose legal actions with total probability 1.

    Example:
        >>> two = FiniteMDP.from_arrays([[[0.0]], [[0.0]]], [[1.0, 3.0]], substochastic=True)
        >>> under_policy(two, [[0.5, 0.5]]).reward.tolist()
        [2.0]
    """
    given = np.asarray(policy)
    shape = (mdp.num_states, mdp.num_actions)
    if given.shape == shape[:1]:
        pi = np.zeros(shape)
        lively = np.flatnonzero(~mdp.is_terminal)
        pi[lively, given[lively].astype(np.int64)] = 1.0
    elif given.shape == shape:
        pi = given.astype(np.float64)
    else:
        raise ValueError(f"policy must have shape {shape[:1]} or {shape}, got {given.shape}")
    legal_mass = np.where(mdp.legal, pi, 0.0).sum(axis=1)
    bad = np.flatnonzero(~mdp.is_terminal & ((np.abs(legal_mass - 1) > 1e-9) | (pi < 0).any(axis=1)))
    if bad.size:
        raise ValueError(f"policy in {mdp.state_name(bad[0])} gives its legal actions {legal_mass[bad[0]]}, not 1")
    source = complete_outcomes(mdp)
    row = source.row
    weight = source.probability * pi[mdp.s_tm1, mdp.a_tm1][row]
    keep = weight > 0
    states = np.flatnonzero(~mdp.is_terminal)
    indptr = np.searchsorted(mdp.s_tm1[row[keep]], np.append(states, mdp.num_states)).astype(np.int64)
    outcomes = Outcomes(indptr, weight[keep], source.s_t[keep], source.reward[keep], source.terminated[keep])
    transition, reward = outcomes.expected(mdp.num_states)
    zeros = np.zeros(len(states), dtype=np.int64)
    start = mdp.start_distribution
    return FiniteMDP(mdp.num_states, 1, states, zeros, transition, reward, None, start, mdp.state_names, None, outcomes)


def _one_action(experience: Experience) -> Experience:
    e = experience
    return Experience(e.s_tm1, np.zeros(len(e), dtype=np.int64), e.r_t, e.discount_t, e.s_t, e.last_t)

"""Prediction: TD(λ) for state values, on-line, once per episode, or over a whole batch; and true online TD(λ).

The formulas are in `neuralq.tabular.kernels.td`. A process to predict is an MDP with one action in every state;
`under_policy` makes one of any model and policy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.mdp import FiniteMDP, Outcomes
from neuralq.tabular.engine import RunOptions, Source, learn, log_of, new_table, replay, table_from
from neuralq.tabular.kernels.acting import Table, new_walk
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.kernels.td import KINDS, UPDATES, run_td
from neuralq.tabular.kernels.traces import new_traces
from neuralq.tabular.learner import Learner
from neuralq.tabular.model import complete_outcomes, empty_arrays
from neuralq.tabular.policies import CONSTANT, StepCode, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Experience, Learned

__all__ = ["batch_td", "predict", "td_lambda", "td_learner", "under_policy"]


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
        lambda_: λ in [0, 1].
        kind: "accumulating", "replacing" or "true-online".
        update: whether increments are added at every "step" or at the end of each "episode".
        step_size: α by visits of the state.

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
    learner = td_learner(table, step_code(step_size, num_steps), lambda_, kind, update)
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
    return replay(td_learner(table_from(_column(v)), code, lambda_, kind, update), _one_action(experience))


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
        tol: largest change of a value, divided by the step size, that counts as none; times the largest |reward| or
            |value| where that is below 1. What is rounding counts as none too.
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
    table, batch, eps = table_from(_column(v)), _one_action(experience), float(np.finfo(np.float64).eps)
    pending = np.zeros(len(table.q))
    learner = td_learner(table, step_code(step_size, 1), lambda_, "accumulating", "batch", pending)
    replay(learner, batch)  # checks the batch; its increments are those of the first presentation
    largest = float(np.max(np.abs(batch.r_t), initial=0.0))
    walk, nothing, log = new_walk(0), empty_arrays(), log_of(batch)
    for _ in range(max_presentations):
        table.q[:, 0] += pending
        moved = float(np.max(np.abs(pending)))
        pending[:] = 0
        size = max(largest, float(np.max(np.abs(table.q), initial=0.0)))
        if moved <= max(tol * min(1.0, size), len(batch) * eps * size) * step_size:
            return table.q[:, 0].copy(), True
        learner.run(nothing, walk, log, 0.0, len(batch))
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


def _column(v: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(v, dtype=np.float64)[:, None]


def td_learner(
    table: Table,
    step_size: StepCode,
    lambda_: float,
    kind: str,
    update: str,
    pending: NDArray[np.float64] | None = None,
    acts_in: Table | None = None,
) -> Learner:
    """What `td_lambda` and `predict` run; the increments of a batch are only collected, in ``pending``.

    Args:
        table: state values ``[S, 1]``.
        pending: increments not yet added, ``[S]``.
        acts_in: the actions of the world that is predicted, all equally likely, where it has more than one.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> td_learner(table_from([[0.0]]), step_code(0.1, 1), 0.9, "accumulating", "step").loop is run_td
        True
    """
    check_choice("kind", kind, KINDS)
    check_choice("update", update, UPDATES)
    check_fraction("lambda_", lambda_, "for Monte Carlo use lambda_=1")
    if table.q.shape[1] != 1:
        raise ValueError(
            f"prediction needs a process with one action, got {table.q.shape[1]}; see tabular.under_policy(mdp, pi)"
        )
    if kind == "true-online" and (step_size.kind != CONSTANT or step_size.listed.size or update != "step"):
        raise ValueError('true online TD(λ) is derived for a constant step size and update="step"')
    size = len(table.q)
    waiting = np.zeros(size) if pending is None else pending
    traces, v_old = new_traces(size), np.zeros(1)
    rest = (KINDS.index(kind), UPDATES.index(update), float(lambda_))
    arguments = (step_size, traces, waiting, v_old, *rest)
    streams = (*traces, waiting, v_old)
    return Learner(run_td, table, acting_code("random"), arguments, connections=streams, acts_in=acts_in)

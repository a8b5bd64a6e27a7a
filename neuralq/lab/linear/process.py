"""A problem as the linear mathematics sees it: rows with features, two chains over them, and how often each is updated.

The n rows are the states of a problem that learns V, or the legal pairs (s, a) of one that learns Q. Either way

    P(i, j)      chance to go from row i to row j under the target policy, row discounts included, ends left out
    P_mu(i, j)   the same under the behaviour policy
    transition   one way to go on under the behaviour: (row, next row or the end, chance, ratio, reward, discount)

and the ratio of a transition is its chance under the target over that under the behaviour: π(a|s)/μ(a|s) between states
and π(a'|s')/μ(a'|s') between pairs, whose own action is given. So a method that evaluates a policy is written once.
Terminal states are no rows: entering one ends the episode, with a successor feature of 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from neuralq.exact import resolvent
from neuralq.types import Floats, Indices
from neuralq_envs.counterexamples import Problem

__all__ = ["Process", "Transitions", "check_values", "linear_process"]


LARGEST_DENSE = 2000
"""Rows up to which chains are kept as dense arrays: beyond, products with sparse ones are cheaper and fit in memory."""


@dataclass(frozen=True, eq=False)
class Transitions:
    """Every way to go on that has a chance under the behaviour policy, sorted by row, ``[K]`` each.

    Args:
        row: where it starts.
        next_row: where it leads; -1 where the episode ends.
        probability: its chance given the row; those of a row sum to 1.
        rho: importance ratio, chance under the target over ``probability``; 0 where the target never goes.
        reward: expected reward of the action taken.
        discount: γ, or 0 where the episode ends.
        starts: transitions of row i are ``starts[i]:starts[i + 1]``, ``[n + 1]``.
    """

    row: Indices
    next_row: Indices
    probability: Floats
    rho: Floats
    reward: Floats
    discount: Floats
    starts: Indices

    @cached_property
    def cumulative(self) -> Floats:
        """Row number plus the chance of a transition and of those before it in its row, to look uniform draws up in."""
        total = np.cumsum(self.probability)
        before = np.concatenate([[0.0], total])[self.starts[:-1]]
        within = np.minimum(total - before[self.row], 1.0)
        within[self.starts[1:] - 1] = 1.0  # whatever rounding left of the last transition's share
        return np.asarray(self.row + within)

    def drawn_from(self, row: Indices, u: Floats) -> Indices:
        """A transition of each given row, ``[N]``, with its chance, by uniform draws ``[N]``."""
        found: Indices = np.minimum(np.searchsorted(self.cumulative, row + u, side="right"), self.starts[row + 1] - 1)
        return found

    def matrix(self, weight: Floats) -> Floats | sparse.csr_array:
        """Weights of the transitions ``[K]`` as a matrix from row to row, ``[n, n]``; an end has no column."""
        n, inside = len(self.starts) - 1, self.next_row >= 0
        entries = (weight[inside], (self.row[inside], self.next_row[inside]))
        chain = sparse.csr_array(sparse.coo_array(entries, shape=(n, n)))
        return chain.toarray() if n <= LARGEST_DENSE else chain

    def sums(self, weight: Floats) -> Floats:
        """Weights of the transitions ``[K]`` summed for each row, ``[n]``."""
        return np.bincount(self.row, weights=weight, minlength=len(self.starts) - 1).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Process:
    """What the expected and the sampled updates of a problem are made of.

    Args:
        X: features of every row, ``[n, d]``.
        P: target chain, ``[n, n]``, dense or sparse.
        P_mu: behaviour chain, ``[n, n]``.
        r: expected reward of every row under the target, ``[n]``.
        r_mu: the same under the behaviour, ``[n]``.
        D: how often each row is updated, ``[n]``, sums to 1.
        start: where episodes begin, ``[n]``.
        gamma: γ.
        transitions: every way to go on under the behaviour.
        target_transitions: every way to go on under the target.
        pairs: state and action of every row where rows are pairs, ``[n, 2]``; None where they are states.
        state: state of every row, ``[n]``.
        target_policy: π(a|s) of the problem, ``[S, A]``.
        behaviour_policy: μ(a|s), ``[S, A]``.
        row_of: row of every pair, ``[S, A]``, -1 where it has none; None where rows are states.
    """

    X: Floats
    P: Floats | sparse.csr_array
    P_mu: Floats | sparse.csr_array
    r: Floats
    r_mu: Floats
    D: Floats
    start: Floats
    gamma: float
    transitions: Transitions
    target_transitions: Transitions
    pairs: Indices | None
    state: Indices
    target_policy: Floats
    behaviour_policy: Floats
    row_of: Indices | None

    @property
    def num_rows(self) -> int:
        """How many rows there are, n."""
        return len(self.D)

    @property
    def num_weights(self) -> int:
        """How many weights there are, d."""
        return int(self.X.shape[1])

    @cached_property
    def v(self) -> Floats:
        """The exact values of the target policy, (I − γP)⁻¹ r, ``[n]``."""
        return resolvent(sparse.csr_array(self.P), self.r, self.gamma)

    def seen(self, row: Indices) -> Floats:
        """Features of some rows, 0 for an end, ``[N] -> [N, d]``."""
        x: Floats = self.X[row]
        x[row < 0] = 0.0
        return x

    def with_features(self, X: Floats) -> Process:
        """The same chains seen through other features, ``[n, d']``."""
        return replace(self, X=X)

    @cached_property
    def visible(self) -> Floats:
        """An orthonormal basis of the weights that some row sees, ``[d, rank X]``; others never matter to a value."""
        tall = self.num_rows > 2 * self.num_weights  # the triangle of X has the same singular values and right vectors
        _, singular, right = np.linalg.svd(np.linalg.qr(self.X, mode="r") if tall else self.X, full_matrices=False)
        if len(singular) == 0 or singular[0] == 0:
            return np.zeros((self.num_weights, 0))
        kept: Floats = right[singular > 1e-12 * max(self.X.shape) * singular[0]].T
        return kept


def linear_process(problem: Problem) -> Process:
    """A problem becomes rows, chains and transitions.

    A row's discount below 1 counts as the chance that the episode goes on, as in simulation. Rewards are the expected
    ones of each pair.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> process = linear_process(star())
        >>> process.num_rows, len(process.transitions.row), process.visible.shape
        (7, 49, (8, 7))
        >>> sorted(set(process.transitions.rho.round(9).tolist()))  # dashed, solid
        [0.0, 7.0]
    """
    return _of_pairs(problem) if problem.learns_q else _of_states(problem)


def check_values(problem: Problem) -> None:
    """With γ = 1 there are values only where every path ends.

    Raises:
        ValueError: the values of the target policy are not defined.
    """
    try:
        defined = problem.gamma < 1 or bool(np.isfinite(linear_process(problem).v).all())
    except (RuntimeError, ValueError):
        defined = False
    if not defined:
        raise ValueError(f"{problem.name} never ends, so it has no values with γ = 1; choose a gamma below 1")


def _of_states(problem: Problem) -> Process:
    """Rows are the states that have actions."""
    mdp = problem.mdp
    active = np.flatnonzero(~mdp.is_terminal)
    number = np.full(mdp.num_states, -1, dtype=np.int64)
    number[active] = np.arange(len(active))
    chains = []
    for policy, ratio in ((problem.behaviour_policy, problem.importance_ratio), (problem.target_policy, None)):
        row, next_row, p, source = _go_on(problem, number, number[mdp.s_tm1], policy[mdp.s_tm1, mdp.a_tm1])
        rho = np.ones(len(p)) if ratio is None else ratio[mdp.s_tm1[source], mdp.a_tm1[source]]
        chains.append(_sorted(problem, len(active), row, next_row, p, rho, mdp.reward[source]))
    return _assembled(
        problem, *chains, X=np.array(problem.features[active]), D=problem.state_distribution[active],
        start=mdp.start_distribution[active], pairs=None, state=active, row_of=None,
    )  # fmt: skip


def _of_pairs(problem: Problem) -> Process:
    """Rows are the legal pairs; a row goes on to s' by the model and from there to a' by the policy."""
    mdp, n = problem.mdp, problem.mdp.num_rows
    number = np.where(mdp.is_terminal, -1, np.arange(mdp.num_states))
    row, s_next, p, source = _go_on(problem, number, np.arange(n), np.ones(n))
    counts = np.where(s_next < 0, 1, np.diff(mdp.row_starts)[np.maximum(s_next, 0)])
    index = np.repeat(np.arange(len(row)), counts)
    offset = np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
    next_row = np.where(s_next[index] < 0, -1, mdp.row_starts[np.maximum(s_next[index], 0)] + offset)
    there = (mdp.s_tm1[next_row], mdp.a_tm1[next_row])
    chains = []
    for policy, ratio in ((problem.behaviour_policy, problem.importance_ratio), (problem.target_policy, None)):
        chance = np.where(next_row < 0, 1.0, policy[there])
        rho = np.ones(len(index)) if ratio is None else np.where(next_row < 0, 1.0, ratio[there])
        ways = (row[index], next_row, p[index] * chance, rho, mdp.reward[source[index]])
        chains.append(_sorted(problem, n, *(one[chance > 0] for one in ways)))
    here = (mdp.s_tm1, mdp.a_tm1)
    taken = problem.behaviour_policy[here]
    return _assembled(
        problem, *chains, X=np.array(problem.features[here]), D=problem.state_distribution[mdp.s_tm1] * taken,
        start=mdp.start_distribution[mdp.s_tm1] * taken, pairs=np.stack(here, axis=1), state=mdp.s_tm1,
        row_of=mdp.row_index,
    )  # fmt: skip


def _go_on(problem: Problem, number: Indices, row: Indices, chance: Floats) -> tuple[Indices, Indices, Floats, Indices]:
    """Model rows spread over their successors, ends included: row, next row, chance and model row of each transition.

    Args:
        problem: the problem.
        number: what each state counts as, -1 for the end, ``[S]``.
        row: what each model row starts from, ``[K]``.
        chance: probability of each model row given its start, ``[K]``.
    """
    mdp = problem.mdp
    flow = mdp.transition.tocoo()
    source, successor = np.asarray(flow.coords[0], dtype=np.int64), number[np.asarray(flow.coords[1])]
    p = flow.data * mdp.row_discount[source]
    inside = successor >= 0
    source, successor, p = source[inside], successor[inside], p[inside]
    ended = 1.0 - np.bincount(source, weights=p, minlength=mdp.num_rows)
    ends = np.flatnonzero(ended > 1e-12)
    source = np.concatenate([source, ends])
    successor = np.concatenate([successor, np.full(len(ends), -1)])
    p = np.concatenate([p, ended[ends]]) * chance[source]
    kept = p > 0
    return row[source[kept]], successor[kept], p[kept], source[kept]


def _sorted(problem: Problem, n: int, *ways: NDArray[Any]) -> Transitions:
    order = np.lexsort((ways[1], ways[0]))
    row, next_row, probability, rho, reward = (one[order] for one in ways)
    discount = np.where(next_row < 0, 0.0, problem.gamma)
    starts = np.searchsorted(row, np.arange(n + 1)).astype(np.int64)
    return Transitions(row, next_row, probability, rho, reward, discount, starts)


def _assembled(problem: Problem, behaviour: Transitions, target: Transitions, **rows: Any) -> Process:
    P, P_mu = (one.matrix(one.probability) for one in (target, behaviour))
    r, r_mu = (one.sums(one.probability * one.reward) for one in (target, behaviour))
    return Process(
        P=P, P_mu=P_mu, r=r, r_mu=r_mu, gamma=problem.gamma, transitions=behaviour, target_transitions=target,
        target_policy=problem.target_policy, behaviour_policy=problem.behaviour_policy, **rows,
    )  # fmt: skip

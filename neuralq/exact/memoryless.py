"""What a policy without memory is worth, and which is the best of those that leave nothing to chance.

A memoryless policy acts on the present observation; spread over the states that look alike it is a policy of states,
and its value one linear system (`evaluate`). The best deterministic one is found by branch and bound (Littman 1994):
some observations have their action, and in states that look otherwise any action may be taken. The optimum V of that
relaxed problem bounds every policy that goes on from there. Its operator has lost actions against that of the problem
it was split from, so applying it to that one's V only ever goes down: each sweep is a bound already, and the first one
that does not reach what has been found is enough. Next to be decided is the observation whose states lose most, by V,
if they have to agree on one action; what they would agree on is tried at once, and often is as good as the bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from neuralq.checks import check_discount, check_whole
from neuralq.exact.evaluation import evaluate, policy_process
from neuralq.exact.planning import solve
from neuralq.mdp import AliasedMDP

__all__ = ["MemorylessSolution", "best_memoryless", "evaluate_memoryless"]

_CLOSE = 1e-9  # of the value; what is nearer than that to the best is as good
_FEW_SWEEPS = 1000  # a bound that is not swept down to the end is one all the same


def evaluate_memoryless(aliased: AliasedMDP, policy: ArrayLike, gamma: float) -> NDArray[np.float64]:
    """The exact value of every state, ``[S]``, under a policy that sees observations only.

    Args:
        aliased: the model.
        policy: actions ``[O]`` or probabilities ``[O, A]``; those of observations without an action do not matter.
        gamma: γ in [0, 1]; with 1 the policy must end its episodes.

    Raises:
        ValueError: a policy of another shape, or one that `evaluate` refuses.

    Source: Singh, Jaakkola & Jordan 1994.

    Example:
        Two states look alike; a move to the other one pays 1, a refused one costs 1. Tossing a coin is best.

        >>> from neuralq.mdp import FiniteMDP
        >>> swap = FiniteMDP.from_arrays([[[0, 1], [0, 1]], [[1, 0], [1, 0]]], [[1.0, -1.0], [-1.0, 1.0]])
        >>> alike = AliasedMDP(swap, [0, 0])
        >>> [evaluate_memoryless(alike, policy, 0.9).mean().round(6).item() for policy in ([0], [[0.5, 0.5]])]
        [-9.0, 0.0]
    """
    given = np.asarray(policy)
    num, num_actions = aliased.num_observations, aliased.mdp.num_actions
    if given.shape not in ((num,), (num, num_actions)):
        raise ValueError(
            f"policy must be actions of shape ({num},) or probabilities of shape ({num}, {num_actions}), one for each "
            f"observation, got shape {given.shape}"
        )
    return evaluate(aliased.mdp, given[aliased.observation], gamma)


@dataclass(frozen=True, eq=False)
class MemorylessSolution:
    """The best deterministic memoryless policy that was found, and what proves it.

    Args:
        value: its expected return from the start; −∞ if nothing that ends was found.
        policy: an action for each observation, ``[O]``; −1 where no state that acts looks so.
        bound: no deterministic memoryless policy is worth more than this; where the search was not cut off, that is
            ``value`` but for rounding.
        num_bounds: relaxed problems that were looked at.
        proved: whether the search is complete.
    """

    value: float
    policy: NDArray[np.int64]
    bound: float
    num_bounds: int
    proved: bool


def best_memoryless(aliased: AliasedMDP, gamma: float, *, max_bounds: int = 100_000) -> MemorylessSolution:
    """The best deterministic memoryless policy by branch and bound; it need not be the best memoryless one.

    Args:
        aliased: the model; transitions may leave something to chance.
        gamma: γ in [0, 1]. With 1 every step must cost something, and some policy of states must end from everywhere.
        max_bounds: how many relaxed problems to look at; after that the best so far is returned with what bounds it.

    Raises:
        ValueError: an argument out of range, or γ = 1 with a reward that is not below 0.

    Source: Littman 1994; the bound is the value of the process in which what is undecided is seen.

    Example:
        >>> from neuralq.mdp import FiniteMDP
        >>> swap = FiniteMDP.from_arrays([[[0, 1], [0, 1]], [[1, 0], [1, 0]]], [[1.0, -1.0], [-1.0, 1.0]])
        >>> found = best_memoryless(AliasedMDP(swap, [0, 0]), gamma=0.9)
        >>> round(found.value, 6), found.policy.tolist(), found.proved
        (-9.0, [0], True)
    """
    check_discount("gamma", gamma)
    check_whole("max_bounds", max_bounds)
    free = np.flatnonzero(aliased.mdp.reward >= 0)
    if gamma == 1 and free.size:
        raise ValueError(
            f"with gamma=1 every step must cost something, but {aliased.mdp.row_name(free[0])} has reward "
            f"{aliased.mdp.reward[free[0]]:g}; use gamma < 1"
        )
    return _Search(aliased, gamma).run(max_bounds)


class _Node(NamedTuple):
    """Which observations have their action, and values that bound those of every policy that goes on from there."""

    policy: NDArray[np.int64]
    v: NDArray[np.float64]
    bound: float


class _Search:
    """A depth-first search; of the ways to decide an observation, that with the best bound is gone first."""

    def __init__(self, aliased: AliasedMDP, gamma: float) -> None:
        self._aliased, self._gamma = aliased, gamma
        mdp = aliased.mdp
        self._observed = aliased.observation[mdp.s_tm1]  # of each row
        self._acting = np.flatnonzero(~mdp.is_terminal)
        self._firsts = mdp.row_starts[self._acting]
        self._follow = sparse.csr_array(sparse.diags_array(gamma * mdp.row_discount) @ mdp.transition)
        self._follow.eliminate_zeros()  # what is worth −∞ is not to be taken 0 times
        self._may_end = np.asarray(self._follow.sum(axis=1)) < 1 - 1e-9
        self._value, self._policy = -np.inf, np.where(aliased.legal.any(axis=1), 0, -1)
        self._num_bounds = 0

    def run(self, max_bounds: int) -> MemorylessSolution:
        """Until nothing is left that could be better."""
        mdp = self._aliased.mdp
        solution = solve(mdp, self._gamma)
        v = solution.v + solution.bound * ~mdp.is_terminal
        nobody = np.full(self._aliased.num_observations, -1)
        open_nodes = [_Node(nobody, v, float(mdp.start_distribution @ v))]
        while open_nodes and self._num_bounds < max_bounds:
            node = open_nodes.pop()
            if not self._is_hopeless(node.bound):
                children = map(self._bounded, self._children(node))
                open_nodes += sorted(children, key=lambda child: child.bound)
        left = max((node.bound for node in open_nodes), default=-np.inf)
        return MemorylessSolution(
            self._value, self._policy, max(left, self._value), self._num_bounds, self._is_hopeless(left)
        )

    def _is_hopeless(self, bound: float) -> bool:
        """Whether nothing that is worth no more than this can be better than what was found."""
        best = self._value + _CLOSE * max(abs(self._value), 1.0) if self._value > -np.inf else -np.inf
        return bound <= best

    def _allowed(self, policy: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Rows that are not against what is decided, ``[K]``."""
        decided = policy[self._observed]
        return np.asarray((decided < 0) | (decided == self._aliased.mdp.a_tm1))

    def _bounded(self, node: _Node) -> _Node:
        """The same with its values swept down until they stay, or are too low to be of interest."""
        self._num_bounds += 1
        start, reward = self._aliased.mdp.start_distribution, self._aliased.mdp.reward
        allowed = self._allowed(node.policy)
        v = node.v.copy()
        if self._gamma == 1:
            v[~self._may_come_to_an_end(allowed)] = -np.inf
        bound = _mean(start, v)
        for _ in range(max(_FEW_SWEEPS, 4 * len(start))):
            if self._is_hopeless(bound):
                break
            q = np.where(allowed, reward + self._follow @ v, -np.inf)
            after = np.minimum(v[self._acting], np.maximum.reduceat(q, self._firsts))
            finite = after > -np.inf
            change = float(np.max(v[self._acting][finite] - after[finite], initial=0.0))
            v[self._acting] = after
            bound = _mean(start, v)
            if change <= 1e-13 * max(abs(bound), 1.0):
                break
        return _Node(node.policy, v, bound)

    def _may_come_to_an_end(self, allowed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """States from which the end of the episode can be reached by these rows, ``[S]``; terminal ones too."""
        ends = self._aliased.mdp.is_terminal.copy()
        while True:
            leads = allowed & (self._may_end | (self._follow @ ends.astype(np.float64) > 0))
            more = ends.copy()
            more[self._acting] |= np.logical_or.reduceat(leads, self._firsts)
            if more.sum() == ends.sum():
                return ends
            ends = more

    def _children(self, node: _Node) -> list[_Node]:
        """One for each action of the observation that loses most by deciding; none if none is needed."""
        aliased, mdp = self._aliased, self._aliased.mdp
        q = mdp.reward + self._follow @ node.v
        matter = node.v[mdp.s_tm1] > -np.inf  # of the others nothing is expected anyhow
        losses = np.full((aliased.num_observations, mdp.num_actions), np.inf)
        losses[aliased.legal] = 0.0
        np.add.at(losses, (self._observed[matter], mdp.a_tm1[matter]), (node.v[mdp.s_tm1] - q)[matter])
        undecided = aliased.legal.any(axis=1) & (node.policy < 0)
        self._try(np.where(undecided, losses.argmin(axis=1), node.policy))
        if self._is_hopeless(node.bound) or not undecided.any():
            return []
        o = int(np.argmax(np.where(undecided, losses.min(axis=1), -np.inf)))
        decided = np.arange(len(undecided)) == o
        actions = np.flatnonzero(aliased.legal[o]).tolist()
        return [_Node(np.where(decided, a, node.policy), node.v, node.bound) for a in actions]

    def _try(self, policy: NDArray[np.int64]) -> None:
        """Takes a policy for the best so far if it is."""
        value = _value_from_start(self._aliased, policy, self._gamma)
        if value > self._value:
            self._value, self._policy = value, policy


def _mean(start: NDArray[np.float64], v: NDArray[np.float64]) -> float:
    """The expected value of the first state; what is worth −∞ and never comes first does not matter."""
    begins = start > 0
    return float(start[begins] @ v[begins])


def _value_from_start(aliased: AliasedMDP, policy: NDArray[np.int64], gamma: float) -> float:
    """The expected return of a deterministic policy, −∞ where it may go on for ever at γ = 1 (every step costs)."""
    mdp = aliased.mdp
    follow, reward = policy_process(mdp, np.maximum(policy, 0)[aliased.observation])
    reached = mdp.start_distribution > 0
    while (more := reached | (reached @ follow > 0)).sum() > reached.sum():
        reached = more
    inside = np.flatnonzero(reached)
    follow = sparse.csr_array(follow[inside][:, inside])
    if gamma == 1:
        ends = np.asarray(follow.sum(axis=1)) < 1 - 1e-9
        while (more := ends | (follow @ ends.astype(np.float64) > 0)).sum() > ends.sum():
            ends = more
        if not ends.all():
            return -np.inf
    system = sparse.csc_array(sparse.eye_array(len(inside)) - gamma * follow)
    return float(mdp.start_distribution[inside] @ splu(system).solve(reward[inside]))

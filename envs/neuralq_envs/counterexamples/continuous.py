"""Deterministic problems with continuous states: where a step leads, what it costs, and where it ends.

Costs are paid, not earned, as in the papers these problems come from. The optimal cost-to-go obeys

    J(s) = min_a [ c(s, a) + γ J(s') ],    J = 0 in the goal and wherever an episode has ended.

A program cannot sweep over a continuum, so fitted iteration backs up a finite *support* of states and lets a regressor
fill in the rest. `reachable_mdp` gives something to compare with: where steps are deterministic and of fixed length,
the states reachable from a support are often finitely many, and on them the problem is an ordinary finite model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq.types import Floats

__all__ = ["ContinuousModel", "Steps", "grid_support", "random_support", "reachable_mdp"]

_CELL = 1e-8  # states closer than this are one state that was reached by two sums of rounded steps


class Steps(NamedTuple):
    """What every action does in every state.

    Args:
        successor: ``[n, A, dim]``.
        cost: ``[n, A]``.
        ended: whether the episode ends on arrival, ``[n, A]``; the cost-to-go there is 0.
    """

    successor: Floats
    cost: Floats
    ended: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ContinuousModel:
    """A deterministic problem in a box of ℝᵈ with finitely many actions and a goal.

    Args:
        name: one word.
        low: lower corner of the box, ``[dim]``.
        high: upper corner, ``[dim]``.
        action_names: one per action.
        step: what every action does, ``[n, dim] -> Steps``.
        is_goal: which states are in the goal, ``[n, dim] -> [n]``.
        cost_to_go: J of γ = 1 in closed form, ``[n, dim] -> [n]``; None where none is known.
        title: how people call it.
        source: author and year.
        known: what is known of it.

    Raises:
        ValueError: corners that do not span a box.

    Example:
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> gridworld().step(np.array([[0.5, 0.92]])).ended.tolist()
        [[False, False, False, False]]
    """

    name: str
    low: Floats
    high: Floats
    action_names: tuple[str, ...]
    step: Callable[[Floats], Steps]
    is_goal: Callable[[Floats], NDArray[np.bool_]]
    cost_to_go: Callable[[Floats], Floats] | None = None
    title: str = ""
    source: str = ""
    known: str = ""

    def __post_init__(self) -> None:
        for field in ("low", "high"):
            corner = np.array(getattr(self, field), dtype=np.float64)
            corner.flags.writeable = False
            object.__setattr__(self, field, corner)
        if self.low.ndim != 1 or self.low.shape != self.high.shape or not (self.low < self.high).all():
            raise ValueError(f"low must lie below high in every dimension, got low={self.low} and high={self.high}")

    @property
    def num_actions(self) -> int:
        """A."""
        return len(self.action_names)


def grid_support(model: ContinuousModel, num_per_side: int) -> Floats:
    """A regular grid over the box, corners included, ``[num_per_side ** dim, dim]``; the last coordinate runs first.

    Raises:
        ValueError: fewer than two points per side.

    Example:
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> grid_support(gridworld(), 2).tolist()
        [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    check_whole("num_per_side", num_per_side, 2)
    axes = [np.linspace(lo, hi, num_per_side) for lo, hi in zip(model.low, model.high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def random_support(model: ContinuousModel, num_points: int, rng: np.random.Generator) -> Floats:
    """Points drawn uniformly from the box, ``[num_points, dim]``.

    Raises:
        ValueError: fewer than one point.

    Example:
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> random_support(gridworld(), 3, np.random.default_rng(0)).shape
        (3, 2)
    """
    check_whole("num_points", num_points)
    return rng.uniform(model.low, model.high, size=(num_points, len(model.low)))


def reachable_mdp(
    model: ContinuousModel, states: ArrayLike, *, max_states: int = 200_000
) -> tuple[FiniteMDP, NDArray[np.int64]]:
    """The finite model of all states that can be reached from these, and which of its states these are, ``[n]``.

    Rewards are minus the costs; goal states are terminal, and a step that ends elsewhere leads nowhere. Its optimal
    values are exactly −J.

    Args:
        model: the continuous problem.
        states: where to start, ``[n, dim]``.
        max_states: give up beyond so many.

    Raises:
        ValueError: more than ``max_states`` states; the reachable set may well be infinite.

    Example:
        >>> from neuralq_envs.counterexamples.boyan_moore import gridworld
        >>> mdp, index = reachable_mdp(gridworld(), [[0.9, 0.95], [0.95, 0.95]])
        >>> mdp.is_terminal[index].tolist()
        [False, True]
    """
    known: dict[tuple[int, ...], int] = {}
    start = _indices(np.asarray(states, dtype=np.float64), known)
    frontier = _first_of_each(np.asarray(states, dtype=np.float64), start, 0)
    rows: list[tuple[NDArray[np.int64], NDArray[np.int64], Floats, NDArray[np.int64]]] = []
    numbered = 0
    while len(frontier):
        number = numbered + np.arange(len(frontier))
        numbered += len(frontier)
        active = ~model.is_goal(frontier)
        steps = model.step(frontier[active])
        flat = steps.successor.reshape(-1, steps.successor.shape[-1])
        on = ~(steps.ended.reshape(-1) & ~model.is_goal(flat))  # a failure leads nowhere, the goal is a state
        target = np.full(len(flat), -1, dtype=np.int64)
        target[on] = _indices(flat[on], known)
        if len(known) > max_states:
            raise ValueError(
                f"more than max_states={max_states} states can be reached from these {len(start)}; "
                "start from fewer, or from points on a common grid of the step length"
            )
        a = np.tile(np.arange(model.num_actions), int(active.sum()))
        rows.append((np.repeat(number[active], model.num_actions), a, steps.cost.reshape(-1), target))
        frontier = _first_of_each(flat[on], target[on], numbered)
    s_tm1, a_tm1, cost, s_t = (np.concatenate(column) for column in zip(*rows, strict=True))
    leads = s_t >= 0
    transition = sparse.csr_array(
        (np.ones(int(leads.sum())), (np.flatnonzero(leads), s_t[leads])), shape=(len(s_t), len(known))
    )
    return FiniteMDP(len(known), model.num_actions, s_tm1, a_tm1, transition, -cost), start


def _indices(states: Floats, known: dict[tuple[int, ...], int]) -> NDArray[np.int64]:
    """Number of each state, a new one being numbered on first sight."""
    keys = np.round(states / _CELL).astype(np.int64).tolist()
    return np.array([known.setdefault(tuple(key), len(known)) for key in keys], dtype=np.int64)


def _first_of_each(states: Floats, number: NDArray[np.int64], begin: int) -> Floats:
    """One state for each number from ``begin`` on, in order."""
    fresh, first = np.unique(number, return_index=True)
    return states[first[fresh >= begin]]

"""Finite models and linear smoothers as sweeps of fitted iteration, and the model that an averager derives."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from neuralq.lab.fitted.diagnosis import is_averager
from neuralq.lab.fitted.iteration import Sweep
from neuralq.mdp import FiniteMDP

Floats = NDArray[np.float64]


def sweep_of_mdp(mdp: FiniteMDP, support: ArrayLike, hat: ArrayLike) -> Sweep:
    """A sweep over some states of a finite model, the others being filled in by a linear smoother.

    Costs are minus the rewards, so the run finds minus the values. A row's discount multiplies its hat row.

    Args:
        mdp: the model.
        support: numbers of the states that are backed up, ``[n]``.
        hat: H, ``[S, n]``; rows of terminal states count as 0.

    Raises:
        ValueError: a support that is no list of different states, or H of another shape.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[0.5, 0.5], [0.0, 1.0]]], [[1.0], [0.0]])
        >>> sweep_of_mdp(mdp, [0], [[1.0], [0.5]]).hat_next.tolist()
        [[0.75]]
    """
    states = np.asarray(support, dtype=np.int64)
    if states.ndim != 1 or len(np.unique(states)) != len(states) or not len(states):
        raise ValueError(f"support must list different states, got {states.tolist()}")
    if states.min() < 0 or states.max() >= mdp.num_states:
        raise ValueError(f"support must hold states in 0..{mdp.num_states - 1}, got {states.tolist()}")
    given = np.asarray(hat, dtype=np.float64)
    if given.shape != (mdp.num_states, len(states)):
        raise ValueError(f"hat must have shape ({mdp.num_states}, {len(states)}), got {given.shape}")
    smoother = np.where(mdp.is_terminal[:, None], 0.0, given)
    rows = mdp.row_index[states]
    legal = rows >= 0
    cost = np.where(legal, -mdp.reward[rows], np.inf)
    onward = mdp.row_discount[:, None] * (mdp.transition @ smoother)
    at_next = np.where(legal.reshape(-1)[:, None], onward[rows.reshape(-1)], 0.0)
    at_support = smoother[states]

    def look(y: Floats) -> tuple[Floats, Floats]:
        return at_support @ y, (at_next @ y).reshape(rows.shape)

    return Sweep(cost, look, mdp.is_terminal[states], at_next)


def derived_mdp(sweep: Sweep) -> FiniteMDP:
    """The model that fitted iteration with an averager solves: a step leads to point j with probability H(x', j).

    Its states are the support points, its rewards minus the costs; missing row mass ends the episode. The optimal
    values of this model, negated, are the fixed point y of fitted iteration.

    Raises:
        ValueError: the regressor is no averager, so there are no such probabilities.

    Source: Gordon 1995.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[0.5, 0.5], [0.0, 1.0]]], [[1.0], [0.0]])
        >>> derived_mdp(sweep_of_mdp(mdp, [0], [[1.0], [0.5]])).transition.toarray().tolist()
        [[0.75]]
    """
    if sweep.hat_next is None or not is_averager(sweep.hat_next):
        raise ValueError(
            "only an averager (hat rows >= 0 with sums <= 1) derives a model: use nearest neighbours, interpolation "
            "on a grid, aggregation or a kernel"
        )
    n, num_actions = sweep.cost.shape
    legal = np.isfinite(sweep.cost) & ~sweep.is_goal[:, None]
    hat = sparse.csr_array(sweep.hat_next)[np.flatnonzero(legal.reshape(-1))]
    hat.data = np.maximum(hat.data, 0.0)
    s_tm1, a_tm1 = np.nonzero(legal)
    return FiniteMDP(n, num_actions, s_tm1, a_tm1, hat, -sweep.cost[legal])

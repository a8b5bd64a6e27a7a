"""A domain theory of small networks: what a state earns and what follows it, learned from single steps beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.learners import SlopeNet, fit_slopes, new_slope_net
from neuralq.rules import return_slopes
from neuralq_envs.linear_quadratic import GAMMA, LAW, PUSH, rewards, successors

__all__ = ["HORIZON", "Theory", "explain", "learn_theory", "observe", "predict"]

Array = NDArray[np.float64]

HORIZON = 30
"""Steps of an episode that are observed and explained; what comes later is worth some 10⁻⁶."""
_SPREAD = 1.5  # of the states that the theory is learned from; episodes begin within 1
_NUM_HIDDEN, _STEP_SIZE = 16, 0.05


@dataclass(frozen=True, eq=False)
class Theory:
    """What was learned of the world before.

    Args:
        reward: of leaving a state.
        changes: by action, a network for each number of the state: how much that changes.
    """

    reward: SlopeNet
    changes: Mapping[int, tuple[SlopeNet, ...]]


def learn_theory(num_transitions: int, rng: np.random.Generator) -> Theory:
    """Fitted to that many transitions of each kind from states drawn uniformly within ±1.5.

    Raises:
        ValueError: fewer than one transition.

    Example:
        >>> theory = learn_theory(6, np.random.default_rng(0))
        >>> len(theory.changes[PUSH])
        2
    """
    check_whole("num_transitions", num_transitions)
    s = rng.uniform(-_SPREAD, _SPREAD, (num_transitions, 2))

    def learned(y: Array) -> SlopeNet:
        return fit_slopes(new_slope_net(2, _NUM_HIDDEN, rng), s, y, step_size=_STEP_SIZE)

    return Theory(learned(rewards(s)), {a: tuple(map(learned, (successors(s, a) - s).T)) for a in (PUSH, LAW)})


def observe(s: Array) -> tuple[Array, Array]:
    """An episode from each state that pushes once and follows the law from then on.

    Args:
        s: first states, ``[N, 2]``.

    Returns:
        The states that were left, ``[HORIZON, N, 2]``, and the discounted return, ``[N]``.

    Example:
        >>> left, returns = observe(np.array([[1.0, 0.0]]))
        >>> left.shape, left[1].tolist(), bool(-6 < returns[0] < -5)
        ((30, 1, 2), [[1.0, 0.3]], True)
    """
    left = [s, successors(s, PUSH)]
    while len(left) < HORIZON:
        left.append(successors(left[-1], LAW))
    return np.stack(left), _discounted(rewards(np.stack(left)))


def predict(theory: Theory, s: Array) -> Array:
    """The return that the theory expects from states, ``[N, 2]`` to ``[N]``, by its own successors alone.

    Example:
        >>> s = np.array([[0.5, 0.5]])
        >>> theory = learn_theory(200, np.random.default_rng(0))
        >>> bool(abs(predict(theory, s)[0] - observe(s)[1][0]) < 0.5)
        True
    """
    earned = []
    for step in range(HORIZON):
        earned.append(theory.reward.values(s))
        s = s + np.stack([net.values(s) for net in theory.changes[_action(step)]], axis=-1)
    return _discounted(np.stack(earned))


def explain(theory: Theory, left: Array) -> Array:
    """The slope of the return in the first state, by the theory's Jacobians in the states that were observed.

    Args:
        theory: what explains.
        left: states that were left, ``[T, N, 2]``.

    Returns:
        ``[N, 2]``.

    Example:
        >>> explain(learn_theory(6, np.random.default_rng(0)), np.zeros((30, 4, 2))).shape
        (4, 2)
    """
    changes = [
        np.stack([net.slopes(s) for net in theory.changes[_action(step)]], axis=-2) for step, s in enumerate(left)
    ]
    slopes = return_slopes(
        torch.from_numpy(theory.reward.slopes(left)),
        torch.full(left.shape[:-1], GAMMA, dtype=torch.float64),
        torch.from_numpy(np.eye(2) + np.stack(changes)),
        torch.zeros(left.shape[1:], dtype=torch.float64),
    )
    return slopes[0].numpy()


def _action(step: int) -> int:
    return PUSH if step == 0 else LAW


def _discounted(r: Array) -> Array:
    """The return of rewards ``[T, N]``."""
    return np.asarray(GAMMA ** np.arange(len(r)) @ r)

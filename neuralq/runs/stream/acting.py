"""ε-greedy action selection for a batch, compiled: `rules.sample(rules.epsilon_greedy(q, ε), u)` in one pass.

Acting happens at every environment step, and as tensor operations it would cost more than a small environment. The
rule stays the definition; tests/test_acting.py holds this to it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from neuralq.checks import check_fraction
from neuralq.jit import kernel
from neuralq.types import Array

__all__ = ["EpsilonGreedyPolicy", "choose_among", "choose_epsilon_greedy", "choose_greedy"]


@kernel
def _choose(q: Array, epsilon: float, u: Array, actions: Array, mu: Array) -> int:
    """Fill ``actions`` and ``mu``; returns the first row without a usable action value, or −1."""
    rows, num_actions = q.shape
    for i in range(rows):
        best, num_legal = -1, 0
        for j in range(num_actions):
            if q[i, j] != q[i, j] or q[i, j] == np.inf:
                return i
            if q[i, j] > -np.inf:
                num_legal += 1
                if best < 0 or q[i, j] > q[i, best]:
                    best = j
        if best < 0:
            return i
        each = epsilon / num_legal
        # Inverse distribution function over the legal actions in index order.
        reached, chosen, left = 0.0, best, u[i]
        for j in range(num_actions):
            if q[i, j] > -np.inf:
                mass = each + (1.0 - epsilon if j == best else 0.0)
                reached += mass
                if mass > 0:  # the last such action stays chosen where rounding leaves the sum below u
                    chosen = j
                    if left < reached:
                        break
        actions[i] = chosen
        mu[i] = each + (1.0 - epsilon if chosen == best else 0.0)
    return -1


def choose_among(q: Array, epsilon: float, u: Array) -> tuple[Array, Array]:
    """As `choose_epsilon_greedy`, from arrays to arrays.

    Example:
        >>> a, mu = choose_among(np.array([[0.0, 2.0]]), 0.5, np.array([0.9]))
        >>> a.tolist(), mu.tolist()
        ([1], [0.75])
    """
    if not 0.0 <= epsilon <= 1.0:
        check_fraction("epsilon", epsilon)
    if q.ndim != 2 or u.shape != q.shape[:1]:
        raise ValueError(
            f"action values must be [N, A] with N uniform numbers, got {q.shape} and {u.shape}; "
            "give a single observation a leading axis of one"
        )
    actions = np.empty(len(q), np.int64)
    mu = np.empty(len(q), np.float32)
    row = _choose(q, epsilon, u, actions, mu)
    if row >= 0:
        raise ValueError(
            f"cannot choose an action in environment {row} from the values {q[row].tolist()}: NaN or inf means "
            "that training diverged (try a smaller step size), all −inf that the action mask allows nothing"
        )
    return actions, mu


def choose_epsilon_greedy(q: Tensor, epsilon: float, u: Array) -> tuple[Tensor, Tensor]:
    """ε-greedy actions and the probability of each.

    Args:
        q: action values ``[N, A]``, −∞ for illegal actions.
        epsilon: in [0, 1]; its mass is spread over the legal actions, the greedy one included. Ties go to the
            lowest index.
        u: uniform numbers in [0, 1), ``[N]`` float64.

    Returns:
        Actions ``[N]`` int64 and their probabilities ``[N]`` float32, on the CPU.

    Raises:
        ValueError: if a row holds NaN or +∞ (the learner has diverged) or no legal action (the environment gave an
            empty mask), if ``epsilon`` is not in [0, 1], or if there is not one number per row.

    Example:
        >>> a, mu = choose_epsilon_greedy(torch.tensor([[0.0, 2.0]]), 0.5, np.array([0.9]))
        >>> a.tolist(), mu.tolist()
        ([1], [0.75])
    """
    actions, mu = choose_among(q.detach().cpu().numpy(), epsilon, u)
    return torch.from_numpy(actions), torch.from_numpy(mu)


def choose_greedy(q: Tensor) -> tuple[Tensor, Tensor]:
    """Greedy actions ``[N]`` and probability one for each; ties go to the lowest index.

    Example:
        >>> choose_greedy(torch.tensor([[1.0, 1.0], [0.0, 3.0]]))[0].tolist()
        [0, 1]
    """
    return choose_epsilon_greedy(q, 0.0, np.zeros(len(q)))


class EpsilonGreedyPolicy:
    """A policy that draws from ``rng`` and looks up ε at every step.

    Args:
        values: observations ``[N, *obs]`` to action values ``[N, A]``.
        epsilon: the present ε, usually a schedule of a counter.
        rng: drawn from once per environment and step.
        array_values: ``values`` from arrays to arrays, where the engine has it: a stream then asks `on_arrays`, and no
            tensor is made for one step, which would cost as much as the values of a small network.

    Example:
        >>> policy = EpsilonGreedyPolicy(lambda s: -s, lambda: 0.0, np.random.default_rng(0))
        >>> policy(torch.tensor([[1.0, 0.0]]))[0].tolist()
        [1]
    """

    def __init__(
        self,
        values: Callable[[Tensor], Tensor],
        epsilon: Callable[[], float],
        rng: np.random.Generator,
        array_values: Callable[[Array], Array] | None = None,
    ) -> None:
        self._values, self._epsilon, self._rng = values, epsilon, rng
        self._array_values = array_values
        self.on_arrays = None if array_values is None else self._choose

    def __call__(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Actions ``[N]`` and the probability of each."""
        return choose_epsilon_greedy(self._values(s), self._epsilon(), self._rng.random(s.shape[0]))

    def _choose(self, s: Array) -> tuple[Array, Array]:
        """The same for an array of observations, with the same draws."""
        assert self._array_values is not None
        return choose_among(self._array_values(s), self._epsilon(), self._rng.random(len(s)))
